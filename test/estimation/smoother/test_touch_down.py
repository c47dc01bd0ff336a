"""Which impact was the touch-down: short jumps, whose out-run is louder, and falls."""

import numpy as np
import pytest

from imu_fusion.estimation.smoother import Smoother, SmootherParams
from imu_fusion.evaluation.consistency import nees
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


@pytest.mark.parametrize("start, own", [(-50.0, {}), (-70.0, {"sink_time": 0.12, "braking": 3.5})])
def test_who_falls_is_not_lifted_to_the_height_of_who_stands(start, own):
    jump = Fall(HILL, JumpParams(start_x=start, duration=30.0, **own))
    jump = jump.shaken(np.random.default_rng([0, 1]))
    recording = record(jump, np.random.default_rng(0))
    result = Smoother(SmootherParams(), HILL).run(recording.imu, recording.mag, recording.fix,
                                                  recording.velocity)
    assert abs(result.jump.length - jump.length) < min(3 * result.jump.length_sd, 0.5)
    off = result.samples["position_world"] - recording.motion.position_world
    assert nees(off, result.samples["cov_position"]).mean() < 10.0
    assert [remark for remark in result.remarks() if "a fall" in remark and "below" in remark]


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
