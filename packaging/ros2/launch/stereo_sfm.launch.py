"""Starts the service beside the robot's other nodes: ros2 launch stereo_sfm_ros stereo_sfm.launch.py [config:=FILE]."""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess
from launch.substitutions import LaunchConfiguration


def generate_launch_description() -> LaunchDescription:
    """The service as a process that is started again when it ends."""
    default = str(Path(__file__).resolve().parents[1] / "config" / "robot.toml")
    service = ExecuteProcess(
        cmd=["stereo-sfm", "serve", "-c", LaunchConfiguration("config")],
        output="screen",
        respawn=True,
        respawn_delay=2.0,
        sigterm_timeout="8",
    )
    return LaunchDescription([DeclareLaunchArgument("config", default_value=default), service])
