"""Priorities of the nodes' processes."""

import os
import subprocess
import sys

import pytest

from drocap_ros.ros.topics import NODES

SCRIPT = """
import os, sys, threading, time
from drocap_ros.ros.spin import lower_priority
before, release = threading.Event(), threading.Event()
for _ in range(300):  # others end meanwhile
    threading.Thread(target=time.sleep, args=(0.01,)).start()
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


def test_the_flight_loop_and_the_way_to_the_initial_pose_precede_the_newest_pose_and_this_all_that_is_left():
    live = {name: node.niceness for name, node in NODES.items() if node.live}
    order = [{name for name in live if live[name] == niceness} for niceness in sorted(set(live.values()))]
    assert order == [
        {"mavlink_bridge", "image_ingest", "pose_estimator", "initializer"},
        {"bundle_adjuster"},
        {"session_recorder"},
        {"visualizer"},
    ]
