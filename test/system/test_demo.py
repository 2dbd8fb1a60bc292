"""``drocap demo`` as a process, in real time, interrupted, and with arguments that are refused."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from drocap_ros.cli import main
from drocap_ros.cli.demo.verdict import settled_orbit
from drocap_ros.cli.running import interruptible
from drocap_ros.flight.orbit.states import State


def test_demo_in_real_time_flies_and_shows_the_shares_of_the_processor(tmp_path, capsys):
    status = main(["demo", "--seconds", "4", "--seed", "1", "--out", str(tmp_path / "demo"), "--real-time"])
    printed = capsys.readouterr()
    if status:  # a busy machine may hold the vehicle
        assert "demo: expected 4 s of orbit" in printed.err
    else:
        assert re.search(
            r"processor: flight_simulator \d+ %, pose_estimator \d+ %, .*session_recorder \d+ %", printed.out
        )
        assert "simulated time:" not in printed.out


# The command, and its processes of pictures, poses and adjustments.  In real time:
# the command, seven nodes, the adjuster's process and the bridge's guardian, the server that forks, and the tracker.
@pytest.mark.parametrize(("options", "processes"), [((), 4), (("--real-time",), 12)])
def test_interrupted_demo_leaves_no_process_and_no_file(tmp_path, options, processes):
    command = [sys.executable, "-u", "-m", "drocap_ros.cli", "demo", "--out", str(tmp_path / "demo"), *options]
    mark = f"demo_{os.getpid()}"
    environment = {**os.environ, "DROCAP_TEST_MARK": mark}
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment) as demo:
        for line in demo.stdout:
            if "pilot" in line:
                break
        end = time.monotonic() + 30  # of a busy machine, where a process of its own begins late
        while len(_marked(mark)) < processes and time.monotonic() < end:
            time.sleep(0.05)
        assert len(_marked(mark)) == processes
        demo.send_signal(signal.SIGINT)
        demo.stdout.read()
        error = demo.stderr.read()
        assert (demo.wait(60), error) == (130, "drocap: interrupted\n")
    assert _marked(mark) == []
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interruption_is_noticed_where_python_cannot_raise_it(number, monkeypatch):
    class Interrupted:
        def __del__(self):
            os.kill(os.getpid(), number)
            for _ in range(100):  # signals are looked for now and then
                pass

    lost = []
    monkeypatch.setattr(sys, "unraisablehook", lambda what: lost.append(what.exc_type))
    before = signal.getsignal(number)
    with interruptible() as interrupted:
        assert not interrupted.is_set()
        Interrupted()
        assert interrupted.is_set()
    assert lost == [KeyboardInterrupt]
    assert signal.getsignal(number) is before


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interruption_that_a_library_turns_into_an_error_is_one_of_the_command(number, monkeypatch, capsys):
    def library(args):
        with interruptible():
            try:
                os.kill(os.getpid(), number)
            except KeyboardInterrupt:
                raise RuntimeError("Unable to convert call argument") from None

    monkeypatch.setattr("drocap_ros.cli.demo.command.run", library)
    assert main(["demo"]) == 130
    assert capsys.readouterr().err == "drocap: interrupted\n"
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def _marked(mark):
    """Processes whose environment bears the mark."""
    return [path.parent.name for path in Path("/proc").glob("[0-9]*/environ") if mark.encode() in _environment(path)]


def _environment(path):
    try:
        return path.read_bytes()
    except OSError:  # it has just ended
        return b""


def test_flight_without_length_is_refused(tmp_path, capsys):
    assert main(["demo", "--seconds", "-1", "--out", str(tmp_path / "demo")]) == 2
    assert "seconds: expected" in capsys.readouterr().err
    assert not (tmp_path / "demo").exists()


def test_demo_without_networks_is_refused_and_leaves_nothing(tmp_path, capsys):
    words = ["demo", "--models", str(tmp_path / "none"), "--out", str(tmp_path / "demo"), "--quiet"]
    assert main(words) == 2
    assert "none: expected a folder with a" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_orbit_is_settled_after_the_ramp_of_each_start():
    stamps = np.arange(60) * 10**9
    orbit, hold = State.ORBITING, State.HOLDING
    printed = [
        (0, State.READY),
        (10, orbit),
        (11, orbit),
        (25, hold),
        (30, orbit),
        (33, hold),
        (40, orbit),
        (49, orbit),
    ]
    settled = settled_orbit(stamps, [(t * 10**9, state) for t, state in printed])
    assert np.flatnonzero(settled).tolist() == [*range(16, 25), *range(46, 49)]
    assert not settled_orbit(stamps, []).any()
