"""``ros2 launch drocap_ros drocap.launch.py config:=FILE``: the start-up of ``drocap live``.

The command starts, watches and restarts its nodes itself, so launch runs the command instead of single nodes.
"""

import sys

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, OpaqueFunction, Shutdown
from launch.substitutions import LaunchConfiguration

from drocap_ros.ros.topics import NODES

NO = ("false", "False", "0", "no")


def generate_launch_description():
    """Arguments and the one process."""
    return LaunchDescription(
        [
            DeclareLaunchArgument("config", description="parameters of the components (YAML)"),
            DeclareLaunchArgument("namespace", default_value="/drocap", description="of all topics"),
            DeclareLaunchArgument(
                "record", default_value="true", description="true, false, or the new folder of the session"
            ),
            OpaqueFunction(function=live),
        ]
    )


def live(context):
    """``drocap live`` with the arguments of the launch."""
    config, namespace, record = (
        LaunchConfiguration(name).perform(context) for name in ("config", "namespace", "record")
    )
    command = [sys.executable, "-m", "drocap_ros.cli", "live", "--config", config, "--namespace", namespace]
    if record in NO:
        command += ["--nodes", *(name for name, node in NODES.items() if node.live and name != "session_recorder")]
    elif record not in ("true", "True", "1", "yes"):
        command += ["--session", record]
    return [ExecuteProcess(cmd=command, output="screen", on_exit=Shutdown())]
