"""The centre of a body that tumbles is where the force does not turn with it."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from imu_fusion.estimation.smoother import Smoother, SmootherParams, hypotheses
from imu_fusion.estimation.smoother.attempt import other_centre
from imu_fusion.samples.centre import centre_in_flight, find_centre
from imu_fusion.samples.logs import ImuLog
from imu_fusion.simulation.avalanche import FLUELA, Avalanche
from imu_fusion.simulation.ball_sensors import LEVER_ARM, BallErrors, record_ball
from imu_fusion.surfaces.plane import Plane


@pytest.fixture(scope="module")
def ball():
    """Time, force and rate of a ball's whole way, forces with the errors of its sensors."""
    avalanche = Avalanche(rng=np.random.default_rng(3))
    log = record_ball(avalanche, np.random.default_rng(4), BallErrors(gyr_range=1e3, gyr_lsb=0.0))
    return avalanche.motion.time[log.rows], log.imu.acc, log.imu.gyr


def test_it_lies_where_the_ball_has_it(ball):
    found = find_centre(*ball)
    assert found.point == pytest.approx(-np.array(LEVER_ARM), abs=0.004)
    assert found.sd.max() < 0.01


def test_a_force_that_is_turned_round_puts_it_on_the_other_side(ball):
    time, force, rate = ball
    assert find_centre(time, -force, rate).point == pytest.approx(np.array(LEVER_ARM), abs=0.004)


def test_what_does_not_tumble_has_none(ball):
    time, force, rate = ball
    assert find_centre(time, force, 0.1 * rate) is None


def test_what_rolls_about_one_axis_alone_has_none(ball):
    """Where on the axis it is, no force tells; without noise the equations are singular."""
    time, force, rate = ball
    assert find_centre(time, np.tile([0.0, 0.0, 9.81], (len(time), 1)),
                       np.outer(5.0 + np.abs(rate[:, 0]), [0.0, 0.0, 1.0])) is None


def test_one_flight_of_a_second_tells_it(ball):
    """But where on the axis of the turn it is; without the flight nothing does."""
    time, force, rate = ball
    flies = (time > 0.65) & (time < 1.45)
    axis = rate[flies].mean(axis=0)
    axis /= np.linalg.norm(axis)
    for chosen, found in ((time < 1.45, True), (time < 0.6, False)):
        logs = [values[(time > -3.0) & chosen] for values in (time, force, rate)]
        assert centre_in_flight(*logs, -np.array(LEVER_ARM)) is None
        point = centre_in_flight(*logs, np.zeros(3))
        assert (point is not None) == found
        if found:
            off = point + LEVER_ARM
            assert np.linalg.norm(off - axis * (off @ axis)) < 0.004
            assert abs(point @ axis) < 0.004     # as given


@pytest.mark.parametrize(("lever_arm", "phase", "found"), [
    ((0.0, 0.0, 0.0), "always", True), (-np.array(LEVER_ARM), "always", False),
    (LEVER_ARM, "always", True), ((0.0, 0.0, 0.0), "in_run", False)])
def test_the_smoother_is_told_another_one(ball, lever_arm, phase, found):
    """Not given, given, with the other sign; a jumper's ski is no centre."""
    time, force, rate = ball
    params = SmootherParams().replace(**{"surface.lever_arm": tuple(lever_arm)})
    log = ImuLog(np.round(1e9 * (time - time[0])).astype(np.int64), rate, force)
    holds = [dataclasses.replace(c, phase=phase)
             for c in Plane(FLUELA, slope_deg=32.0, aspect_deg=45.0).constraints()]
    centre = other_centre(SimpleNamespace(
        params=params, constraints=holds, imu=SimpleNamespace(log=log)))
    assert (centre is not None) == found


def test_a_result_says_where_it_is(monkeypatch):
    n = 200
    imu = ImuLog(np.arange(n) * 10_000_000, np.zeros((n, 3)), np.tile([0.0, 0.0, 9.81], (n, 1)))
    monkeypatch.setattr(hypotheses, "other_centre", lambda problem: np.array([0.0, 0.031, -0.012]))
    result = Smoother(SmootherParams().replace(**{
        "initial.position": (47.0, 11.0, 800.0), "initial.position_sd": 0.1})).run(imu)
    (text,) = [text for text in result.remarks() if "surface.lever_arm" in text]
    assert "[0.000, 0.031, -0.012] m" in text
