"""The process that a running graph has in reserve for a node that dies."""

import os
import signal
import sys
import time
from pathlib import Path

import pytest

from drocap_ros.bringup import bringup
from drocap_ros.config import DrocapConfig
from drocap_ros.errors import InputError
from drocap_ros.msg import Pose3D
from drocap_ros.ros.processes import Place, Spare
from drocap_ros.ros.topics import RESULT_QOS

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
NODES = ["capture_simulator", "initializer"]


def flight():
    config = DrocapConfig().replace("capture_simulator", seconds=60.0, rate_hz=15.0)
    return config.replace("initializer", azimuth_starts=2, start_iterations=4, sparse_rounds=1)


def command_of(pid):
    return Path(f"/proc/{pid}/cmdline").read_bytes().decode().replace("\0", " ")


def spares():
    """Processes in reserve that this one has started."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                parent = (entry / "stat").read_text().rsplit(")", 1)[1].split()[1]
                if int(parent) == os.getpid() and "drocap_ros.ros.standby" in command_of(entry.name):
                    found.append(int(entry.name))
            except OSError:
                pass
    return found


def test_a_node_that_dies_is_started_again_in_the_process_in_reserve_and_another_one_is_kept():
    with bringup(flight(), NODES, processes=True, respawn=True) as graph:
        poses = []
        graph.node.create_subscription(Pose3D, "pose3d/initial", poses.append, RESULT_QOS)
        for restarts in (1, 2):
            graph.wait_until(spares, 30, "a process in reserve")
            spare = spares()[0]
            os.kill(graph.pid("initializer"), signal.SIGKILL)
            graph.wait_until(lambda n=restarts: graph.restarts["initializer"] == n, 10, "the restart")
            assert graph.pid("initializer") == spare
            graph.wait_ready("initializer", timeout_s=20)
            assert "drocap_ros.nodes.initializer" in command_of(spare)
            poses.clear()
            graph.wait_until(lambda: poses, 10, "poses again")
        graph.wait_until(spares, 30, "a process in reserve")
    assert not spares()


def test_when_the_process_in_reserve_is_dead_too_the_node_starts_in_a_new_one():
    with bringup(flight(), NODES, processes=True, respawn=True) as graph:
        graph.wait_until(spares, 30, "a process in reserve")
        spare = spares()[0]
        os.kill(spare, signal.SIGKILL)
        os.kill(graph.pid("initializer"), signal.SIGKILL)
        graph.wait_until(lambda: graph.restarts["initializer"], 10, "the restart")
        assert graph.pid("initializer") != spare
        graph.wait_ready("initializer", timeout_s=30)


def test_without_respawn_there_is_none():
    with bringup(flight(), NODES, processes=True) as graph:
        graph.spin_for(3.0)
        assert not spares()


def test_it_has_imported_what_the_first_results_of_its_nodes_need(tmp_path):
    spare = Spare(Place(["bundle_adjuster"], "/drocap", 101, tmp_path))
    maps, end = Path(f"/proc/{spare.process.pid}/maps"), time.monotonic() + 20
    while "_flapack" not in maps.read_text() and time.monotonic() < end:
        time.sleep(0.1)
    assert "_flapack" in maps.read_text()
    spare.dismiss()
    spare.wait()


def test_it_ends_with_its_graph_and_refuses_what_its_node_refuses(tmp_path):
    place = Place(["bundle_adjuster"], "/drocap", 101, tmp_path)
    spare = Spare(place)
    spare.dismiss()
    spare.wait()
    assert spare.process.returncode == 0
    assert not spare.become("bundle_adjuster", tmp_path / "none.yaml")

    spare = Spare(place)
    parameters = tmp_path / "bundle_adjuster.yaml"
    parameters.write_text("/**:\n  ros__parameters:\n    window_s: -1.0\n")
    begin = time.monotonic()
    assert spare.become("bundle_adjuster", parameters)
    spare.wait()
    assert time.monotonic() - begin < 15
    assert spare.process.returncode == InputError.exit_status
    assert "window_s" in spare.log.read_text()
