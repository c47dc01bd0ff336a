"""Flags and biases as messages: what a reader gets is what the estimator said."""

import numpy as np
import pytest

from imu_fusion.errors import MessageError
from imu_fusion.estimation.orientation import rows as st
from imu_fusion.estimation.orientation.params import OrientationParams
from imu_fusion.estimation.orientation.rows import ORIENTATION_DTYPE
from imu_fusion.messages.orientation_status import (
    WORDS,
    bias_message,
    bias_values,
    flags_message,
    flags_value,
    lasting_flags,
)
from imu_fusion.streams.orientation_messages import OrientationOutputParams, OrientationWriter
from imu_fusion.streams.stream import one_by_one


@pytest.mark.parametrize("flags", [0, *WORDS, sum(WORDS)])
def test_flags_survive_the_message(flags):
    stamp = 1_700_000_000_123_456_789
    assert flags_value(flags_message(stamp, "imu", flags)) == (stamp, flags)


def test_bytes_that_are_no_flags_are_refused():
    with pytest.raises(MessageError, match="DiagnosticArray"):
        flags_value(b"\x00\x01\x00\x00\x07")


def test_a_disturbance_lasts_until_the_next_magnetometer_sample():
    """Imu rows between two magnetometer samples say nothing of the field."""
    rows = [st.FLAG_MAG_USED, st.FLAG_MAG_DISTURBED, 0, st.FLAG_SATURATED, st.FLAG_MAG_USED, 0]
    d = st.FLAG_MAG_DISTURBED
    expected = [0, d, d, d | st.FLAG_SATURATED, 0, 0]
    assert lasting_flags(np.array(rows), 0).tolist() == expected
    for cut in range(1, len(rows)):
        assert lasting_flags(np.array(rows[cut:]), expected[cut - 1]).tolist() == expected[cut:]


def test_bias_and_its_deviation_survive_the_message():
    row = np.zeros((), ORIENTATION_DTYPE)
    row["stamp"], row["gyr_bias"], row["gyr_bias_sd"] = 12_345, [0.1, -0.2, 0.3], [1e-3, 2e-3, 3e-3]
    stamp, bias, sd = bias_values([bias_message(row, "imu")])
    assert stamp[0] == 12_345
    np.testing.assert_allclose(bias[0], row["gyr_bias"], rtol=1e-15)
    np.testing.assert_allclose(sd[0], row["gyr_bias_sd"], rtol=1e-12)


def test_flags_come_when_they_change_and_biases_ten_times_a_second():
    rows = np.zeros(500, ORIENTATION_DTYPE)
    rows["stamp"] = np.arange(500) * 10_000_000
    rows["quat_world_imu"][:, 3] = 1.0
    rows["flags"][100:200] = st.FLAG_SATURATED
    rows["flags"][150:300] |= st.FLAG_STILL
    writer = OrientationWriter(OrientationParams(), OrientationOutputParams())
    messages = [message for part in (rows[:170], rows[170:])
                for message in one_by_one(writer.messages(part, "imu"))]
    flags = [flags_value(cdr) for topic, _, cdr in messages if topic == "imu/flags"]
    s, r = st.FLAG_SATURATED, st.FLAG_STILL
    assert flags == [(0, 0), (1_000_000_000, s), (1_500_000_000, s | r), (2_000_000_000, r),
                     (3_000_000_000, 0)]
    assert sum(topic == "imu/gyro_bias" for topic, _, _ in messages) == 50
    steady = [(stamp, cdr[4]) for topic, stamp, cdr in messages if topic == "imu/steady_state"]
    assert steady == [(0, 0), (1_500_000_000, 1), (3_000_000_000, 0)]
