"""Constants of accelerometers, gyroscopes that feel forces or are late: tumbling tells of them."""

import numpy as np
import pytest

from imu_fusion.samples.lasting_errors import check_field_errors, check_force_errors
from imu_fusion.samples.logs import ImuLog
from imu_fusion.simulation.going_round import Walk
from imu_fusion.simulation.rotation import Sensors, Tumbling, simulate

# Errors that any sensor has, so that none of them is taken for another.
USUAL = Sensors(gyr_density=3e-4, acc_density=2e-3, mag_sd=4e-7, gyr_bias=(0.02, -0.03, 0.01),
                gyr_matrix=((1.01, 0.005, 0.0), (-0.003, 0.99, 0.004), (0.002, 0.0, 1.015)),
                acc_bias=(0.05, -0.08, 0.1), mag_offset=(3e-6, -4e-6, 2e-6), mag_delay=0.01)


def recording(seed, duration=25.0, **motion):
    """ImuLog and MagLog of a body that tumbles and is shaken."""
    return simulate(Tumbling(seed=seed, **motion), duration, rate=100.0, sensors=USUAL,
                    seed=seed)[:2]


def changed(imu, gyr=None, acc=None):
    return ImuLog(imu.stamp, imu.gyr if gyr is None else gyr, imu.acc if acc is None else acc)


@pytest.mark.parametrize("seed,motion", [
    (1, {}), (2, {"travel_sd": 0.02}), (3, {"rate_sd": 0.5}), (4, {"rate_sd": 6.0}),
    (5, {"travel_sd": 1.0}), (6, {"duration": 70.0})])
def test_what_any_sensor_has_gets_no_word(seed, motion):
    imu, mag = recording(seed, **motion)
    imu.acc[len(imu) // 2] += [300.0, -500.0, 800.0]    # once, as buses do
    assert check_force_errors(imu, "imu") + check_field_errors(imu, mag, "mag") == []


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("off", [1.0, -1.5])
def test_an_axis_of_the_accelerometer_that_is_off_is_told_by_how_much(axis, off):
    imu, _ = recording(7 + axis)
    (finding,) = check_force_errors(changed(imu, acc=imu.acc + off * np.eye(3)[axis]), "imu")
    said = [float(v) for v in finding.text.split("(")[1].split(")")[0].split(",")]
    np.testing.assert_allclose(said, USUAL.acc_bias + off * np.eye(3)[axis], atol=0.4)


@pytest.mark.parametrize("feels", [0.01 * np.eye(3), np.diag([0.0, -0.01, 0.0]),
                                   np.array([[0, 0.01, 0], [0, 0, 0], [0, 0, 0.0]])])
def test_a_gyroscope_that_feels_forces_is_told_by_the_field(feels):
    imu, mag = recording(10)
    (finding,) = check_field_errors(changed(imu, gyr=imu.gyr + imu.acc @ feels.T), mag, "mag")
    said = float(finding.text.split("up to ")[1].split()[0])
    assert abs(said) == pytest.approx(10.0, abs=1.5)
    assert np.sign(said) == np.sign(feels.sum())


@pytest.mark.parametrize("late", [-0.06, 0.1])
def test_a_gyroscope_that_is_late_is_told_by_gravity_however_it_is_shaken(late):
    imu, _ = recording(11)
    t = (imu.stamp - imu.stamp[0]) * 1e-9
    gyr = np.column_stack([np.interp(t - late, t, rate) for rate in imu.gyr.T])
    (finding,) = check_force_errors(changed(imu, gyr=gyr), "imu")
    said = float(finding.text.split("were ")[1].split()[0]) * (1 if "later" in finding.text else -1)
    assert said == pytest.approx(late * 1e3, abs=12.0)


def test_forces_that_turn_with_whoever_goes_round_are_no_constant():
    imu, mag, _, _ = simulate(Walk(202), 63.0, rate=100.0, sensors=USUAL, seed=202)
    assert check_force_errors(imu, "imu") + check_field_errors(imu, mag, "mag") == []


def test_a_body_that_does_not_tumble_or_a_clipped_gyroscope_tells_nothing():
    imu, mag = recording(12)
    still = changed(imu[:1000], gyr=0.0 * imu.gyr[:1000], acc=0.0 * imu.acc[:1000] + [1.0, 0, 9.8])
    one_axis = changed(imu, gyr=imu.gyr * [1.0, 0.0, 0.0])
    clipped = changed(imu, gyr=np.clip(imu.gyr, -3.0, 3.0))
    for log in (still, one_axis, clipped, imu[:100], imu[:0]):
        assert check_force_errors(log, "imu") + check_field_errors(log, mag, "mag") == []
