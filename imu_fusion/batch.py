"""Offline: a recording in, estimates out, without DDS and as fast as the machine can.

Runs the same guards, estimators and message encoders as the nodes. For the same
recording and parameters the estimates are those of the nodes, bit for bit.
"""

import json
import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

from imu_fusion.kernels import announced_compiling
from imu_fusion.errors import TopicError
from imu_fusion.estimation.orientation.estimator import OrientationParams
from imu_fusion.streams import acceleration_field as field_stream
from imu_fusion.streams import orientation
from imu_fusion.streams import smoother as smoothing
from imu_fusion.recordings.bag import BagWriter, find_topic, open_bag
from imu_fusion.messages.convert import SAMPLE_TYPES
from imu_fusion.streams.stream import EstimatorNodeParams
from imu_fusion.parameters.file import node_values, parameters_for
from imu_fusion.samples.guard import guard_log
from imu_fusion.surfaces.file import load_surface


@dataclass(frozen=True)
class Stage:
    """One estimator of the batch path.

    ``run(logs, report, *params)`` yields (topic, stamp, cdr) of the ``outputs`` and fills in the
    report; ``params`` are objects of the classes of that name; ``logs`` maps a topic to
    (log, epochs) of the samples fit for use, without optional topics that the recording lacks.
    ``findings(logs)`` lists in words what looks wrong with whole logs as recorded.
    ``node_params`` are those of the node alone: read, not used.
    ``kinds`` maps topics to the SampleType that reads them where it is not the usual one of
    their message type; ``unusable`` says why the stage cannot run.
    """

    node: str
    params: tuple
    node_params: tuple
    required: dict
    optional: dict
    outputs: dict
    run: Callable
    findings: Callable
    kinds: dict = field(default_factory=dict)
    configure: Callable | None = None
    unusable: str = ""

    def prepare(self, params_file):
        """(Stage, parameters): with ``configure``, topics may depend on the parameters."""
        if self.configure is not None:
            return self.configure(self, params_file)
        return self, self.read_params(params_file)

    def read_params(self, params_file):
        """The objects of ``params`` in a parameter file (or None: defaults)."""
        params = parameters_for(self.params + self.node_params, self.node, params_file)
        return params[:len(self.params)]

    def kind(self, topic, info):
        """The SampleType that reads a topic (bag.TopicInfo) of this stage."""
        return self.kinds.get(topic) or SAMPLE_TYPES[info.msgtype]


@dataclass
class StageReport:
    """What one stage did: samples taken and refused per topic, messages written.

    ``skipped`` says why it did not run; ``summary`` is a line of text, ``results`` plain
    numbers of what it found, ``remarks`` texts on what makes them doubtful.
    """

    node: str
    params: list
    used: dict = field(default_factory=dict)
    refused: dict = field(default_factory=dict)
    written: Counter = field(default_factory=Counter)
    skipped: str = ""
    summary: str = ""
    results: dict = field(default_factory=dict)
    remarks: list = field(default_factory=list)


def _types(inputs, topics):
    return {topic: inputs[topic].layout.msgtype for topic in topics}


def stages():
    """The estimators that ``process`` knows, by node name."""
    return {stage.node: stage for stage in (
        Stage("orientation_estimator",
              (OrientationParams, orientation.OrientationOutputParams), (EstimatorNodeParams,),
              required=_types(orientation.INPUTS, [orientation.IMU_TOPIC]),
              optional=_types(orientation.INPUTS, [orientation.MAG_TOPIC, orientation.FIX_TOPIC]),
              outputs=orientation.OUTPUTS, run=orientation.run, findings=orientation.findings,
              kinds={orientation.IMU_TOPIC: orientation.INPUTS[orientation.IMU_TOPIC]}),
        Stage("smoother", (smoothing.SmoothingParams,), (smoothing.SmootherNodeParams,),
              required=_types(smoothing.INPUTS, smoothing.REQUIRED),
              optional=_types(smoothing.INPUTS, [smoothing.MAG_TOPIC, smoothing.VELOCITY_TOPIC]),
              outputs=smoothing.OUTPUTS, run=smoothing.run, findings=smoothing.findings,
              configure=_configure_smoother),
        Stage(field_stream.NODE, (field_stream.FieldConfiguration,), (EstimatorNodeParams,),
              required={}, optional={}, outputs=field_stream.OUTPUTS, run=field_stream.run,
              findings=lambda logs: [], configure=_configure_field),
    )}


def field_configuration(params_file):
    """The FieldConfiguration of the acceleration field estimator in a parameter file (or None).

    Raises:
        ParameterError, LayoutError: with the name of what is wrong.
    """
    values = node_values(field_stream.NODE, params_file, field_stream.FieldConfiguration.names())
    for info in EstimatorNodeParams.infos():
        values.pop(info.name, None)
    return field_stream.FieldConfiguration.from_mapping(values, str(params_file or ""))


def _configure_smoother(stage, params_file):
    params = stage.read_params(params_file)
    if params[0].surface.file:
        load_surface(params[0].surface.file)  # a bad file is refused before anything is read
    return stage, params


def _configure_field(stage, params_file):
    config = field_configuration(params_file)
    gyroscope = [field_stream.GYROSCOPE_TOPIC] * (config.gyroscope is not None)
    return replace(
        stage, kinds=config.inputs, optional=_types(config.inputs, gyroscope),
        required=_types(config.inputs, [t for t in config.inputs if t not in gyroscope]),
        unusable="" if config.accelerometers else
        "no accelerometers described; set accelerometers.names in a parameter file"), [config]


def process(bag, out, params_file=None, without=(), remap=None, overwrite=False,
            progress=lambda text: None):
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
    remap = dict(remap or {})
    known = stages()
    for name in without:
        if name not in known:
            raise TopicError(f"no estimator '{name}'; there are: {', '.join(known)}")
    with open_bag(bag) as reader:
        chosen, reports = [], []
        for stage in known.values():
            stage, params = stage.prepare(params_file)
            report = StageReport(stage.node, params)
            reports.append(report)
            if stage.node in without:
                report.skipped = "switched off"
                continue
            if stage.unusable:
                report.skipped = stage.unusable
                continue
            names, missing = inputs_of(stage, reader, remap)
            if missing:
                report.skipped = missing
            else:
                chosen.append((stage, report, names))
        if not chosen:
            raise TopicError("nothing to do: " + "; ".join(
                f"{r.node}: {r.skipped}" for r in reports))
        kinds = {(name, stage.kind(topic, reader.topics[name]))
                 for stage, _, names in chosen for topic, name in names.items()}
        wanted = sorted({name for name, _ in kinds})
        progress(f"reading {', '.join(wanted)} from {Path(bag).name}")
        logs = _read(reader, wanted, kinds)
        warnings = list(reader.warnings)
    with BagWriter(out, overwrite=overwrite) as writer, announced_compiling(progress):
        for stage, report, names in chosen:
            inputs, recorded = {}, {}
            for topic, name in names.items():
                recorded[topic], log, epochs, guard = logs[
                    name, stage.kind(topic, reader.topics[name])]
                inputs[topic] = (log, epochs)
                report.used[topic] = len(log)
                if guard.refused():
                    report.refused[topic] = guard.refused()
            progress(f"{stage.node}: "
                     + ", ".join(f"{len(log)} {names[topic]}" for topic, log in recorded.items()))
            warnings += stage.findings(recorded)
            for topic, stamp, cdr in stage.run(inputs, report, *report.params):
                writer.write("/" + topic, stage.outputs[topic], cdr, stamp)
                report.written[topic] += 1
            if report.summary:
                progress(f"{stage.node}: {report.summary}")
        found = {report.node: report.results for report in reports if report.results}
        write_results(writer.directory, found)
    warnings += [f"{report.node}: {text}" for report in reports for text in report.remarks]
    return reports, list(dict.fromkeys(warnings))


def write_results(directory, found):
    """Write results.json: dict of node to plain numbers; what is not finite becomes null."""
    def plain(value):
        if isinstance(value, dict):
            return {key: plain(v) for key, v in value.items()}
        if isinstance(value, (list, tuple)):
            return [plain(v) for v in value]
        return None if isinstance(value, float) and not math.isfinite(value) else value

    (Path(directory) / "results.json").write_text(
        json.dumps(plain(found), indent=2, allow_nan=False))


def inputs_of(stage, reader, remap):
    """Where a recording holds the topics of a stage.

    Args:
        stage: Stage. reader: an open recording.
        remap: dict of topic names of ours to those in the recording.

    Returns:
        dict of our topic to its name in the recording, and words for required ones that it
        lacks, '' if none.

    Raises:
        TopicError: a topic has another type.
    """
    names = {}
    for topic, msgtype in {**stage.required, **stage.optional}.items():
        name = find_topic(reader.topics, remap.get(topic, topic))
        if name is not None and reader.topics[name].count:
            names[topic] = reader.require(name, msgtype).name
    missing = {t: stage.required[t] for t in stage.required if t not in names}
    return names, explain_missing(reader, missing)


def _read(reader, names, kinds):
    """dict of (topic, SampleType) to (log as recorded, log fit for use, its epochs, Guard), in
    bag order."""
    raw = {name: [] for name in names}
    for topic, _, _, cdr in reader.messages(names):
        raw[topic].append(cdr)
    logs = {(name, kind): kind.read(raw[name]) for name, kind in kinds}
    return {key: (log, *guard_log(log)) for key, log in logs.items()}


def explain_missing(reader, wanted):
    """Words for topics that a recording lacks, with the ones in it that would fit.

    Args:
        reader: an open recording.
        wanted: dict of topic to type.
    """
    parts = []
    for topic, msgtype in wanted.items():
        fitting = [t.name for t in reader.topics.values() if t.msgtype == msgtype and t.count]
        text = f"no messages on '{topic}' ({msgtype})"
        if fitting:
            text += "; of that type it has " + ", ".join(fitting) \
                + f": add --remap {topic}:={fitting[0]}"
        else:
            others = ", ".join(f"{t.name} ({t.msgtype})" for t in reader.topics.values())
            text += f"; it has {others or 'no topics'}"
        parts.append(text)
    return "; ".join(parts)
