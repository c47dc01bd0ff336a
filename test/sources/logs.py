"""What tests of formats share."""

import struct

from imu_fusion.samples.logs import Log
from imu_fusion.sources.ulog import MAGIC


def together(blocks):
    """{topic: log} of blocks in order."""
    found = {}
    for topic, log, _ in blocks:
        found.setdefault(topic, []).append(log)
    return {topic: Log.joined(logs) for topic, logs in found.items()}


def read(source, data, part="", cuts=()):
    """{topic: log} of bytes that are fed in pieces."""
    blocks, start = [], 0
    for cut in (*cuts, len(data)):
        blocks += source.feed(data[start:cut], part)
        start = cut
    return together(blocks + source.finish())


def read_parts(source, files):
    blocks = [block for part, data in files.items() for block in source.feed(data, part)]
    return together(blocks + source.finish())


def same(a, b):
    """Whether two sets of logs are equal, sample by sample, bit for bit."""
    return a.keys() == b.keys() and all(
        (a[t].stamp == b[t].stamp).all() and a[t].flat().tobytes() == b[t].flat().tobytes()
        for t in a)


GPS = ("vehicle_gps_position", "uint64_t timestamp;uint64_t time_utc_usec;int32_t lat;int32_t lon;"
       "int32_t alt_ellipsoid;float eph;float epv;float s_variance_m_s;float vel_n_m_s;"
       "float vel_e_m_s;float vel_d_m_s;uint8_t fix_type;")
COMBINED = ("sensor_combined", "uint64_t timestamp;float[3] gyro_rad;uint32_t gyro_integral_dt;"
            "int32_t accelerometer_timestamp_relative;float[3] accelerometer_m_s2;"
            "uint32_t accelerometer_integral_dt;")
APART = [(name, "uint64_t timestamp;float x;float y;float z;")
         for name in ("sensor_gyro", "sensor_accel")]


def ulog(apart=False):
    """A ULog of an Imu at 100 Hz and a receiver at 5 Hz (docs.px4.io, "ULog File Format"); the Imu
    as one topic, or as those of its two sensors, of which the accelerometer is 2 ms early."""
    topics = [GPS, *(APART if apart else [COMBINED])]
    records = [(b"F", f"{name}:{text}".encode()) for name, text in topics]
    records += [(b"A", struct.pack("<BH", 0, number) + name.encode())
                for number, (name, _) in enumerate(topics)]
    for k in range(200):
        time = 10_000 * k
        if apart:
            records.append((b"D", struct.pack("<HQ3f", 1, time, 0.1, 0.0, 0.2)))
            records.append((b"D", struct.pack("<HQ3f", 2, max(time - 2000, 0), 0.0, 0.0, -9.81)))
        else:
            records.append((b"D", struct.pack("<HQ3fIi3fI", 1, time, 0.1, 0.0, 0.2, 10_000, -2000,
                                              0.0, 0.0, -9.81, 10_000)))
        if k % 20 == 0:
            records.append((b"D", struct.pack(
                "<HQQ3i6fB", 0, time, 1_700_000_000_000_000 + time, 470_000_000, 110_000_000,
                500_000, 1.0, 2.0, 0.3, 1.0, 0.0, 0.0, 3)))
    return MAGIC + b"\x01" + bytes(8) + b"".join(
        struct.pack("<H", len(content)) + kind + content for kind, content in records)
