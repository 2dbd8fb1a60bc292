"""The real `mavlink_bridge` process flies the simulated copter over UDP, in real time, and is killed, stopped and
restarted, and so is its perception: `python benchmarks/flight_faults.py processes`.

Three processes: the bridge (`bringup`, processes=True), the stand-in of the pose estimator (this file with
`--perceive`), which publishes `pose2d` for what the camera sends it, and this one with the copter and its camera.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from figures import ROOT, table, write_figures

from drocap_ros.config import DrocapConfig
from drocap_ros.errors import NodeError
from drocap_ros.flight.autopilot import autopilot_of
from drocap_ros.flight.conditions import PICTURE_CODES, ConditionCode
from drocap_ros.flight.mavlink.guardian import PACKETS, PERIOD_S
from drocap_ros.flight.mavlink.transport import open_transport
from drocap_ros.flight.orbit.states import Command, State
from drocap_ros.flight.vehicle import camera_rotation
from drocap_ros.keypoints import PoseObservation
from drocap_ros.simulation.pinhole import pinhole_matrix, project
from drocap_ros.simulation.simulated_person import simulate_person
from drocap_ros.simulation.vehicle.copter import SimulatedCopter
from drocap_ros.simulation.vehicle.copter_reports import CopterSetup
from drocap_ros.simulation.vehicle.loopback import free_udp_port
from lab.flights.fault_causes import TIMEOUT
from lab.flights.fault_flight import EXCURSION_M, MOTION_S, Bounds
from lab.flights.orbit_loop import LoopSettings
from lab.simulation.keypoint_errors import noisy_keypoints

RATE_HZ, WIDTH, HEIGHT, FIELD_DEG = 15.0, 1280, 720, 60.0
CONTROL = {"ardupilot": "GUIDED", "px4": "OFFBOARD"}
MATRIX = pinhole_matrix(WIDTH, HEIGHT, FIELD_DEG)
ORBIT_S, WATCH_S = 8.0, 6.0
FRAME_S, LINK_S = 0.1, 0.05
TRIES = 4
SCHEDULING_S = 0.05  # a signal, a packet and a step of the vehicle each wait for their turn on a busy machine


def perceive(port: int) -> None:
    """Publish keypoints for each pose of the camera that comes, until killed."""
    import rclpy
    from rclpy.executors import ExternalShutdownException
    from sensor_msgs.msg import CameraInfo

    from drocap_ros.ros.conversions import pose2d_to_ros
    from drocap_ros.ros.topics import TOPICS

    rclpy.init(args=[])
    node = rclpy.create_node("perception_stand_in", namespace="/drocap")
    poses = node.create_publisher(TOPICS["pose2d"].message, "pose2d", TOPICS["pose2d"].qos)
    infos = node.create_publisher(CameraInfo, "camera_info", TOPICS["camera_info"].qos)
    joints = simulate_person(np.zeros(1), "stand", 1)
    camera = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    camera.bind(("127.0.0.1", port))
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        for frame in range(10**9):
            pose = json.loads(camera.recv(4096))
            rotation = camera_rotation(np.array(pose["orientation"]))[None]
            seen = noisy_keypoints(project(joints, rotation, np.array([pose["position"]]), MATRIX), None, frame)
            observation = PoseObservation(
                pose["stamp_ns"], 1, (WIDTH, HEIGHT), keypoints=seen.keypoints[0].astype(np.float32),
                covariance=seen.covariance[0].astype(np.float32), confidence=seen.confidence[0].astype(np.float32),
            )  # fmt: skip
            poses.publish(pose2d_to_ros(observation, "camera_optical"))
            infos.publish(CameraInfo(width=WIDTH, height=HEIGHT, k=MATRIX.ravel()))


class Drone:
    """Copter on its UDP link and the camera, in real time.

    seeing : whether the camera sends its poses
    rows : (s of the flight, position (3,), setpoints accepted, mode)
    """

    def __init__(self, autopilot: str, port: int, camera_port: int, seed: int = 1) -> None:
        setup = CopterSetup(autopilot, mode=autopilot_of(autopilot).handed_over_mode, seed=seed)
        self.copter = SimulatedCopter(open_transport(f"udpout:127.0.0.1:{port}"), np.array([7.0, 0, 2.8]), np.pi, setup)
        self.autopilot, self.seeing, self.t = autopilot, True, 0.0
        self.rows: list[tuple[float, np.ndarray, int, str]] = []
        self._camera = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._camera_port = camera_port
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def _run(self) -> None:
        begin, frame = time.monotonic(), 0
        while not self._stop.wait(0.005):
            self.t = time.monotonic() - begin
            self.copter.fly(self.t)
            self.rows.append(
                (self.t, self.copter.body.position.copy(), self.copter.accepted_setpoints, self.copter.mode)
            )
            if self.t * RATE_HZ >= frame:
                frame = int(self.t * RATE_HZ) + 1
                if self.seeing:
                    pose = {
                        "stamp_ns": time.time_ns(), "position": self.copter.body.position.tolist(),
                        "orientation": self.copter.camera_orientation().tolist(),
                    }  # fmt: skip
                    self._camera.sendto(json.dumps(pose).encode(), ("127.0.0.1", self._camera_port))

    def __enter__(self) -> Drone:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(5.0)
        self.copter.close()
        self._camera.close()


class Scene:
    """The flight under test: processes by their ids, statuses of the bridge, commands of the operator."""

    def __init__(self, graph: Any, drone: Drone, perception: subprocess.Popen[bytes], config: DrocapConfig) -> None:
        from drocap_ros.msg import OrbitStatus
        from drocap_ros.ros.topics import TOPICS
        from drocap_ros.srv import OrbitCommand

        self.graph, self.drone, self.perception, self.config = graph, drone, perception, config
        self.bridge = graph.pid("mavlink_bridge")
        self.statuses: list[Any] = []
        self.mark = 0  # number of statuses before the fault
        node = graph.node
        node.create_subscription(OrbitStatus, "orbit/status", self.statuses.append, TOPICS["orbit/status"].qos)
        self._commands = node.create_client(OrbitCommand, "orbit/command")

    def listen(self, seconds: float) -> None:
        """Let time pass, also after the end of nodes."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.graph._executor.spin_once(timeout_sec=0.02)

    def wait(self, state: State, timeout_s: float = 40.0) -> None:
        """Wait for this state of the bridge."""
        end = time.monotonic() + timeout_s
        while not (self.statuses and self.statuses[-1].state == int(state)):
            if time.monotonic() > end:
                raise AssertionError(f"no {state.name} in {timeout_s:g} s: {[m.reason for m in self.statuses[-9:]]}")
            self.listen(0.05)

    def command(self, kind: Command) -> None:
        """The operator's command."""
        from drocap_ros.srv import OrbitCommand

        nan = float("nan")
        request = OrbitCommand.Request(command=int(kind), radius_m=nan, height_m=nan, angular_speed_deg_s=nan)
        self._commands.call_async(request)

    def orbit(self, seconds: float) -> None:
        """Start the orbit and fly it for a while."""
        self.wait(State.READY)
        while not self._commands.service_is_ready():  # discovery: an earlier request is lost
            self.listen(0.05)
        control = self.drone.copter.mode == CONTROL[self.drone.autopilot]
        for _ in range(5):  # a refused command is repeated
            self.command(Command.START if control else Command.ENGAGE)
            with contextlib.suppress(AssertionError):
                self.wait(State.ORBITING, 4.0)
                break
        self.wait(State.ORBITING, 1.0)
        self.listen(seconds)
        if self.statuses[-1].state != int(State.ORBITING):
            raise AssertionError(f"not orbiting before the fault: {self.statuses[-1].reason}")

    @contextlib.contextmanager
    def new_bridge(self) -> Iterator[None]:
        """Another bridge process in the place of the dead one."""
        from drocap_ros.bringup import bringup

        self.statuses.clear()
        self.mark = 0
        with bringup(self.config, ["mavlink_bridge"], processes=True, domain_id=self.graph.domain_id):
            yield


@contextlib.contextmanager
def scene(autopilot: str, seed: int = 1, **values: Any) -> Iterator[Scene]:
    """Bridge, perception and drone, each in its process.  A bridge that was killed is no error at the end."""
    from drocap_ros.bringup import bringup

    port, camera_port = free_udp_port(), free_udp_port()
    settings = {"commands_enabled": True, "mode_change_allowed": True, **values}
    config = DrocapConfig().replace("mavlink_bridge", url=f"udpin:127.0.0.1:{port}", **settings)
    with contextlib.ExitStack() as stack:
        stack.enter_context(_ended_by_us())
        graph = stack.enter_context(bringup(config, ["mavlink_bridge"], processes=True))
        environment = {
            **os.environ, "ROS_DOMAIN_ID": str(graph.domain_id), "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT),
        }  # fmt: skip
        command = [sys.executable, str(Path(__file__).resolve()), "--perceive", str(camera_port)]
        perception = subprocess.Popen(command, env=environment, start_new_session=True)
        stack.callback(perception.wait)
        stack.callback(perception.kill)
        drone = stack.enter_context(Drone(autopilot, port, camera_port, seed))
        yield Scene(graph, drone, perception, config)


@contextlib.contextmanager
def _ended_by_us() -> Iterator[None]:
    try:
        yield
    except NodeError as error:
        if not any(f"mavlink_bridge ended with status {status}" in str(error) for status in (-9, -2, 0)):
            raise


class Outcome(NamedTuple):
    """Effect of a fault of a process; see ``simulation.closed_loop.fault_flight.FaultResult``.

    ended : state and condition of the last status; None = no status after the fault
    """

    motion_s: float
    excursion_m: float
    speed_m_s: float
    accepted_later: int  # setpoints taken from `quiet_s` after the fault on
    mode: str
    ended: tuple[State, ConditionCode] | None
    reason: str


def watch(flying: Scene, observable_s: float, quiet_s: float, begin_s: float) -> Outcome:
    """Measure from the instant of the fault to now."""
    drone = flying.drone
    rows = [row for row in list(drone.rows) if row[0] >= begin_s + observable_s]
    place = rows[0][1]
    ahead = next(row for row in rows if row[0] >= rows[0][0] + 0.05)
    late = [row[2] for row in rows if row[0] >= begin_s + quiet_s]
    new = flying.statuses[flying.mark :]
    ended = (State(new[-1].state), ConditionCode(new[-1].condition)) if new else None
    return Outcome(
        drone.copter.motion_until_s - rows[0][0], max(float(np.linalg.norm((r[1] - place)[:2])) for r in rows),
        float(np.linalg.norm((ahead[1] - place)[:2])) / (ahead[0] - rows[0][0]), late[-1] - late[0] if late else 0,
        drone.copter.mode, ended, f"{ended[0].name}: {new[-1].reason}" if ended else "no status",
    )  # fmt: skip


def _kill_bridge(flying: Scene) -> None:
    os.kill(flying.bridge, signal.SIGKILL)
    flying.listen(WATCH_S)


def _kill_computer(flying: Scene) -> None:
    """The guardian first: it would hold."""
    for children in Path(f"/proc/{flying.bridge}/task").glob("*/children"):
        for guardian in children.read_text().split():
            os.kill(int(guardian), signal.SIGKILL)
    _kill_bridge(flying)


def _stop_bridge(flying: Scene) -> None:
    os.kill(flying.bridge, signal.SIGSTOP)
    flying.listen(3.0)
    os.kill(flying.bridge, signal.SIGCONT)
    flying.listen(WATCH_S)


def _end_bridge(flying: Scene) -> None:
    os.kill(flying.bridge, signal.SIGINT)
    flying.listen(WATCH_S)


def _restart_bridge(flying: Scene) -> None:
    os.kill(flying.bridge, signal.SIGKILL)
    with flying.new_bridge():
        flying.listen(WATCH_S)


def _kill_perception(flying: Scene) -> None:
    flying.perception.kill()
    flying.listen(WATCH_S)


def _stop_perception(flying: Scene) -> None:
    """It resumes with three seconds of old images in its queue."""
    flying.perception.send_signal(signal.SIGSTOP)
    flying.listen(3.0)
    flying.perception.send_signal(signal.SIGCONT)
    flying.listen(WATCH_S)


def _stop_camera(flying: Scene) -> None:
    flying.drone.seeing = False
    flying.listen(WATCH_S)


class Case(NamedTuple):
    """A fault of a process.

    ends : the last status must show one of these states or conditions; empty = any
    quiet_s : time after which no setpoint may be accepted at all; infinite = the hold streams
    """

    name: str
    make: Callable[[Scene], None]
    observable_s: float
    timeout: bool
    ends: frozenset[State | ConditionCode]
    quiet_s: float = float("inf")


_HELD_S = PACKETS * PERIOD_S + 0.2  # for which a guardian sends, and a transmission
_ANY: frozenset[State | ConditionCode] = frozenset()
_BEFORE = frozenset({State.READY, State.IDLE})
_STOOD = frozenset({ConditionCode.CONTROL_LOOP_STALLED, ConditionCode.PILOT_TOOK_OVER})
_LOST = PICTURE_CODES | {ConditionCode.NO_SUBJECT}
CASES = (
    Case("bridge killed (SIGKILL)", _kill_bridge, LINK_S, False, _ANY, _HELD_S),
    Case("bridge and guardian killed (SIGKILL)", _kill_computer, LINK_S, True, _ANY, 0.2),
    Case("bridge stopped for 3 s (SIGSTOP)", _stop_bridge, LINK_S, False, _STOOD),
    Case("bridge ended (SIGINT)", _end_bridge, LINK_S, False, _ANY),
    Case("bridge killed and started again", _restart_bridge, LINK_S, False, _BEFORE, _HELD_S),
    Case("perception killed (SIGKILL)", _kill_perception, FRAME_S, False, _LOST),
    Case("perception stopped for 3 s (SIGSTOP)", _stop_perception, FRAME_S, False, _LOST),
    Case("camera sends nothing", _stop_camera, FRAME_S, False, _LOST),
)


def fly(case: Case, autopilot: str, seed: int = 1) -> Outcome:
    """Orbit, make the fault, measure; again where a busy machine ends the orbit before."""
    for _ in range(TRIES):
        with contextlib.suppress(AssertionError), scene(autopilot, seed) as flying:
            flying.orbit(ORBIT_S)
            begin_s, flying.mark = flying.drone.t, len(flying.statuses)
            case.make(flying)
            return watch(flying, case.observable_s, case.quiet_s, begin_s)
    raise AssertionError(f"{case.name}: no orbit before it in {TRIES} flights")


def bounds(case: Case, autopilot: str, speed_m_s: float) -> Bounds:
    """Bounds of the case, stated before the flight."""
    if not case.timeout:
        return Bounds()
    motion_s, excursion_m = TIMEOUT.bounds(LoopSettings(autopilot=autopilot), speed_m_s)
    return Bounds(motion_s + SCHEDULING_S, excursion_m + SCHEDULING_S * speed_m_s)


def failures(case: Case, autopilot: str, outcome: Outcome) -> list[str]:
    """Violated bounds, as sentences."""
    limits, found = bounds(case, autopilot, outcome.speed_m_s), []
    if outcome.motion_s > limits.motion_s:
        found.append(f"motion for {outcome.motion_s:.2f} s, bound {limits.motion_s:.2f} s")
    if outcome.excursion_m >= limits.excursion_m:
        found.append(f"excursion of {outcome.excursion_m:.2f} m, bound {limits.excursion_m:.2f} m")
    if outcome.accepted_later:
        found.append(f"{outcome.accepted_later} setpoints after the end")
    # By type too: states and conditions are both numbers.
    if case.ends and not any(type(a) is type(b) and a == b for a in case.ends for b in outcome.ended or ()):
        found.append(f"ended with {outcome.reason}")
    return found


def main() -> int:
    """Fly every case and write the table."""
    rows, bad = [], 0
    for autopilot in ("ardupilot", "px4"):
        for case in CASES:
            outcome = fly(case, autopilot)
            found = failures(case, autopilot, outcome)
            bad += bool(found)
            limits = bounds(case, autopilot, outcome.speed_m_s)
            kept = outcome.motion_s <= MOTION_S and outcome.excursion_m < EXCURSION_M
            note = f"NOT KEPT: {'; '.join(found)}. " if found else "" if kept else f"[{TIMEOUT.description}] "
            rows.append([
                "-" if found else "+" if kept else "c", autopilot, case.name, f"{outcome.motion_s:.2f}",
                f"{limits.motion_s:.2f}", f"{outcome.excursion_m:.2f}", f"{limits.excursion_m:.2f}",
                f"{outcome.speed_m_s:.2f}", outcome.mode, f"{note}{outcome.reason}",
            ])  # fmt: skip
            print("  ".join(rows[-1]), flush=True)
    summary = f"{len(rows)} cases with real processes, in real time, one flight each: {bad} not kept."
    print(summary)
    head = [
        "", "dialect", "fault", "motion, s", "bound, s", "away, m", "bound, m", "speed, m/s", "mode", "cause or reason",
    ]  # fmt: skip
    write_figures("flight_processes", "Faults of real processes", f"{summary}\n\n{table(head, rows)}")
    return 1 if bad else 0


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--perceive", type=int, metavar="PORT")
    chosen = parser.parse_args()
    if chosen.perceive:
        perceive(chosen.perceive)
    else:
        raise SystemExit(main())
