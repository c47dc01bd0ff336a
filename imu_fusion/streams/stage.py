"""One estimator between topics, as ``process``, the pipeline and the report use it."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from imu_fusion.messages.convert import SampleType
from imu_fusion.parameters.declare import Parameters
from imu_fusion.parameters.file import ParamsFile, parameters_for
from imu_fusion.samples import checks
from imu_fusion.samples.field_turning import check_axes
from imu_fusion.samples.findings import Finding
from imu_fusion.samples.lasting_errors import check_field_errors
from imu_fusion.samples.travel import check_travel
from imu_fusion.streams.stream import FIX_TOPIC, IMU_TOPIC, MAG_TOPIC, VELOCITY_TOPIC


def check_logs(logs: Mapping[str, Any]) -> list[Finding]:
    """What looks wrong with whole logs as recorded, of Imu, magnetometer and receiver by topic."""
    imu, mag = logs.get(IMU_TOPIC), logs.get(MAG_TOPIC)
    found = [] if imu is None else checks.check_imu(imu, IMU_TOPIC)
    if FIX_TOPIC in logs:
        found += checks.check_fix(logs[FIX_TOPIC])
    if FIX_TOPIC in logs and VELOCITY_TOPIC in logs:
        found += check_travel(logs[FIX_TOPIC], logs[VELOCITY_TOPIC], VELOCITY_TOPIC)
    if mag is not None:
        found += checks.check_mag(mag, MAG_TOPIC)
    if imu is not None and mag is not None:
        found += checks.check_clock(mag.stamp, imu.stamp, MAG_TOPIC)
        found += (check_axes(imu, mag, MAG_TOPIC)
                  or check_field_errors(imu, mag, MAG_TOPIC))
    return found


def _no_findings(logs: Mapping) -> list[Finding]:
    return []


@dataclass(frozen=True, eq=False)
class Stage:
    """One estimator, between its topics.

    Attributes:
        node: name of its node.
        params: classes of the parameters of the estimate; ``node_params``: of those that concern
            the node alone, which are read here and not used.
        inputs: topic to the SampleType that reads it; ``required`` are those without which it
            cannot run. ``dispensable``: see :func:`~imu_fusion.recordings.inputs.find_inputs`.
        outputs: topic to message type.
        stream: the class of its Stream, ``(*params, warn=...)``.
        findings: ``(logs)`` lists what looks wrong with whole logs as recorded.
        configure: ``(stage, params_file)`` is (Stage, parameters), where reading the parameters is
            not all: topics may depend on them.
        unusable: why it cannot run, empty if it can.
    """

    node: str
    params: tuple[type, ...]
    node_params: tuple[type[Parameters], ...]
    inputs: Mapping[str, SampleType]
    required: tuple[str, ...]
    outputs: Mapping[str, str]
    stream: type[Any]
    findings: Callable[[Mapping], Sequence[Finding]] = _no_findings
    configure: Callable[["Stage", ParamsFile], tuple["Stage", list]] | None = None
    unusable: str = ""
    dispensable: tuple[str, ...] = ()

    def prepare(self, params_file: ParamsFile = None) -> tuple["Stage", list]:
        """(Stage, parameters) under a ParamsFile.

        Raises:
            ImuFusionError: the parameters, or files that they name, are not usable.
        """
        if self.configure is not None:
            return self.configure(self, params_file)
        return self, self.read_params(params_file)

    def has_clock(self, topic: str) -> bool:
        """Whether the clock of a topic is judged: see Guard."""
        judged = self.stream.one_clock
        return judged is None or topic in judged

    def read_params(self, params_file: ParamsFile = None) -> list:
        """The objects of ``params`` under a ParamsFile."""
        params = parameters_for(self.params + self.node_params, self.node, params_file)
        return params[:len(self.params)]

    def input_types(self) -> tuple[dict[str, str], dict[str, str], tuple[str, ...]]:
        """Message types of the topics that are required, and of those that are not, and
        ``dispensable``."""
        types = {topic: kind.layout.msgtype for topic, kind in self.inputs.items()}
        return ({topic: types[topic] for topic in self.required},
                {topic: name for topic, name in types.items() if topic not in self.required},
                self.dispensable)


@dataclass
class StageReport:
    """What one stage did.

    Attributes:
        node: name of its node; ``params`` the objects that it ran with.
        used: topic to number of samples taken; ``refused``: to reasons and how many of each.
        written: topic to number of messages.
        skipped: why it did not run, empty if it did.
        summary: a line of text; ``results``: plain numbers of what it found; ``remarks``: texts on
            what makes them doubtful; ``detail``: see Conclusion.
        findings: on what looks wrong with the samples; ``warnings``: texts on what the estimator
            met.
    """

    node: str
    params: list
    used: dict[str, int] = field(default_factory=dict)
    refused: dict[str, dict[str, int]] = field(default_factory=dict)
    written: Counter = field(default_factory=Counter)
    skipped: str = ""
    summary: str = ""
    results: dict = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)
    detail: Any = None
    findings: list[Finding] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
