"""One property, every stream: what comes out does not depend on how the input was cut into blocks.

The input has what real ones have: samples that are broken, repeated, overtaken or not to be
decoded, sensors that come late, gaps, a clock set back.
"""

from dataclasses import replace

import numpy as np
import pytest

from imu_fusion.estimation.orientation.params import OrientationParams
from imu_fusion.messages.convert import fix_message, imu_message, mag_message, velocity_message
from imu_fusion.messages.layouts import IMU
from imu_fusion.simulation.rotation import Sensors, Tumbling, simulate
from imu_fusion.streams.acceleration_field import AccelerationFieldStream, FieldConfiguration
from imu_fusion.streams.orientation import OrientationStream
from imu_fusion.streams.orientation_messages import OrientationOutputParams
from imu_fusion.streams.smoother import SmootherStream

EPOCH = 1_700_000_000_000_000_000
NOISY = Sensors(gyr_density=1e-4, acc_density=2e-3, mag_sd=3e-7, gyr_bias=(0.01, -0.02, 0.005),
                gyr_limit=4.0)
PLACES = {"a": (0.1, 0.0, 0.0), "b": (0.0, 0.1, 0.0), "c": (0.0, 0.0, 0.1), "d": (-0.1, -0.1, 0.0)}


def spoilt(messages, rng):
    """Messages (stamp, make(stamp) -> CDR) of one topic, as a bad cable and a bad clock leave
    them."""
    result = []
    for i, (stamp, make) in enumerate(messages):
        stamp += EPOCH - (10_000_000_000 if i > 0.7 * len(messages) else 0)
        if 0.4 * len(messages) < i < 0.45 * len(messages):
            continue    # a gap
        fate = rng.random()
        if fate < 0.01:
            result.append(make(stamp)[:50])
        elif fate < 0.02:
            result += [make(stamp), make(stamp)]
        elif fate < 0.03:
            result.append(make(stamp - 25_000_000))
        else:
            result.append(make(stamp))
    return result


@pytest.fixture(scope="module")
def recording():
    """topic -> list of CDR messages: 8 s of a tumbling body that knows where it is."""
    rng = np.random.default_rng(5)
    imu, mag, _, _ = simulate(Tumbling(seed=3), 8.0, rate=100.0, mag_rate=23.0, sensors=NOISY,
                              seed=4)

    def rows(log, make):
        return spoilt([(int(s), lambda stamp, i=i: make(stamp, i))
                       for i, s in enumerate(log.stamp.tolist())], rng)
    broken = imu.gyr.copy()
    broken[rng.integers(0, len(broken), 8)] = np.nan
    fixes = replace(mag[::5])
    found = {
        "imu/data_raw": rows(imu, lambda s, i: imu_message(s, "ball", broken[i], imu.acc[i])),
        "imu/mag": rows(mag, lambda s, i: mag_message(s, "ball", mag.mag[i])),
        "fix": rows(fixes, lambda s, i: fix_message(s, "gnss", 47.0, 11.0, 600.0, np.eye(3),
                                                    status=0 if i > 3 else -1)),
        "fix_velocity": rows(fixes, lambda s, i: velocity_message(s, "world", np.zeros(3)))}
    for k, name in enumerate(PLACES):
        found[f"accelerometers/{name}"] = rows(imu, lambda s, i, k=k, name=name: imu_message(
            s + (k * 30_000 if i % 50 else 300_000), name, None, imu.acc[i]))
    return found


def field(**values):
    return FieldConfiguration.from_mapping({
        "sample_rate": 100.0, "points": [0.0, 0.0, 0.1], "accelerometers.names": list(PLACES),
        **{f"accelerometers.{n}.position": p for n, p in PLACES.items()}, **values})


STREAMS = {
    "orientation": OrientationStream,
    "orientation, lag": lambda: OrientationStream(OrientationParams(lag=0.3)),
    "orientation, smoothed": lambda: OrientationStream(OrientationParams(mode="smoothed")),
    "orientation, gyro_mag": lambda: OrientationStream(OrientationParams(method="gyro_mag")),
    "orientation, turned": lambda: OrientationStream(
        OrientationParams(world_frame="ned"), OrientationOutputParams(remove_gravity_vector=True)),
    "acceleration field": lambda: AccelerationFieldStream(field()),
    "acceleration field, smoothed": lambda: AccelerationFieldStream(field(mode="smoothed")),
    "acceleration field, ao": lambda: AccelerationFieldStream(field(method="ao")),
    "smoother": SmootherStream,
}


def run(stream, recording, sizes):
    """All that a strict session of the stream gives, topic -> [(stamp, CDR)], and what it counts;
    sizes() is the number of messages of the next block of a topic."""
    topics = [topic for topic in stream.inputs if topic in recording]
    stream.reset(topics)
    at = dict.fromkeys(topics, 0)
    made = []
    while any(at[topic] < len(recording[topic]) for topic in topics):
        block = {}
        for topic in topics:
            first, at[topic] = at[topic], min(at[topic] + sizes(), len(recording[topic]))
            if at[topic] > first:
                block[topic] = recording[topic][first:at[topic]]
        made += stream.take(block)
        ended = [t for t in topics if at[t] == len(recording[t])]
        if sizes() % 2:
            made += stream.end(ended)
    made += stream.finish()
    found = {}
    for topic, stamp, cdrs in made:
        found.setdefault(topic, []).extend(zip(stamp.tolist(), cdrs))
    counts = {topic: (stream.guards[topic].counts, stream.refused(topic)) for topic in topics}
    if isinstance(stream, SmootherStream):
        found["collected"] = {topic: (log.stamp.tolist(), log.flat().tolist())
                              for topic, log in stream.logs().items()}
    return {topic: rows for topic, rows in found.items() if rows}, counts, stream.restarts


@pytest.mark.parametrize("name", STREAMS)
def test_cuts_change_nothing(name, recording):
    whole, counts, restarts = run(STREAMS[name](), recording, lambda: 10 ** 6)
    assert whole and restarts == 1 and all(refused for _, refused in counts.values())
    one_by_one, same, again = run(STREAMS[name](), recording, lambda: 1)
    assert (one_by_one.keys(), same, again) == (whole.keys(), counts, restarts)
    assert one_by_one == whole
    for seed in range(3):
        rng = np.random.default_rng(seed)
        assert run(STREAMS[name](), recording, lambda rng=rng: int(rng.geometric(0.05) - 1)) == (
            whole, counts, restarts)


@pytest.mark.parametrize("name, topic", [("orientation", "imu/data"),
                                         ("acceleration field", "acceleration_field/imu")])
def test_what_comes_out_is_of_what_came_in(name, topic, recording):
    """Half of the input gives the first part of the output, so the property is not an empty one."""
    half = {topic: rows[:len(rows) // 2] for topic, rows in recording.items()}
    first, second = (run(STREAMS[name](), rows, lambda: 7)[0][topic] for rows in (recording, half))
    assert 100 < len(second) < len(first)
    assert second[:100] == first[:100]


def later(cdrs, shift):
    """Messages whose stamps are ``shift`` ns later; those without one as they are."""
    moved = []
    for cdr in cdrs:
        second, nanosecond = np.frombuffer(cdr, "<i4", 2, 4).tolist()
        stamp = np.array(divmod(second * 10**9 + nanosecond + shift, 10**9), "<i4")
        moved.append(cdr[:4] + stamp.tobytes() + cdr[12:])
    return moved


@pytest.mark.parametrize("name, topic", [
    ("orientation", "imu/data"), ("orientation, lag", "imu/data_smoothed"),
    ("acceleration field", "acceleration_field/imu")])
def test_a_microsecond_later_everywhere_estimates_differ_by_rounding(name, topic, recording):
    moved = {t: later(cdrs, 1000) for t, cdrs in recording.items()}
    first, second = (run(STREAMS[name](), rows, lambda: 50)[0][topic]
                     for rows in (recording, moved))
    assert [s + 1000 for s, _ in first] == [s for s, _ in second] and len(first) > 100
    values = [IMU.decode_block([cdr for _, cdr in rows]).values for rows in (first, second)]
    np.testing.assert_allclose(*values, rtol=1e-9, atol=1e-12)
