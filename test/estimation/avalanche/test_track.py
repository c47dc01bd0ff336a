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
from imu_fusion.estimation.orientation.recovered import recover
from imu_fusion.estimation.smoother import Smoother
from imu_fusion.estimation.smoother.problem import Problem
from imu_fusion.parameters.file import parameters_for
from imu_fusion.sensors.magnetometer_calibration import calibrate_magnetometer
from imu_fusion.simulation.avalanche import Avalanche
from imu_fusion.simulation.ball_sensors import LEVER_ARM, BallErrors, record_ball
from imu_fusion.streams.smoother import recovery_params
from imu_fusion.streams.smoother_params import SmootherNodeParams, SmoothingParams
from imu_fusion.surfaces.file import load_surface
from test.documents import ROOT


@pytest.fixture(scope="module")
def avalanche():
    return Avalanche(rng=np.random.default_rng(5))


@pytest.fixture(scope="module")
def plane(avalanche):
    return load_surface("fluela_plane")


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
    force = central_force(samples)
    true = avalanche.motion.phases[1:]
    found = find_phases(samples.time, force, samples.rate, true[-1].start, avalanche.gravity)
    assert [t.number for t in found] == [p.number for p in true]
    assert [t.time for t in found] == pytest.approx([p.start for p in true], abs=0.05)
    assert "free fall" in found[1].reason and " g " in found[3].reason
    first = flights(samples.time, force, avalanche.gravity)[0]
    assert (first.start, first.end) == pytest.approx((true[1].start, true[2].start), abs=0.05)


def test_a_flight_ends_where_the_samples_do():
    time = np.r_[np.arange(0.0, 2.0, 0.01), np.arange(2.5, 4.0, 0.01)]
    force = np.full((len(time), 3), 6.0)
    force[(time > 1.7) & (time < 2.8)] = 0.1
    first, second = flights(time, force, 9.8)
    assert (first.start, first.end) == pytest.approx((1.71, 1.99), abs=0.011)
    assert (second.start, second.end) == pytest.approx((2.5, 2.8), abs=0.011)


def test_phases_that_are_not_there_are_left_out(avalanche):
    time = np.arange(0.0, 10.0, 1 / 150)
    found = find_phases(time, np.full((len(time), 3), 6.0), np.zeros((len(time), 3)), 10.0,
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


def smoothed(avalanche, log, plane, **changes):
    """SmootherResult of the first 9 s with the start alone, and its errors (n, 3) in the slope
    frame."""
    (params,) = parameters_for((SmoothingParams, SmootherNodeParams), "smoother",
                               ROOT / "config" / "avalanche.yaml")[:1]
    time = avalanche.motion.time[log.rows]
    part = (time > -2.0) & (time < 8.9)
    rows = log.rows[part]
    moving = (time > 0.0) & (time < 70.0)
    mag = calibrate_magnetometer(log.mag.mag[moving], float(np.linalg.norm(log.field_world)))
    place = avalanche.motion.position_of(LEVER_ARM)[rows[0]]
    params = params.replace(**{
        **{name: value for name, value in mag.to_parameters().items() if "sensor." in name},
        "initial.position": tuple(float(v) for v in avalanche.origin.to_geodetic(place)),
        "initial.position_sd": 0.1, **changes})
    imu = log.imu
    if params.recover_rates:
        imu = recover(imu, log.mag, recovery_params(params)).imu
    result = Smoother(params, plane).run(imu[part], log.mag[part])
    error = result.samples["position_world"] - avalanche.motion.position_of(LEVER_ARM)[rows]
    return result, error @ avalanche.slope_axes()


def test_the_smoother_takes_recovered_rates(avalanche, plane):
    """Without them a ball beyond the range is lost; with them what is stated holds, though only
    the start is known."""
    log = record_ball(avalanche, np.random.default_rng(7))
    result, error = smoothed(avalanche, log, plane)
    axes = avalanche.slope_axes()
    sd = np.sqrt(np.einsum("ji,njk,ki->ni", axes, result.samples["cov_position"], axes))
    rms = np.sqrt(np.mean(error ** 2, axis=0))
    assert result.converged and rms[2] < 0.3
    assert np.all(rms < 2.5 * np.sqrt(np.mean(sd ** 2, axis=0)))
    lost, astray = smoothed(avalanche, log, plane, recover_rates=False)
    assert np.sqrt(np.mean(astray ** 2)) > 3.0 * np.sqrt(np.mean(error ** 2))


def test_a_turn_that_a_gap_hides_is_found_by_the_slope(plane, monkeypatch):
    """A second without samples in the middle of the tumbling: beginning as the samples alone lead,
    the attitude ends half a turn off, with 7 deg stated and no remark."""
    avalanche = Avalanche(rng=np.random.default_rng(5))
    log = record_ball(avalanche, np.random.default_rng(105), BallErrors(gap=(3.0, 4.0)))
    time = avalanche.motion.time[log.rows]
    after = log.rows[(time > 6.0) & (time < 8.9)]

    def off():
        result, _ = smoothed(avalanche, log, plane)
        turn = (Rotation.from_quat(result.samples["quat_world_imu"][-len(after):]).inv()
                * Rotation.from_quat(avalanche.motion.quat[after]))
        return np.degrees(np.sqrt(np.mean(turn.magnitude() ** 2))), result

    found, result = off()
    assert found < 10.0
    # With a start alone, and a surface, others fit nearly as well.
    assert any("the turn about the magnetic field was lost" in text for text in result.remarks())
    monkeypatch.setattr(Problem, "rates_recovered", False)
    assert off()[0] > 30.0
