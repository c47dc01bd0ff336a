"""Which impact was the touch-down: short jumps, whose out-run is louder, and falls."""

import numpy as np
import pytest

from imu_fusion.estimation.smoother import Smoother, SmootherParams
from imu_fusion.simulation.jump_sensors import record
from imu_fusion.simulation.ski_jump import Fall, JumpParams, SkiJump
from imu_fusion.surfaces.file import load_surface

HILL = load_surface("oberstdorf_hs106")


def smoothed(jump, seed=0):
    recording = record(jump, np.random.default_rng(seed))
    return Smoother(SmootherParams(), HILL).run(recording.imu, recording.mag, recording.fix,
                                                recording.velocity)


@pytest.mark.parametrize("start, braking", [(-30.0, 6.0), (-50.0, 3.5), (-60.0, 6.0)])
def test_short_jumps_end_where_they_land_though_the_out_run_is_louder(start, braking):
    jump = SkiJump(HILL, JumpParams(start_x=start, braking=braking))
    result = smoothed(jump)
    assert result.jump is not None and jump.length < 31.0
    error = abs(result.jump.length - jump.length)
    assert error < 0.2 and error < 3 * result.jump.length_sd
    assert not result.remarks()


@pytest.mark.parametrize("start", [-50.0, -78.0])
def test_a_fall_is_told_and_makes_the_length_less_certain(start):
    jump = Fall(HILL, JumpParams(start_x=start))
    result = smoothed(jump)
    sd = result.jump.length_sd
    assert abs(result.jump.length - jump.length) < 3 * sd
    assert sd > 3 * smoothed(SkiJump(HILL, JumpParams(start_x=start))).jump.length_sd
    assert any("a fall, a deep landing" in remark for remark in result.remarks())


def test_a_fall_that_is_harder_than_the_landing_is_not_taken_for_it():
    jump = Fall(HILL, JumpParams(start_x=-70.0, duration=30.0, sink_time=0.12, braking=3.5))
    result = smoothed(jump.shaken(np.random.default_rng([0, 1])))
    assert abs(result.jump.length - jump.length) < min(3 * result.jump.length_sd, 1.0)
    assert result.remarks()


@pytest.mark.parametrize("start", [-40.0, -90.0])
def test_a_deep_landing_lengthens_no_jump(start):
    jump = SkiJump(HILL, JumpParams(start_x=start, sink_time=0.12))
    result = smoothed(jump)
    assert abs(result.jump.length - jump.length) < min(3 * result.jump.length_sd, 0.5)
    assert result.adapted == {"jump.event_margin": 1.0}
    assert any("a deep landing" in remark for remark in result.remarks())


def test_a_touch_down_that_was_given_is_not_replaced():
    jump = SkiJump(HILL, JumpParams(start_x=-50.0))
    recording = record(jump, np.random.default_rng(0))
    result = Smoother(SmootherParams.from_mapping({"jump.touchdown": 16.0}), HILL).run(
        recording.imu, recording.mag, recording.fix, recording.velocity)
    assert abs((result.events.touchdown - recording.imu.stamp[0]) * 1e-9 - 16.0) < 0.5
