"""Rows of equal stamps: missing, late and duplicated samples."""

import numpy as np

from imu_fusion.samples.matching import SampleMatcher


def run(samples, sensors=2, tolerance=2, hold=30):
    matcher = SampleMatcher(sensors, 1, tolerance, hold)
    rows = [row for sensor, stamp, value in samples for row in matcher.add(sensor, stamp, value)]
    return matcher, rows + matcher.flush()


def test_equal_stamps_within_the_tolerance_make_a_row():
    _, rows = run([(0, 10, 1.0), (1, 12, 2.0), (1, 19, 4.0), (0, 20, 3.0)])
    assert [stamp for stamp, _ in rows] == [10, 19]
    assert [r.ravel().tolist() for _, r in rows] == [[1, 2], [3, 4]]


def test_order_of_arrival_does_not_matter_within_the_hold():
    samples = [(s, 10 * k + s, float(k)) for k in range(40) for s in (0, 1)]
    random = np.random.default_rng(0)
    # Delays below 25: no sample comes more than the hold of 30 late.
    jumbled = sorted(samples, key=lambda x: x[1] + random.uniform(0, 25))

    def stamps(rows):
        return [r.ravel().tolist() for _, r in rows]
    matcher, rows = run(jumbled)
    assert stamps(rows) == stamps(run(samples)[1]) and len(rows) == 40
    assert matcher.late == matcher.duplicates == matcher.incomplete == 0


def test_missing_samples_are_not_waited_for_longer_than_the_hold():
    matcher = SampleMatcher(2, 1, 2, 30)
    assert matcher.add(0, 10, 1.0) == []
    assert matcher.add(0, 30, 2.0) == [] and matcher.add(1, 30, 2.0) == []  # 10 waits for its own
    (first, second) = matcher.add(0, 41, 3.0)
    assert first[0] == 10 and np.isnan(first[1][1, 0]) and second[0] == 30
    assert matcher.incomplete == 1
    assert matcher.add(1, 10, 1.0) == [] and matcher.late == 1


def test_duplicates_are_left_out():
    matcher, rows = run([(0, 10, 1.0), (0, 11, 9.0), (1, 10, 2.0)])
    assert rows[0][1].ravel().tolist() == [1, 2] and len(rows) == 1 and matcher.duplicates == 1
