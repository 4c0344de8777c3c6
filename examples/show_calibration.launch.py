"""Publish a calibration in ROS 2 and show two LiDARs by it: drivers aside, all that a site needs.

retropole export retropole-out --to launch --parent front --child rear --out tf.launch.py
ros2 launch examples/show_calibration.launch.py transform:=tf.launch.py fixed_frame:=front

With `bag:=aligned.mcap`, as `retropole export --to mcap` writes it, no driver has to run.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, IncludeLaunchDescription
from launch.conditions import LaunchConfigurationNotEquals
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

TOPICS = "/target/points", "/source/points"


def generate_launch_description():
    bag = LaunchConfiguration("bag")
    return LaunchDescription(
        [
            DeclareLaunchArgument("transform", description="what 'export --to launch' wrote"),
            DeclareLaunchArgument("fixed_frame", description="--parent of the export"),
            DeclareLaunchArgument("bag", default_value="", description="recording to play"),
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(LaunchConfiguration("transform"))
            ),
            ExecuteProcess(
                # /tf_static of the recording stays behind: the transform is published above.
                cmd=["ros2", "bag", "play", "--loop", bag, "--topics", *TOPICS],
                condition=LaunchConfigurationNotEquals("bag", ""),
            ),
            Node(
                package="rviz2",
                executable="rviz2",
                arguments=["--fixed-frame", LaunchConfiguration("fixed_frame")],
            ),
        ]
    )
