"""Priorities of the nodes' processes."""

import os
import threading
from pathlib import Path

import pytest

from drocap_ros.nodes import run


@pytest.fixture
def asked(monkeypatch):
    """What is asked of the system, which refuses the first two requests as coming too soon."""
    requests = []

    def write(path, text):
        requests.append((str(path), text))
        if len(requests) <= 2:
            raise BlockingIOError

    monkeypatch.setattr(Path, "write_text", write)
    monkeypatch.setattr(run.time, "sleep", lambda _: None)
    return requests


def test_a_request_that_came_too_soon_is_made_again(asked, monkeypatch):
    monkeypatch.setattr(os, "getsid", lambda _: os.getpid())
    run.step_session_back("bundle_adjuster")
    assert asked == [("/proc/self/autogroup", "15")] * 3


def test_a_session_of_others_and_the_estimators_own_are_left_as_they_are(asked, monkeypatch):
    monkeypatch.setattr(os, "getsid", lambda _: os.getpid() + 1)
    run.step_session_back("bundle_adjuster")
    monkeypatch.setattr(os, "getsid", lambda _: os.getpid())
    run.step_session_back("pose_estimator")
    assert asked == []


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
