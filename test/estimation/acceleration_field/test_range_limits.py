"""Accelerometers at the ends of their ranges, and steps of their converters."""

import numpy as np
import pytest

from imu_fusion.estimation.acceleration_field.estimator import AccelerationFieldEstimator
from imu_fusion.estimation.acceleration_field.rows import SATURATED
from imu_fusion.simulation.rigid_body_impact import simulate
from test.estimation.acceleration_field.test_faults import PARAMS, felt, judged, layout


@pytest.fixture(scope="module")
def impact():
    return simulate(duration=0.8)


def test_lost_samples_are_no_limit(impact):
    random = np.random.default_rng(1)
    readings = felt(impact)
    for k in (1, 2):
        readings[random.random(len(readings)) < 0.3, k] = np.nan
    estimator = AccelerationFieldEstimator(PARAMS, layout())
    rows = estimator.run(impact.stamp, readings)
    assert estimator.limits_found == {} and not np.any(rows["flags"] & SATURATED)


def test_steps_that_are_coarser_than_the_noise_are_told(impact):
    fine, coarse = felt(impact), np.round(felt(impact) / 2.0) * 2.0
    for readings, told in ((fine, False), (coarse, True)):
        estimator = AccelerationFieldEstimator(PARAMS, layout())
        estimator.run(impact.stamp, readings)
        assert any("in steps of 2 m/s^2" in text for text in estimator.remarks()) is told


def test_ranges_are_found_and_have_a_tolerance(impact):
    limit = 78.4532
    readings = np.clip(felt(impact), -limit, limit)
    at_limit = (np.abs(readings) >= limit).any(axis=(1, 2))
    # As a data sheet rounds it, above what the chip gives.
    rows, remarks, *_ = judged(impact, readings, layout(range=(78.4533,)))
    assert np.array_equal(rows["flags"] & SATURATED > 0, at_limit)
    bare = (np.abs(readings) < limit).sum(axis=(1, 2)) <= 6    # a and alpha take as many channels
    assert bare.sum() >= 3 and len(remarks) == 1
    assert f"too few channels in {bare.sum()} of {len(readings)}" in remarks[0]
    rows, remarks, *_ = judged(impact, readings)
    found = rows["flags"] & SATURATED > 0
    assert not np.any(found & ~at_limit) and found.sum() > 0.8 * at_limit.sum()
    assert any("stands at its limit of" in text and "78.4532" in text for text in remarks)


@pytest.mark.parametrize("mode", ["causal", "smoothed"])
def test_a_range_that_is_given_too_large_is_found_all_the_same(impact, mode):
    readings = np.clip(felt(impact), -80.0, 80.0)
    (rows, remarks, *_), (alike, *_) = (
        judged(impact, readings, layout(**given), mode=mode) for given in ({"range": (81.0,)}, {}))
    assert any("left: stands at its limit of 80" in text for text in remarks)
    assert np.array_equal(rows["specific_force"], alike["specific_force"])


def test_limits_that_leave_too_few_channels_are_said(impact):
    readings = np.clip(felt(impact), -50.0, 50.0)
    for limit, said in ((49.9, True), (500.0, False)):
        sound = felt(impact) if limit > 50.0 else readings
        remarks = judged(impact, sound, layout(range=(limit,)))[1]
        assert any("leave too few channels" in text for text in remarks) is said
