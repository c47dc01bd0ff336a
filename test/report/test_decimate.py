"""Decimation for plots: bounded, in order, no extreme lost, breaks kept."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imu_fusion.report.decimate import decimate, envelope


@settings(deadline=None, max_examples=60)
@given(st.integers(1, 5000), st.integers(0, 2 ** 31), st.integers(6, 300))
def test_every_spike_survives_and_the_length_is_bounded(n, seed, points):
    rng = np.random.default_rng(seed)
    time, values = np.arange(n) * 0.01, rng.normal(size=n)
    short_time, short = decimate(time, values, points)
    assert len(short) <= max(points, n if n <= points else 0)
    assert np.all(np.diff(short_time) > 0)
    assert short.min() == values.min() and short.max() == values.max()
    # A subset of the samples, not something in between.
    np.testing.assert_array_equal(values[np.searchsorted(time, short_time)], short)


def test_holes_break_the_line_and_nothing_else_does():
    values = np.ones(10000)
    values[4000:6000] = np.nan
    values[100] = np.nan
    time, short = decimate(np.arange(10000), values, 300)
    assert len(short) <= 300
    np.testing.assert_array_equal(time[np.isnan(short)], [100, 4000])
    assert not np.isnan(decimate(np.arange(10000), np.ones(10000), 300)[1]).any()
    assert len(decimate(np.arange(1000), np.full(1000, np.nan), 100)[1]) == 0


def test_a_band_is_never_drawn_narrower_than_it_is():
    rng = np.random.default_rng(0)
    time = np.arange(5000.0)
    low, high = -rng.random(5000), rng.random(5000)
    short_time, short_low, short_high = envelope(time, low, high, 100)
    assert len(short_time) <= 100 and np.all(np.diff(short_time) > 0)
    assert short_low.min() == low.min() and short_high.max() == high.max()
    low[7] = np.nan
    assert len(envelope(time[:50], low[:50], high[:50], 100)[0]) == 49


@pytest.mark.parametrize("n", [0, 1, 2])
def test_nothing_and_little_pass_through(n):
    time, values = decimate(np.arange(n), np.arange(n, dtype=float))
    assert len(time) == len(values) == n
