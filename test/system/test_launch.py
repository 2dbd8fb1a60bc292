"""The launch file; the ROS wheels have no ``launch``, so it is read, not run."""

import ast
import re

import pytest

from drocap_ros.cli.graph import live
from drocap_ros.ros.topics import NODES


@pytest.fixture(scope="module")
def tree(root):
    path = root / "launch" / "drocap.launch.py"
    compile(path.read_text(), str(path), "exec")
    return ast.parse(path.read_text())


def strings(tree):
    return [node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)]


def test_arguments_are_config_namespace_and_record(tree):
    calls = [
        n for n in ast.walk(tree) if isinstance(n, ast.Call) and getattr(n.func, "id", "") == "DeclareLaunchArgument"
    ]
    assert [call.args[0].value for call in calls] == ["config", "namespace", "record"]


def test_its_options_are_those_of_drocap_live(tree):
    import argparse

    commands = argparse.ArgumentParser().add_subparsers()
    live.add_parser(commands)
    options = {text for text in strings(tree) if re.fullmatch(r"--[a-z-]+", text)}
    assert options >= {"--config", "--namespace", "--session", "--nodes"}
    listed = commands.choices["live"].format_help()
    assert all(option in listed for option in options)


def test_the_node_that_it_leaves_out_exists(tree):
    assert "session_recorder" in strings(tree)
    assert NODES["session_recorder"].live


def test_launch_folder_and_all_nodes_are_installed(root):
    text = (root / "CMakeLists.txt").read_text()
    assert re.search(r"install\(DIRECTORY [^)]*\blaunch\b", text)
    assert {path.stem for path in (root / "drocap_ros" / "nodes").glob("[a-z]*.py")} == set(NODES)
