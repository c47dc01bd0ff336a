"""Replay a recording through the estimators, smooth it, record everything.

    ros2 launch imu_fusion pipeline.launch.py bag:=PATH [out:=DIRECTORY] [rate:=0.0]
        [params_file:=FILE]

Ends by itself when everything has been played, smoothed and recorded. `imu_fusion pipeline`
does the same without launch.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, EmitEvent, RegisterEventHandler
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare


def generate_launch_description():
    """The arguments, the five nodes, and what ends them."""
    arguments = [
        DeclareLaunchArgument("bag", description="recording to replay"),
        DeclareLaunchArgument("out", default_value="smoothed",
                              description="directory of the new recording"),
        DeclareLaunchArgument("rate", default_value="0.0",
                              description="speed; 0: as fast as the nodes take it"),
        DeclareLaunchArgument(
            "params_file", description="ROS 2 parameter file",
            default_value=PathJoinSubstitution(
                [FindPackageShare("imu_fusion"), "config", "pipeline.yaml"])),
    ]
    params_file = LaunchConfiguration("params_file")

    def text(name):
        return ParameterValue(LaunchConfiguration(name), value_type=str)

    recorder = Node(
        package="imu_fusion", executable="recorder", name="recorder", output="screen",
        parameters=[params_file, {"out": text("out"), "end_with_sources": True,
                                  "expected_sources": ["smoother"]}])
    smoother = Node(
        package="imu_fusion", executable="smoother", name="smoother", output="screen",
        parameters=[params_file, {"qos": "reliable"}])
    orientation = Node(
        package="imu_fusion", executable="orientation_estimator", name="orientation_estimator",
        output="screen", parameters=[params_file, {"qos": "reliable"}])
    pipeline = Node(
        package="imu_fusion", executable="pipeline", name="pipeline", output="screen",
        parameters=[params_file])
    replayer = Node(
        package="imu_fusion", executable="replayer", name="replayer", output="screen",
        parameters=[params_file, {
            "bag": text("bag"), "wait_for_subscribers": 0,
            "wait_for_nodes": ["recorder", "smoother", "orientation_estimator", "pipeline"],
            "rate": ParameterValue(LaunchConfiguration("rate"), value_type=float)}])

    # The recorder ends by itself when replay and smoother have said that nothing more comes.
    complete = RegisterEventHandler(OnProcessExit(
        target_action=recorder, on_exit=[EmitEvent(event=Shutdown(reason="recording ended"))]))

    def when_failed(node):
        return RegisterEventHandler(OnProcessExit(
            target_action=node, on_exit=lambda event, context: EmitEvent(
                event=Shutdown(reason=f"{event.process_name} failed"))
            if event.returncode else None))

    return LaunchDescription([*arguments, recorder, smoother, orientation, pipeline, replayer,
                              complete, when_failed(replayer), when_failed(pipeline)])
