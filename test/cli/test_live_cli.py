"""``drocap live`` and ``drocap record`` as commands, with a video that the test draws itself."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from drocap_ros.bringup import free_domain, watch
from drocap_ros.cli import main
from drocap_ros.flight.conditions import ConditionCode
from drocap_ros.flight.orbit.states import State
from drocap_ros.recording.open_session import session_info
from drocap_ros.ros.topics import RESULT_QOS
from drocap_ros.simulation.vehicle.loopback import free_udp_port
from drocap_ros.station.desk import sentence

ROOT = Path(__file__).resolve().parents[2]
IMAGES = "/drocap/image/compressed"


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    path = tmp_path_factory.mktemp("video") / "square.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 20.0, (320, 240))
    for i in range(40):
        frame = np.full((240, 320, 3), 90, np.uint8)
        cv2.rectangle(frame, (20 + 5 * i, 60), (60 + 5 * i, 180), (40, 200, 240), -1)
        writer.write(frame)
    writer.release()
    return path


def start(*arguments, log, **variables):
    command = [sys.executable, "-m", "drocap_ros.cli", *map(str, arguments)]
    env = {**os.environ, "PYTHONPATH": str(ROOT), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", **variables}
    # A session of its own: nodes, which are groups of their own, stay in it.
    return subprocess.Popen(command, env=env, stdout=log.open("w"), stderr=subprocess.STDOUT, start_new_session=True)


def wait_for_running(log):
    end = time.monotonic() + 60
    while "running" not in log.read_text() and time.monotonic() < end:
        time.sleep(0.1)


def counts(session):
    return {topic.name: topic.count for topic in session_info(session).topics}


@pytest.mark.parametrize("option", [(), ("--one-process",)], ids=["processes", "one process"])
def test_a_video_file_goes_live_into_a_session_and_the_command_ends_with_it(video, tmp_path, option):
    config = ROOT / "config" / "video_file.yaml"
    nodes = ("--nodes", "image_ingest", "session_recorder")
    with free_domain() as domain:
        common = ("--config", config, "--source", video, "--session", tmp_path / "session", "--domain-id", domain)
        live = start("live", *common, *nodes, *option, log=tmp_path / "log")
        assert live.wait(120) == 0, (tmp_path / "log").read_text()
    assert "running image_ingest, session_recorder" in (tmp_path / "log").read_text()
    assert f"session: {tmp_path / 'session'}\n" in (tmp_path / "log").read_text()
    # Pictures are best effort; on one machine at this size nearly all arrive.
    assert 30 <= counts(tmp_path / "session")[IMAGES] <= 40


def test_record_takes_what_another_graph_publishes_until_it_is_interrupted(video, tmp_path):
    # The recorder joins a graph that runs: discovery may take seconds, so the video goes round.
    config = tmp_path / "loop.yaml"
    config.write_text(f"/**/image_ingest: {{ros__parameters: {{source: {video}, loop: true}}}}")
    with free_domain() as domain:
        common = ("--config", config, "--domain-id", domain, "--nodes", "image_ingest")
        live = start("live", *common, log=tmp_path / "live.log")
        record = start("record", "--out", tmp_path / "rec", "--domain-id", domain, log=tmp_path / "record.log")
        for name in ("live", "record"):
            wait_for_running(tmp_path / f"{name}.log")
        end = time.monotonic() + 60
        # Chunks are flushed while it records, so that the file can be read before it is closed.
        while counts(tmp_path / "rec").get(IMAGES, 0) <= 20 and time.monotonic() < end:
            time.sleep(0.5)
        for process in (record, live):
            process.send_signal(signal.SIGINT)
        assert record.wait(60) == 0, (tmp_path / "record.log").read_text()
        assert live.wait(60) == 0, (tmp_path / "live.log").read_text()
    assert counts(tmp_path / "rec")[IMAGES] > 20


def group_of(pid):
    os.killpg(pid, signal.SIGTERM)


def session_of(pid):
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            session = int(stat.read_text().rpartition(")")[2].split()[3])
        except OSError:
            continue
        if session == pid:
            os.kill(int(stat.parent.name), signal.SIGTERM)


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("end", [group_of, session_of], ids=["group, as timeout does", "all, as systemd does"])
def test_sigterm_to_all_processes_ends_the_graph_in_order(video, tmp_path, end):
    config = tmp_path / "loop.yaml"
    config.write_text(f"/**/image_ingest: {{ros__parameters: {{source: {video}, loop: true}}}}")
    with free_domain() as domain:
        common = ("--config", config, "--session", tmp_path / "session", "--domain-id", domain)
        live = start("live", *common, "--nodes", "image_ingest", "session_recorder", log=tmp_path / "log")
        wait_for_running(tmp_path / "log")
        time.sleep(1.5)
        end(live.pid)
        assert live.wait(30) == 0, (tmp_path / "log").read_text()
    assert "restart" not in (tmp_path / "log").read_text()
    assert f"session: {tmp_path / 'session'}\n" in (tmp_path / "log").read_text()
    assert not session_info(tmp_path / "session").warnings
    assert not (tmp_path / "session_2").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--config", "none.yaml"), "none.yaml"),
        (("--config", ROOT / "config" / "video_file.yaml", "--source", "none.mp4"), "none.mp4"),
        (
            ("--config", ROOT / "config" / "video_file.yaml", "--source", "topic:bad name/compressed"),
            "got 'bad name/com",
        ),
        (("--config", ROOT / "config" / "video_file.yaml", "--domain-id", "500"), "--domain-id: expected 0 to 101"),
    ],
)
def test_what_cannot_run_is_refused_with_status_2(tmp_path, arguments, words):
    with free_domain() as domain:
        given = arguments if "--domain-id" in arguments else (*arguments, "--domain-id", domain)
        live = start("live", *given, "--nodes", "image_ingest", log=tmp_path / "log")
        assert live.wait(120) == 2
    text = (tmp_path / "log").read_text().strip()
    assert words in text
    assert "Traceback" not in text


@pytest.mark.parametrize("option", [(), ("--one-process",)], ids=["processes", "one process"])
def test_a_graph_that_cannot_begin_leaves_no_session(tmp_path, option):
    config = ROOT / "config" / "video_file.yaml"
    with free_domain() as domain:
        live = start(
            "live", "--config", config, "--source", "none.mp4", "--session", tmp_path / "flight",
            "--nodes", "image_ingest", "session_recorder", "--domain-id", domain, *option, log=tmp_path / "log",
        )  # fmt: skip
        assert live.wait(120) == 2
    assert "none.mp4" in (tmp_path / "log").read_text()
    assert not (tmp_path / "flight").exists()


def test_top_shows_the_nodes_of_a_running_graph(video, tmp_path, monkeypatch, capsys):
    config = ROOT / "config" / "video_file.yaml"
    with free_domain() as domain:
        nodes = ("--nodes", "session_recorder")
        common = ("--config", config, "--session", tmp_path / "session", "--domain-id", domain)
        live = start("live", *common, *nodes, log=tmp_path / "live.log")
        try:
            wait_for_running(tmp_path / "live.log")
            top = start("top", "--once", "--domain-id", domain, log=tmp_path / "top.log")
            assert top.wait(60) == 0, (tmp_path / "live.log").read_text()
        finally:
            live.send_signal(signal.SIGINT)
            assert live.wait(60) == 0
        assert "drocap/session_recorder" in (tmp_path / "top.log").read_text()
        # Nobody is left to be heard; a node would say something once a second.
        monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        monkeypatch.setattr("drocap_ros.cli.graph.top.ONCE_TIMEOUT_S", 3.0)
        assert main(["top", "--once", "--domain-id", str(domain)]) == 1
        assert f"in /drocap, domain {domain}, found none" in capsys.readouterr().err


def test_top_waits_for_the_nodes_that_are_found_later(tmp_path, monkeypatch):
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    with free_domain() as domain, watch("/drocap", domain) as graph:
        publisher = graph.node.create_publisher(DiagnosticArray, "/diagnostics", RESULT_QOS)
        top = start("top", "--once", "--domain-id", domain, log=tmp_path / "log")
        graph.wait_until(publisher.get_subscription_count, 30, "the command to listen")
        begin = time.monotonic()
        while top.poll() is None:
            names = [
                name for name, after_s in (("a", 0.0), ("b", 1.2), ("c", 2.7)) if time.monotonic() > begin + after_s
            ]
            publisher.publish(DiagnosticArray(status=[DiagnosticStatus(name=f"drocap/{name}") for name in names]))
            graph.spin_for(0.1)
        assert top.wait() == 0
    assert time.monotonic() - begin < 10.0
    assert [name for name in "abc" if f"drocap/{name}" in (tmp_path / "log").read_text()] == ["a", "b", "c"]


def test_every_command_joins_the_domain_of_the_environment(tmp_path):
    config = tmp_path / "quiet.yaml"
    config.write_text(f"mavlink_bridge:\n  url: udpin:127.0.0.1:{free_udp_port()}\n")
    with free_domain() as domain:
        here = {"ROS_DOMAIN_ID": str(domain)}

        def run(*arguments):
            name = arguments[0]
            status = start(*arguments, log=tmp_path / name, **here).wait(120)
            return status, (tmp_path / name).read_text()

        common = ("--config", config, "--nodes", "mavlink_bridge")
        live = start("live", *common, log=tmp_path / "live.log", **here)
        record = start("record", "--out", tmp_path / "rec", log=tmp_path / "record.log", **here)
        try:
            for name in ("live", "record"):
                wait_for_running(tmp_path / f"{name}.log")
                assert f"domain {domain}; Ctrl-C stops" in (tmp_path / f"{name}.log").read_text()
            # The option comes first, and another domain is empty: this one listens until its time-out.
            elsewhere = start("top", "--once", "--domain-id", "101", log=tmp_path / "elsewhere.log", **here)
            status, text = run("top", "--once")
            assert (status, "drocap/mavlink_bridge" in text) == (0, True), text
            status, text = run("orbit", "status")
            assert (status, text.split(":")[0]) == (0, "idle"), text
            assert elsewhere.wait(60) == 1
        finally:
            for process in (record, live):
                process.send_signal(signal.SIGINT)
        assert (record.wait(60), live.wait(60)) == (0, 0)
        assert counts(tmp_path / "rec")["/drocap/orbit/status"] > 0
        status, text = run("replay", tmp_path / "rec", "--rate", "100")
        assert (status, f"domain {domain};" in text) == (0, True), text


@pytest.mark.parametrize("namespace", ["a-b", "a b", "/a/", "1a", "//"])
@pytest.mark.parametrize(
    "command",
    [
        "record",
        "replay s",
        "top --once",
        "orbit status",
        "preflight --config c",
        "live --config c",
        "station --config c",
    ],
)
def test_a_namespace_that_ros_does_not_know_is_refused(command, namespace, capsys):
    assert main([*command.split(), "--namespace", namespace]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"--namespace: expected names of letters, digits and _, as /drocap or /a/b, got '{namespace}'" in line


def test_an_adjustment_without_a_value_is_refused(capsys):
    assert main(["orbit", "adjust", "--timeout", "0.1"]) == 2
    assert "expected --radius, --height or --speed, got none" in capsys.readouterr().err


@pytest.mark.parametrize("action", ["start", "adjust"])
def test_a_value_that_is_no_number_is_not_taken_for_one_left_out(action, capsys):
    assert main(["orbit", action, "--radius", "nan", "--speed", "5", "--timeout", "0.1"]) == 2
    assert "--radius: expected a finite number, got nan" in capsys.readouterr().err


@pytest.mark.parametrize("command", [("orbit", "status"), ("top", "--once"), ("record",)])
def test_a_domain_of_the_environment_that_does_not_exist_is_refused(command, monkeypatch, capsys):
    monkeypatch.setenv("ROS_DOMAIN_ID", "400")
    assert main(list(command)) == 2
    assert capsys.readouterr().err == "drocap: ROS_DOMAIN_ID: expected 0 to 101, got 400; choose another domain\n"


@pytest.mark.parametrize(("condition", "stays"), [(ConditionCode.STOPPED, True), (ConditionCode.SUBJECT_NEAR, False)])
def test_the_status_of_a_hold_says_that_the_vehicle_gives_way_to_nobody(condition, stays):
    status = SimpleNamespace(state=State.HOLDING, condition=condition, reason="held", radius_m=4.0, height_m=2.5)
    assert ("stays there, also where somebody walks up to it" in sentence(status)) == stays
