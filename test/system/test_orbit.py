"""The orbit through the real nodes, a real socket and the command line, in real time."""

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from flying import flying

from drocap_ros.bringup import bringup, free_domain
from drocap_ros.cli import main
from drocap_ros.config import DrocapConfig
from drocap_ros.flight.conditions import ConditionCode
from drocap_ros.flight.orbit.states import Command
from drocap_ros.msg import OrbitStatus
from drocap_ros.ros.topics import TOPICS
from drocap_ros.simulation.vehicle.loopback import free_udp_port

ROOT = Path(__file__).resolve().parents[2]
OTHER_POSE_PUBLISHER, SECOND_BRIDGE = 130, 131  # CONDITION_* of OrbitStatus


def operator(graph, *words):
    """Run ``drocap orbit`` beside the graph; returns the exit status and the output.

    It runs in a process of its own: a second ROS context in this one would delay the drone's thread for a second.
    """
    place = ["--domain-id", str(graph.domain_id), "--namespace", graph.namespace]
    command = [sys.executable, "-m", "drocap_ros.cli", "orbit", *words, *place]
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen([*command, "--timeout", "20"], env=env, stdout=subprocess.PIPE, text=True) as process:
        graph.wait_until(lambda: process.poll() is not None, 60, f"an answer to {words}")
        return process.returncode, process.stdout.read().strip()


def test_operator_flies_an_orbit_from_the_command_line():
    # Loose bounds: this machine may run other tests at the same time.
    with flying(commands_enabled=True, max_state_age_s=0.5, watchdog_s=0.5) as (graph, drone, got):
        graph.wait_until(lambda: got and got[-1].state == OrbitStatus.READY, 40, "readiness")
        assert operator(graph, "start", "--radius", "2") == (
            1, "refused: radius_m: expected at least 3.5 m (min_distance_m and 0.5 m of room), got 2; "
            "choose a larger radius",
        )  # fmt: skip
        status, answer = operator(graph, "start", "--speed", "40")
        assert status == 1
        assert answer.startswith("refused: angular_speed_deg_s: expected at most 33.1 deg/s at 6 m (max_acceleration")
        graph.wait_until(lambda: got[-1].state == OrbitStatus.READY, 20, "readiness")
        assert operator(graph, "start", "--speed", "15") == (0, "orbiting the subject")
        begin = time.monotonic()
        graph.wait_until(lambda: time.monotonic() - begin > 6, 30)
        assert np.linalg.norm(drone.copter.body.velocity) > 0.8, [(m.state, m.reason) for m in got[-5:]]
        status, sentence = operator(graph, "status")
        assert status == 0
        assert sentence.startswith("orbiting: orbiting the subject; ")
        drone.seeing = False
        graph.wait_until(lambda: got[-1].state == OrbitStatus.HOLDING, 10, "a hold when perception stops")
        assert got[-1].condition == ConditionCode.PICTURES_LOST
        graph.wait_until(lambda: drone.copter.mode == "BRAKE", 15, "the hold mode")
        drone.copter.set_mode("LOITER", "pilot")
        graph.wait_until(lambda: got[-1].state == OrbitStatus.TAKEN_OVER, 10, "the take-over to be seen")
        status, answer = operator(graph, "start")
        assert (status, answer.split(";")[0]) == (1, "refused: the pilot has taken over")
        assert got[-1].command_condition == OrbitStatus.CONDITION_PILOT_IN_COMMAND
        assert operator(graph, "stop") == (0, "acknowledged by the operator")
        graph.wait_until(lambda: got[-1].command_accepted, 10, "a status with the accepted command")
        assert got[-1].command_condition == OrbitStatus.CONDITION_ACKNOWLEDGED


def test_an_operator_whose_console_dies_is_missed():
    values = {"commands_enabled": True, "max_state_age_s": 0.5, "watchdog_s": 0.5, "operator_timeout_s": 2.0}
    with flying(**values) as (graph, _, got):
        graph.wait_until(lambda: got and got[-1].condition == ConditionCode.OPERATOR_SILENT, 40, "the lack of him")
        place = ["--domain-id", str(graph.domain_id), "--namespace", graph.namespace]
        command = [sys.executable, "-m", "drocap_ros.cli", "orbit", "watch", *place, "--timeout", "20"]
        env = {**os.environ, "PYTHONPATH": str(ROOT)}
        with subprocess.Popen(command, env=env, stdout=subprocess.PIPE, text=True) as console:
            try:
                graph.wait_until(lambda: got[-1].state == OrbitStatus.READY, 40, "readiness")
                assert operator(graph, "start", "--speed", "15") == (0, "orbiting the subject")
                begin = time.monotonic()
                graph.wait_until(lambda: time.monotonic() - begin > 4, 30)
                assert got[-1].state == OrbitStatus.ORBITING
                assert got[-1].command == Command.START  # a sign is no command
            finally:
                console.kill()
            graph.wait_until(lambda: got[-1].state == OrbitStatus.HOLDING, 10, "a hold")
            assert got[-1].condition == ConditionCode.OPERATOR_SILENT
            assert "orbiting" in console.stdout.read()


def test_a_second_publisher_of_the_keypoints_ends_the_orbit_and_forbids_another():
    with flying(commands_enabled=True, max_state_age_s=0.5, watchdog_s=0.5) as (graph, drone, got):
        graph.wait_until(lambda: got and got[-1].state == OrbitStatus.READY, 40, "readiness")
        assert operator(graph, "start") == (0, "orbiting the subject")
        graph.wait_until(lambda: got[-1].state == OrbitStatus.ORBITING, 20, "an orbit")
        other = graph.node.create_publisher(TOPICS["pose2d"].message, "pose2d", TOPICS["pose2d"].qos)
        copies = graph.node.create_subscription(
            TOPICS["pose2d"].message, "pose2d", lambda m: m.track_id < 9 and other.publish(relabelled(m)), 10
        )
        begin = time.monotonic()
        graph.wait_until(lambda: got[-1].state == OrbitStatus.HOLDING, 10, "a hold")
        assert time.monotonic() - begin < 2.0
        assert got[-1].condition == OTHER_POSE_PUBLISHER, got[-1].reason
        graph.wait_until(lambda: drone.copter.mode == "BRAKE", 15, "the hold mode")
        status, answer = operator(graph, "start")
        assert (status, answer.split(" (")[0]) == (1, "refused: pose2d has more than one publisher")
        graph.node.destroy_subscription(copies)
        graph.spin_for(4.0)
        assert "pose2d" not in operator(graph, "start")[1]  # the other one has gone


def test_a_second_bridge_ends_the_orbit_of_the_first_and_flies_none():
    with flying(commands_enabled=True, max_state_age_s=0.5, watchdog_s=0.5) as (graph, drone, got):
        graph.wait_until(lambda: got and got[-1].state == OrbitStatus.READY, 40, "readiness")
        assert operator(graph, "start") == (0, "orbiting the subject")
        url = f"udpin:127.0.0.1:{free_udp_port()}"
        config = DrocapConfig().replace("mavlink_bridge", url=url, commands_enabled=True)
        begin = time.monotonic()
        with bringup(config, ["mavlink_bridge"], domain_id=graph.domain_id):
            ready_s = time.monotonic() - begin
            graph.wait_until(lambda: SECOND_BRIDGE in {m.condition for m in got}, 10, "the second bridge to be seen")
            assert time.monotonic() - begin - ready_s < 2.0
            graph.wait_until(lambda: drone.copter.mode == "BRAKE", 15, "the hold mode")


def test_a_command_to_one_of_two_drones_in_one_graph_does_not_move_the_other(monkeypatch):
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    limits = {"commands_enabled": True, "max_state_age_s": 0.5, "watchdog_s": 0.5}
    with (
        free_domain() as domain,
        flying("/drone_1", domain, **limits) as (graph, drone, got),
        flying("/drone_2", domain, **limits) as (graph_2, other, got_2),
    ):

        def both(condition, timeout_s, what):
            graph.wait_until(lambda: graph_2.wait(condition, 0.0) and condition(), timeout_s, what)

        both(lambda: {m[-1].state for m in (got, got_2) if m} == {OrbitStatus.READY}, 60, "two ready drones")
        assert operator(graph, "start", "--speed", "15") == (0, "orbiting the subject")
        place = other.copter.body.position.copy()
        begin = time.monotonic()
        both(lambda: time.monotonic() - begin > 4.0, 30, "four seconds")
        # A busy machine may hold it soon.
        assert OrbitStatus.ORBITING in {m.state for m in got}
        assert drone.copter.accepted_setpoints > 0
        assert other.copter.accepted_setpoints == 0
        assert {m.state for m in got_2} <= {OrbitStatus.IDLE, OrbitStatus.READY}
        assert "SET_POSITION_TARGET_LOCAL_NED" not in other.copter.received
        # Wind and the autopilot's own errors.
        assert np.linalg.norm(other.copter.body.position - place) < 1.0
        assert operator(graph, "stop")[0] == 0
        topics = {name for name, _ in graph.node.get_topic_names_and_types()}
        of_all = {"/diagnostics", "/parameter_events", "/rosout"}
        assert {name.split("/")[1] for name in topics - of_all} == {"drone_1", "drone_2"}
        assert {"/drone_1/tf", "/drone_2/tf", "/drone_1/vehicle/state", "/drone_2/vehicle/state"} <= topics
        services = {name.split("/")[1] for name, _ in graph.node.get_service_names_and_types()}
        assert services == {"drone_1", "drone_2"}
        nodes = dict(graph.node.get_node_names_and_namespaces())
        assert set(nodes.values()) <= {"/drone_1", "/drone_2"}


def relabelled(message):
    """The same person by another tracker."""
    message.track_id = 9
    return message


def test_commands_are_a_service_and_no_topic_that_a_replay_could_publish():
    with flying(commands_enabled=True) as (graph, _, got):
        graph.wait_until(lambda: got, 40, "a status")
        names = dict(graph.node.get_topic_names_and_types())
        assert not any("orbit/command" in name for name in names)
        services = dict(graph.node.get_service_names_and_types())
        assert services["/drocap/orbit/command"] == ["drocap_ros/srv/OrbitCommand"]


def test_commands_that_are_not_enabled_move_nothing():
    with flying() as (graph, drone, got):
        graph.wait_until(lambda: got, 40, "a status")
        status, answer = operator(graph, "engage")
        assert status == 1
        assert "commands are disabled" in answer
    assert "SET_POSITION_TARGET_LOCAL_NED" not in drone.copter.received
    assert drone.copter.mode == "GUIDED"


@pytest.mark.parametrize(
    "words",
    [
        ["start", "--radius", "inf"],
        ["start", "--radius", "-3"],
        ["adjust", "--speed", "500"],
        ["start", "--height", "-1"],
        ["stop", "--radius", "5"],
        ["status", "--timeout", "0"],
    ],
)
def test_options_out_of_range_are_refused(words, capsys):
    assert main(["orbit", *words]) == 2
    error = capsys.readouterr().err
    assert "expected" in error or "takes no values" in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("radius_m: -3.0", "radius_m: expected 0 to 100 m, got -3.0"),
        ("radius_m: 2.0", "radius_m: expected at least 3.5 m (min_distance_m and 0.5 m of room), got 2"),
        ("angular_speed_deg_s: 40.0", "expected at most 33.1 deg/s at 6 m (max_acceleration_m_s2 2), got 40"),
        ("angular_speed_deg_s: 50.0", "expected at most 43.0 deg/s at 6 m (max_speed_m_s 4.5), got 50"),
        ("radius_m: six", "radius_m: expected float, got 'six'"),
        ("angular_speed_deg_s: .nan", "angular_speed_deg_s: expected a finite number"),
        ("url: http://localhost:1", "url: expected udpin:HOST:PORT"),
        ("url: udpin:127.0.0.1:99999", "url: expected a port from 1 to 65535"),
        ("system_id: 255", "system_id: expected 1 to 254"),
        ("signing_key_file: /does/not/exist", "signing_key_file: expected a file that can be read"),
        ("orbit_radius: 5.0", "unknown parameter 'orbit_radius'"),
    ],
)
def test_configuration_that_cannot_be_flown_is_refused(line, words, tmp_path, capsys):
    file = tmp_path / "config.yaml"
    file.write_text(f"mavlink_bridge:\n  {line}\n")
    assert main(["live", "--config", str(file), "--nodes", "mavlink_bridge", "--one-process", "--domain-id", "96"]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1


def test_orbit_without_a_running_graph_is_refused(capsys):
    assert main(["orbit", "status", "--timeout", "1", "--domain-id", "97"]) == 2
    assert "drocap live" in capsys.readouterr().err
