"""Replay a recording through the orientation estimator into a new recording.

    ros2 launch imu_fusion replay.launch.py bag:=PATH [out:=DIRECTORY] [rate:=0.0]
        [params_file:=FILE]

Ends by itself when everything has been played and recorded.
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
    """The arguments, the three nodes, and what ends them."""
    arguments = [
        DeclareLaunchArgument("bag", description="recording to replay"),
        DeclareLaunchArgument("out", default_value="replayed",
                              description="directory of the new recording"),
        DeclareLaunchArgument("rate", default_value="0.0",
                              description="speed; 0: as fast as the nodes take it"),
        DeclareLaunchArgument(
            "params_file", description="ROS 2 parameter file",
            default_value=PathJoinSubstitution(
                [FindPackageShare("imu_fusion"), "config", "replay.yaml"])),
    ]
    params_file = LaunchConfiguration("params_file")
    recorder = Node(
        package="imu_fusion", executable="recorder", name="recorder", output="screen",
        parameters=[params_file, {
            "out": ParameterValue(LaunchConfiguration("out"), value_type=str)}])
    estimator = Node(
        package="imu_fusion", executable="orientation_estimator", name="orientation_estimator",
        output="screen", parameters=[params_file])
    replayer = Node(
        package="imu_fusion", executable="replayer", name="replayer", output="screen",
        parameters=[params_file, {
            "bag": ParameterValue(LaunchConfiguration("bag"), value_type=str),
            "rate": ParameterValue(LaunchConfiguration("rate"), value_type=float)}])

    # The recorder ends by itself when replayer and estimator have said that nothing more comes.
    complete = RegisterEventHandler(OnProcessExit(
        target_action=recorder, on_exit=[EmitEvent(event=Shutdown(reason="recording ended"))]))
    failed = RegisterEventHandler(OnProcessExit(
        target_action=replayer, on_exit=lambda event, context: EmitEvent(
            event=Shutdown(reason="replayer failed")) if event.returncode else None))
    return LaunchDescription([*arguments, recorder, estimator, replayer, complete, failed])
