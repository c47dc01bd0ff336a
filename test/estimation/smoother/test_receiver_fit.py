"""An antenna or a clock that is not as it is said to be is seen, mended and said."""

import dataclasses

import numpy as np
import pytest

from imu_fusion.estimation.smoother import Smoother, SmootherParams
from imu_fusion.simulation import walk as walking

LEVER = np.array([0.3, -0.2, 0.4])


def walked(**errors):
    """A walk of 30 s with RTK, and what is recorded of it."""
    walk = walking.Walk(30.0, np.random.default_rng(8))
    return walk, walking.record(walk, np.random.default_rng(9), walking.WalkErrors(**errors))


def off(result, walk, imu):
    """RMS distance (m) of the sensor from where it was."""
    place = result.frame.to_enu(*walking.FRAME.to_geodetic(walk.position(
        (result.samples["stamp"] - imu.stamp[0]) * 1e-9)))
    return np.sqrt(np.mean(np.sum((result.samples["position_world"] - place) ** 2, axis=1)))


def test_an_antenna_that_is_elsewhere():
    walk, recorded = walked(lever_arm=tuple(LEVER))
    given = LEVER * [1.0, -1.0, -1.0]
    result = Smoother(SmootherParams().replace(**{"gnss.lever_arm": tuple(given)})).run(
        recorded.imu, recorded.mag, recorded.fix, recorded.velocity)
    (found,), (sd,) = (values[:1] for values in result.states["gnss_lever_arm"])
    assert np.all(np.abs(found - LEVER) < 4.0 * sd) and np.all(sd < 0.02)
    assert off(result, walk, recorded.imu) < 0.03
    assert any("an antenna at" in text for text in result.remarks())


def test_a_receiver_whose_clock_runs_slower():
    rate = -0.003
    walk, recorded = walked()
    start = recorded.imu.stamp[0]
    fix, velocity = (dataclasses.replace(log, stamp=start + np.round(
        (log.stamp - start) * (1.0 + rate)).astype(np.int64))
        for log in (recorded.fix, recorded.velocity))
    result = Smoother().run(recorded.imu, recorded.mag, fix, velocity)
    assert result.clock_rate == pytest.approx(rate, abs=5e-4)
    assert off(result, walk, recorded.imu) < 0.03
    assert any("millionths slower" in text for text in result.remarks())


def test_fixes_alone_whose_heights_are_in_feet():
    walk, recorded = walked()
    for unit, said in ((0.3048, True), (1.0, False)):
        result = Smoother().run(recorded.imu, recorded.mag, dataclasses.replace(
            recorded.fix, height=recorded.fix.height / unit))
        assert (1.5 < result.height_scale < 4.0) == said
        assert any("heights of the fixes" in text for text in result.remarks()) == said


def test_antenna_and_clock_as_they_are_said_to_be():
    walk, recorded = walked(lever_arm=tuple(LEVER))
    result = Smoother(SmootherParams().replace(**{"gnss.lever_arm": tuple(LEVER)})).run(
        recorded.imu, recorded.mag, recorded.fix, recorded.velocity)
    assert not result.clock_rate and not result.remarks()
    assert off(result, walk, recorded.imu) < 0.03
