"""Logs refuse what is misshapen; guards judge by stamp and value."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imu_fusion.errors import SampleError
from imu_fusion.samples import ImuLog, MagLog, seconds
from imu_fusion.samples.guard import JUMP_BACK, Guard, Verdict, guard_log

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
