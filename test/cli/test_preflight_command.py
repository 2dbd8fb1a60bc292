"""``drocap preflight`` as a process, against simulated vehicles as processes; two at a time."""

import dataclasses
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import yaml
from station_files import station_settings

from drocap_ros.bringup import free_domain
from drocap_ros.cli import main
from drocap_ros.cli.graph.preflight import look, pace_of, setup_of
from drocap_ros.cli.graph.running_bridge import BridgeListener
from drocap_ros.config import DrocapConfig
from drocap_ros.errors import InputError
from drocap_ros.flight.autopilot.autopilot import Level
from drocap_ros.flight.bridge_config import MavlinkBridgeConfig
from drocap_ros.flight.mavlink.transport import open_transport
from drocap_ros.flight.preflight.link_checks import link_findings
from drocap_ros.flight.preflight.measure import all_findings
from drocap_ros.flight.preflight.setup_checks import Pace, Pictures, Setup, setup_findings
from drocap_ros.flight.vehicle import LANDED_ON_GROUND, VehicleState
from drocap_ros.perception.sources import Frame, ImageSource
from drocap_ros.perception.sources.base import ImageIngestConfig
from drocap_ros.ros.diagnostics import Key
from drocap_ros.simulation.vehicle.loopback import free_udp_port

ROOT = Path(__file__).resolve().parents[2]
ENV = {**os.environ, "PYTHONPATH": str(ROOT), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
#: What a ground station loads, and a gimbal.
SETTINGS = {
    name: tuple(f"{setting}={value}" for setting, value in {**station_settings(name), **more}.items())
    for name, more in {"ardupilot": {"MNT1_TYPE": 6.0}, "px4": {}}.items()
}
#: Checks that wait for the air.
WAITING = {"phase", "subject", "place"}
#: Name: autopilot ("" = nobody), more words of the vehicle, expected status, expected missing checks.
CASES = {
    "ready": ("ardupilot", (), 0, set()),
    "ground_px4": ("px4", ("--on-ground",), 0, set()),
    "timeout": ("ardupilot", ("GUID_TIMEOUT=3.0",), 1, {"guid_timeout"}),
    "rates": ("ardupilot", ("--max-rate", "4"), 1, {"rate_attitude_quaternion", "rate_local_position_ned"}),
    "silent": ("", (), 2, {"link"}),
    "garbage": ("", (), 2, {"link"}),
}


@pytest.fixture(scope="module", autouse=True)
def own_domain():
    """The command reads the bridge of any graph that it hears: those of other tests live in other domains."""
    with free_domain() as domain:
        ENV["ROS_DOMAIN_ID"] = str(domain)
        yield


def start(*arguments, log):
    command = [sys.executable, "-m", *map(str, arguments)]
    with log.open("w") as out, log.with_suffix(".err").open("w") as err:
        return subprocess.Popen(command, env=ENV, stdout=out, stderr=err)


def pictures(folder):
    """A folder of pictures in the place of a camera, which this machine does not have."""
    path = folder / "pictures"
    if not path.exists():
        path.mkdir()
        image = np.random.default_rng(0).integers(255, size=(720, 1280, 3), dtype=np.uint8)
        for number in range(3):
            cv2.imwrite(str(path / f"{number}.png"), image)
    return path


def write_config(path, url, models, **values):
    bridge = {"url": url, "commands_enabled": True, "mode_change_allowed": True, "size_error": 0.04, **values}
    bridge.update(max_state_age_s=1.0, max_round_trip_s=2.0)  # this machine may run other tests at the same time
    ingest = {"source": str(pictures(path.parent)), "horizontal_fov_deg": 60.0, "width_px": 1280, "height_px": 720}
    sections = {"mavlink_bridge": bridge, "image_ingest": ingest, "pose_estimator": {"models_dir": str(models)}}
    path.write_text(yaml.safe_dump(sections))
    return path


def fly(folder, names):
    """Status, table, error and JSON of each case."""
    found, running, vehicles = {}, {}, []
    for name in names:
        autopilot, words, _, _ = CASES[name]
        port = free_udp_port()
        config = write_config(folder / f"{name}.yaml", f"udpin:127.0.0.1:{port}", "simulation")
        if autopilot:
            more = words if words and words[0].startswith("--") else ()
            settings = (*SETTINGS[autopilot], *(words if not more else ()))
            module = "lab.simulation.path_vehicle"
            place = ("--url", f"udpout:127.0.0.1:{port}", "--autopilot", autopilot)
            vehicles.append(start(module, *place, *more, "--set", *settings, log=folder / f"{name}.vehicle"))
        options = ("--config", config, "--seconds", "5", "--json", folder / f"{name}.json")
        running[name] = start("drocap_ros.cli", "preflight", *options, log=folder / f"{name}.txt"), port
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as noise:
        end = time.monotonic() + 90
        while any(process.poll() is None for process, _ in running.values()) and time.monotonic() < end:
            if "garbage" in running:
                noise.sendto(os.urandom(200), ("127.0.0.1", running["garbage"][1]))
            time.sleep(0.02)
    for vehicle in vehicles:
        vehicle.send_signal(signal.SIGINT)
        assert vehicle.wait(20) == 0
    for name, (process, _) in running.items():
        table, error = ((folder / f"{name}{ending}").read_text() for ending in (".txt", ".err"))
        found[name] = process.returncode, table, error, json.loads((folder / f"{name}.json").read_text())
    return found


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """All cases; two vehicles at a time, so that each keeps its rates."""
    folder = tmp_path_factory.mktemp("preflight")
    groups = (("silent", "garbage", "rates", "timeout"), ("ready", "ground_px4"))
    return {name: run for names in groups for name, run in fly(folder, names).items()}


@pytest.mark.parametrize("name", CASES)
def test_status_and_checks_of_each_case(runs, name):
    _, _, expected, missing = CASES[name]
    status, table, error, content = runs[name]
    assert (status, content["exit_status"]) == (expected, expected), table + error
    assert {check["code"] for check in content["checks"] if check["level"] == "missing"} == missing
    assert content["status"] == {0: "ready", 1: "missing", 2: "silent"}[expected]
    assert error.count("\n") == (expected == 2)
    assert "Traceback" not in error
    for check in content["checks"]:
        assert check["name"] in table
        assert (check["level"] == "ok") <= (not check["remedy"])
        assert check["remedy"] or check["level"] == "ok", check


def test_the_table_names_value_limit_and_remedy(runs):
    _, table, _, content = runs["timeout"]
    (check,) = (check for check in content["checks"] if check["code"] == "guid_timeout")
    assert (check["found"], check["wanted"]) == ("3 s", "at most 0.5 s")
    assert check["remedy"].startswith("set GUID_TIMEOUT to 0.5 on the autopilot")
    assert check["values"] == {"value": 3.0, "limit": 0.5}
    assert table.splitlines()[-1].startswith("not ready, missing: GUID_TIMEOUT (")


def test_on_the_ground_it_names_what_waits_for_the_air(runs):
    _, table, _, content = runs["ground_px4"]
    waiting = {check["code"]: check["name"] for check in content["checks"] if check["level"] == "waits"}
    assert waiting.keys() == WAITING | {"estimator_flight"}
    assert table.splitlines()[-1] == f"waits for the air: {', '.join(waiting.values())}"
    assert "waits for the air" not in runs["ready"][1]


def test_silence_and_noise_have_different_remedies(runs):
    assert "found nothing on udpin" in runs["silent"][2]
    assert "check the cable" in runs["silent"][2]
    assert "that are no MAVLink" in runs["garbage"][2]
    assert "check the baud rate" in runs["garbage"][2]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("mavlink_bridge: {orbit_radius: 5.0}", "unknown parameter 'orbit_radius'"),
        ("mavlink_bridge: {url: 'http://localhost:1'}", "url: expected udpin:HOST:PORT"),
        ("mavlink_bridge: {url: 'serial:/dev/none:57600'}", "url: expected a serial device that can be opened"),
        ("mavlink_bridge: {radius_m: 2.0}", "radius_m: expected at least 3.5 m"),
        ("mavlink_bridge: {status_hz: 1.0}", "status_hz: expected at least 2 Hz"),
        ("[1, 2]", "expected a mapping of components"),
        (":\n:", "expected YAML"),
        (None, "expected a configuration file"),
    ],
)
def test_what_cannot_be_used_is_refused_in_one_line(tmp_path, text, words, capfd):
    config = tmp_path / "config.yaml"
    if text is not None:
        config.write_text(text)
    assert main(["preflight", "--config", str(config)]) == 2
    out, error = capfd.readouterr()
    assert words in error
    assert error.count("\n") == 1
    assert out == ""


@pytest.mark.parametrize("option", [("--seconds", "0.5"), ("--seconds", "nan"), ("--domain-id", "200")])
def test_an_option_out_of_range_is_refused(tmp_path, option, capfd):
    config = write_config(tmp_path / "c.yaml", f"udpin:127.0.0.1:{free_udp_port()}", "simulation")
    assert main(["preflight", "--config", str(config), *option]) == 2
    assert f"{option[0]}: expected" in capfd.readouterr().err


def test_a_file_that_cannot_be_written_is_refused_before_listening(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("drocap_ros.cli.graph.preflight._measure", None)
    config = write_config(tmp_path / "c.yaml", "udpin:127.0.0.1:1", "simulation")
    assert main(["preflight", "--config", str(config), "--json", str(tmp_path)]) == 2
    assert capsys.readouterr().err.startswith(f"drocap: --json {tmp_path}: expected a file, found a folder")


def test_ctrl_c_ends_it_at_once_and_leaves_no_file(tmp_path):
    port = free_udp_port()
    config = write_config(tmp_path / "c.yaml", f"udpin:127.0.0.1:{port}", "simulation")
    options = ("--config", config, "--seconds", "200", "--json", tmp_path / "out.json")
    process = start("drocap_ros.cli", "preflight", *options, log=tmp_path / "out")
    end = time.monotonic() + 60
    while f":{port:04X} " not in Path("/proc/net/udp").read_text() and time.monotonic() < end:
        time.sleep(0.1)
    time.sleep(0.5)  # it listens
    assert process.poll() is None
    begin = time.monotonic()
    process.send_signal(signal.SIGINT)
    assert process.wait(20) == 130
    assert time.monotonic() - begin < 2.0
    assert (tmp_path / "out.err").read_text() == "drocap: interrupted\n"
    assert not (tmp_path / "out.json").exists()


def test_with_a_running_graph_it_reads_what_the_bridge_hears(tmp_path):
    port = free_udp_port()
    config = write_config(tmp_path / "c.yaml", f"udpin:127.0.0.1:{port}", "simulation")
    module = "lab.simulation.path_vehicle"
    vehicle = start(module, "--url", f"udpout:127.0.0.1:{port}", "--set", "GUID_TIMEOUT=3.0", log=tmp_path / "vehicle")
    live = start("drocap_ros.cli", "live", "--config", config, "--nodes", "mavlink_bridge", log=tmp_path / "live")
    try:
        end = time.monotonic() + 60
        while "running" not in (tmp_path / "live").read_text() and time.monotonic() < end:
            time.sleep(0.2)
        time.sleep(5.0)  # for the autopilot's parameters
        options = ("--config", config, "--seconds", "5", "--json", tmp_path / "out.json")
        process = start("drocap_ros.cli", "preflight", *options, log=tmp_path / "out")
        assert process.wait(60) == 1, (tmp_path / "out.err").read_text()
    finally:
        for running in (live, vehicle):
            running.send_signal(signal.SIGINT)
        assert live.wait(60) == 0
    checks = {check["code"]: check for check in json.loads((tmp_path / "out.json").read_text())["checks"]}
    assert checks["link"]["found"].startswith("by the running bridge in /drocap, idle: ")
    assert checks["guid_timeout"]["level"] == "missing"
    assert checks["guid_timeout"]["found"] == "3 s"
    assert checks["rate_attitude_quaternion"]["values"]["real_hz"] > 25
    assert checks["battery"]["found"] == "87 %, 15.8 V"
    assert (checks["settings"]["level"], checks["settings"]["found"]) == ("warning", "not read")


def images_check(ingest, config=None):
    """The check of what `look` saw."""
    setup = setup_of(DrocapConfig().replace("image_ingest", **ingest))
    setup = setup._replace(pictures=look(ImageIngestConfig(**ingest)))
    return {finding.code: finding for finding in setup_findings(config or MavlinkBridgeConfig(), setup)}.get("images")


def test_a_camera_that_is_not_there_is_missing():
    check = images_check({"source": "/dev/video97"})
    assert (check.level, check.found, check.values["opened"]) == (Level.MISSING, "not opened", False)
    assert check.remedy.startswith("/dev/video97: expected")


def test_a_source_is_opened_and_its_images_are_measured(tmp_path):
    source = {"source": str(pictures(tmp_path)), "folder_rate_hz": 12.5}
    check = images_check({**source, "width_px": 1280, "height_px": 720})
    assert (check.level, check.found) == (Level.OK, "1280x720 px, 12.5 images/s, latency not known")
    assert check.values["rate_hz"] == pytest.approx(12.5)
    other = images_check({**source, "width_px": 1920, "height_px": 1080})
    assert other.level == Level.WARNING
    assert other.wanted == "images of 1920x1080 px"


def test_a_covered_lens_is_named(tmp_path):
    cv2.imwrite(str(tmp_path / "1.png"), np.full((48, 64, 3), 9, np.uint8))
    check = images_check({"source": str(tmp_path / "1.png")})
    assert check.level == Level.WARNING
    assert "all of one colour" in check.found
    assert "uncover the lens" in check.remedy


class Networks:
    """Take so many seconds for an image, and let optical flow follow the others of load shedding."""

    def __init__(self, seconds):
        self.seconds, self.propagated, self.levels, self.since = seconds, False, [], 0

    def process(self, image, stamp_ns, load_level):
        self.levels.append(load_level)
        self.propagated = self.since < load_level
        self.since = self.since + 1 if self.propagated else 0
        time.sleep(0.0 if self.propagated else self.seconds)


@pytest.mark.parametrize(("work_s", "passes"), [(0.001, False), (0.9, True)])
def test_the_networks_are_watched_on_the_images_of_the_source(tmp_path, monkeypatch, work_s, passes):
    for number in range(90):
        cv2.imwrite(str(tmp_path / f"{number:03}.png"), np.full((48, 64, 3), number, np.uint8))
    config = DrocapConfig().replace("image_ingest", source=str(tmp_path), folder_rate_hz=20.0)
    networks = Networks(work_s)
    monkeypatch.setattr("drocap_ros.perception.estimator.PoseEstimator", lambda *_: networks)
    monkeypatch.setattr("drocap_ros.cli.graph.preflight._PACE_S", 4.0)
    pace = pace_of(config, Path("models"), 20.0, lambda *_: None)
    assert 3.5 < pace.seconds <= 4.0
    assert pace.pixels == 48 * 64
    assert pace.every >= 1.0
    assert pace.passed_over > 0.5 if passes else pace.passed_over < 0.4  # a busy machine passes over some
    assert (max(networks.levels) > 0) or not passes


@pytest.mark.parametrize(
    ("pace", "level", "words"),
    [
        ((0.0, 1.4, 1280 * 720, 1, 2), Level.OK, ()),
        ((0.0, 3.6, 1280 * 720, 1, 2), Level.WARNING, ("max_rate_hz to 17", "smaller one")),
        ((0.2, 3.0, 1920 * 1080, 1, 8), Level.WARNING, ("max_rate_hz to 16", "width_px", "threads to 4")),
        ((0.8, 1.0, 1280 * 720, 4, 8), Level.MISSING, ("max_rate_hz to 6", "smaller one")),
    ],
)
def test_a_machine_that_does_not_keep_up_is_told_which_setting_to_change(pace, level, words):
    setup = setup_of(DrocapConfig().replace("image_ingest", source="x"))
    pictures = Pictures(size=(1280, 720), rate_hz=30.0, pace=Pace(10.0, *pace))
    found = {f.code: f for f in setup_findings(MavlinkBridgeConfig(), setup._replace(pictures=pictures))}["pace"]
    assert found.level == level
    assert found.found.startswith("keeps up with 30" if pace[0] == 0 else f"passes over {100 * pace[0]:.0f}% of 30")
    assert all(word in found.remedy for word in words)
    assert bool(found.remedy) == bool(words)


def test_the_images_of_a_topic_come_from_the_graph():
    assert images_check({"source": "topic:/camera/image_raw"}) is None


class Driver(ImageSource):
    """A driver that stamps its images 80 ms before it gives them, and stops after some."""

    live = True
    size = (64, 48)

    def __init__(self, count):
        super().__init__()
        self.left, self.closed = count, threading.Event()

    def read(self):
        if not self.left:
            self.closed.wait(60)
            return None
        self.left -= 1
        time.sleep(0.05)
        return Frame(
            time.time_ns() - 80_000_000, np.random.default_rng(0).integers(255, size=(48, 64, 3), dtype=np.uint8)
        )

    def close(self):
        self.closed.set()


@pytest.mark.parametrize(("count", "words"), [(1, "one image, then no more"), (100, " images/s, here 0.08 s after")])
def test_a_driver_gives_rate_and_latency_and_may_stall(monkeypatch, count, words):
    monkeypatch.setattr("drocap_ros.perception.sources.open_source", lambda *_: Driver(count))
    begin = time.monotonic()
    check = images_check({"source": "/dev/video0"})
    assert words in check.found
    assert check.values["latency_s"] == pytest.approx(0.08, abs=0.04)
    assert time.monotonic() - begin < 10
    if count == 1:
        assert check.level == Level.WARNING
    else:
        assert 5 < check.values["rate_hz"] < 21


def test_what_the_running_bridge_refuses_is_missing_whatever_the_file_permits():
    graph = SimpleNamespace(node=SimpleNamespace(create_subscription=lambda *_: None), namespace="/drocap")
    listener = BridgeListener(graph)
    for code, reason in ((115, "not armed"), (100, "commands are disabled"), (100, "commands are disabled")):
        listener.statuses.append(SimpleNamespace(state=0, condition=code, reason=reason))
    config, standing = MavlinkBridgeConfig(commands_enabled=True), VehicleState(0, "px4", landed_state=LANDED_ON_GROUND)
    measured = dataclasses.replace(listener.measured(config, "/drocap"), heard=True, vehicle=standing)
    setup = Setup(None, (1280, 720), "", True, "/dev/video0", 1.7, "models")
    found = {finding.code: finding for finding in all_findings(config, setup, measured)}
    assert found["condition_commands_disabled"].level == Level.MISSING
    assert found["condition_commands_disabled"].found == "commands are disabled (67% of the time)"
    assert "condition_not_armed" not in found
    assert found["phase"].level == Level.WAITS


def test_values_of_the_bridge_that_are_no_numbers_are_unknown():
    graph = SimpleNamespace(node=SimpleNamespace(create_subscription=lambda *_: None), namespace="/drocap")
    listener = BridgeListener(graph)
    listener.statuses.append(SimpleNamespace(state=0, condition=0, reason=""))
    listener.values = {"stream_rate_hz/SYS_STATUS": "often", "GUID_TIMEOUT": "short"}
    measured = listener.measured(MavlinkBridgeConfig(), "/drocap")
    assert np.isnan([measured.streams["SYS_STATUS"].real_hz, measured.settings["GUID_TIMEOUT"]]).all()


@pytest.mark.parametrize(("round_trip", "missing"), [("nan", True), ("0.021", False)])
def test_a_running_bridge_whose_time_synchronization_is_never_answered_is_not_ready(round_trip, missing):
    listener = BridgeListener(
        SimpleNamespace(node=SimpleNamespace(create_subscription=lambda *_: None), namespace="/drocap")
    )
    listener.statuses.append(SimpleNamespace(state=0, condition=115, reason="not armed"))
    listener.values[Key.ROUND_TRIP] = round_trip
    config = MavlinkBridgeConfig(commands_enabled=True)
    found = {finding.code for finding in link_findings(config, listener.measured(config, "/drocap"))}
    assert ("round_trip" in found) == missing


def test_a_link_that_another_program_holds_is_refused_in_one_line(tmp_path):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        config = write_config(tmp_path / "c.yaml", f"udpin:127.0.0.1:{other.getsockname()[1]}", "simulation")
        process = start("drocap_ros.cli", "preflight", "--config", config, log=tmp_path / "out")
        assert process.wait(60) == 2
    error = (tmp_path / "out.err").read_text()
    assert "that no other program holds them" in error
    assert error.count("\n") == 1


def test_a_serial_line_belongs_to_one_program():
    pytest.importorskip("serial")
    master, slave = os.openpty()
    first = open_transport(f"serial:{os.ttyname(slave)}:57600")
    with pytest.raises(InputError, match="expected a serial device that can be opened"):
        open_transport(f"serial:{os.ttyname(slave)}:57600")
    first.close()
    os.close(master)
    os.close(slave)
