"""What tests of formats share."""

from imu_fusion.samples.logs import Log


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


def same(a, b):
    """Whether two sets of logs are equal, sample by sample, bit for bit."""
    return a.keys() == b.keys() and all(
        (a[t].stamp == b[t].stamp).all() and a[t].flat().tobytes() == b[t].flat().tobytes()
        for t in a)
