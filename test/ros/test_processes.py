"""Nodes in processes: forks of a preloaded server, restarts, ends."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from captured_flight import captured_config

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
ROOT = Path(__file__).resolve().parents[2]


def name_of(pid):
    try:
        return Path(f"/proc/{pid}/comm").read_text().strip()
    except OSError:
        return None


COMMAND = """
import time
import sys
from drocap_ros.bringup import bringup
from drocap_ros.config import DrocapConfig
if __name__ == "__main__":
    config = DrocapConfig().replace("session_player", session=sys.argv[1])
    with bringup(config, ["session_player", "initializer"], processes=True) as graph:
        print(*(graph.pid(name) for name in graph.names), flush=True)
        time.sleep(60.0)
"""


def test_nodes_stop_when_the_process_that_started_them_is_killed(tmp_path):
    script = tmp_path / "graph.py"
    script.write_text(COMMAND)
    session = captured_config(tmp_path, 60.0).session_player.session
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = subprocess.Popen([sys.executable, script, session], env=env, stdout=subprocess.PIPE, text=True)
    pids = [int(word) for word in command.stdout.readline().split()]
    assert {name_of(pid) for pid in pids} == {"session_player", "initializer"}
    command.kill()
    end = time.monotonic() + 15.0
    while any(name_of(pid) for pid in pids) and time.monotonic() < end:
        time.sleep(0.1)
    assert not any(name_of(pid) for pid in pids)
