"""Priorities of the nodes' processes."""

import os
import threading

import pytest

from drocap_ros.ros import spin as run


@pytest.mark.skipif(not hasattr(os, "SCHED_IDLE"), reason="Linux's policies")
@pytest.mark.parametrize(
    ("component", "own_process", "policy"),
    [
        ("pose_estimator", True, "SCHED_OTHER"),
        ("initializer", True, "SCHED_OTHER"),
        ("mavlink_bridge", True, "SCHED_OTHER"),
        ("session_recorder", True, "SCHED_BATCH"),
        ("bundle_adjuster", True, "SCHED_IDLE"),
        # A thread that holds Python's lock must be let run.
        ("bundle_adjuster", False, "SCHED_BATCH"),
    ],
)
def test_what_comes_last_takes_what_others_leave_but_not_beside_them_in_a_process(component, own_process, policy):
    found = []

    def ask():
        run.step_back(component, own_process)
        found.append(os.sched_getscheduler(0))

    thread = threading.Thread(target=ask)
    thread.start()
    thread.join()
    assert found == [getattr(os, policy)]
