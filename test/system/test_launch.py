"""The launch file; the ROS wheels have no ``launch``, so its description is made with the names that it imports."""

import re
import runpy
import sys
from types import ModuleType, SimpleNamespace

import pytest

from drocap_ros.config import section_types
from drocap_ros.ros.topics import NODES


@pytest.fixture
def launch(root, monkeypatch):
    """A function of the launch's arguments that gives the nodes by name."""

    def record(kind):
        return lambda *args, **more: SimpleNamespace(kind=kind, args=args, **more)

    given = {}

    class Configuration:
        def __init__(self, name):
            self.perform = lambda _: given[name]

    for module, names in {
        "launch": {"LaunchDescription": list},
        "launch.actions": {name: record(name) for name in ("DeclareLaunchArgument", "OpaqueFunction")},
        "launch.substitutions": {"LaunchConfiguration": Configuration},
        "launch_ros": {},
        "launch_ros.actions": {"Node": record("Node")},
    }.items():
        stand_in = ModuleType(module)
        vars(stand_in).update(names)
        monkeypatch.setitem(sys.modules, module, stand_in)
    *declared, made = runpy.run_path(str(root / "launch" / "drocap.launch.py"))["generate_launch_description"]()

    def start(**arguments):
        given.update({action.args[0]: getattr(action, "default_value", None) for action in declared})
        assert set(arguments) <= set(given)
        given.update(arguments)
        return {node.name: node for node in made.function(None)}

    return start


def test_every_node_is_a_process_of_its_own_that_is_restarted(launch):
    nodes = launch(config="mine.yaml")
    assert list(nodes) == [name for name, entry in NODES.items() if entry.live and name != "session_recorder"]
    for name, node in nodes.items():
        assert (node.package, node.executable, node.namespace) == ("drocap_ros", name, "/drocap")
        assert node.parameters[0] == "mine.yaml"
        assert node.respawn


@pytest.mark.parametrize(("record", "folder"), [("true", None), ("/data/flight", "/data/flight")])
def test_a_session_is_recorded_on_demand(launch, record, folder):
    recorder = launch(config="mine.yaml", record=record)["session_recorder"]
    assert recorder.parameters[1] == ({"session_dir": folder} if folder else {})


def test_a_video_without_a_drone(launch):
    nodes = launch(config="mine.yaml", source="walk.mp4", autopilot="false", respawn="false")
    assert "mavlink_bridge" not in nodes
    assert not any(node.respawn for node in nodes.values())
    assert nodes["image_ingest"].parameters[1] == {"source": "walk.mp4"}


def test_parameters_that_it_sets_exist(launch):
    for name, node in launch(config="mine.yaml", source="0", record="/data/flight").items():
        assert set(node.parameters[1]) <= set(section_types()[name].__dataclass_fields__)


def test_launch_folder_and_all_nodes_are_installed(root):
    text = (root / "CMakeLists.txt").read_text()
    assert re.search(r"install\(DIRECTORY [^)]*\blaunch\b", text)
    assert {path.stem for path in (root / "drocap_ros" / "nodes").glob("[a-z]*.py")} == set(NODES)
