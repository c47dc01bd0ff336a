"""Offline: a recording in, estimates out, without DDS and as fast as the machine can.

Runs the same streams as the nodes, in blocks of thousands of messages. For the same
recording and parameters the estimates are those of the nodes, bit for bit.
"""

import itertools
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from imu_fusion.errors import BagError, ImuFusionError, SampleError, TopicError
from imu_fusion.kernels import announced_compiling
from imu_fusion.messages.layouts import Decoded, Layout
from imu_fusion.parameters.file import ParamsFile
from imu_fusion.recordings.bag_reader import Reader, open_bag
from imu_fusion.recordings.bag_writer import BagWriter
from imu_fusion.recordings.inputs import find_inputs
from imu_fusion.recordings.results import FINDINGS, left_out, write_results
from imu_fusion.recordings.targets import refuse_source
from imu_fusion.samples.blocks import Growing
from imu_fusion.samples.checks import check_frames
from imu_fusion.samples.guard import Verdict
from imu_fusion.streams.registry import STAGES
from imu_fusion.streams.stage import Stage, StageReport
from imu_fusion.streams.stream import Messages, one_by_one

Write = Callable[[str, str, int, bytes], object]
"""Takes topic, type, stamp in int ns and CDR bytes of a message."""

Chosen = tuple[Stage, StageReport, Mapping[str, str]]
"""A stage that can run, its report, and its topics to those in the recording."""

_REFUSALS = (ImuFusionError, np.linalg.LinAlgError)    # the latter: of values beyond all bounds
_BLOCK = 4000    # messages read before the estimators take them

Block = Mapping[tuple[str, Layout], Decoded]
"""Messages by the name of their topic in the recording and their layout."""


class _Feed:
    """One estimator, fed with a recording.

    Args:
        names: its topics to those in the recording.
        write: what takes its messages; None: they are not made where that can be spared.
    """

    def __init__(self, stage: Stage, report: StageReport, names: Mapping[str, str],
                 write: Write | None) -> None:
        self._stage, self._report, self._names, self._write = stage, report, names, write
        self._recorded = {topic: Growing(stage.inputs[topic].width) for topic in names}
        self._frames: dict[str, dict[str, None]] = {topic: {} for topic in names}
        self._stream = stage.stream(*report.params, warn=report.warnings.append)
        self._stream.concludes = True
        self._stream.reset(list(names))

    def take(self, block: Block) -> None:
        """Messages of the recording."""
        if self._report.skipped:
            return
        found = {}
        for topic, name in self._names.items():
            kind = self._stage.inputs[topic]
            decoded = block.get((name, kind.layout))
            if decoded is not None:
                found[topic] = decoded
                self._recorded[topic].add(decoded.stamp, kind.values(decoded.values))
                self._frames[topic] |= dict.fromkeys(decoded.frame_ids)
        try:
            self._hand_on(self._stream.take_decoded(found))
        except BagError:    # of the writer
            raise
        except _REFUSALS as error:    # the other stages go on
            self._report.skipped = str(error)

    def finish(self) -> None:
        """The end of the recording: what is held back, and the report."""
        report, stream = self._report, self._stream
        try:
            report.findings = [
                *(finding for topic, named in self._frames.items()
                  for finding in check_frames(named, topic)),
                *self._stage.findings(self._logs())]
            if report.skipped:
                return
            self._hand_on(stream.finish())
            conclusion = stream.conclude()
            for made in conclusion.made if self._write else ():
                self._hand_on(made)
            report.results, report.summary = dict(conclusion.results), conclusion.summary
            report.remarks, report.detail = list(conclusion.remarks), conclusion.detail
        except BagError:    # of the writer
            raise
        except _REFUSALS as error:    # the other stages go on
            report.skipped = str(error)
        finally:
            self._count()

    def _logs(self) -> dict[str, Any]:
        """What was recorded; it is kept no longer."""
        return {topic: self._stage.inputs[topic].log(
                    *self._recorded.pop(topic).take(), next(iter(frames), ""))
                for topic, frames in self._frames.items()}

    def _count(self) -> None:
        report, stream = self._report, self._stream
        for topic in self._names:
            report.used[topic] = stream.guards[topic].counts[Verdict.OK]
            refused = stream.refused(topic)
            if refused:
                report.refused[topic] = refused

    def _hand_on(self, made: list[Messages]) -> None:
        if self._write is None:
            return
        for topic, stamp, cdr in one_by_one(made):
            self._write(topic, self._stage.outputs[topic], stamp, cdr)
            self._report.written[topic] += 1


def process(bag: str | Path, out: str | Path, params_file: ParamsFile = None,
            without: Collection[str] = (), remap: Mapping[str, str] | None = None,
            overwrite: bool = False, progress: Callable[[str], object] = lambda text: None,
            force: bool = False) -> tuple[list[StageReport], list[str]]:
    """Run every estimator whose topics are in a recording and write what it says.

    Args:
        bag: path of a recording.
        out: rosbag2 directory to write.
        params_file: ParamsFile; None: defaults.
        without: node names of estimators to leave out.
        remap: dict of topic names of ours to those in the recording.
        overwrite: replace ``out``.
        progress: called with a line of text as things happen.
        force: estimate from samples that are known to be unusable, too.

    Returns:
        (list of StageReport, list of what looks wrong with the recording)

    Raises:
        SampleError: samples make every estimate from them wrong; nothing is written.
        ImuFusionError: recording, parameters or topics are not usable.
    """
    for name in without:
        if name not in STAGES:
            raise TopicError(f"no estimator '{name}'; there are: {', '.join(STAGES)}")
    refuse_source(bag, out)
    with open_bag(bag, remap=remap) as reader:
        reports, chosen = _choose(reader, params_file, without)
        if not chosen:
            raise TopicError("nothing to do: " + "; ".join(
                f"{r.node}: {r.skipped}" for r in reports))
        topics = sorted({name for _, _, names in chosen for name in names.values()})
        progress(f"reading {', '.join(topics)} from {Path(bag).name}")
        with (BagWriter(out, overwrite=overwrite, whole=True) as writer,
              announced_compiling(progress)):
            def write(topic, msgtype, stamp, cdr):
                writer.write("/" + topic.lstrip("/"), msgtype, cdr, stamp)

            for stage, report, names in _run(reader, chosen, write):
                progress(f"{stage.node}: " + ", ".join(
                    f"{report.used[topic]} {name}" for topic, name in names.items()))
                if report.summary:
                    progress(f"{stage.node}: {report.summary}")
            unusable = dict.fromkeys(finding.text for report in reports
                                     for finding in report.findings if finding.unusable)
            if unusable and not force:
                raise SampleError(f"{bag}: not usable: " + "; ".join(unusable)
                                  + ". Nothing was written; --force estimates all the same")
            warnings = list(reader.warnings)
            results: dict[str, Any] = {
                report.node: report.results for report in reports if report.results}
            write_results(writer.directory, results | _found(reports) | left_out(
                {report.node: report.refused for report in reports},
                reader.losses))
    warnings += [finding.text for report in reports for finding in report.findings]
    warnings += [f"{report.node}: {text}" for report in reports
                 for text in (*report.warnings, *report.remarks)]
    return reports, list(dict.fromkeys(warnings))


def _found(reports: Sequence[StageReport]) -> dict[str, Any]:
    """What looks wrong with the samples, as results.json holds it; empty where nothing does."""
    found = dict.fromkeys(finding.text for report in reports for finding in report.findings)
    return {FINDINGS: [*found]} if found else {}


def estimate(bag: str | Path, nodes: Collection[str], params_file: ParamsFile = None,
             keep: Collection[str] = (), remap: Mapping[str, str] | None = None
             ) -> tuple[dict[str, StageReport], dict[str, list[bytes]]]:
    """What some estimators say of a recording, without writing it.

    Args:
        bag: path of a recording.
        nodes: node names of estimators; one whose topics are missing is skipped.
        params_file: ParamsFile; None: defaults.
        keep: topics whose messages are wanted.
        remap: topic names of ours to those in the recording.

    Returns:
        (StageReports by node name, CDR bytes of the topics in ``keep`` in order)

    Raises:
        ImuFusionError: recording, parameters or topics are not usable.
    """
    kept: dict[str, list[bytes]] = {topic: [] for topic in keep}

    def write(topic, msgtype, stamp, cdr):
        if topic in kept:
            kept[topic].append(cdr)

    with open_bag(bag, remap=remap) as reader:
        reports, chosen = _choose(reader, params_file, STAGES.keys() - set(nodes))
        for _ in _run(reader, chosen, write, kept.keys()):
            pass
    return {report.node: report for report in reports}, kept


def _run(reader: Reader, chosen: Sequence[Chosen], write: Write,
         only: Collection[str] | None = None) -> Iterator[Chosen]:
    """Feed a recording to stages; yield each when it has finished. ``only``: topics to write."""
    feeds = [_Feed(*one, write if only is None or one[0].outputs.keys() & only else None)
             for one in chosen]
    wanted = {(name, stage.inputs[topic].layout) for stage, _, names in chosen
              for topic, name in names.items()}
    for block in _blocks(reader, wanted):
        for feed in feeds:
            feed.take(block)
    for feed, one in zip(feeds, chosen):
        feed.finish()
        yield one


def _choose(reader: Reader, params_file, without) -> tuple[list[StageReport], list[Chosen]]:
    """A report per stage, and the stages that can run."""
    reports: list[StageReport] = []
    chosen: list[Chosen] = []
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
            names, report.skipped = find_inputs(reader, *stage.input_types())
            if not report.skipped:
                chosen.append((stage, report, names))
    return reports, chosen


def _blocks(reader: Reader, wanted: Collection[tuple[str, Layout]]) -> Iterator[Block]:
    """What is recorded on the topics wanted, some thousand messages at a time."""
    names = sorted({name for name, _ in wanted})
    messages = reader.messages(names)
    while True:
        raw: dict[str, list] = {}
        for topic, _, _, cdr in itertools.islice(messages, _BLOCK):
            raw.setdefault(topic, []).append(cdr)
        if not raw:
            return
        yield {(name, layout): layout.decode_block(raw[name]) for name, layout in wanted
               if name in raw}
