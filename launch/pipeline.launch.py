"""Replay a recording through the estimators, smooth it, record everything.

    ros2 launch imu_fusion pipeline.launch.py bag:=PATH [out:=DIRECTORY] [rate:=0.0]
        [params_file:=FILE] [report:=true]

Compiles first, where that has not been done. Ends by itself when everything has been played,
smoothed and recorded, or with a failure, and without a recording, when a node fails.
`imu_fusion pipeline` does the same without launch.
"""

import sys

from launch.actions import DeclareLaunchArgument, ExecuteProcess, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from imu_fusion.nodes.launching import after_compiling, check_arguments, on_success, shutdown
from imu_fusion.nodes.pipeline import SMOOTHER, plan_pipeline
from launch import LaunchDescription


def start(context):
    """The nodes that have work to do with the recording; refused before any of them starts."""
    given = check_arguments({name: LaunchConfiguration(name).perform(context)
                             for name in ("bag", "out", "rate", "params_file", "report")})
    plan = plan_pipeline(given.bag, given.params_file)

    def node(name, **parameters):
        return Node(package="imu_fusion", executable=name, name=name, output="screen",
                    parameters=[given.params_file, parameters])

    recorder = node("recorder", out=given.out, whole=True, end_with_sources=True,
                    expected_sources=[SMOOTHER])
    # ROS has no empty lists: what is empty is left to its default.
    replay = {name: list(value) if isinstance(value, tuple) else value
              for name, value in plan.replay_parameters(given.bag).items() if value != ()}
    others = [node("replayer", **replay | {"rate": given.rate}),
              *(node(name, qos="reliable", **({"smooth_at_end": True} if name == SMOOTHER else {}))
                for name in plan.estimators)]
    # The recorder ends by itself when replay and smoother have said that nothing more comes.
    recorded = [shutdown("recording ended")]
    handlers = []
    if given.report:
        report = ExecuteProcess(output="screen", cmd=[
            sys.executable, "-m", "imu_fusion.cli", "report", given.bag, "--estimates", given.out,
            "--params-file", given.params_file, "--out", f"{given.out}/report.html"])
        handlers.append(on_success(report, [shutdown("report written")]))
        recorded = [report]
    handlers += [on_success(recorder, recorded), *map(on_success, others)]
    return after_compiling([*handlers, recorder, *others])


def generate_launch_description():
    """The arguments, and what starts the rest."""
    return LaunchDescription([
        DeclareLaunchArgument("bag", description="recording to replay"),
        DeclareLaunchArgument("out", default_value="smoothed",
                              description="directory of the new recording"),
        DeclareLaunchArgument("rate", default_value="0.0",
                              description="speed; 0: as fast as the nodes take it"),
        DeclareLaunchArgument("report", default_value="false",
                              description="true: write report.html beside the recording, too"),
        DeclareLaunchArgument(
            "params_file", description="ROS 2 parameter file",
            default_value=PathJoinSubstitution(
                [FindPackageShare("imu_fusion"), "config", "pipeline.yaml"])),
        OpaqueFunction(function=start)])
