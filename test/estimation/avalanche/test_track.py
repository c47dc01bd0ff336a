"""The method of the paper on the simulated ball."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_fusion.estimation.avalanche.dead_reckoning import (
    BallSamples,
    central_force,
    dead_reckon,
)
from imu_fusion.estimation.avalanche.phases import find_phases, flights
from imu_fusion.estimation.avalanche.slope import slope_axes
from imu_fusion.estimation.avalanche.track import TrackParams, track_ball
from imu_fusion.simulation.avalanche import Avalanche
from imu_fusion.simulation.ball_sensors import LEVER_ARM, BallErrors, record_ball
from imu_fusion.surfaces.plane import Plane


@pytest.fixture(scope="module")
def avalanche():
    return Avalanche(rng=np.random.default_rng(5))


@pytest.fixture(scope="module")
def plane(avalanche):
    return Plane(avalanche.origin, slope_deg=32.0, aspect_deg=45.0)


def truth_at(avalanche, log, first=0.0, last=9.0):
    """BallSamples of the truth and rows of the motion, between two times."""
    motion = avalanche.motion
    time = motion.time[log.rows]
    part = (time >= first) & (time < last)
    rows = log.rows[part]
    return BallSamples(motion.time[rows] - first, motion.quat[rows], log.imu.acc[part],
                       motion.omega[rows], LEVER_ARM), rows


def test_perfect_sensors_lead_along_the_true_path(avalanche):
    """150 Hz and trapezoids leave 0.4 m of 145 m in 9 s."""
    log = record_ball(avalanche, np.random.default_rng(0), BallErrors.none())
    samples, rows = truth_at(avalanche, log)
    track = dead_reckon(samples, avalanche.gravity)
    moved = avalanche.motion.position[rows] - avalanche.motion.position[rows[0]]
    assert np.abs(track.position - moved).max() < 0.6
    assert np.abs(track.vel - avalanche.motion.vel[rows]).max() < 0.1
    # Without the lever arm the sensor's own path is followed, which circles about that.
    bare = dead_reckon(BallSamples(samples.time, samples.quat, samples.force, samples.rate),
                       avalanche.gravity)
    assert np.abs(bare.acc - track.acc).max() > 5.0
    assert np.abs(bare.position - track.position).max() < 0.5


def test_phases_of_perfect_signals(avalanche, plane):
    log = record_ball(avalanche, np.random.default_rng(0), BallErrors.none())
    samples, _ = truth_at(avalanche, log, 0.0, 80.0)
    lateral = Rotation.from_quat(samples.quat).apply(samples.rate) @ avalanche.slope_axes()[:, 1]
    force = central_force(samples)
    true = avalanche.motion.phases[1:]
    found = find_phases(samples.time, force, lateral, true[-1].start, avalanche.gravity)
    assert [t.number for t in found] == [p.number for p in true]
    assert [t.time for t in found] == pytest.approx([p.start for p in true], abs=0.05)
    assert "free fall" in found[1].reason and " g " in found[3].reason
    first = flights(samples.time, force, avalanche.gravity)[0]
    assert (first.start, first.end) == pytest.approx((true[1].start, true[2].start), abs=0.05)


def test_phases_that_are_not_there_are_left_out(avalanche):
    time = np.arange(0.0, 10.0, 1 / 150)
    found = find_phases(time, np.full((len(time), 3), 6.0), np.zeros(len(time)), 10.0,
                        avalanche.gravity)
    assert [t.number for t in found] == [1, 6]


@pytest.fixture(scope="module")
def tracked(avalanche, plane):
    log = record_ball(avalanche, np.random.default_rng(7))
    result = track_ball(log.imu, log.mag, plane, log.field_world, avalanche.gravity,
                        TrackParams(duration=9.0))
    time = (log.imu.stamp[result.motion.start] - log.imu.stamp[0]) * 1e-9
    start = int(round((time + avalanche.motion.time[0] - 0.0 + 10.0) * 1500))
    rows = start + np.round(result.samples.time * 1500).astype(int)
    return result, rows


def test_the_calibration_brings_the_track_back_to_the_slope(avalanche, tracked):
    result, rows = tracked
    motion, axes = avalanche.motion, avalanche.slope_axes()
    assert result.axes == pytest.approx(axes, abs=1e-6)
    moved = motion.position[rows] - motion.position[rows[0]]
    before, after = ((track.position - moved) @ axes for track in (
        result.track, result.improved_track))
    rms = np.sqrt(np.mean(np.square([before, after]), axis=1))
    assert rms[0, 2] > 1.0 and rms[1, 2] < 0.3
    assert abs(motion.time[rows[0]]) < 0.05


def test_attitudes_are_right_to_degrees(avalanche, tracked):
    result, rows = tracked
    error = (Rotation.from_quat(result.improved.quat)
             * Rotation.from_quat(avalanche.motion.quat[rows]).inv()).magnitude()
    assert np.degrees(np.sqrt(np.mean(error ** 2))) < 10.0
    assert result.field.norm == pytest.approx(48e-6, rel=0.02)


def test_it_needs_its_own_slope(avalanche, tracked):
    """Against the normal of another slope the same track is not kept near it."""
    result, _ = tracked
    other = slope_axes(np.array([1.0, 1.0, -0.5]))
    assert np.std(result.improved_track.position @ other[:, 2]) > 5.0
