"""Guarding and merging: by stamp alone, whatever the arrival."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from imu_fusion.errors import SampleError
from imu_fusion.samples import ImuLog, MagLog, seconds
from imu_fusion.samples.guard import JUMP_BACK, Guard, Verdict, guard_log
from imu_fusion.samples.merge import RESTART, SampleStream, merge_order

ONE = np.ones(3)


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


def test_guard_refuses_and_counts():
    guard = Guard()
    s = JUMP_BACK
    judged = [guard.check(stamp, values) for stamp, values in [
        (10 * s, ONE), (10 * s, ONE), (10 * s - 1, ONE), (9 * s, ONE), (11 * s, np.array([np.nan])),
        (11 * s, np.array([np.inf, -np.inf])), (11 * s, ONE)]]
    assert judged == [Verdict.OK, Verdict.DUPLICATE, Verdict.BACKWARDS, Verdict.BACKWARDS,
                      Verdict.NOT_FINITE, Verdict.NOT_FINITE, Verdict.OK]
    assert guard.epoch == 0
    assert guard.check(10 * s - 1, ONE) is Verdict.OK and guard.epoch == 1
    assert sum(guard.refused().values()) == 5


stamp_lists = st.lists(st.integers(0, 5 * JUMP_BACK), max_size=30)


@given(stamp_lists)
def test_guarding_a_log_is_guarding_its_samples(stamps):
    log = MagLog(np.array(stamps, dtype=np.int64), np.tile(ONE, (len(stamps), 1)))
    kept, epochs, whole = guard_log(log)
    guard = Guard()
    rows = [(s, guard.epoch) for s in stamps if guard.check(s, ONE) is Verdict.OK]
    assert list(zip(kept.stamp.tolist(), epochs.tolist())) == rows
    assert whole.counts == guard.counts and (whole.last, whole.epoch) == (guard.last, guard.epoch)
    key = epochs * 10 * JUMP_BACK + kept.stamp
    assert (np.diff(key) > 0).all()


@settings(max_examples=200)
@given(stamp_lists, stamp_lists, st.randoms(use_true_random=False))
def test_streaming_in_any_interleaving_gives_the_batch_order(mag, imu, random):
    logs = [MagLog(np.array(s, dtype=np.int64), np.tile(ONE, (len(s), 1))) for s in (mag, imu)]
    guarded = [guard_log(log) for log in logs]
    topics, indices = merge_order([g[0].stamp for g in guarded], [g[1] for g in guarded])
    expected = [("mag", "imu")[t] + str(guarded[t][0].stamp[i]) for t, i in zip(topics, indices)]

    stream = SampleStream(["mag", "imu"])
    stream.begin(["mag", "imu"])
    arrivals = ["mag"] * len(mag) + ["imu"] * len(imu) + ["end mag", "end imu"]
    random.shuffle(arrivals)
    queues = {"mag": list(mag), "imu": list(imu)}
    events, ended = [], []
    for arrival in arrivals:
        if arrival.startswith("end"):
            ended.append(arrival[4:])
        else:
            stamp = queues[arrival].pop(0)
            events += stream.add(arrival, stamp, ONE)
        for topic in list(ended):  # an end is known once all its samples have come
            if not queues[topic]:
                events += stream.end(topic)
                ended.remove(topic)
    assert [t + str(s) for t, s, _ in events if t != RESTART] == expected
    assert stream.held == 0
    restarts = sum(t == RESTART for t, _, _ in events)
    assert restarts <= max([g[2].epoch for g in guarded])


def test_magnetometer_comes_before_the_imu_of_its_stamp():
    stream = SampleStream(["mag", "imu"])
    stream.begin(["mag", "imu"])
    assert stream.add("imu", 5, ONE) == []
    assert [e[0] for e in stream.add("mag", 5, ONE)] == ["mag", "imu"]


def test_live_holds_nothing_back_and_restarts_once_for_all_topics():
    stream = SampleStream(["mag", "imu"])
    assert [e[0] for e in stream.add("imu", 50 * JUMP_BACK, ONE)] == ["imu"]
    assert [e[0] for e in stream.add("mag", 49 * JUMP_BACK, ONE)] == ["mag"]
    assert [e[0] for e in stream.add("imu", 1, ONE)] == [RESTART, "imu"]
    assert [e[0] for e in stream.add("mag", 2, ONE)] == ["mag"]


def test_topics_outside_the_session_hold_nobody_back():
    stream = SampleStream(["mag", "imu"])
    stream.begin(["imu"])
    assert len(stream.add("imu", 5, ONE)) == 1


def test_refusals_are_reported_with_topic_and_stamp():
    seen = []
    stream = SampleStream(["imu"], refused=lambda *a: seen.append(a))
    stream.add("imu", 5, ONE)
    stream.add("imu", 5, ONE)
    assert seen == [("imu", 5, Verdict.DUPLICATE)]
