"""Offline: a recording in, estimates out, without DDS and as fast as the machine can.

Runs the same guards, estimators and message encoders as the nodes. For the same
recording and parameters the estimates are those of the nodes, bit for bit.
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from imu_fusion.errors import TopicError
from imu_fusion.kernels import announced_compiling
from imu_fusion.messages.convert import SampleType
from imu_fusion.recordings.bag_reader import Reader, open_bag
from imu_fusion.recordings.bag_writer import BagWriter
from imu_fusion.recordings.inputs import find_inputs
from imu_fusion.recordings.results import write_results
from imu_fusion.samples.guard import Guard, guard_log
from imu_fusion.samples.logs import Log
from imu_fusion.streams.registry import STAGES
from imu_fusion.streams.stage import Stage, StageReport


@dataclass(frozen=True, eq=False)
class _Recorded:
    """One topic: the log as recorded, the one fit for use with its epochs, and the guard."""

    log: Log
    usable: Log
    epochs: np.ndarray
    guard: Guard


@dataclass(frozen=True, eq=False)
class _Chosen:
    """A stage that can run; ``names`` maps its topics to those in the recording."""

    stage: Stage
    report: StageReport
    names: Mapping[str, str]


_Logs = Mapping[tuple[str, SampleType], _Recorded]


def process(bag: str | Path, out: str | Path, params_file: str | Path | None = None,
            without: Collection[str] = (), remap: Mapping[str, str] | None = None,
            overwrite: bool = False, progress: Callable[[str], object] = lambda text: None
            ) -> tuple[list[StageReport], list[str]]:
    """Run every estimator whose topics are in a recording and write what it says.

    Args:
        bag: path of a recording.
        out: rosbag2 directory to write.
        params_file: ROS 2 parameter file, or None for defaults.
        without: node names of estimators to leave out.
        remap: dict of topic names of ours to those in the recording.
        overwrite: replace ``out``.
        progress: called with a line of text as things happen.

    Returns:
        (list of StageReport, list of what looks wrong with the recording)

    Raises:
        ImuFusionError: recording, parameters or topics are not usable.
    """
    for name in without:
        if name not in STAGES:
            raise TopicError(f"no estimator '{name}'; there are: {', '.join(STAGES)}")
    with open_bag(bag) as reader:
        reports, chosen = _choose(reader, params_file, without, remap or {})
        if not chosen:
            raise TopicError("nothing to do: " + "; ".join(
                f"{r.node}: {r.skipped}" for r in reports))
        kinds = {(name, c.stage.inputs[topic]) for c in chosen for topic, name in c.names.items()}
        wanted = sorted({name for name, _ in kinds})
        progress(f"reading {', '.join(wanted)} from {Path(bag).name}")
        logs = _read(reader, wanted, kinds)
        warnings = list(reader.warnings)
    with BagWriter(out, overwrite=overwrite) as writer, announced_compiling(progress):
        for one in chosen:
            warnings += _run(one, logs, writer, progress)
        write_results(writer.directory, {report.node: report.results for report in reports
                                         if report.results})
    warnings += [f"{report.node}: {text}" for report in reports for text in report.remarks]
    return reports, list(dict.fromkeys(warnings))


def _choose(reader: Reader, params_file, without, remap) -> tuple[list[StageReport], list[_Chosen]]:
    """A report per stage, and the stages that can run."""
    reports, chosen = [], []
    for stage in STAGES.values():
        # Left out or not: its parameters are checked.
        stage, params = stage.prepare(params_file)
        report = StageReport(stage.node, params)
        reports.append(report)
        if stage.node in without:
            report.skipped = "switched off"
        elif stage.unusable:
            report.skipped = stage.unusable
        else:
            names, report.skipped = find_inputs(reader, *stage.input_types(), remap)
            if not report.skipped:
                chosen.append(_Chosen(stage, report, names))
    return reports, chosen


def _read(reader: Reader, names, kinds) -> _Logs:
    """What is recorded, by the name of the topic and its SampleType."""
    raw: dict[str, list] = {name: [] for name in names}
    for topic, _, _, cdr in reader.messages(names):
        raw[topic].append(cdr)
    logs = {(name, kind): kind.read(raw[name]) for name, kind in kinds}
    return {key: _Recorded(log, *guard_log(log)) for key, log in logs.items()}


def _run(chosen: _Chosen, logs: _Logs, writer: BagWriter, progress) -> list[str]:
    """Write what a stage says and complete its report; what looks wrong with its logs."""
    stage, report, names = chosen.stage, chosen.report, chosen.names
    recorded = {topic: logs[name, stage.inputs[topic]] for topic, name in names.items()}
    for topic, one in recorded.items():
        report.used[topic] = len(one.usable)
        if one.guard.refused():
            report.refused[topic] = one.guard.refused()
    progress(f"{stage.node}: "
             + ", ".join(f"{len(one.log)} {names[topic]}" for topic, one in recorded.items()))
    found = list(stage.findings({topic: one.log for topic, one in recorded.items()}))
    inputs = {topic: (one.usable, one.epochs) for topic, one in recorded.items()}
    for topic, stamp, cdr in stage.process_logs(inputs, report, *report.params):
        writer.write("/" + topic, stage.outputs[topic], cdr, stamp)
        report.written[topic] += 1
    if report.summary:
        progress(f"{stage.node}: {report.summary}")
    return found
