"""Priorities of the nodes' processes."""

import os
import subprocess
import sys

import pytest

from drocap_ros.ros.topics import NODES

SCRIPT = """
import os, sys, threading
from drocap_ros.ros.spin import lower_priority
before, release = threading.Event(), threading.Event()
thread = threading.Thread(target=release.wait, daemon=True)
thread.start()
lower_priority(int(sys.argv[1]))
print(*{(os.getpriority(os.PRIO_PROCESS, t), os.sched_getscheduler(t)) for t in (thread.native_id, 0)}, sep=";")
"""


@pytest.mark.skipif(not hasattr(os, "SCHED_BATCH"), reason="Linux's policies")
@pytest.mark.parametrize(("niceness", "policy"), [(0, "SCHED_OTHER"), (5, "SCHED_OTHER"), (15, "SCHED_BATCH")])
def test_all_threads_of_a_process_get_its_priority(niceness, policy):
    run = subprocess.run([sys.executable, "-c", SCRIPT, str(niceness)], capture_output=True, text=True, check=True)
    expected = max(niceness, os.getpriority(os.PRIO_PROCESS, 0)) if niceness else os.getpriority(os.PRIO_PROCESS, 0)
    assert run.stdout.strip() == str((expected, getattr(os, policy)))


def test_the_flight_loop_and_short_work_precede_the_keypoints_and_these_all_that_is_left():
    live = {name: node.niceness for name, node in NODES.items() if node.live}
    first, second, *last = (
        {name for name in live if live[name] == niceness} for niceness in sorted(set(live.values()))
    )
    assert first == {"mavlink_bridge", "image_ingest", "initializer"}
    assert second == {"pose_estimator", "bundle_adjuster"}
    assert last == [{"session_recorder"}, {"visualizer"}]


def run_node(*arguments):
    command = [sys.executable, "-m", "drocap_ros.nodes", "initializer", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=60)


def test_help_of_a_node_lists_its_parameters_and_ends():
    done = run_node("--help")
    assert done.returncode == 0
    assert "assumed_height_m (" in done.stdout
    assert "--ros-args -p NAME:=VALUE" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "words"),
    [(("--ros-args", "-p", "nonsense:=1"), "unknown parameter 'nonsense'"), (("walk.mp4",), "walk.mp4: expected ROS")],
)
def test_unknown_words_on_a_node_s_command_line_are_refused(arguments, words):
    done = run_node(*arguments)
    assert done.returncode == 2
    (line,) = done.stderr.strip().splitlines()
    assert words in line
