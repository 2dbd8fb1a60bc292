"""The closed loop in simulated time: vehicle, person, keypoints from the vehicle's true pose, the real controller.

Link, parser, estimator, planner and safety are the flown ones; clocks, transport and vehicle are simulated.
Deterministic and much faster than real time.
"""

from __future__ import annotations

import dataclasses
import math
import random
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from drocap_ros.flight.autopilot import autopilot_of
from drocap_ros.flight.bridge_config import MavlinkBridgeConfig
from drocap_ros.flight.conditions import Condition
from drocap_ros.flight.mavlink.guardian import Guardian
from drocap_ros.flight.mavlink.link import MavlinkLink
from drocap_ros.flight.orbit.controller import ControlStatus, OrbitController
from drocap_ros.flight.orbit.states import Action, Command, CommandAnswer, OperatorCommand, State
from drocap_ros.flight.orbit.watchdog import Watchdog
from drocap_ros.flight.vehicle import camera_rotation
from drocap_ros.keypoints import PoseObservation
from drocap_ros.simulation.pinhole import pinhole_matrix, project
from drocap_ros.simulation.simulated_person import simulate_person
from drocap_ros.simulation.vehicle.copter import SimulatedCopter
from drocap_ros.simulation.vehicle.copter_reports import CopterSetup
from drocap_ros.simulation.vehicle.loopback import Channel, LoopbackTransport
from drocap_ros.simulation.vehicle.mount import SimulatedMount
from lab.simulation.keypoint_errors import detect_person

EPOCH_NS = 1_700_000_000_000_000_000
_STEP_S = 0.01
_LINK_S = 0.02
_SIZE = (1280, 720)
#: Stands of a loop of 20 Hz by more than 0.05 s, per second and process that wants to run, and mean length beyond that,
#: s: measured on two cores at loads of 6 to 8, which have 500 an hour, 50 of them longer than 0.2 s.
_STANDS_HZ, _STANDS_S = 0.01, 0.08


@dataclass(frozen=True)
class LoopSettings:
    """One flight.

    action : of the person, one of ``ACTIONS``
    walking_m_s : mean speed of a walking person
    moves_from_s : the person stands until then
    bearing_deg, distance_m, height_m : initial position of the vehicle, from the person
    wind_m_s : (3,) mean
    latency_s : from exposure to keypoints
    late_share, late_s : share of the images whose keypoints are late, by up to this time more (a busy machine); images
        that come meanwhile are dropped
    stamp_late_s : of the pictures' stamps after the exposure, as a USB camera's
    gaps_hz : pauses of the telemetry, as on a busy machine; see :class:`Channel`
    load : processes that want to run beside the bridge: its process and its control loop stand still now and then
    ready_s : of the vehicle, as of ``CopterSetup``; the default is ready
    seconds : longest flight
    start_mode : "" = the mode in which the pilot hands over: GUIDED, or LOITER for PX4
    mount : of the camera: "gimbal", "servo" or "fixed"; the bridge is configured for it where the autopilot cannot
        describe it
    camera_pitch_deg : of the camera, negative = down; NaN = aimed at the middle of the person
    field_deg : width of the camera's field of view
    timeout_s, estimate_error, attitude_error_deg, yaw_error_deg, gyro_error : as :class:`CopterSetup`
    """

    autopilot: str = "ardupilot"
    seed: int = 0
    action: str = "stand"
    walking_m_s: float = 1.4
    moves_from_s: float = 6.0
    stature_m: float = 1.75
    bearing_deg: float = 0.0
    distance_m: float = 7.0
    height_m: float = 3.0
    wind_m_s: tuple[float, float, float] = (0.0, 0.0, 0.0)
    perception_hz: float = 15.0
    latency_s: float = 0.1
    late_share: float = 0.0
    late_s: float = 0.3
    stamp_late_s: float = 0.0
    gaps_hz: float = 0.0
    load: float = 0.0
    ready_s: tuple[float, float, float] = (-1.0, -1.0, -1.0)
    seconds: float = 40.0
    start_mode: str = ""
    mount: str = "gimbal"
    camera_pitch_deg: float = math.nan
    field_deg: float = 60.0
    timeout_s: float = 0.5
    estimate_error: float = 1.0
    attitude_error_deg: float = 0.4
    yaw_error_deg: float = 0.0
    gyro_error: float = 1.0
    config: MavlinkBridgeConfig = field(
        default_factory=lambda: MavlinkBridgeConfig(
            commands_enabled=True, mode_change_allowed=True, attitude_hz=25.0, position_hz=20.0
        )
    )


def configured_mount(settings: LoopSettings) -> LoopSettings:
    """Settings with the camera's pitch, and with the bridge configured for a mount that the autopilot cannot describe.

    A mount that follows the person already points at them; another camera is tilted for the orbit, a fixed one also
    for the lean that the orbit needs.
    """
    config, pitch = settings.config, settings.camera_pitch_deg
    if math.isnan(pitch):
        aim = 0.53 * settings.stature_m
        drop, away = config.height_m - aim, config.radius_m
        if config.gimbal_control:
            drop, away = settings.height_m - aim, settings.distance_m
        pitch = -math.degrees(math.atan2(drop, away))
        if settings.mount == "fixed":
            centripetal = math.radians(config.angular_speed_deg_s) ** 2 * config.radius_m
            pitch += math.degrees(math.atan2(centripetal, 9.81))
    if config.mount == "auto" and (settings.mount == "fixed" or settings.autopilot == "px4"):
        fixed_pitch = pitch if settings.mount == "fixed" else config.camera_pitch_deg
        config = dataclasses.replace(config, mount=settings.mount, camera_pitch_deg=fixed_pitch)
    return dataclasses.replace(settings, camera_pitch_deg=pitch, config=config)


class Row(NamedTuple):
    """Truth at one step of the control loop: m, m/s, deg; ``distance_m`` horizontal from the pelvis."""

    t_s: float
    position: np.ndarray
    velocity: np.ndarray
    distance_m: float
    yaw_error_deg: float
    state: State
    action: Action
    mode: str


class OrbitLoop:
    """A stepped flight.  Faults are injected by setting its attributes during the flight.

    perceive : changes each observation before its delivery; None = lost
    hung : the control loop does not run;  stopped : link and watchdog do not run either (SIGSTOP, SIGKILL)
    dead : the computer; with ``stopped``, nobody holds the vehicle
    clock_jump_s : added to the bridge's clock of the stamps
    status : of the last step of the controller
    """

    def __init__(self, settings: LoopSettings) -> None:
        settings = configured_mount(settings)
        self.settings, self.t = settings, 0.0
        self.hung = self.stopped = self.dead = False
        self._guardians: list[Guardian] = []  # of each of the bridge's processes
        self.clock_jump_s = 0.0
        self.perceive: Callable[[PoseObservation], PoseObservation | None] = lambda seen: seen
        self.down, self.up = (Channel(lambda: self.t, settings.seed + i) for i in (1, 2))
        self.down.gaps_hz = settings.gaps_hz
        joints = self._person()
        bearing = math.radians(settings.bearing_deg)
        start = np.array([math.cos(bearing), math.sin(bearing), 0.0]) * settings.distance_m
        start += np.array([*joints[0, 0, :2], settings.height_m])
        self.copter = SimulatedCopter(
            LoopbackTransport(self.up, self.down),
            start,
            bearing + math.pi,
            CopterSetup(
                settings.autopilot,
                wind=settings.wind_m_s,
                seed=settings.seed,
                estimate_error=settings.estimate_error,
                attitude_error_deg=settings.attitude_error_deg,
                yaw_error_deg=settings.yaw_error_deg,
                gyro_error=settings.gyro_error,
                timeout_s=settings.timeout_s,
                mode=settings.start_mode or autopilot_of(settings.autopilot).handed_over_mode,
                mount=SimulatedMount(settings.mount, settings.camera_pitch_deg),
                ready_s=settings.ready_s,
            ),
        )
        self.rows: list[Row] = []
        self.answers: list[tuple[float, CommandAnswer]] = []
        self.reasons: list[tuple[float, str, Condition]] = []
        self.framing: list[tuple[float, bool]] = []
        self.status: ControlStatus | None = None
        self.matrix = pinhole_matrix(*_SIZE, settings.field_deg)
        self._joints = joints
        self._frame = 0
        self._waiting: list[tuple[float, PoseObservation]] = []
        self._chance = random.Random(settings.seed)
        self._next_link = self._next_control = 0.0
        self._standing = random.Random(f"{settings.seed} stands")
        self._stands = dict.fromkeys(("stopped", "hung") if settings.load else (), (math.inf, 0.0))
        self.restart()

    def restart(self) -> None:
        """Replace the bridge's process by a new one."""
        config = self.settings.config
        transport = LoopbackTransport(self.down, self.up)
        self.link = MavlinkLink(config, self.clock_ns, monotonic_s=lambda: self.t, transport=transport)
        for guardian in self._guardians:
            guardian.ended = True
        self._guardians.append(guardian := Guardian(config.watchdog_s))
        self.link.guardian = lambda packets, *_: guardian.take(self.t, packets)
        self.watchdog = Watchdog(self.link.send_unlocked, config.watchdog_s, self.link.hand_over)
        self.controller = OrbitController(self.link, config, self.watchdog)
        self.controller.on_camera(self.matrix)

    def clock_ns(self) -> int:
        """The bridge's clock of the stamps."""
        return EPOCH_NS + round((self.t + self.clock_jump_s) * 1e9)

    def stamp_ns(self) -> int:
        """Stamp of a picture that is exposed now."""
        return self.clock_ns() + round(self.settings.stamp_late_s * 1e9)

    def command(self, kind: Command, **values: float) -> None:
        """Send a command of the operator now."""
        self.controller.command(OperatorCommand(int(kind), stamp_ns=self.clock_ns(), **values))

    def pelvis(self, t_s: float | None = None) -> np.ndarray:
        """(3,) m, truth; now, or at a time."""
        frame = (self.t if t_s is None else t_s) * self.settings.perception_hz
        i = min(int(frame), len(self._joints) - 2)
        part = min(frame - i, 1.0)
        pelvis: np.ndarray = (1 - part) * self._joints[i, 0] + part * self._joints[i + 1, 0]
        return pelvis

    def future_joints(self) -> np.ndarray:
        """(F, 15, 3) m, the person at the present and every later frame; changes of it take effect."""
        return self._joints[int(self.t * self.settings.perception_hz) :]

    def run(self, until_s: float, each: Callable[[OrbitLoop], None] | None = None) -> None:
        """Fly until a time; ``each`` is called before every step of the control loop."""
        while self.t < until_s - 1e-9 and not self.copter.crashed:
            self._step(each)

    def start(self, settle_s: float = 4.0, **values: float) -> None:
        """Let link and filter settle, then start the orbit; request control where the pilot has not given it."""
        self.run(self.t + settle_s)
        in_control = self.copter.mode == self.copter.kind.control_mode
        self.command(Command.START if in_control else Command.ENGAGE, **values)

    def observe(self, joints: np.ndarray, rotation: np.ndarray, position: np.ndarray) -> PoseObservation:
        """Observation of the person now; here from the projections of the joints.

        Parameters
        ----------
        joints : (15, 3) m, truth
        rotation, position : (3, 3) world -> optical, (3,) m, of the camera, truth
        """
        seed = self.settings.seed * 1_000_003 + self._frame
        found = detect_person(joints[None], rotation[None], position[None], self.matrix, _SIZE, seed)
        return PoseObservation(
            self.stamp_ns(), 1 if found.visible.any() else 0, _SIZE, keypoints=found.keypoints[0].astype(np.float32),
            covariance=found.covariance[0].astype(np.float32), confidence=found.confidence[0].astype(np.float32),
        )  # fmt: skip

    def _stand(self) -> None:
        """The process, and its control loop alone, stand still now and then."""
        for name, (begins_s, ends_s) in self._stands.items():
            if self.t >= ends_s:
                begins_s = self.t + self._standing.expovariate(_STANDS_HZ * self.settings.load)
                self._stands[name] = begins_s, begins_s + 0.05 + self._standing.expovariate(1.0 / _STANDS_S)
                setattr(self, name, False)
            elif self.t >= begins_s:
                setattr(self, name, True)

    def _step(self, each: Callable[[OrbitLoop], None] | None) -> None:
        self.t = round(self.t + _STEP_S, 6)
        self._stand()
        self.copter.fly(self.t)
        self._expose()
        self._deliver()
        if self.t >= self._next_link - 1e-9:
            self._next_link += _LINK_S
            if not self.stopped:
                for state in self.link.spin_once(0.0):
                    self.controller.on_state(state)
                self.watchdog.step(self.t)
            for guardian in [] if self.dead else self._guardians:
                if (packet := guardian.due(self.t)) is not None:
                    self.up.write(packet)
        if self.t < self._next_control - 1e-9:
            return
        self._next_control += 1.0 / self.settings.config.control_hz
        if each is not None:
            each(self)
        self._control()

    def _control(self) -> None:
        runs = not (self.hung or self.stopped)
        if runs:
            self.status = status = self.controller.step(self.clock_ns(), self.t)
            self.answers += [(self.t, answer) for _, answer in status.answers]
            _, state, before = self.reasons[-1] if self.reasons else (0.0, "", None)
            if before is None or (state, before.code) != (status.state.name, status.condition.code):
                self.reasons.append((self.t, status.state.name, status.condition))
        body, pelvis = self.copter.body, self.pelvis()
        sight = pelvis[:2] - body.position[:2]
        error = math.remainder(body.yaw - math.atan2(sight[1], sight[0]), 2 * math.pi)
        self.rows.append(
            Row(
                self.t, body.position.copy(), body.velocity.copy(), float(np.hypot(*sight)), math.degrees(error),
                self.controller.safety.state, self.status.action if runs and self.status else Action.NOTHING,
                self.copter.mode,
            )
        )  # fmt: skip

    def _person(self) -> np.ndarray:
        """(F, 15, 3) m: the person at every frame, at the wanted walking speed."""
        s = self.settings
        t = np.arange(int((s.seconds + 1.0) * s.perception_hz) + 2) / s.perception_hz
        t = np.maximum(t - s.moves_from_s, 0.0)
        joints = simulate_person(t, s.action, s.seed, s.stature_m)
        if s.action == "walk":
            # The path is stretched to the wanted speed and keeps its turns, so the feet slide a little.
            trial = simulate_person(np.arange(2.0, 12.0, 0.1), s.action, s.seed, s.stature_m)[:, 0, :2]
            speed = float(np.linalg.norm(np.diff(trial, axis=0), axis=1).mean() / 0.1)
            joints[..., :2] += (s.walking_m_s / speed - 1.0) * joints[:, :1, :2]
        return joints

    def _expose(self) -> None:
        if self.t < self._frame / self.settings.perception_hz - 1e-9 or self._frame >= len(self._joints):
            return
        joints = self._joints[self._frame]
        rotation, position = camera_rotation(self.copter.camera_orientation()), self.copter.body.position
        exact = project(joints[None], rotation[None], position[None], self.matrix)[0]
        middle = 0.5 * (exact.min(axis=0) + exact.max(axis=0)) - np.array(_SIZE) / 2  # NaN behind the camera
        self.framing.append((self.t, bool(np.all(np.abs(middle) < np.array(_SIZE) / 6))))
        observation = self.observe(joints, rotation, position)
        self._frame += 1
        arrival_s = self.t + self.settings.latency_s
        if self._waiting and self._waiting[-1][0] > arrival_s:
            return  # perception is busy with a late one
        if self._chance.random() < self.settings.late_share:
            arrival_s += self._chance.uniform(0.0, self.settings.late_s)
        self._waiting.append((arrival_s, observation))

    def _deliver(self) -> None:
        while self._waiting and self._waiting[0][0] <= self.t + 1e-9:
            observation = self.perceive(self._waiting.pop(0)[1])
            if observation is not None and not self.stopped:
                self.controller.on_pose2d(observation)


class OrbitQuality(NamedTuple):
    """Quality of an orbit after its ramp: mean absolute errors, shares of the time, extremes."""

    radius_error_m: float
    yaw_error_deg: float
    in_middle_third: float
    least_distance_m: float
    top_speed_m_s: float
    orbiting: float


def orbit_quality(loop: OrbitLoop, radius_m: float, after_s: float) -> OrbitQuality:
    """Quality over the steps after a time, against the truth."""
    rows = [row for row in loop.rows if row.t_s >= after_s]
    framing = [inside for t, inside in loop.framing if t >= after_s]
    return OrbitQuality(
        float(np.mean([abs(row.distance_m - radius_m) for row in rows])),
        float(np.mean([abs(row.yaw_error_deg) for row in rows])),
        float(np.mean(framing)),
        min(row.distance_m for row in rows),
        max(float(np.linalg.norm(row.velocity)) for row in rows),
        float(np.mean([row.state == State.ORBITING for row in rows])),
    )


def with_config(settings: LoopSettings, **values: object) -> LoopSettings:
    """Settings with some parameters of the bridge changed."""
    return dataclasses.replace(settings, config=dataclasses.replace(settings.config, **values))  # type: ignore[arg-type]
