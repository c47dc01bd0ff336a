"""Replay a recording through the orientation estimator into a new recording.

    ros2 launch imu_fusion replay.launch.py bag:=PATH [out:=DIRECTORY] [rate:=0.0]
        [params_file:=FILE]

Compiles first, where that has not been done. Ends by itself when everything has been played and
recorded, or with a failure, and without a recording, when a node fails.
"""

from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from imu_fusion.nodes.launching import after_compiling, check_arguments, on_success, shutdown
from launch import LaunchDescription


def start(context):
    """The three nodes, and what ends them; bad arguments are refused before any of them starts."""
    given = check_arguments({name: LaunchConfiguration(name).perform(context)
                             for name in ("bag", "out", "rate", "params_file")})

    def node(name, **parameters):
        return Node(package="imu_fusion", executable=name, name=name, output="screen",
                    parameters=[given.params_file, parameters])

    recorder = node("recorder", out=given.out, whole=True)
    others = [node("orientation_estimator"),
              node("replayer", bag=given.bag, rate=given.rate)]
    # The recorder ends by itself when replayer and estimator have said that nothing more comes.
    handlers = [on_success(recorder, [shutdown("recording ended")]), *map(on_success, others)]
    return after_compiling([*handlers, recorder, *others])


def generate_launch_description():
    """The arguments, and what starts the rest."""
    return LaunchDescription([
        DeclareLaunchArgument("bag", description="recording to replay"),
        DeclareLaunchArgument("out", default_value="replayed",
                              description="directory of the new recording"),
        DeclareLaunchArgument("rate", default_value="0.0",
                              description="speed; 0: as fast as the nodes take it"),
        DeclareLaunchArgument(
            "params_file", description="ROS 2 parameter file",
            default_value=PathJoinSubstitution(
                [FindPackageShare("imu_fusion"), "config", "replay.yaml"])),
        OpaqueFunction(function=start)])
