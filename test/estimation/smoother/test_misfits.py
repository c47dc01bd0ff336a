"""What contradicts the smoother's model is said, mended or makes it less certain."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.smoother_speed import FRAME, drive
from imu_fusion.estimation.smoother import Smoother, SmootherParams
from imu_fusion.estimation.smoother.whiteness import correlation, wandering
from imu_fusion.evaluation.consistency import nees
from imu_fusion.messages import convert
from imu_fusion.messages.layouts import FIX
from imu_fusion.samples.checks import check_fix
from imu_fusion.samples.logs import FixLog
from imu_fusion.simulation import walk as walking
from imu_fusion.simulation.noise import gauss_markov
from imu_fusion.simulation.noise_gnss import GnssErrors

PARAMS = SmootherParams(gravity=9.8)


@pytest.fixture(scope="module")
def logs():
    return drive(45.0)


@pytest.fixture(scope="module")
def clean(logs):
    return Smoother(PARAMS).run(*logs)


def later(log, seconds):
    return dataclasses.replace(log, stamp=log.stamp + int(seconds * 1e9))


def test_right_data_leave_no_remark(clean):
    assert not clean.remarks() and clean.gnss_lag == 0.0
    assert set(clean.wander.values()) == {1.0}


@pytest.mark.parametrize("lag", [1.2, -1.2, 18.0])
def test_a_receiver_of_another_clock_is_noticed_and_put_right(logs, clean, lag):
    imu, mag, fix, velocity = logs
    result = Smoother(PARAMS).run(imu, mag, later(fix, lag), later(velocity, lag))
    delay, sd = result.states["gnss_time_offset"]
    assert abs(delay[0, 0] - lag) < 3 * sd[0, 0] + 1e-3
    assert any("against those of the Imu" in remark for remark in result.remarks())
    # Where there are fixes all the same.
    both = slice(2000, -2000)
    apart = np.linalg.norm((result.frame.to_enu(*clean.frame.to_geodetic(
        clean.samples["position_world"])) - result.samples["position_world"])[both], axis=1)
    assert apart.max() < 3 * np.sqrt(np.trace(result.samples["cov_position"][both].mean(axis=0)))


def up_error(result, fix):
    """m, and its standard deviation, at the samples: the drive is level."""
    height = result.frame.to_geodetic(result.samples["position_world"])[2]
    return height - fix.height.mean(), np.sqrt(result.samples["cov_position"][:, 2, 2])


@pytest.mark.parametrize(("step", "begin", "with_velocity"), [
    (48.0, 0.7, True), (-15.0, 0.4, True), (48.0, 0.5, False)])
def test_a_step_of_the_height_datum_is_found_and_said(logs, step, begin, with_velocity):
    imu, mag, fix, velocity = logs
    first = int(begin * len(fix))
    height = fix.height + step * (np.arange(len(fix)) >= first)
    result = Smoother(PARAMS).run(imu, mag, dataclasses.replace(fix, height=height),
                                  velocity if with_velocity else None)
    found = result.gnss_step
    assert abs(found.stamp - fix.stamp[first]) < 3e9    # three seconds: 15 m are 3 sd of a fix
    assert abs(found.offset[2] - step) < 3 * found.sd[2]
    assert any("another height datum" in remark for remark in result.remarks())
    error, sd = up_error(result, fix)
    assert (np.abs(error) < 3 * sd).mean() > 0.97 and np.median(sd) < 2.0


def test_errors_that_wander_are_no_step_and_widen_what_is_stated(logs, clean):
    imu, mag, fix, velocity = logs
    t = (fix.stamp - fix.stamp[0]) * 1e-9
    wandering = dataclasses.replace(fix, height=fix.height + 15.0 * np.sin(0.6 * t))
    result = Smoother(PARAMS).run(imu, mag, wandering, velocity)
    assert result.gnss_step is None
    assert any("the fix innovations wander" in remark for remark in result.remarks())
    up = result.samples["cov_position"][:, 2, 2] / clean.samples["cov_position"][:, 2, 2]
    assert np.median(up) > 1.5 ** 2


def test_two_fixes_tell_no_delay(logs):
    """Of a start and an end that lie too far apart a delay of seconds would make either free."""
    imu, mag, fix, _ = logs
    ends = fix[np.arange(len(fix)) % (len(fix) - 1) == 0]
    apart = dataclasses.replace(ends, longitude_deg=ends.longitude_deg + [0.0, 2e-3])
    result = Smoother(PARAMS).run(imu, mag, apart)
    assert len(ends) == 2 and "gnss_time_offset" not in result.states


def test_fixes_of_which_many_are_rejected_are_said(logs):
    """Ten seconds of fixes beside the path, as between houses: the loss lets go of them."""
    imu, mag, fix, velocity = logs
    t = (fix.stamp - fix.stamp[0]) * 1e-9
    beside = (t > 15.0) & (t < 25.0)
    shifted = dataclasses.replace(fix, longitude_deg=fix.longitude_deg + 1e-3 * beside)
    result = Smoother(PARAMS).run(imu, mag, shifted, velocity)
    found = result.outliers()["fix"]
    assert abs(found.share - beside.mean()) < 0.02 and found.longest >= 0.9 * beside.sum()
    assert any("in a row" in remark and "fix" in remark for remark in result.remarks())


def test_fixes_of_a_receiver_that_knows_nothing_yet_are_left_out_and_counted(logs, clean):
    imu, mag, fix, velocity = logs
    null = dataclasses.replace(fix, latitude_deg=fix.latitude_deg.copy(),
                               longitude_deg=fix.longitude_deg.copy())
    null.latitude_deg[:20] = null.longitude_deg[:20] = 0.0
    without = fix[np.arange(len(fix)) >= 20]
    result, expected = (Smoother(PARAMS).run(imu, mag, f, velocity) for f in (null, without))
    assert result.samples.tobytes() == expected.samples.tobytes()
    assert any("20 positions are 0 deg, 0 deg" in str(f) and "left out" in str(f)
               for f in check_fix(null))
    assert abs(result.frame.latitude_deg - FRAME.latitude_deg) < 1e-3


def test_unknown_status_is_usable_and_a_covariance_of_nan_is_unknown():
    cov = np.full((3, 3), np.nan)
    message = convert.fix_message(5, "gnss", 47.0, 11.0, 600.0, cov, status=-2)
    values = convert.fix_values(FIX.decode(message)[2])
    assert np.array_equal(values[3:12], np.zeros(9)) and values[12] == -2
    log = FixLog(np.array([5]), *(values[i:i + 1] for i in range(3)),
                 values[3:12].reshape(1, 3, 3), values[12:])
    assert log.usable.all() and not check_fix(log)


def test_errors_that_wander_are_no_delay_in_the_end():
    """At first a delay of the velocities explains part of it; once the wander is known, none."""
    imu, mag, fix, velocity = drive(30.0)
    rng, error = np.random.default_rng(4), np.zeros((len(fix), 3))
    for k in range(1, len(fix)):    # Gauss-Markov: 5 m over 20 s
        error[k] = np.exp(-0.005) * error[k - 1] + 0.5 * rng.standard_normal(3)
    enu = FRAME.to_enu(fix.latitude_deg, fix.longitude_deg, fix.height) + error
    stated = np.broadcast_to(np.eye(3), (len(fix), 3, 3))
    result = Smoother(PARAMS).run(
        imu, mag, FixLog(fix.stamp, *FRAME.to_geodetic(enu), stated, fix.status), velocity)
    assert "gnss.position_error_sd" in result.adapted
    assert not any("time_offset" in name for name in result.adapted)


def test_correlation_does_not_depend_on_what_is_stated():
    rng = np.random.default_rng(1)
    white = [correlation(rng.standard_normal((150, 3))) for _ in range(200)]
    assert np.count_nonzero(white) < 4    # a thousandth of 600 components
    slow = gauss_markov(np.arange(150.0), [1.0] * 3, 10.0, rng)
    assert correlation(slow) == pytest.approx(np.exp(-0.1), abs=0.15)
    assert correlation(0.3 * slow) == pytest.approx(correlation(slow))
    assert correlation(0.01 * slow) == 0.0    # less than the mean of 150 is sure: .08


def test_errors_of_a_minute_show_in_means_over_longer_times():
    rng = np.random.default_rng(2)
    stamp = np.arange(600) * 10**9
    white = rng.standard_normal((600, 3))
    assert wandering(stamp, white) == 1.0
    # .3 over a minute: a twentieth in the variance of means over 5 s, half of those over 80 s.
    assert wandering(stamp, white + 0.3 * gauss_markov(
        np.arange(600.0), [1.0] * 3, 60.0, rng)) > 2.0


def walked(seconds, errors, seed):
    """A walk, and result and truth (n, 3) m, less what lies in ``outage`` s."""
    walk = walking.Walk(seconds, np.random.default_rng([seed, 3]))
    recorded = walking.record(walk, np.random.default_rng([seed, 4]), errors)

    def run(outage=(0.0, 0.0)):
        t = (recorded.fix.stamp - recorded.imu.stamp[0]) * 1e-9
        kept = (t < outage[0]) | (t >= outage[1])
        result = Smoother(SmootherParams()).run(recorded.imu, recorded.mag, recorded.fix[kept],
                                                recorded.velocity[kept])
        since = (result.samples["stamp"] - recorded.imu.stamp[0]) * 1e-9
        truth = result.frame.to_enu(*walking.FRAME.to_geodetic(walk.position(since)))
        return result, result.samples["position_world"] - truth, since
    return run


def test_a_magnetometer_past_iron_counts_less():
    """As sure as stated, it draws the position 9 m away while there are no fixes."""
    outage = 30.0, 45.0
    result, error, t = walked(60.0, walking.WalkErrors(iron=8e-6), 0)(outage)
    inside = (t > outage[0]) & (t < outage[1])
    assert result.noise["mag"] > 5.0 and any("of mag" in remark for remark in result.remarks())
    assert np.linalg.norm(error[inside], axis=1).max() < 0.5
    assert nees(error[inside], result.samples["cov_position"][inside]).mean() < 6.0


def test_fixes_that_are_small_and_alike_are_not_averaged_away():
    """A receiver that states 4 m and errs by 3 m the same way for half a minute: innovations are
    small, and the mean of a hundred fixes would be sure to .4 m."""
    errors = walking.WalkErrors(gnss_rate=1.0, stated_sd=(4.0, 4.0, 6.0), gnss=GnssErrors(
        position_sd=(3.0, 3.0, 6.0), position_tau=30.0, correlated_share=0.97,
        velocity_sd=(0.3, 0.3, 0.3)))
    result, error, _ = walked(60.0, errors, 1)()
    assert "gnss.position_error_sd" in result.adapted
    # One error of each axis for minutes: NEES of three numbers, below 16.3 in 999 of 1000.
    assert nees(error, result.samples["cov_position"]).mean() < 16.3


def off(result):
    """Errors (n, 3) m of a figure of eight."""
    t = (result.samples["stamp"] - result.samples["stamp"][0]) * 1e-9
    truth = np.stack([100 * np.sin(0.1 * t), 50 * np.sin(0.2 * t), 0 * t], axis=1)
    return FRAME.to_enu(*result.frame.to_geodetic(result.samples["position_world"])) - truth


def test_a_receiver_that_holds_its_last_is_left_out_where_it_contradicts(logs):
    imu, mag, fix, velocity = logs
    held = np.arange(len(fix))
    held[120:240] = 120
    result = Smoother(PARAMS).run(
        imu, mag, dataclasses.replace(fix[held], stamp=fix.stamp),
        dataclasses.replace(velocity[held], stamp=velocity.stamp))
    assert result.repeats == {"fix": 119, "velocity": 119}
    assert any("holds its last" in text for text in result.remarks())
    assert nees(off(result), result.samples["cov_position"]).mean() < 9.0


def test_a_receiver_at_rest_may_repeat_itself():
    imu, _, fix, velocity = drive(20.0, 4)
    rng = np.random.default_rng(5)
    still = dataclasses.replace(
        imu, gyr=0.0175 * rng.standard_normal(imu.gyr.shape),
        acc=[0.0, 0.0, 9.8] + 0.1 * rng.standard_normal(imu.gyr.shape))
    result = Smoother(PARAMS).run(
        still, None, dataclasses.replace(fix[np.zeros(len(fix), int)], stamp=fix.stamp),
        dataclasses.replace(velocity, vel_world=0.0 * velocity.vel_world))
    assert not result.repeats
    assert np.ptp(result.samples["position_world"], axis=0).max() < 0.1


@pytest.mark.parametrize(("fixes", "velocities"), [(-2.0, 0.0), (0.0, 2.0)])
def test_fixes_and_velocities_of_two_clocks(fixes, velocities):
    walk = walking.Walk(40.0, np.random.default_rng(8))
    recorded = walking.record(walk, np.random.default_rng(9))
    result = Smoother().run(recorded.imu, recorded.mag, later(recorded.fix, fixes),
                            later(recorded.velocity, velocities))
    assert result.gnss_lag == pytest.approx(fixes, abs=0.11)
    assert result.velocity_lag == pytest.approx(velocities - fixes, abs=0.11)
    samples = result.samples[500:-500]
    place = result.frame.to_enu(*walking.FRAME.to_geodetic(walk.position(
        (samples["stamp"] - recorded.imu.stamp[0]) * 1e-9)))
    assert np.sqrt(np.mean((samples["position_world"] - place) ** 2)) < 0.03


@pytest.mark.parametrize("late", [{"gyr": 0.05}, {"mag": 0.1}])
def test_which_of_gyroscope_and_magnetometer_is_late(late):
    walk = walking.Walk(30.0, np.random.default_rng(8))
    recorded = walking.record(walk, np.random.default_rng(9))
    imu, mag = recorded.imu, recorded.mag
    if "gyr" in late:
        imu = dataclasses.replace(imu, gyr=np.roll(imu.gyr, 5, axis=0))
        assert np.all(np.diff(imu.stamp) == 10_000_000)
    else:
        mag = later(mag, late["mag"])
    result = Smoother().run(imu, mag, recorded.fix, recorded.velocity)
    assert result.late == pytest.approx(late, abs=0.01)
    assert any("late against" in text for text in result.remarks())
    attitude = walk.attitude((imu.stamp - imu.stamp[0]) * 1e-9)
    off = Rotation.from_quat(result.samples["quat_world_imu"]).inv() * attitude
    assert nees(off.as_rotvec()[50:-50], result.samples["cov_attitude"][50:-50]).mean() < 6.0


def test_fixes_of_metres_alone_tell_that_they_are_late():
    walk = walking.Walk(70.0, np.random.default_rng(8))
    recorded = walking.record(walk, np.random.default_rng(9), walking.WalkErrors(
        stated_sd=(1.5, 1.5, 2.5), gnss=GnssErrors(position_sd=(1.5, 1.5, 2.5))))
    result = Smoother().run(recorded.imu, recorded.mag, later(recorded.fix, 2.0))
    (delay,), (sd,) = (values[0] for values in result.states["gnss_time_offset"])
    assert abs(delay - 2.0) < 3 * sd < 1.5
    assert any("s late (standard" in text for text in result.remarks())
