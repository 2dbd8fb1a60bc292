"""``ros2 launch drocap_ros drocap.launch.py config:=FILE``: the nodes of ``drocap live``, each restarted by launch."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from drocap_ros.ros.topics import NODES

YES, NO = ("true", "True", "1", "yes"), ("", "false", "False", "0", "no")
#: Name -> default and description.
ARGUMENTS = {
    "config": (None, "parameters of the components (YAML)"),
    "namespace": ("/drocap", "of all topics"),
    "source": ("", "replaces the configuration's image_ingest.source: a video, a camera, a URL, topic:NAME"),
    "record": ("false", "true, false, or the new folder of the session"),
    "autopilot": ("true", "whether mavlink_bridge runs"),
    "respawn": ("true", "whether a node that ends is started again; false for a video, which ends"),
}


def generate_launch_description():
    """Arguments and nodes."""
    arguments = [
        DeclareLaunchArgument(name, description=words, **({} if default is None else {"default_value": default}))
        for name, (default, words) in ARGUMENTS.items()
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=nodes)])


def nodes(context):
    """The nodes by the arguments of the launch."""
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    left_out = {"session_recorder"} if given["record"] in NO else set()
    left_out |= {"mavlink_bridge"} if given["autopilot"] in NO else set()
    more = {"image_ingest": {"source": given["source"]}} if given["source"] else {}
    if given["record"] not in (*YES, *NO):
        more["session_recorder"] = {"session_dir": given["record"]}
    return [
        Node(
            package="drocap_ros",
            executable=name,
            name=name,
            namespace=given["namespace"],
            parameters=[given["config"], more.get(name, {})],
            respawn=given["respawn"] in YES,
            respawn_delay=1.0,
            output="screen",
        )
        for name, entry in NODES.items()
        if entry.live and name not in left_out
    ]
