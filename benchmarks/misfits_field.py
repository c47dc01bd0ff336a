"""Situations of :mod:`benchmarks.misfits`: accelerometers on a rigid body."""

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.scenarios import LIMIT, Outcome, Scenario
from imu_fusion.errors import EstimationError, LayoutError
from imu_fusion.estimation.acceleration_field.estimator import AccelerationFieldEstimator
from imu_fusion.estimation.acceleration_field.params import (
    AccelerationFieldParams,
    AccelerometerParams,
    Initial,
)
from imu_fusion.simulation.rigid_body_impact import (
    PAPER_AXES,
    PAPER_POSITIONS,
    ImpactScene,
    RigidMotion,
)
from imu_fusion.simulation.rigid_body_impact import simulate as simulate_impact

# Samples of the field that are not judged: its first ones know nothing of the acceleration.
_START = 50
CENTRE = np.array([0.0, 0.0, 0.75])
PLACES = PAPER_POSITIONS - CENTRE
NAMES = ("top", "left", "front", "back")
NOISE, BIAS = 0.3, 0.1    # m/s^2
FIELD = AccelerationFieldParams(initial=Initial(
    mode="given", angular_velocity=(5.0, 5.0, 5.0), angular_velocity_sd=0.05,
    orientation_sd=0.002), gravity=9.8)
MOTION = simulate_impact(duration=1.0)
# Falls at 3 m/s onto ground that is up to ten thousand times harder than the paper's.
HARD = {modulus: simulate_impact(ImpactScene(modulus=modulus, ground=0.6, velocity=(0.75, 0.0, -3.0),
                                             mass=4.5), duration=0.3, step=5e-6, every=200)
        for modulus in (1e5, 1e6, 1e7, 1e8)}
FAST = simulate_impact(ImpactScene(modulus=1e6, ground=0.6, velocity=(0.75, 0.0, -3.0), mass=4.5),
                       duration=0.3, step=5e-6, every=100)
# Free flights that turn by some 12 rad/s, sampled slowly.
SLOW = {rate: simulate_impact(ImpactScene(ground=-1e9, omega=(3.0, 10.0, 5.0)), duration=10.0,
                              step=2.5e-4, every=round(4000 / rate)) for rate in (10, 20, 50)}


def layout(**changes) -> dict[str, AccelerometerParams]:
    """The four accelerometers of the paper about the centre of its ellipsoid."""
    return {name: AccelerometerParams(
        position=tuple(place), axes=tuple(axes.ravel()),
        **({"noise_density": NOISE / 1000 ** 0.5, "bias_sd": BIAS} | changes))
        for name, place, axes in zip(NAMES, PLACES, PAPER_AXES)}


def felt(rng, position_sd=0.0, axes_sd=0.0, places=PLACES, jitter=0.0,
         motion: RigidMotion = MOTION) -> np.ndarray:
    """Readings (n, 4, 3) of an impact."""
    places = places + CENTRE + position_sd * rng.standard_normal(places.shape)
    axes = np.array([a @ Rotation.from_rotvec(axes_sd * rng.standard_normal(3)).as_matrix().T
                     for a in PAPER_AXES])
    clean = motion.readings(places, axes)
    if jitter:
        t = motion.t
        for k in range(len(places)):
            at = np.clip(t + rng.normal(0.0, jitter, len(t)), 0.0, t[-1])
            clean[:, k] = np.column_stack([np.interp(at, t, clean[:, k, i]) for i in range(3)])
    return (clean + rng.normal(0.0, BIAS, (1, *clean.shape[1:]))
            + rng.normal(0.0, NOISE, clean.shape))


def field_outcome(readings, accelerometers, params=FIELD, motion=MOTION, start=_START,
                  gyr=None) -> Outcome:
    """Outcome of one recording of an impact, without its first ``start`` samples."""
    estimator = AccelerationFieldEstimator(params, accelerometers)
    rows = estimator.run(motion.stamp, readings, gyr)[start:]
    force = motion.specific_force_body(CENTRE)[start:]
    errors = {
        "omega": motion.omega[start:] - rows["omega"],
        "specific_force": force - rows["specific_force"],
        "attitude": (Rotation.from_quat(rows["quat"]).inv()
                     * Rotation.from_quat(motion.quat[start:])).as_rotvec()}
    nees, shares = [], []
    for name, error in errors.items():
        cov = rows["cov_" + name] + 1e-15 * np.eye(3)
        nees.append(np.mean(np.einsum("ni,nij,nj->n", error, np.linalg.inv(cov), error)))
        shares.append(np.mean(np.abs(error) <= 3 * np.sqrt(np.einsum("nii->ni", cov))))
    # In a free flight nothing is felt at the centre: there the angular velocity is compared.
    name, size, unit = ("specific_force", np.linalg.norm(force), "%")
    if size < 1e-6:
        name, size, unit = "omega", 100.0 * np.sqrt(len(rows)), "rad/s"
    sd = np.sqrt(np.sum(np.trace(rows["cov_" + name], axis1=1, axis2=2)))
    return Outcome(100 * np.linalg.norm(errors[name]) / size, 100 * sd / size, unit,
                   max(nees), min(shares), estimator.remarks())


def field_row(situation, before, readings, changes=None, **params) -> Scenario:
    """Scenario of readings(rng) -> (n, 4, 3)."""
    def run(seed):
        return field_outcome(readings(np.random.default_rng(seed)), layout(**(changes or {})),
                             FIELD.replace(**params))
    return Scenario("Acceleration field", situation, before, run)


def gyro_row(situation, before, bias=0.0, delay=0.0, scale_sd=0.0, scale=1.0) -> Scenario:
    """Scenario with a gyroscope, 1 mm and 2 deg off."""
    params = FIELD.replace(**{"use_gyro": True, "sensor.gyro_noise_density": 0.02 / 1000 ** 0.5})

    def run(seed):
        rng = np.random.default_rng(seed)
        readings = felt(rng, 1e-3, 0.035)
        gyr = np.column_stack([np.interp(MOTION.t - delay, MOTION.t, rate)
                               for rate in MOTION.omega.T])
        gyr = (scale * gyr * (1.0 + scale_sd * rng.standard_normal(3)) + bias * np.sign(rng.normal(size=3))
               + rng.normal(0.0, 0.02, gyr.shape))
        return field_outcome(readings, layout(), params, gyr=gyr)
    return Scenario("Acceleration field", situation, before, run)


def hard_row(modulus, rig, before="", mode="causal", **mounting) -> Scenario:
    """Scenario of a hard impact."""
    motion = HARD[modulus]
    peak = np.linalg.norm(motion.specific_force_body(CENTRE), axis=1)

    def run(seed):
        return field_outcome(felt(np.random.default_rng(seed), motion=motion, **mounting), layout(),
                             FIELD.replace(mode=mode), motion, start=20)
    return Scenario("Acceleration field", f"impact of {peak.max() / 9.81:.0f} g, "
                    f"{np.sum(peak > 2.0)} ms, {rig}, defaults"
                    + (", smoothed" if mode == "smoothed" else ""), before, run)


def slow_row(rate, before, mode="causal") -> Scenario:
    """Scenario of slow samples."""
    motion = SLOW[rate]
    params = FIELD.replace(sample_rate=float(rate), mode=mode, initial=FIELD.initial.replace(
        angular_velocity=(3.0, 10.0, 5.0)))

    def run(seed):
        readings = felt(np.random.default_rng(seed), 1e-3, 0.035, motion=motion)
        return field_outcome(readings, layout(noise_density=NOISE / rate ** 0.5), params, motion,
                             start=20)
    return Scenario("Acceleration field", f"turning at 12 rad/s, sampled at {rate} Hz, 1 mm and "
                    "2 deg off, defaults" + (", smoothed" if mode == "smoothed" else ""), before, run)


def dies(rng):
    readings = felt(rng)
    readings[300:, 1] = 0.0
    return readings


def reversed_one(rng):
    readings = felt(rng)
    readings[:, 0] *= -1.0
    return readings


def exchanged(rng):
    readings = felt(rng)
    readings[:, [0, 1]] = readings[:, [1, 0]]
    return readings


def misplaced(rng):
    places = PLACES.copy()
    places[2] += [-0.05, 0.03, 0.02]
    return felt(rng, places=places)


def half(rng):
    readings = felt(rng)
    readings[:, 1] *= 0.5
    return readings


def late_by_three(rng):
    readings = felt(rng)
    readings[3:, 1] = readings[:-3, 1].copy()
    return readings


def axes_exchanged(rng):
    readings = felt(rng, 1e-3, 0.035)
    readings[:, 1] = readings[:, 1][:, [1, 0, 2]]
    return readings


def a_fifth_lost(rng):
    readings = felt(rng, 1e-3, 0.035)
    readings[rng.random(len(readings)) < 0.2, 1] = np.nan
    return readings


def biased(rng):
    readings = felt(rng, 1e-3, 0.035)
    readings[:, 1, 0] += 2.0
    return readings


def filtered(rng):
    """A first-order low-pass of 5 ms."""
    readings = felt(rng, 1e-3, 0.035)
    share = 1.0 - np.exp(-1e-3 / 5e-3)
    for n in range(1, len(readings)):
        readings[n, 1] = readings[n - 1, 1] + share * (readings[n, 1] - readings[n - 1, 1])
    return readings


def drifting(rng):
    readings = felt(rng, 1e-3, 0.035)
    end = rng.choice([-1.0, 1.0], (1, *readings.shape[1:]))
    return readings + MOTION.t[:, None, None] * end


def all_filtered(rng):
    """A first-order low-pass of 5 ms that all have in common."""
    readings = felt(rng, 1e-3, 0.035)
    share = 1.0 - np.exp(-1e-3 / 5e-3)
    for n in range(1, len(readings)):
        readings[n] = readings[n - 1] + share * (readings[n] - readings[n - 1])
    return readings


def seldom(rng):
    readings = felt(rng, 1e-3, 0.035)
    readings[np.arange(len(readings)) % 10 != 0, 1] = np.nan
    return readings


def spinning_row(speed, axis, use_gyro, before) -> Scenario:
    """Scenario of a body that turns steadily from the first sample on, and is said to be still."""
    t = np.arange(3000) * 1e-3
    stamp = np.round(t * 1e9).astype(np.int64)
    axis = np.array(axis) / np.linalg.norm(axis)
    omega = np.tile(speed * axis, (len(t), 1))
    up = Rotation.from_rotvec(-np.outer(speed * t, axis)).apply([0.0, 0.0, 9.8])
    spun = np.cross(omega[0], np.cross(omega[0], PLACES))
    params = AccelerationFieldParams(gravity=9.8, use_gyro=use_gyro)
    if use_gyro:
        params = params.replace(**{"sensor.gyro_noise_density": 0.02 / 1000 ** 0.5})

    def run(seed):
        rng = np.random.default_rng(seed)
        readings = np.einsum("kij,nkj->nki", PAPER_AXES, up[:, None] + spun)
        readings += rng.normal(0.0, BIAS, (1, 4, 3)) + rng.normal(0.0, NOISE, readings.shape)
        gyr = omega + rng.normal(0.0, 0.02, omega.shape) if use_gyro else None
        estimator = AccelerationFieldEstimator(params, layout())
        try:
            rows = estimator.run(stamp, readings, gyr)
        except EstimationError as error:
            return Outcome(said=[str(error)], refused=True)
        error = speed * axis - rows["omega"]
        nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(rows["cov_omega"]), error)
        sd = np.sqrt(np.mean(np.trace(rows["cov_omega"], axis1=1, axis2=2)))
        return Outcome(np.sqrt(np.mean(np.sum(error ** 2, axis=1))), sd, "rad/s", nees.mean(),
                       np.mean(nees < LIMIT), estimator.remarks())
    about = "the vertical" if axis[2] == 1.0 else "a horizontal axis"
    return Scenario("Acceleration field", f"spins at {speed} rad/s about {about} from the first "
                    "sample on, said to be still" + (", with a gyroscope" if use_gyro else ""),
                    before, run)


def scales_off(rng):
    readings = felt(rng, 1e-3, 0.035)
    return readings * (1.0 + 0.01 * rng.standard_normal((1, *readings.shape[1:])))


def few_channels_row(situation, before, measured, motion, spoil=lambda readings: readings,
                     start=20) -> Scenario:
    """Scenario of sensors that measure only some of their axes each, at random places and in random
    directions, 1 mm and 2 deg off, defaults."""
    rate = 1.0 / (motion.t[1] - motion.t[0])
    random = np.random.default_rng(1)
    places = random.uniform(-0.12, 0.12, (len(measured), 3))
    axes = Rotation.random(len(measured), random_state=1)
    sensors = {f"s{k}": AccelerometerParams(
        position=tuple(place), axes=tuple(own.ravel()), measured_axes=tuple(letters), bias_sd=BIAS,
        noise_density=NOISE / rate ** 0.5)
        for k, (place, own, letters) in enumerate(zip(places, axes.as_matrix(), measured))}
    params = FIELD.replace(sample_rate=rate, initial=FIELD.initial.replace(
        angular_velocity=tuple(motion.omega[0])))

    def run(seed):
        rng = np.random.default_rng(seed)
        turned = Rotation.from_rotvec(0.035 * rng.standard_normal(places.shape)) * axes
        readings = motion.readings(CENTRE + places + 1e-3 * rng.standard_normal(places.shape),
                                   turned.as_matrix())
        readings += rng.normal(0.0, BIAS, (1, *readings.shape[1:]))
        readings += rng.normal(0.0, NOISE, readings.shape)
        return field_outcome(spoil(readings), sensors, params, motion, start)
    return Scenario("Acceleration field", situation, before, run)


def fifth_stands_still(readings):
    readings[100:, 4] = readings[100, 4]
    return readings


def second_in_g(readings):
    readings[:, 1] /= 9.81
    return readings


def six_uniaxial(seed):
    rng = np.random.default_rng(seed)
    places, axes = rng.uniform(-0.1, 0.1, (6, 3)), Rotation.random(6, random_state=seed)
    try:
        AccelerationFieldEstimator(FIELD, [
            AccelerometerParams(position=tuple(place), axes=tuple(axis.ravel()),
                                measured_axes=("x",))
            for place, axis in zip(places, axes.as_matrix())])
    except LayoutError as error:
        return Outcome(said=[str(error)], refused=True)
    return Outcome(nees=np.inf)


FIELD_ROWS = [
    field_row("clean, mounting known exactly (sd 0)", "", felt,
              {"position_sd": 0.0, "axes_sd": 0.0, "scale_sd": 0.0}),
    field_row("clean, defaults", "", felt),
    field_row("clean, defaults, smoothed", "", felt, mode="smoothed"),
    field_row("positions off by 1 mm", "NEES 4,600", lambda rng: felt(rng, position_sd=1e-3)),
    field_row("axes off by 2 deg", "NEES 29,000", lambda rng: felt(rng, axes_sd=0.035)),
    field_row("both", "", lambda rng: felt(rng, position_sd=1e-3, axes_sd=0.035)),
    field_row("both, smoothed", "", lambda rng: felt(rng, position_sd=1e-3, axes_sd=0.035),
              mode="smoothed"),
    *(hard_row(modulus, "exact rig", f"NEES {before}")
      for modulus, before in zip(HARD, (10, 990, 27, 67))),
    *(hard_row(modulus, "1 mm and 2 deg off", f"NEES {before}", position_sd=1e-3, axes_sd=0.035)
      for modulus, before in zip(HARD, (13, 930, 170, 98))),
    *(hard_row(modulus, "1 mm and 2 deg off", before, "smoothed", position_sd=1e-3, axes_sd=0.035)
      for modulus, before in ((1e6, "NEES 1,190"), (1e7, "NEES 1,320"))),
    slow_row(10, ""), slow_row(20, ""), slow_row(50, ""),
    slow_row(20, "", "smoothed"),
    field_row("one of four dies", "3,406 %, silent", dies),
    field_row("one of four reversed", "peak -29 %, silent", reversed_one),
    field_row("one of four 62 mm from its place", "HIC15 +56 %, silent", misplaced),
    field_row("two of four exchanged", "silent", exchanged),
    Scenario("Acceleration field", "six uni-axial accelerometers", "2,600 %", six_uniaxial),
    field_row("clipped at 20 m/s^2, no range given", "NEES 4e5",
              lambda rng: np.clip(felt(rng), -20.0, 20.0)),
    field_row("clipped at 80 m/s^2, no range given", "", lambda rng: np.clip(felt(rng), -80, 80)),
    field_row("clipped at 80 m/s^2, range: 80 as the remark says", "",
              lambda rng: np.clip(felt(rng), -80, 80), {"range": (80.0,)}),
    field_row("clipped at 78.4532, range: 78.453", "detection off",
              lambda rng: np.clip(felt(rng), -78.4532, 78.4532), {"range": (78.4533,)}),
    field_row("jitter of 2 ms that no stamp tells", "NEES 190",
              lambda rng: felt(rng, jitter=2e-3)),
    field_row("the same, noise_scale raised as the remark says", "",
              lambda rng: felt(rng, jitter=2e-3), noise_scale=10.0),
    field_row("one of four reads half", "", half),
    field_row("one of four is 3 ms late", "", late_by_three),
    field_row("x and y of one of four exchanged, 1 mm and 2 deg off", "", axes_exchanged),
    field_row("a fifth of the samples of one of four lost, 1 mm and 2 deg off", "", a_fifth_lost),
    field_row("rounded to 2 m/s^2", "", lambda rng: np.round(felt(rng) / 2.0) * 2.0),
    field_row("the same, noise_density and bias_sd as the remark says", "",
              lambda rng: np.round(felt(rng) / 2.0) * 2.0,
              {"noise_density": 2.0 / 1000 ** 0.5, "bias_sd": 0.58}),
    field_row("scale of each axis off by 1 %, 1 mm and 2 deg off", "NEES 124", scales_off),
    field_row("scale of each axis off by 1 %, 1 mm and 2 deg off, smoothed", "", scales_off,
              mode="smoothed"),
    field_row("one of four with a bias of 2 m/s^2 (bias_sd 0.1), 1 mm and 2 deg off", "silent",
              biased),
    field_row("one of four behind a low-pass of 5 ms, 1 mm and 2 deg off", "", filtered),
    field_row("one of four at a tenth of the rate, 1 mm and 2 deg off", "", seldom),
    field_row("biases drift by 1 m/s^2 in 1 s (bias_walk 0), 1 mm and 2 deg off", "", drifting),
    field_row("the same, sensor.acc_bias_walk as the remark says", "", drifting,
              **{"sensor.acc_bias_walk": 1.0}),
    field_row("all behind a low-pass of 5 ms, 1 mm and 2 deg off", "", all_filtered),
    field_row("given rate off by 1 rad/s, 1 mm and 2 deg off", "",
              lambda rng: felt(rng, position_sd=1e-3, axes_sd=0.035),
              initial=FIELD.initial.replace(angular_velocity=(6.0, 5.0, 5.0))),
    *(spinning_row(speed, axis, use_gyro, "silent") for speed, axis, use_gyro in (
        (0.6, (1.0, 0.0, 0.0), False), (1.7, (0.0, 0.0, 1.0), True), (5.0, (0.0, 0.0, 1.0), False),
        (1.7, (0.0, 0.0, 1.0), False))),
    gyro_row("with a gyroscope", ""),
    gyro_row("with a gyroscope whose scales are off by 10 %", "silent", scale=1.1),
    gyro_row("with a gyroscope whose scales are off by 1 %", "", scale_sd=0.01),
    gyro_row("with a gyroscope whose bias is 0.3 rad/s (gyro_bias_sd 0.02)", "silent", bias=0.3),
    gyro_row("with a gyroscope that is 10 ms late", "silent in 1 of 3", delay=0.01),
    few_channels_row("twelve uni-axial accelerometers, 55 g, 2 kHz", "NEES 16", ["x"] * 12, FAST),
    few_channels_row("one of twelve uni-axial accelerometers stands still", "NEES 28, silent",
                     ["x"] * 12, MOTION, fifth_stands_still),
    few_channels_row("three tri-axial and a uni-axial one", "", ["xyz"] * 3 + ["x"], MOTION),
    few_channels_row("the same, one in g", "NaN", ["xyz"] * 3 + ["x"], MOTION, second_in_g),
]
