"""The recording at a glance: topics, rates, gaps, ranges, what looks wrong."""

import numpy as np

from imu_fusion.report.figures import SERIES, Line, Panel, time_figure
from imu_fusion.report.html import Figure, Notes, Section, Table, Text
from imu_fusion.samples import seconds
from imu_fusion.samples.checks import GAP_FACTOR


def overview_section(topics, stamps, origin):
    """Section about a whole recording.

    Args:
        topics: list of TopicReport (imu_fusion.messages.inspect).
        stamps: dict of topic to (n,) int64 ns, of the topics whose intervals are drawn.
        origin: int ns, zero of the time axis.
    """
    rows = []
    for t in topics:
        times = t.timing
        timed = (number(times.rate_hz, 2), number(times.jitter_s * 1e3, 3), times.gaps,
                 number(times.longest_gap_s * 1e3, 1), times.repeated + times.backwards)
        rows.append((t.topic, t.msgtype.replace("/msg/", "/"), t.count,
                     *(timed if t.stamped else ["–"] * len(timed)),
                     ", ".join(f"{r.quantity} {r.low:.4g} to {r.high:.4g} {r.unit}".strip()
                               for r in t.ranges)))
    findings = [finding.text for t in topics for finding in t.findings]
    blocks = [Table(("topic", "type", "messages", "rate Hz", "jitter ms", "gaps", "longest ms",
                     "out of order", "range of values"), tuple(rows),
                    "By header stamps. Jitter: half the width of the central 68 % of the "
                    f"intervals. Gaps: intervals above {GAP_FACTOR:g} times the usual one; the "
                    "longest interval stands beside them.")]
    blocks.append(Notes(tuple(findings)) if findings
                  else Text("Nothing looks wrong: stamps increase, units and magnitudes fit, no "
                            "axis stands at a limit."))
    lines = []
    for i, (topic, stamp) in enumerate(sorted(stamps.items())):
        step = np.diff(stamp) * 1e-6
        forward = step > 0
        if forward.any():
            lines.append(Line(topic, seconds(stamp[1:][forward], origin), step[forward],
                              SERIES[i % len(SERIES)]))
    if lines:
        blocks.append(Figure(
            time_figure([Panel("interval in ms", tuple(lines), log=True)]),
            "Time between one stamp and the next: a flat line is a steady rate, peaks are lost "
            "samples."))
    return Section("The recording", tuple(blocks))


def number(value, digits):
    """A number for a table, a dash where there is none."""
    return "–" if value is None or not np.isfinite(value) else f"{value:.{digits}f}"
