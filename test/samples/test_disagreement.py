"""Gyroscopes that are late, of another scale or of another body; axes that stand still."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_fusion.samples.checks import check_imu
from imu_fusion.samples.disagreement import check_agreement, check_field_agreement
from imu_fusion.samples.logs import ImuLog, MagLog
from imu_fusion.samples.standing import check_standing
from imu_fusion.simulation.rotation import Sensors, Tumbling, simulate

SENSORS = Sensors(gyr_density=2e-4, acc_density=2e-3, gyr_bias=(0.01, -0.02, 0.005))


def recording(seed, travel_sd=0.01):
    return simulate(Tumbling(seed=seed, travel_sd=travel_sd, quat_start=(0.0, 0.0, 0.0, 1.0)), 25.0,
                    rate=100.0, sensors=SENSORS, seed=seed)[0]


def texts(imu):
    return [finding.text for finding in check_imu(imu, "imu")]


@pytest.mark.parametrize("travel_sd", [0.01, 0.2])
@pytest.mark.parametrize("seed", range(4))
def test_what_fits_gets_no_word_however_it_is_shaken(seed, travel_sd):
    assert texts(recording(seed, travel_sd)) == []


@pytest.mark.parametrize("travel_sd", [0.01, 0.2])
@pytest.mark.parametrize("factor", [0.5, 2.0, 60.0 / (2.0 * np.pi)])
def test_rates_of_another_scale_are_named_with_the_factor(factor, travel_sd):
    imu = recording(1, travel_sd)
    (finding,) = check_agreement(ImuLog(imu.stamp, imu.gyr * factor, imu.acc), "imu")
    assert finding.kind == "unit"
    assert float(finding.text.split("turns ")[1].split()[0]) == pytest.approx(1 / factor, rel=0.15)


@pytest.mark.parametrize("late", [-0.1, 0.04, 0.1])
def test_a_gyroscope_that_is_late_is_named_with_its_delay(late):
    imu = recording(2)
    t = (imu.stamp - imu.stamp[0]) * 1e-9
    gyr = np.column_stack([np.interp(t - late, t, rate) for rate in imu.gyr.T])
    (finding,) = check_agreement(ImuLog(imu.stamp, gyr, imu.acc), "imu")
    said = float(finding.text.split("were ")[1].split()[0]) * (1 if "later" in finding.text else -1)
    assert said == pytest.approx(late * 1e3, abs=10.0)


@pytest.mark.parametrize("travel_sd", [0.01, 0.2])
@pytest.mark.parametrize("seed", range(3))
def test_the_gyroscope_of_another_body_explains_nothing(seed, travel_sd):
    imu, other = recording(seed, travel_sd), recording(seed + 100)
    (finding,) = check_agreement(ImuLog(imu.stamp, other.gyr, imu.acc), "imu")
    assert "does not turn as the gyroscope says" in finding.text


@pytest.mark.parametrize("axes", [[2], [0, 1, 2]])
@pytest.mark.parametrize("part", ["gyr", "acc"])
def test_axes_that_stop_are_named(part, axes):
    imu = recording(3)
    values = {"gyr": imu.gyr.copy(), "acc": imu.acc.copy()}
    values[part][1200:, axes] = values[part][1200, axes]
    found = check_standing(ImuLog(imu.stamp, **values), "imu")
    if part == "acc" and len(axes) == 3:    # no other axis is left to move
        assert found == []
        return
    assert found[0].unusable and "from sample 1200 on, for 1300 samples" in found[0].text
    assert f"{', '.join('xyz'[axis] for axis in axes)} stands" in found[0].text


def test_an_axis_that_never_measures_is_named_only_where_the_body_turns_about_others():
    imu = recording(4)
    assert check_standing(ImuLog(imu.stamp, imu.gyr * [1, 1, 0], imu.acc), "imu")
    # A robot on a floor has no use for the other two.
    n = 2000
    random = np.random.default_rng(0)
    level = random.normal(0.0, 0.02, (n, 3)) + [0.0, 0.0, 9.81]
    yaw = np.column_stack([np.zeros(n), np.zeros(n), np.sin(np.arange(n) * 0.01)])
    assert check_standing(ImuLog(np.arange(n) * 10_000_000, yaw, level), "imu") == []


@pytest.mark.parametrize("turns", [(0.0, 0.9, 0.0), (0.7, 0.9, 0.0)])
def test_a_body_that_turns_about_one_or_two_axes_alone_has_no_dead_ones(turns):
    """Simulated without noise: the other rates are zero throughout, and should be."""
    stamp = np.arange(800) * 10_000_000
    gyr = turns * np.cos(np.outer(stamp * 1e-9, [1.3, 1.0, 1.0]))
    steps = Rotation.from_rotvec(0.01 * 0.5 * (gyr[1:] + gyr[:-1]))
    attitude = [Rotation.identity()]
    for step in steps:
        attitude.append(attitude[-1] * step)
    acc = np.array([each.inv().apply([0.0, 0.0, 9.81]) for each in attitude])
    assert check_standing(ImuLog(stamp, gyr, acc), "imu") == []
    other = gyr[:, [1, 0, 2]] if turns[0] == 0.0 else gyr[:, [2, 0, 1]]
    assert check_standing(ImuLog(stamp, other, acc), "imu")    # it turns about others


def test_a_gyroscope_whose_steps_are_coarser_than_its_rest_is_not_dead():
    imu = recording(5)
    gyr = np.round(imu.gyr / 0.05) * 0.05
    gyr[:1000], acc = 0.0, imu.acc.copy()
    acc[:1000] = [0.0, 0.0, 9.81] + np.random.default_rng(1).normal(0.0, 0.02, (1000, 3))
    assert check_standing(ImuLog(imu.stamp, gyr, acc), "imu") == []


@pytest.mark.parametrize("spoil, word", [
    (lambda imu, t: imu.gyr, None),
    (lambda imu, t: np.column_stack([np.interp(t - 0.1, t, rate) for rate in imu.gyr.T]),
     "100 ms later than the magnetometer"),
    (lambda imu, t: 0.5 * imu.gyr, "2 times as fast"),
    (lambda imu, t: recording(101).gyr, "does not turn as the gyroscope says")])
def test_the_field_tells_of_a_gyroscope_however_it_is_shaken(spoil, word):
    imu, mag = simulate(Tumbling(seed=1, travel_sd=0.4), 25.0, rate=100.0, sensors=SENSORS,
                        seed=1)[:2]
    iron = MagLog(mag.stamp, mag.mag + [1e-5, -2e-5, 1.5e-5])
    gyr = spoil(imu, (imu.stamp - imu.stamp[0]) * 1e-9)
    found = check_field_agreement(ImuLog(imu.stamp, gyr, imu.acc), iron, "mag")
    assert len(found) == (word is not None)
    assert all(word in finding.text for finding in found)


def test_accelerations_hide_no_delay_that_explains_most_of_what_turns():
    imu = recording(3, travel_sd=0.2)
    t = (imu.stamp - imu.stamp[0]) * 1e-9
    gyr = np.column_stack([np.interp(t - 0.1, t, rate) for rate in imu.gyr.T])
    (finding,) = check_agreement(ImuLog(imu.stamp, gyr, imu.acc), "imu")
    assert float(finding.text.split("were ")[1].split()[0]) == pytest.approx(100.0, abs=40.0)
    assert "later than the accelerometer" in finding.text
