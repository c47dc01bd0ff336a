"""Take-off and touch-down on simulated jumps, and the results read off the truth."""

import dataclasses

import numpy as np
import pytest

from imu_fusion.errors import EstimationError
from imu_fusion.estimation.smoother import SAMPLE
from imu_fusion.estimation.smoother.jump_events import (
    JumpEvents,
    detect_jump,
    impact_onset,
    table_crossing,
)
from imu_fusion.estimation.smoother.jump_result import jump_result
from imu_fusion.samples.logs import ImuLog
from imu_fusion.simulation.jump_sensors import EPOCH, record
from imu_fusion.simulation.ski_jump import SkiJump
from imu_fusion.surfaces.file import load_surface


@pytest.fixture(scope="module")
def jump():
    return SkiJump(load_surface("oberstdorf_hs106"))


@pytest.fixture(scope="module")
def recording(jump):
    return record(jump, np.random.default_rng(11))


def stamp_of(t):
    return EPOCH + int(t * 1e9)


def truth_samples(jump, recording):
    samples = np.zeros(len(recording.imu), SAMPLE)
    samples["stamp"] = recording.imu.stamp
    samples["position_world"] = recording.motion.position_world
    samples["vel_world"] = recording.motion.vel_world
    samples["cov_position"] = 0.01 * np.eye(3)
    return samples


def test_detection_of_the_paper(jump, recording):
    events = detect_jump(recording.imu, recording.velocity)
    # The push-off peaks half its duration before the edge; the impact within 0.05 s.
    push = stamp_of(jump.t_takeoff - 0.5 * jump.params.push_duration)
    assert abs(events.takeoff - push) < 0.06e9
    assert abs(events.touchdown - stamp_of(jump.t_touchdown)) < 0.05e9


def test_second_peak_is_sought_away_from_the_first(jump, recording):
    # Two strong peaks 0.1 s apart at the landing must not be taken for a jump (A2).
    acc = recording.imu.acc.copy()
    peak = int(np.argmax(np.linalg.norm(acc, axis=1)))
    acc[peak + 10] = acc[peak] * 0.99
    events = detect_jump(ImuLog(recording.imu.stamp, recording.imu.gyr, acc), recording.velocity)
    assert events.touchdown - events.takeoff > 1.5e9


def test_velocities_that_are_not_finite_hide_no_peak(recording):
    events = detect_jump(recording.imu, recording.velocity)
    velocity = recording.velocity.vel_world.copy()
    velocity[np.abs(recording.velocity.stamp - events.touchdown) < 0.15e9] = np.nan
    assert detect_jump(recording.imu, dataclasses.replace(
        recording.velocity, vel_world=velocity)) == events


def test_no_jump_says_so(recording):
    slow = dataclasses.replace(recording.velocity,
                               vel_world=0.2 * recording.velocity.vel_world)
    with pytest.raises(EstimationError, match="never exceeds 10 m/s"):
        detect_jump(recording.imu, slow)
    with pytest.raises(EstimationError, match="jump.takeoff and jump.touchdown"):
        detect_jump(recording.imu, None)


@pytest.mark.parametrize("error", [-0.15, 0.0, 0.15])
def test_onset_is_dated_within_a_third_of_a_sample(jump, recording, error):
    onset, sd = impact_onset(recording.imu, stamp_of(jump.t_touchdown + error))
    # 10 ms samples; the simulated force sets in with a slope that one sample resolves.
    assert abs(onset - stamp_of(jump.t_touchdown)) < 3.5e6
    assert sd == pytest.approx(0.01 / np.sqrt(12))


def test_no_onset_in_quiet_data(jump, recording):
    assert impact_onset(recording.imu, stamp_of(2.0)) is None


def test_table_crossing_and_results_of_the_truth(jump, recording):
    samples = truth_samples(jump, recording)
    takeoff = table_crossing(jump.hill, samples, stamp_of(jump.t_takeoff + 0.2))
    # Linear between samples 10 ms apart: acceleration of 10 m/s^2 at 25 m/s errs by 5 us.
    assert abs(takeoff - stamp_of(jump.t_takeoff)) < 2e4
    assert table_crossing(jump.hill, samples, stamp_of(0.0)) is None
    result = jump_result(jump.hill, samples, recording.imu,
                         JumpEvents(takeoff, stamp_of(jump.t_touchdown)))
    truth = jump.at([jump.t_takeoff, jump.t_touchdown])
    assert result.length == pytest.approx(jump.length, abs=2e-3)
    assert result.flight_time == pytest.approx(jump.t_touchdown - jump.t_takeoff, abs=1e-4)
    speeds = np.linalg.norm(truth.vel_world, axis=1)
    assert result.takeoff_speed == pytest.approx(speeds[0], abs=0.02)
    # The velocity at touch-down bends with 35 m/s^2 within a sample of 10 ms.
    assert result.landing_speed == pytest.approx(speeds[1], abs=0.2)
    # The table falls by 11 deg; the push-off turns the flight up by atan(1.4/25.6) or so.
    assert -11 < result.takeoff_angle_deg < -6
    # 0.1 m along the profile and 2.9 ms at 26 m/s.
    assert 0.11 < result.length_sd < 0.16
    assert set(result.to_mapping()) >= {"length", "length_sd", "in_run_speed"}
