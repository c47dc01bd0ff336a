"""What velocities are in is told from fixes, and nothing is said where they agree."""

import dataclasses

import numpy as np
import pytest

from imu_fusion.geometry.geodesy import LocalFrame
from imu_fusion.samples.checks import check_fix
from imu_fusion.samples.logs import FixLog, VelocityLog
from imu_fusion.samples.travel import check_travel

FRAME = LocalFrame(47.0, 11.0, 600.0)
NOISE = (0.02, 1.5)    # m: RTK, and a receiver of a phone


def drive(seed, sd, speed=8.0):
    """Two minutes of a winding and hilly road, 5 Hz."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 120.0, 0.2)
    heading = np.cumsum(np.interp(t, np.arange(0.0, 130.0, 6.0), rng.uniform(-0.3, 0.3, 22))) * 0.2
    vel = speed * np.column_stack([np.cos(heading), np.sin(heading), 0.1 * np.sin(0.2 * t)])
    place = np.vstack([np.zeros(3), np.cumsum(0.5 * (vel[1:] + vel[:-1]) * 0.2, axis=0)])
    stamp = 10**18 + np.round(1e9 * t).astype(np.int64)
    fix = FixLog(stamp, *FRAME.to_geodetic(place + sd * rng.standard_normal(place.shape)),
                 np.zeros((len(t), 3, 3)), np.zeros(len(t)))
    return fix, VelocityLog(stamp, vel + 0.1 * rng.standard_normal(vel.shape),
                            np.zeros((len(t), 3, 3)))


def changed(velocity, change):
    return dataclasses.replace(velocity, vel_world=change(velocity.vel_world))


def said(fix, velocity):
    return " ".join(finding.text for finding in check_travel(fix, velocity, "fix_velocity"))


@pytest.mark.parametrize("sd", NOISE)
@pytest.mark.parametrize("seed", range(5))
def test_nothing_is_said_of_velocities_that_lead_from_fix_to_fix(seed, sd):
    for speed in (0.0, 1.4, 8.0):
        fix, velocity = drive(seed, sd, speed)
        assert not check_travel(fix, velocity, "fix_velocity")
        # A receiver that is late by less than a period of its own, and one that is biased.
        late = dataclasses.replace(velocity, stamp=velocity.stamp + 150_000_000)
        assert not check_travel(fix, late, "fix_velocity")
        assert not check_travel(fix, changed(velocity, lambda v: v + [0.2, 0.0, 0.1]), "")


@pytest.mark.parametrize("sd", NOISE)
@pytest.mark.parametrize(("change", "text"), [
    (lambda v: v[:, [1, 0, 2]] * [1.0, 1.0, -1.0], "north, east, down"),
    (lambda v: 3.6 * v, "in km/h"),
    (lambda v: v / 0.514444, "in knots"), (lambda v: 100.0 * v, "in cm/s"),
    (lambda v: -v, "reversed"),
    (lambda v: 0.0 * v, "all velocities are zero"),
    (lambda v: np.linalg.norm(v, axis=1)[:, None] * [1.0, 0.0, 0.0], "the body")])
def test_what_velocities_are_in(change, text, sd):
    for seed in range(3):
        fix, velocity = drive(seed, sd)
        finding, = check_travel(fix, changed(velocity, change), "fix_velocity")
        assert text in finding.text and finding.unusable


@pytest.mark.parametrize(("columns", "text"), [
    (lambda fix: (fix.longitude_deg, fix.latitude_deg), "latitude and longitude are exchanged"),
    (lambda fix: (fix.latitude_deg, -fix.longitude_deg), "longitude has the other sign"),
    (lambda fix: [np.floor(v) + 0.6 * (v % 1.0) for v in (fix.latitude_deg, fix.longitude_deg)],
     "degrees and minutes")])
def test_what_fixes_are_in(columns, text):
    fix, velocity = drive(1, NOISE[0])
    latitude, longitude = columns(fix)
    assert text in said(dataclasses.replace(fix, latitude_deg=latitude, longitude_deg=longitude),
                        velocity)


@pytest.mark.parametrize("late", [-1.5, 2.0])
def test_clocks_of_their_own(late):
    fix, velocity = drive(2, NOISE[0])
    velocity = dataclasses.replace(velocity, stamp=velocity.stamp + round(late * 1e9))
    finding, = check_travel(fix, velocity, "fix_velocity")
    assert f"{abs(late):.1f} s {'late' if late > 0 else 'early'}" in finding.text
    assert not finding.unusable


@pytest.mark.parametrize("sd", NOISE)
def test_two_receivers_on_one_topic(sd):
    fix, _ = drive(3, sd)
    assert not check_fix(fix)
    place = FRAME.to_enu(fix.latitude_deg, fix.longitude_deg, fix.height)
    place[1::2] += [1.5, -1.0, 2.0]
    latitude, longitude, height = FRAME.to_geodetic(place)
    finding, = check_fix(dataclasses.replace(fix, latitude_deg=latitude, height=height,
                                             longitude_deg=longitude))
    assert "two receivers" in finding.text and finding.unusable


def test_a_receiver_that_repeats_itself():
    fix, _ = drive(4, NOISE[1])
    finding, = check_fix(dataclasses.replace(fix[np.arange(len(fix)) // 3 * 3], stamp=fix.stamp))
    assert finding.kind == "held"
