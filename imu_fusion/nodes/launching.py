"""What the launch files share: arguments first, then kernels, then nodes; a failure counts.

``ros2 launch`` ends with code 0 whatever its nodes did, unless something raises: then it says
what, ends everything and returns 1.
"""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from launch.actions import EmitEvent, ExecuteProcess, RegisterEventHandler
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.events.process import ProcessExited

from imu_fusion.errors import ImuFusionError, ParameterError
from imu_fusion.nodes.recorder import RecorderParams
from imu_fusion.nodes.replayer import ReplayerParams
from imu_fusion.parameters.file import parameters_for
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.bag_writer import BagWriter
from imu_fusion.recordings.targets import refuse_source
from launch import LaunchContext, LaunchDescriptionEntity


class LaunchError(ImuFusionError):
    """A process of the launch failed."""


@dataclass(frozen=True)
class LaunchArguments:
    """What was given to ``ros2 launch``, checked."""

    bag: str
    out: str
    rate: float
    params_file: str
    report: bool = False


def check_arguments(given: Mapping[str, str]) -> LaunchArguments:
    """Arguments in their types.

    Args:
        given: name to text, as on the command line.

    Raises:
        BagError, ParameterError: the recording or the parameter file cannot be read, ``out`` cannot
            be written, ``rate`` is no speed, or ``report`` neither true nor false.
    """
    open_bag(given["bag"]).close()
    refuse_source(given["bag"], given["out"])
    (recorder,) = parameters_for((RecorderParams,), "recorder", given["params_file"])
    BagWriter(given["out"], overwrite=recorder.overwrite, whole=True).abandon()
    try:
        rate = float(given["rate"])
    except ValueError:
        raise ParameterError(f"argument 'rate': '{given['rate']}' is not a number; 0 is as fast as "
                             "the nodes take it") from None
    (info,) = (info for info in ReplayerParams.infos() if info.name == "rate")
    report = given.get("report", "false").lower()
    if report not in ("true", "false"):
        raise ParameterError(f"argument 'report': '{report}' is neither true nor false")
    return LaunchArguments(given["bag"], given["out"], info.check(rate, "the launch arguments"),
                           given["params_file"], report == "true")


def after_compiling(entities: Sequence[LaunchDescriptionEntity]) -> list[LaunchDescriptionEntity]:
    """What compiles the kernels where that has not been done, and starts ``entities`` then.

    A node that compiles keeps the others waiting until they give up.
    """
    compiler = ExecuteProcess(cmd=[sys.executable, "-m", "imu_fusion.cli", "compile"],
                              name="compile", output="screen")
    return [on_success(compiler, entities), compiler]


def on_success(process: ExecuteProcess, entities: Sequence[LaunchDescriptionEntity] = ()
               ) -> RegisterEventHandler:
    """Start ``entities`` when a process has ended with 0; with another code, fail."""
    def on_exit(event: ProcessExited, context: LaunchContext
                ) -> Sequence[LaunchDescriptionEntity] | None:
        if context.is_shutdown:
            return None    # it was asked to end, or ends with all the others
        if event.returncode:
            raise LaunchError(f"{event.process_name} ended with code {event.returncode}")
        return entities

    return RegisterEventHandler(OnProcessExit(target_action=process, on_exit=on_exit))


def shutdown(reason: str) -> EmitEvent:
    """End the launch."""
    return EmitEvent(event=Shutdown(reason=reason))
