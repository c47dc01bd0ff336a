"""The recording at a glance: topics, rates, gaps, ranges, what looks wrong."""

from collections.abc import Sequence

import numpy as np

from imu_fusion.recordings.inspect import TopicReport
from imu_fusion.report.figures import ESTIMATE, Band, Line, Panel, time_figure
from imu_fusion.report.html import Block, Figure, Notes, Section, Table, Text
from imu_fusion.samples import seconds
from imu_fusion.samples.checks import GAP_FACTOR

# Topics whose intervals are drawn, and stretches of which each is a summary.
_PANELS, _STRETCHES = 8, 400


def overview_section(topics: Sequence[TopicReport], origin: int) -> Section:
    """Section about a whole recording.

    Args:
        topics: of every topic of the recording.
        origin: int ns, zero of the time axis.
    """
    rows, ranges = [], []
    for t in topics:
        times = t.timing
        timed = (number(times.rate_hz, 2), number(times.jitter_s * 1e3, 3), times.gaps,
                 number(times.longest_gap_s * 1e3, 1), times.repeated + times.backwards)
        rows.append((t.topic, t.msgtype.replace("/msg/", "/"), t.count,
                     *(timed if t.stamped else ["–"] * len(timed))))
        ranges += [(t.topic, r.quantity, f"{r.low:.6g}", f"{r.high:.6g}", r.unit)
                   for r in t.ranges]
    findings = [finding.text for t in topics for finding in t.findings]
    blocks: list[Block] = [Table(
        ("topic", "type", "messages", "rate Hz", "jitter ms", "gaps", "longest ms",
         "out of order"), tuple(rows),
        "By header stamps. Jitter: half the width of the central 68 % of the intervals. Gaps: "
        f"intervals above {GAP_FACTOR:g} times the usual one; the longest interval stands beside "
        "them.")]
    blocks.append(Notes(tuple(findings)) if findings
                  else Text("Nothing looks wrong: stamps increase, units and magnitudes fit, no "
                            "axis stands at a limit."))
    if ranges:
        blocks.append(Table(("topic", "quantity", "least", "greatest", "unit"), tuple(ranges)))
    # Samples only: diagnostics of a replay carry the time of the replay.
    drawn = [t for t in topics if t.stamped and t.log is not None]
    panels = [panel for t in drawn[:_PANELS] for panel in _intervals(t, origin)]
    if panels:
        blocks.append(Figure(
            time_figure(panels, panel_height=105),
            "Time between one stamp and the next. A flat line is a steady rate; single peaks are "
            "lost samples."))
    return Section("The recording", tuple(blocks))


def _intervals(topic, origin):
    """The panel of one topic's intervals, if it has any: what is usual, and the longest."""
    step = np.diff(topic.stamp) * 1e-6
    time = seconds(topic.stamp[1:], origin)
    forward = step > 0
    step, time = step[forward], time[forward]
    if len(step) < 2:
        return []
    length = -(-len(step) // _STRETCHES)
    starts = np.arange(0, len(step), length)
    blocks = np.full(len(starts) * length, np.nan)
    blocks[:len(step)] = step
    low, high, longest = np.nanpercentile(blocks.reshape(-1, length), [5, 95, 100], axis=1)
    return [Panel("ms", (Band("90 % of the intervals", time[starts], low, high, opacity=0.6),
                         Line("longest", time[starts], longest, ESTIMATE)),
                  title=topic.topic, from_zero=True)]


def number(value: float | None, digits: int) -> str:
    """A number for a table, a dash where there is none."""
    return "–" if value is None or not np.isfinite(value) else f"{value:.{digits}f}"
