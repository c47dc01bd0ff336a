"""What contradicts the smoother's model is said, mended or makes it less certain."""

import dataclasses

import numpy as np
import pytest

from benchmarks.smoother_speed import FRAME, drive
from imu_fusion.estimation.smoother import Smoother, SmootherParams
from imu_fusion.messages import convert
from imu_fusion.messages.layouts import FIX
from imu_fusion.samples.checks import check_fix
from imu_fusion.samples.logs import FixLog

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


@pytest.mark.parametrize("step", [5.0, 48.0])
def test_a_step_of_the_height_datum_is_said_and_widens_what_is_stated(logs, clean, step):
    imu, mag, fix, velocity = logs
    height = fix.height + step * (np.arange(len(fix)) > len(fix) // 2)
    result = Smoother(PARAMS).run(imu, mag, dataclasses.replace(fix, height=height), velocity)
    assert any("the fix innovations wander" in remark for remark in result.remarks())
    up = result.samples["cov_position"][:, 2, 2] / clean.samples["cov_position"][:, 2, 2]
    assert np.median(up) > 1.5 ** 2


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
