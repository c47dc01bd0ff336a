"""Replay a recording through the estimators, smooth it, record everything.

    ros2 launch imu_fusion pipeline.launch.py bag:=PATH [out:=DIRECTORY] [rate:=0.0]
        [params_file:=FILE] [report:=true]

Ends by itself when everything has been played, smoothed and recorded. `imu_fusion pipeline`
does the same without launch.
"""

import sys

from launch import LaunchDescription
from launch.actions import (DeclareLaunchArgument, EmitEvent, ExecuteProcess, OpaqueFunction,
                            RegisterEventHandler)
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare


def shutdown_after(action, reason):
    """End everything when ``action`` has ended."""
    return RegisterEventHandler(OnProcessExit(
        target_action=action, on_exit=[EmitEvent(event=Shutdown(reason=reason))]))


def shutdown_if_failed(action):
    """End everything when ``action`` ends with another exit code than 0."""
    return RegisterEventHandler(OnProcessExit(
        target_action=action, on_exit=lambda event, context: EmitEvent(
            event=Shutdown(reason=f"{event.process_name} failed")) if event.returncode else None))


def start(context):
    """The nodes for the arguments given: the acceleration field's where it is configured."""
    from imu_fusion.streams.acceleration_field import read_configuration

    given = {name: LaunchConfiguration(name).perform(context)
             for name in ("bag", "out", "rate", "params_file", "report")}
    estimators = ["smoother", "orientation_estimator"]
    if read_configuration(given["params_file"]).accelerometers:
        estimators.append("acceleration_field_estimator")

    def node(name, **parameters):
        return Node(package="imu_fusion", executable=name, name=name, output="screen",
                    parameters=[given["params_file"], parameters])

    recorder = node("recorder", out=given["out"], end_with_sources=True,
                    expected_sources=["smoother"])
    trigger = node("smoothing_trigger")
    replayer = node("replayer", bag=given["bag"], rate=float(given["rate"]),
                    wait_for_subscribers=0, wait_for_nodes=["recorder", "smoothing_trigger", *estimators])
    nodes = [recorder, trigger, replayer, *(node(name, qos="reliable") for name in estimators)]
    ends = [shutdown_if_failed(replayer), shutdown_if_failed(trigger)]
    # The recorder ends by itself when replay and smoother have said that nothing more comes.
    if given["report"].lower() == "true":
        report = ExecuteProcess(output="screen", cmd=[
            sys.executable, "-m", "imu_fusion.cli", "report", given["bag"],
            "--estimates", given["out"], "--params-file", given["params_file"],
            "--out", f"{given['out']}/report.html"])
        ends += [RegisterEventHandler(OnProcessExit(target_action=recorder, on_exit=[report])),
                 shutdown_after(report, "report written")]
    else:
        ends.append(shutdown_after(recorder, "recording ended"))
    return [*nodes, *ends]


def generate_launch_description():
    """The arguments, the nodes, and what ends them."""
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
