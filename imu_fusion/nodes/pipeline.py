"""A recording through real ROS 2 nodes, smoothed and recorded: one call.

    replayer -> smoother and other estimators -> recorder

Each node is a process of an own ROS domain. The estimates are those of ``batch.process``.
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

from imu_fusion.errors import TopicError
from imu_fusion.nodes.processes import NodeProcesses
from imu_fusion.parameters.file import ParamsFile, files_of
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.inputs import find_inputs
from imu_fusion.recordings.logs import LogCollector
from imu_fusion.recordings.losses import read_losses
from imu_fusion.recordings.results import UNDECODABLE, left_out, write_results
from imu_fusion.recordings.targets import refuse_source
from imu_fusion.samples.guard import guard_log
from imu_fusion.streams.registry import STAGES
from imu_fusion.streams.smoother_messages import RESULTS_TOPIC, results_value
from imu_fusion.streams.stage import Stage

SMOOTHER = "smoother"
_PATIENCE = 3600.0  # s; the nodes notice by themselves when nothing can come any more


@dataclass(frozen=True)
class Plan:
    """What a pipeline does with a recording.

    Attributes:
        inputs: of the estimators that have work to do, the smoother among them: their topics to
            those of the recording.
        renamed: topics that are played under other names than those in the recording, to these.
        outdated: topics of the recording with earlier estimates, which are not played.
        warnings: texts on what is wrong with the recording.
    """

    inputs: Mapping[Stage, Mapping[str, str]]
    renamed: Mapping[str, str]
    outdated: tuple[str, ...]
    warnings: tuple[str, ...]

    @property
    def estimators(self) -> list[str]:
        """Names of their nodes."""
        return [stage.node for stage in self.inputs]

    def replay_parameters(self, bag: str | Path) -> dict:
        """Parameters of the replayer: at full speed, once all nodes have joined."""
        return {"bag": str(Path(bag).absolute()), "rate": 0.0, "exclude": self.outdated,
                "remap": tuple(f"{name}:={topic}" for topic, name in self.renamed.items()),
                "wait_for_subscribers": 0,
                "wait_for_nodes": ("recorder", *self.estimators)}


def plan_pipeline(bag: str | Path, params_file: ParamsFile = None,
                  without: Collection[str] = (), remap: Mapping[str, str] | None = None) -> Plan:
    """What a pipeline would do with a recording; arguments as of :func:`run_pipeline`.

    Raises:
        ImuFusionError: recording, parameters or topics are not usable, or there is nothing to
            smooth.
    """
    for name in without:
        if name not in STAGES or name == SMOOTHER:
            raise TopicError(f"no estimator '{name}' to leave out; there are: "
                             + ", ".join(node for node in STAGES if node != SMOOTHER))
    inputs: dict[Stage, Mapping[str, str]] = {}
    made: set[str] = set()
    with open_bag(bag, remap=remap) as reader:
        for stage in STAGES.values():
            # Here, for a bad file to be refused before anything starts.
            stage, _ = stage.prepare(params_file)
            if stage.node in without or stage.unusable:
                continue
            names, missing = find_inputs(reader, *stage.input_types())
            if missing and stage.node == SMOOTHER:
                raise TopicError(f"nothing to smooth: {missing}")
            if missing:
                continue
            inputs[stage] = names
            made |= stage.outputs.keys()
        outdated = tuple(name for name in reader.topics if name.lstrip("/") in made)
        return Plan(inputs, dict(reader.recorded), outdated, tuple(reader.warnings))


def run_pipeline(bag: str | Path, out: str | Path, params_file: ParamsFile = None,
                 without: Collection[str] = (), remap: Mapping[str, str] | None = None,
                 overwrite: bool = False, logs: str | Path | None = None, show: bool = True,
                 warn: Callable[[str], object] = lambda text: None) -> int:
    """Replay a recording through the estimators into a new recording.

    Args:
        bag: recording with what the smoother needs.
        out: rosbag2 directory to write: the recording, with old estimates left out, and the
            new ones; results.json beside them as of ``batch.process``. Where a node fails there is
            no recording, and what ``overwrite`` was to replace stays.
        params_file: ParamsFile, for all nodes; None: defaults.
        without: node names of estimators to leave out.
        remap: dict of topic names of ours to those in the recording.
        overwrite: replace ``out``.
        logs: directory for what the nodes print; a temporary one if None.
        show: let replayer and smoother print here.
        warn: called with texts on what is wrong with the recording.

    Returns:
        ROS domain id that was used.

    Raises:
        ImuFusionError: recording, parameters or topics are not usable, or a node failed.
    """
    refuse_source(bag, out)
    plan = plan_pipeline(bag, params_file, without, remap)
    for text in plan.warnings:
        warn(text)
    files = [Path(file).absolute() for file in files_of(params_file)]
    with NodeProcesses(logs) as nodes:
        nodes.start("recorder", params_file=files, out=str(Path(out).absolute()),
                    overwrite=overwrite, whole=True, end_with_sources=True,
                    expected_sources=(SMOOTHER,))
        for node in plan.estimators:
            own = {"smooth_at_end": True} if node == SMOOTHER else {}
            nodes.start(node, show=show and node == SMOOTHER, params_file=files, qos="reliable",
                        **own)
        nodes.start("replayer", show=show, params_file=files, **plan.replay_parameters(bag))
        nodes.wait("replayer", _PATIENCE)
        nodes.wait("recorder", _PATIENCE)
        domain = nodes.domain
    refused, lost = find_left_out(bag, plan)
    with open_bag(out) as reader:
        found = [results_value(cdr) for _, _, _, cdr in reader.messages([f"/{RESULTS_TOPIC}"])]
        lost += read_losses(reader)
    write_results(out, ({SMOOTHER: found[-1]} if found else {}) | left_out(refused, lost))
    return domain


def find_left_out(bag: str | Path, plan: Plan
                  ) -> tuple[dict[str, dict[str, dict[str, int]]], list[str]]:
    """What the nodes of a pipeline leave out of a recording, by node and topic: reasons and how
    many of each; and what of it cannot be read, in words."""
    refused = {}
    with open_bag(bag, remap=plan.renamed) as reader:
        for stage, names in plan.inputs.items():
            found = {}
            for topic, name in names.items():
                collector = LogCollector(stage.inputs[topic])
                for *_, cdr in reader.messages([name]):
                    collector.add(cdr)
                guard = guard_log(collector.log(), stage.has_clock(topic))[2]
                undecodable = sum(collector.refused.values())
                found[topic] = guard.refused() | (
                    {UNDECODABLE: undecodable} if undecodable else {})
            refused[stage.node] = {topic: why for topic, why in found.items() if why}
        return refused, reader.losses
