"""The smoother and its surface: heights, windows, grids, and surfaces that do not fit."""

import dataclasses

import numpy as np
import pytest
import yaml

from benchmarks.jumps import moved
from imu_fusion.demos.data import data_folder
from imu_fusion.errors import EstimationError, ParameterError
from imu_fusion.estimation.smoother import Smoother, SmootherParams
from imu_fusion.estimation.smoother.jump_events import JumpEvents
from imu_fusion.estimation.smoother.measurements.surface_contact import (
    evaluate_constraints,
    in_flight,
)
from imu_fusion.estimation.smoother.params import Gnss, SurfaceContact
from imu_fusion.estimation.smoother.profile_fit import ProfileError, widened_by_profile
from imu_fusion.estimation.smoother.result import SAMPLE
from imu_fusion.estimation.smoother.surface_fit import surface_fits
from imu_fusion.estimation.smoother.surface_place import fixes_beside, widen_place
from imu_fusion.geometry.geodesy import LocalFrame
from imu_fusion.samples.logs import ImuLog
from imu_fusion.simulation.jump_sensors import EPOCH, GnssErrors, record
from imu_fusion.simulation.ski_jump import FASTEST_WOBBLE
from imu_fusion.surfaces.constraint import Surface, height_constraint
from imu_fusion.surfaces.file import load_surface, surface_from_mapping


def test_unknown_height_of_the_sensor(jump):
    low = LocalFrame(jump.hill.origin.latitude_deg, jump.hill.origin.longitude_deg,
                     jump.hill.origin.height - 1.0)
    believed = dataclasses.replace(jump.hill, origin=low)
    # With the GNSS of a survey the height shows; with a logger's it stays uncertain.
    sharp = GnssErrors(position_sd=(0.05, 0.05, 0.1))
    rec = record(jump, np.random.default_rng(9), gnss=sharp)
    r = Smoother(SmootherParams(surface=SurfaceContact(body_height_sd=2.0)), believed).run(
        rec.imu, rec.mag, rec.fix, rec.velocity)
    height, sd = (v[0, 0] for v in r.states["body_height"])
    assert abs(height - 1.0) < max(4 * sd, 0.05) and sd < 0.1
    # Given, it counts as well as found.
    given = Smoother(SmootherParams(surface=SurfaceContact(body_height=1.0)), believed).run(
        rec.imu, rec.mag, rec.fix, rec.velocity)
    up = [np.median(low.to_geodetic(s.samples["position_world"])[2] - jump.hill.origin.to_geodetic(
        rec.motion.position_world)[2]) for s in (given, r)]
    assert np.abs(up).max() < 0.05 and given.remarks() == []


def test_a_surface_that_does_not_fit_says_so(jump, recording, result):
    assert result.remarks() == []
    # The sensor moves as sigma allows, and the trajectory follows it in part.
    assert all(0.1 < fit.excess < 1.2 for fit in result.surface.values())
    assert set(result.surface) == {"in_run", "in_run_lateral", "landing"}
    logs = recording.imu, recording.mag, recording.fix, recording.velocity

    neighbour = Smoother(SmootherParams(), load_surface("oberstdorf_hs137")).run(*logs)
    assert neighbour.surface["in_run"].excess > 3.0
    assert any("stands off the surface (in_run) by" in text for text in neighbour.remarks())

    shifted = moved(jump.hill, north=5.0)
    beside = Smoother(SmootherParams(), shifted).run(*logs)
    # The surface holds the trajectory too far north, which the fixes (3 m) contradict together.
    (text,) = [text for text in beside.remarks() if "the fixes lie beside" in text]
    assert " m (east/north/up)" in text
    assert -6.0 < float(text.split("by ")[1].split("/")[1]) < -3.0
    # Fixes that may wander by that much do not lie beside.
    wander = SmootherParams(gnss=Gnss(position_error_sd=(5.0, 5.0, 5.0), position_error_tau=300.0))
    assert Smoother(wander, shifted).run(*logs).remarks() == []


@pytest.mark.parametrize("radius", [0.9, 1.1])
def test_a_landing_of_another_radius_is_said_and_counts_less(jump, recording, radius):
    """It is half a metre off behind K, takes a trajectory along, and leaves small deviations."""
    certificate = yaml.safe_load(
        (data_folder("config") / "surfaces" / "oberstdorf_hs106.yaml").read_text())
    believed = surface_from_mapping({**certificate, "rL": radius * certificate["rL"]})
    result = Smoother(SmootherParams(), believed).run(
        recording.imu, recording.mag, recording.fix, recording.velocity)
    (text,) = [text for text in result.remarks() if "heights of the landing profile" in text]
    assert ("too small" if radius > 1.0 else "too large") in text
    assert 0.2 < abs(result.profile.metres) < 0.6
    assert abs(result.jump.length - jump.length) < 3 * result.jump.length_sd < 1.0


def test_an_error_of_the_profile_that_may_be_chance_widens_what_is_stated(result):
    wider = widened_by_profile(result, ProfileError(-0.3, -2.5))
    up, before = (r.samples["cov_position"][:, 2, 2] for r in (wider, result))
    np.testing.assert_allclose(up - before, 0.09)
    up, before = (r.samples["cov_velocity"][:, 2, 2] for r in (wider, result))
    np.testing.assert_allclose(np.sqrt(up - before), 0.3 / result.jump.flight_time)
    assert wider.jump.length_sd == pytest.approx(np.hypot(result.jump.length_sd, 0.3))
    assert wider.jump.length == result.jump.length and wider.remarks() == []


def test_a_surface_is_placed_no_better_than_it_says_and_fixes_show():
    """All of its rows share the error of its origin."""
    samples = np.zeros(2, SAMPLE)
    ground = height_constraint("ground", "always", 0.3, lambda e, n: (0 * e, 0 * e, 0 * e))

    def sd(offset, offset_sd):
        moved_samples = samples.copy()
        widen_place(moved_samples, [ground], 1.0, np.array(offset), np.array(offset_sd))
        return np.sqrt(np.diagonal(moved_samples["cov_position"][1]))
    far = (np.inf,) * 3
    np.testing.assert_allclose(sd((0.0, 0.0, 0.0), far), [0.0, 0.0, 0.3])
    np.testing.assert_allclose(sd((0.0, 0.0, 0.0), (0.01, 0.01, 0.01)), [0.0, 0.0, 0.01], atol=1e-4)
    np.testing.assert_allclose(sd((0.8, -2.0, 0.3), (0.9, 0.9, 0.4)), [0.0, 2.0, 0.24], atol=1e-3)
    # Single fixes far away are no offset; errors that wander are known less well.
    residuals = np.random.default_rng(2).standard_normal((400, 3)) + [0.5, 0.0, 0.0]
    residuals[::20] += 100.0
    offset, offset_sd = fixes_beside(residuals, 1.0)
    assert abs(offset[0] - 0.5) < 3 * offset_sd and np.abs(offset[1:]).max() < 3 * offset_sd
    assert offset_sd == 0.05 and fixes_beside(residuals, 4.0)[1] == 0.2


def test_a_surface_says_as_much_per_second_at_any_rate(jump):
    said = []
    for rate in (50, 100, 400):
        stamp = EPOCH + np.arange(10 * rate + 1) * (10**9 // rate)
        place = jump.at((stamp - EPOCH) * 1e-9).position_world
        events = JumpEvents(EPOCH + int(20e9), EPOCH + int(25e9))
        start, contacts = evaluate_constraints(
            jump.hill.constraints(), place, stamp, events, SmootherParams())
        assert start[-1] == 2 * len(stamp)  # height and lateral, in-run only
        said.append(np.sum(1.0 / contacts["sigma"] ** 2))
        if rate == 100:
            assert np.allclose(contacts["sigma"], 0.1, rtol=1e-12)  # as the paper has it
    # A simulated sensor moves against the skis with the density of these rows.
    allowed = 0.1 * np.sqrt(2.0 * SurfaceContact().interval * FASTEST_WOBBLE)
    assert abs(jump.params.wobble / allowed - 1) < 0.02
    # Two rows for 10 s of independent 0.1 m every 0.01 s, and half an interval at the ends.
    assert np.allclose(said, 2 * 10 / 0.01 / 0.1 ** 2, rtol=0.003)


@pytest.mark.parametrize("rate", [50, 200])
def test_deviations_over_seconds_are_told_by_what_sigma_allows(rate):
    plane = surface_from_mapping({"type": "plane", "slope_deg": 0, "aspect_deg": 0, "sigma": 0.1,
                                  "origin": {"latitude": 47, "longitude": 10, "height": 500}})
    samples = np.zeros(60 * rate, SAMPLE)
    samples["stamp"] = EPOCH + np.arange(60 * rate) * (10**9 // rate)
    samples["stamp"][20 * rate:] += 3600 * 10**9  # an hour without samples counts for nothing
    # Rows of 0.1 m every 10 ms give the mean of a second 10 mm; beside that, 100 Hz of noise that
    # means over a second do not see.
    samples["position_world"][:, 2] = 0.015 + 0.02 * (-1.0) ** np.arange(60 * rate)
    fit = surface_fits(plane.constraints(), samples, {}, None, SmootherParams())["plane"]
    # Half an interval at both ends of each part.
    assert abs(fit.excess - 1.5) < 0.02
    assert abs(fit.rms - 0.025) < 1e-9 and abs(fit.largest - 0.035) < 1e-9
    lifted = surface_fits(plane.constraints(), samples, {}, None,
                          SmootherParams(surface=SurfaceContact(body_height=0.015)))["plane"]
    assert lifted.excess < 0.05  # samples beside the gap count up to fivefold
    # Twice as far for twice the deviation.
    slow = SmootherParams(surface=SurfaceContact(interval=0.04))
    assert abs(surface_fits(plane.constraints(), samples, {}, None, slow)["plane"].excess
               - 0.75) < 0.02


def test_a_plane_holds_the_height(jump, recording):
    t = (recording.imu.stamp - EPOCH) * 1e-9
    still = recording.imu[t < jump.t_start]
    origin = jump.hill.origin.to_geodetic(recording.motion.position_world[0])
    plane = surface_from_mapping({"type": "plane", "slope_deg": 0, "aspect_deg": 0, "sigma": 0.1,
                                  "origin": dict(zip(("latitude", "longitude", "height"),
                                                     map(float, origin)))})
    r = Smoother(SmootherParams(), plane).run(still, recording.mag, recording.fix,
                                              recording.velocity)
    assert np.abs(r.samples["position_world"][:, 2]).max() < 0.1
    assert r.samples["cov_position"][:, 2, 2].max() < 0.01 < r.samples["cov_position"][0, 0, 0]


def test_a_surface_holds_within_its_windows(jump, recording):
    # A plane where the jumper sits: true in the first five seconds, far off later.
    origin = jump.hill.origin
    level = surface_from_mapping({
        "type": "plane", "slope_deg": 0.0, "aspect_deg": 0.0, "sigma": 0.01,
        "origin": {"latitude": origin.latitude_deg, "longitude": origin.longitude_deg,
                   "height": origin.height + float(recording.motion.position_world[0, 2])}})
    windows = SmootherParams(surface=SurfaceContact(windows=(1.0, 4.0, 4.5, 5.0)))
    r = Smoother(windows, level).run(recording.imu, recording.mag, recording.fix,
                                     recording.velocity)
    (fit,) = r.surface.values()
    t = (r.samples["stamp"][fit.sample] - EPOCH) * 1e-9
    assert np.array_equal(np.unique(t.round(2)), np.r_[np.arange(100, 400), np.arange(450, 500)]
                          / 100)
    assert fit.silent == 0.0 and fit.largest < 0.05
    assert r.remarks() == []
    sd = np.sqrt(r.samples["cov_position"][:, 2, 2])
    assert sd[200] < 0.02 < 0.1 < sd[2000]
    # Without windows the plane is held against 80 m of descent, and this is said.
    whole = Smoother(SmootherParams(), level).run(recording.imu, recording.mag, recording.fix,
                                                  recording.velocity)
    assert any("stands off the surface" in text for text in whole.remarks())
    with pytest.raises(EstimationError, match="says nothing at any sample.*surface.windows"):
        Smoother(SmootherParams(surface=SurfaceContact(windows=(50.0, 60.0))), level).run(
            recording.imu, recording.mag, recording.fix, recording.velocity)
    for wrong in ((1.0,), (4.0, 1.0), (1.0, 3.0, 2.0, 4.0)):
        with pytest.raises(ParameterError, match="pairs of start and stop"):
            SmootherParams(surface=SurfaceContact(windows=wrong))


def test_a_grid_that_ends_says_so(jump, recording):
    # Known in the half of the in-run only.
    def elevation(east, north):
        x = jump.hill.to_hill(np.stack([east, north, 0.0 * east], axis=1))[:, 0]
        z, slope, _ = jump.hill.in_run(np.minimum(x, 0.0))
        z = np.where(x < -40.0, -z, np.nan)
        return (z, *(-slope[:, None] * jump.hill.axes[0, :2]).T)

    class Grid(Surface):
        def constraints(self):
            return (height_constraint("grid", "always", 0.1, elevation),)

    r = Smoother(SmootherParams(), Grid(jump.hill.origin)).run(
        recording.imu, recording.mag, recording.fix, recording.velocity)
    held = ~in_flight(recording.imu, 9.81, (0.0, 0.0, 0.0))    # flying, it asks no surface
    known = (jump.hill.to_hill(recording.motion.position_world)[held, 0] < -40.0).mean()
    assert abs(r.surface["grid"].silent - (1.0 - known)) < 0.01
    assert any("says nothing at 6" in text for text in r.remarks()), (known, r.remarks())


def test_a_surface_elsewhere_is_refused(jump, recording):
    away = dataclasses.replace(jump.hill, origin=LocalFrame(48.4, 10.2922, 900.0))
    with pytest.raises(EstimationError, match="origin is 1[0-9][0-9] km from the start"):
        Smoother(SmootherParams(), away).run(recording.imu, recording.mag, recording.fix,
                                             recording.velocity)


def test_what_is_dragged_at_in_flight_is_not_held_and_what_slides_is():
    time = np.arange(300)
    felt = np.select([(time > 50) & (time < 100), time > 200], [0.4 * 9.81, 0.64 * 9.81], 9.81)
    log = ImuLog(10_000_000 * time, np.zeros((300, 3)), np.outer(felt, [0.0, 0.6, 0.8]))
    free = in_flight(log, 9.81, (0.0, 0.0, 0.0))
    assert np.array_equal(np.flatnonzero(free), np.arange(51, 100))
