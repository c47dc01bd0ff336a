"""MCAP files record by record, also such as no writer makes."""

import struct

from imu_fusion.recordings.mcap_records import MAGIC
from test.recordings.test_bag import START


def mcap(path, *records, end=True):
    """An MCAP file of records (opcode, content)."""
    records = [(1, struct.pack("<II", 0, 0)), *records, *([(15, bytes(4)), (2, bytes(20))] * end)]
    path.write_bytes(MAGIC + b"".join(struct.pack("<BQ", op, len(c)) + c for op, c in records)
                     + MAGIC * end)
    return path


def text(*words):
    return b"".join(struct.pack("<I", len(w)) + w for w in (w.encode() for w in words))


def schema(name, definition="", number=1, encoding="ros2msg"):
    return 3, struct.pack("<H", number) + text(name, encoding, definition)


def channel(topic, number=1, encoding="cdr"):
    return 4, struct.pack("<HH", number, number) + text(topic, encoding, "")


def message(cdr, number=1, log_time=START):
    return 5, struct.pack("<HIQQ", number, 0, log_time, log_time) + cdr


def chunk(compression, packed, size, crc=0):
    return 6, struct.pack("<QQQII", START, START, size, crc, len(compression)) + (
        compression.encode() + struct.pack("<Q", len(packed)) + packed)


def in_chunk(*records):
    content = b"".join(struct.pack("<BQ", op, len(c)) + c for op, c in records)
    return chunk("", content, len(content))
