"""Logs refuse what is misshapen; guards judge by stamp and value."""

from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imu_fusion.errors import SampleError
from imu_fusion.samples import ImuLog, MagLog, seconds
from imu_fusion.samples.guard import JUMP, Guard, Verdict, guard_log

MS = 1_000_000
START = 1_700_000_000_000 * MS
DAY = 86_400_000 * MS


def test_stamps_keep_nanoseconds_that_float_seconds_would_lose():
    origin = 1_700_000_000_000_000_000
    assert seconds([origin + 1], origin)[0] == 1e-9


@pytest.mark.parametrize("stamp", [np.array([0.0, 1.0]), np.zeros((2, 2), dtype=np.int64)])
def test_logs_refuse_float_or_misshapen_stamps(stamp):
    with pytest.raises(SampleError, match="integer nanoseconds"):
        MagLog(stamp, np.zeros((2, 3)))


def test_logs_refuse_columns_of_other_lengths():
    with pytest.raises(SampleError, match=r"MagLog.mag has shape \(3, 3\)"):
        MagLog(np.arange(2), np.zeros((3, 3)))


def test_log_slices_keep_rows_together():
    log = ImuLog(np.arange(5), np.arange(15.0).reshape(5, 3), -np.arange(15.0).reshape(5, 3))
    part = log.between(1, 3)
    assert list(part.stamp) == [1, 2] and part.gyr[0, 0] == 3.0 and part.acc[1, 2] == -8.0


def judge(stamps, values=None, small_jumps=True):
    """(epoch and ms since START of what is kept, Counter of what is refused) of stamps in ms; the
    values of samples are all different unless given."""
    stamps = START + np.round(np.array(stamps) * MS).astype(np.int64)
    values = np.arange(len(stamps), dtype=float)[:, None] if values is None else values
    guard = Guard(small_jumps)
    parts = [guard.take(stamps, values), guard.finish()]
    kept = [(e, (int(s) - START) / MS)
            for p in parts for e, found, _ in p.runs for s in found]
    refused = Counter(v for p in parts for v in p.verdicts)
    assert refused == guard.counts - Counter({Verdict.OK: len(kept)})
    return kept, refused


REGULAR = [float(t) for t in range(0, 500, 10)]


def test_broken_samples_are_refused_and_nothing_else():
    values = np.arange(50.0)[:, None]
    values[[3, 20], 0] = np.nan, np.inf
    kept, refused = judge(REGULAR, values)
    assert len(kept) == 48 and refused == {Verdict.NOT_FINITE: 2}
    kept, refused = judge([-START / MS - 5, *REGULAR])
    assert kept == [(0, t) for t in REGULAR] and refused == {Verdict.NEGATIVE: 1}
    kept, refused = judge([*REGULAR[:20], *REGULAR[19:]])
    assert kept == [(0, t) for t in REGULAR] and refused == {Verdict.DUPLICATE: 1}


@pytest.mark.parametrize("late", [1, 5, 20])
def test_what_was_overtaken_is_no_clock_set_back(late):
    """A packet of samples comes after the next packet."""
    order = [*REGULAR[:10], *REGULAR[10 + late:10 + 2 * late], *REGULAR[10:10 + late],
             *REGULAR[10 + 2 * late:]]
    kept, refused = judge(order)
    assert refused == {Verdict.BACKWARDS: late} and len(kept) == 50 - late
    assert {epoch for epoch, _ in kept} == {0}


def test_what_is_sent_again_is_no_clock_set_back():
    values = np.r_[0:30, 10:50].astype(float)[:, None]
    kept, refused = judge([*REGULAR[:30], *REGULAR[10:]], values)
    assert kept == [(0, t) for t in REGULAR] and refused == {Verdict.DUPLICATE: 20}


@pytest.mark.parametrize("by", [13.0, 30.0, 160.0, 203.7, 999.0, 1000.0, 60_000.0])
@pytest.mark.parametrize("jitter", [0.0, 1.5])
def test_a_clock_set_back_begins_an_epoch_without_a_sample_lost(by, jitter):
    """10 ms apart with jitter; true time goes on, stamps go back."""
    true = np.arange(0.0, 4000.0, 10.0)
    stamps = true + np.random.default_rng(1).uniform(-jitter, jitter, len(true))
    stamps[200:] -= by
    kept, refused = judge(stamps)
    assert not refused and [epoch for epoch, _ in kept] == [0] * 200 + [1] * 200
    assert [stamp for _, stamp in kept] == pytest.approx(stamps, abs=1e-5)


def test_a_clock_set_back_is_seen_of_a_signal_that_stands_still():
    """On a regular grid the very same samples come again, as if they had been sent twice."""
    kept, refused = judge([*REGULAR, *(t + 500.0 - 160.0 for t in REGULAR)], np.ones((100, 2)))
    assert not refused and [epoch for epoch, _ in kept] == [0] * 50 + [1] * 50


def test_a_sensor_without_a_say_in_the_clock_refuses_what_is_less_than_a_jump_back():
    kept, refused = judge([*REGULAR, *(t + 500.0 - 160.0 for t in REGULAR)], small_jumps=False)
    assert refused == {Verdict.BACKWARDS: 15, Verdict.DUPLICATE: 1}
    assert {epoch for epoch, _ in kept} == {0}


@pytest.mark.parametrize("wild", [400 * DAY / MS, 3e3, 500.0, 65.0, -3e3, -300 * DAY / MS])
@pytest.mark.parametrize("place", [1, 25, 49])
def test_a_single_wild_stamp_is_left_out(wild, place):
    stamps = list(REGULAR)
    stamps[place] += wild
    kept, refused = judge(stamps)
    if place == 49 and 0 < wild <= 3e3:
        return    # at the end nothing tells it from a pause
    assert refused == {Verdict.WILD: 1}
    assert kept == [(0, t) for i, t in enumerate(REGULAR) if i != place]


def test_a_pause_is_a_gap_and_a_clock_that_was_not_set_begins_anew():
    kept, refused = judge([*REGULAR, *(t + 3600e3 for t in REGULAR)])
    assert not refused and {epoch for epoch, _ in kept} == {0}
    kept, refused = judge([*REGULAR, *(t + 20 * DAY / MS for t in REGULAR)])
    assert not refused and [epoch for epoch, _ in kept] == [0] * 50 + [1] * 50


@pytest.mark.parametrize("interval", [1000.0, 1001.0, 5000.0, 600e3])
def test_slow_sensors_lose_nothing(interval):
    stamps = [k * interval for k in range(20)]
    assert judge(stamps) == ([(0, t) for t in stamps], {})
    # Set back after the tenth.
    stamps = stamps[:10] + [t - 9.5 * interval for t in stamps[10:]]
    assert judge(stamps) == ([(int(k >= 10), t) for k, t in enumerate(stamps)], {})


steps = st.sampled_from([10, 10, 10, 10, 11, 9, 0, -30, -160, 2000, -5000, 40, 20 * 86_400_000])


@settings(max_examples=300, deadline=None)
@given(st.lists(st.tuples(steps, st.sampled_from([0.0, 0.0, 0.0, 1.0, np.nan])), max_size=60),
       st.data())
def test_a_guard_judges_blocks_as_samples(rows, data):
    stamps = START + MS * np.cumsum([step for step, _ in rows], dtype=np.int64)
    values = np.array([[value, 1.0] for _, value in rows]).reshape(-1, 2)

    def run(sizes):
        guard, at, parts = Guard(), 0, []
        while at < len(stamps):
            size = sizes()
            parts.append(guard.take(stamps[at:at + size], values[at:at + size]))
            at += size
        parts.append(guard.finish())
        kept = [(int(e), int(s), float(v[0])) for p in parts
                for e, *run in p.runs for s, v in zip(*run)]
        return kept, [(s, v) for p in parts for s, v in zip(p.refused_stamps, p.verdicts)], (
            guard.epoch, guard.last, guard.ends, guard.counts)

    whole = run(lambda: 100)
    assert run(lambda: 1) == whole == run(lambda: data.draw(st.integers(1, 7)))
    kept = [(epoch, stamp) for epoch, stamp, _ in whole[0]]
    assert kept == sorted(set(kept))
    assert len(kept) + len(whole[1]) == len(rows)


@given(st.lists(steps, max_size=40))
def test_guarding_a_log_is_guarding_its_samples(found):
    stamps = START + MS * np.cumsum(found, dtype=np.int64)
    values = np.arange(3.0 * len(stamps)).reshape(-1, 3)
    kept, epochs, _ = guard_log(MagLog(stamps, values))
    guard = Guard()
    runs = [run for part in (guard.take(stamps, values), guard.finish()) for run in part.runs]
    assert kept.stamp.tolist() == [s for _, stamp, _ in runs for s in stamp.tolist()]
    assert np.array_equal(kept.mag, np.concatenate([values[:0], *(found for *_, found in runs)]))
    assert epochs.tolist() == [epoch for epoch, stamp, _ in runs for _ in stamp]
    assert JUMP == 1000 * MS
