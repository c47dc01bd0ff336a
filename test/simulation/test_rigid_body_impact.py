"""Mechanics of the simulated impact."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_fusion.errors import EstimationError
from imu_fusion.simulation.rigid_body_impact import (
    PAPER_AXES,
    PAPER_PARTICLE,
    PAPER_POSITIONS,
    ImpactScene,
    contact_shape_factor,
    simulate,
)


@pytest.fixture(scope="module")
def motion():
    return simulate(duration=1.0)


def _energy(motion, scene):
    axes2 = np.square(scene.semi_axes)
    inertia = (axes2.sum() - axes2) / 5
    return (0.5 * np.sum(motion.velocity ** 2, axis=1)
            + 0.5 * np.sum(inertia * motion.omega ** 2, axis=1)
            + scene.gravity * motion.position[:, 2])


def test_energy_changes_by_the_work_of_the_contact_force():
    # The law of the paper is not conservative for an ellipsoid: its force depends on the
    # curvature at the contact, hence on the orientation, without a torque to match. The energy
    # must still change by exactly the work of the force at the material point of contact.
    scene = ImpactScene()
    motion = simulate(scene, duration=0.9, step=1e-5, every=1)
    rotation = Rotation.from_quat(motion.quat)
    up = rotation.inv().apply([0, 0, 1.0])
    scaled = np.square(scene.semi_axes) * up
    contact = -scaled / np.sqrt(np.sum(scaled * up, axis=1))[:, None]
    speed = motion.velocity[:, 2] + rotation.apply(np.cross(motion.omega, contact))[:, 2]
    load = motion.acceleration_world([0, 0, scene.height])[:, 2] + scene.gravity
    assert 0.1 < np.mean(load > 1e-6) < 0.5  # the impact of the paper is in the record
    work = np.sum(0.5 * (load[1:] * speed[1:] + load[:-1] * speed[:-1])) * 1e-5
    energy = _energy(motion, scene)
    # Trapezoid and scheme are of second order in 1e-5 s.
    assert energy[-1] - energy[0] == pytest.approx(work, abs=1e-5)
    assert abs(work) > 0.1


def test_free_flight_conserves_angular_momentum(motion):
    scene = ImpactScene()
    axes2 = np.square(scene.semi_axes)
    inertia = (axes2.sum() - axes2) / 5
    flight = motion.t < 0.45
    momentum = Rotation.from_quat(motion.quat[flight]).apply(inertia * motion.omega[flight])
    assert np.abs(momentum - momentum[0]).max() < 1e-9 * np.linalg.norm(momentum[0])


def test_acceleration_is_the_second_derivative_of_position(motion):
    scene = ImpactScene()
    dense = simulate(duration=0.7, step=1e-5, every=10)
    lever = PAPER_PARTICLE - [0, 0, scene.height]
    place = dense.position + Rotation.from_quat(dense.quat).apply(lever)
    numeric = (place[2:] - 2 * place[1:-1] + place[:-2]) / 1e-8
    exact = dense.acceleration_world(PAPER_PARTICLE)[1:-1]
    # Central differences at 1e-4 s: truncation and rounding are below 1e-3 of the peak.
    assert np.abs(numeric - exact).max() < 1e-3 * np.abs(exact).max()


def test_specific_force_is_acceleration_minus_gravity(motion):
    felt = motion.readings(PAPER_POSITIONS, PAPER_AXES)
    moved = motion.readings(PAPER_POSITIONS, PAPER_AXES, "acceleration")
    up = Rotation.from_quat(motion.quat).inv().apply([0, 0, 9.8])
    assert np.allclose(felt - moved, np.einsum("kij,nj->nki", PAPER_AXES, up), atol=1e-12)


def test_sphere_obeys_hertz():
    # Hertz: force 4/3 E / (1 - nu^2) sqrt(R) d^1.5; a sphere dropped without spin reaches
    # v^2 / 2 = 8/15 E* sqrt(R) / m d^2.5 at its lowest point (gravity neglected: set to zero).
    radius, mass, speed = 0.1, 2.0, 3.0
    scene = ImpactScene(semi_axes=(radius,) * 3, mass=mass, ground=0.0, gravity=0.0,
                        position=(0, 0, radius + 1e-3), velocity=(0, 0, -speed), omega=(0, 0, 0),
                        height=0.0)
    motion = simulate(scene, duration=0.2, step=1e-5, every=1)
    deepest = radius - motion.position[:, 2].min()
    stiffness = scene.modulus / (1 - scene.poisson ** 2) * np.sqrt(radius) / mass
    assert deepest == pytest.approx((speed ** 2 * 15 / 16 / stiffness) ** 0.4, rel=1e-6)
    assert motion.velocity[-1, 2] == pytest.approx(speed, rel=1e-6)


def test_contact_shape_factor_of_a_sphere():
    assert contact_shape_factor(1.0) == pytest.approx(np.sqrt(2) / np.pi, rel=1e-12)
    # Continuous towards the sphere, and smaller for a blade.
    assert contact_shape_factor(1 - 1e-6) == pytest.approx(np.sqrt(2) / np.pi, rel=1e-5)
    assert contact_shape_factor(0.05) < contact_shape_factor(0.5)


def test_integration_is_of_second_order():
    coarse, middle, fine = (simulate(duration=0.8, step=h, every=round(0.1 / h)).position[-1]
                            for h in (4e-4, 2e-4, 1e-4))
    assert 3 < np.linalg.norm(coarse - middle) / np.linalg.norm(middle - fine) < 5


def test_blade_is_refused():
    with pytest.raises(EstimationError, match="semi axes"):
        simulate(ImpactScene(semi_axes=(1.0, 0.001, 0.001)))
