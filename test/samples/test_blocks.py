"""Blocks: the same samples in the same order however they are cut, as by a plain sort."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from imu_fusion.samples.blocks import BlockMerger
from imu_fusion.samples.guard import JUMP, Guard, Verdict

TOPICS = {"fix": 1, "mag": 1, "imu": 1}
SECOND = 1_000_000_000


@st.composite
def streams(draw):
    """topic -> (stamps, values) with repeats, overtaken samples, NaN and clocks set back."""
    result = {}
    for topic in TOPICS:
        steps = draw(st.lists(st.sampled_from(
            [10_000_000, 10_000_000, 10_000_001, 0, -30_000_000, -5 * SECOND]), max_size=30))
        stamp = 100 * SECOND + np.cumsum(np.array(steps, dtype=np.int64))
        broken = draw(st.lists(st.booleans(), min_size=len(steps), max_size=len(steps)))
        value = np.where(np.array(broken, bool), np.nan, np.arange(len(steps), dtype=float))
        result[topic] = stamp.astype(np.int64), value[:, None]
    return result


def expected(samples):
    """By the definition: guard one by one, then sort by epoch and stamp."""
    rows, order = [], list(TOPICS)
    for topic, (stamp, values) in samples.items():
        guard = Guard()
        for judged in (guard.take(stamp, values), guard.finish()):
            rows += [(int(e), int(s), order.index(topic), float(v[0]))
                     for e, *run in judged.runs for s, v in zip(*run)]
    return sorted(rows)


def rows_of(segments, epoch=0):
    """Released samples as (epoch, stamp, topic, value) in order; the last epoch."""
    rows, order = [], list(TOPICS)
    for segment in segments:
        epoch += segment.restart
        rows += sorted((epoch, s, order.index(topic), float(v[0]))
                       for topic, (stamp, values) in segment.samples.items()
                       for s, v in zip(stamp.tolist(), values))
    return rows, epoch


def cut(samples, data):
    """The same samples as a list of blocks, topics running ahead of each other."""
    at = {topic: 0 for topic in samples}
    while any(at[t] < len(s[0]) for t, s in samples.items()):
        block = {}
        for topic, (stamp, values) in samples.items():
            size = data.draw(st.integers(0, 7))
            i, at[topic] = at[topic], min(at[topic] + size, len(stamp))
            if at[topic] > i:
                block[topic] = stamp[i:at[topic]], values[i:at[topic]]
        yield block


@settings(max_examples=300, deadline=None)
@given(streams(), st.data())
def test_strict_merging_depends_on_stamps_alone(samples, data):
    merger = BlockMerger(TOPICS)
    merger.begin(list(TOPICS))
    found, epoch, epochs_seen = [], 0, []
    for block in cut(samples, data):
        rows, epoch = rows_of(merger.add(block), epoch)
        found += rows
        epochs_seen.append(epoch)
    rows, epoch = rows_of(merger.end(TOPICS), epoch)
    found += rows
    # A restart is told once an epoch, not once for each number that a guard has counted.
    numbers = {e: i for i, e in enumerate(sorted({row[0] for row in expected(samples)}))}
    shift = 0 if not numbers or 0 in numbers else 1
    assert found == [(numbers[e] + shift, *rest) for e, *rest in expected(samples)]
    assert merger.held == 0


def test_a_sample_waits_until_every_topic_has_passed_it():
    merger = BlockMerger(TOPICS)
    merger.begin(["imu", "mag"])
    stamp = np.arange(10, dtype=np.int64) * 10
    assert merger.add({"imu": (stamp, stamp[:, None].astype(float))}) == [] and merger.held == 10
    (segment,) = merger.add({"mag": (np.array([45]), np.array([[1.0]]))})
    assert segment.samples["imu"][0].tolist() == [0, 10, 20, 30, 40]
    assert segment.samples["mag"][0].tolist() == [45] and not segment.restart
    (segment,) = merger.end(["mag"])
    assert segment.samples["imu"][0].tolist() == [50, 60, 70, 80, 90]


def test_topics_outside_the_session_hold_nobody_back():
    merger = BlockMerger(TOPICS)
    merger.begin(["imu"])
    (segment,) = merger.add({"imu": (np.array([5]), np.array([[1.0]]))})
    assert list(segment.samples) == ["imu"]


def test_live_everything_is_released_at_once_and_all_clocks_go_back_together():
    merger = BlockMerger(TOPICS)
    one = np.array([[1.0]])
    (segment,) = merger.add({"imu": (np.array([100 * SECOND]), one),
                             "mag": (np.array([90 * SECOND]), one)})
    assert set(segment.samples) == {"imu", "mag"} and merger.held == 0
    assert merger.add({"imu": (np.array([3, 4]) * SECOND, one[[0, 0]])}) == []
    (segment,) = merger.add({"imu": (np.array([5 * SECOND]), one)})
    assert segment.restart and len(segment.samples["imu"][0]) == 3
    (segment,) = merger.add({"mag": (np.array([90 * SECOND - JUMP]), one)})
    assert not segment.restart, "the clock of the magnetometer has gone back already"


def test_what_is_refused_is_told_with_its_topic():
    told = []
    merger = BlockMerger(TOPICS, lambda topic, stamp, verdicts: told.append(
        (topic, stamp.tolist(), verdicts)))
    merger.add({"imu": (np.array([1, 1, 2, 3]), np.array([[0.0], [0.0], [np.nan], [0.0]]))})
    assert told == [("imu", [1, 2], [Verdict.DUPLICATE, Verdict.NOT_FINITE])]
    assert merger.guards["imu"].refused() == {
        Verdict.DUPLICATE.value: 1, Verdict.NOT_FINITE.value: 1}


def one_by_one(stamps):
    stamps = np.array(stamps, dtype=np.int64)
    return stamps, np.arange(float(len(stamps)))[:, None]


@settings(max_examples=100, deadline=None)
@given(st.integers(20, 3000), st.integers(0, 900), st.integers(0, 100))
def test_a_slow_topic_follows_a_clock_that_was_set_back(back, start, seed):
    """The fix, once a second, does not see an Imu's clock that is set back in the tenth second by
    ``back`` ms; what comes more than a second later than the Imu's last sample before is of the
    new epoch, however the samples were cut into blocks."""
    true = np.arange(0, 20_000, 10) * 1_000_000 + 100 * SECOND
    imu = true - (true >= 110 * SECOND) * back * 1_000_000
    fix = np.arange(20) * SECOND + 100 * SECOND + start * 1_000_000
    fix = fix - (fix >= 110 * SECOND) * back * 1_000_000
    samples = {"fix": one_by_one(fix), "imu": one_by_one(imu)}

    def run(blocks):
        merger = BlockMerger(TOPICS, one_clock=("imu", "mag"))
        merger.begin(["fix", "imu"])
        found, epoch = [], 0
        for block in blocks:
            rows, epoch = rows_of(merger.add(block), epoch)
            found += rows
        return found + rows_of(merger.end(TOPICS), epoch)[0]

    rng = np.random.default_rng(seed)

    def blocks():
        at = dict.fromkeys(samples, 0)
        while any(at[t] < len(s[0]) for t, s in samples.items()):
            block = {}
            for topic, (stamp, values) in samples.items():
                size = int(rng.integers(0, 7 if topic == "fix" else 700))
                i, at[topic] = at[topic], at[topic] + size
                block[topic] = stamp[i:at[topic]], values[i:at[topic]]
            yield block

    whole = run([samples])
    assert run(blocks()) == whole
    epochs = {topic: [row[0] for row in whole if row[2] == k] for k, topic in
              ((0, "fix"), (2, "imu"))}
    assert epochs["imu"] == [0] * 1000 + [1] * 1000
    assert len(epochs["fix"]) >= 18    # one may look repeated, one overtaken
    late = [stamp > 111 * SECOND for stamp in fix.tolist()]
    assert sum(epochs["fix"]) >= sum(late) - 2
