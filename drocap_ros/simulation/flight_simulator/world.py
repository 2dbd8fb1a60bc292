"""World of the flight simulator: copter with its pilot, person, camera.  No ROS, no clock of its own."""

from __future__ import annotations

import enum
import math
from typing import NamedTuple

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.flight.mavlink.transport import Transport
from drocap_ros.flight.vehicle import camera_rotation
from drocap_ros.simulation.flight_simulator.simulator_config import FlightSimulatorConfig
from drocap_ros.simulation.flight_simulator.truth import MAX_EXPOSURES, FlightTruth
from drocap_ros.simulation.pinhole import pinhole_matrix
from drocap_ros.simulation.simulated_person import simulate_person
from drocap_ros.simulation.vehicle.copter import SimulatedCopter
from drocap_ros.simulation.vehicle.copter_reports import CopterSetup
from drocap_ros.simulation.vehicle.flight_control import Manner, Target
from drocap_ros.simulation.vehicle.mount import SimulatedMount
from drocap_ros.skeleton import BODY_17

_HOVER_S = 1.5  # before the hand-over; a judgement


class PilotedCopter(SimulatedCopter):
    """A copter that stands on the ground until its pilot takes off.

    ground : (2,) m ENU, initial position
    stick : (3,) m/s ENU, the velocity commanded by the sticks
    The other parameters are those of :class:`SimulatedCopter`.
    """

    def __init__(self, transport: Transport, ground: np.ndarray, yaw: float, setup: CopterSetup) -> None:
        # Height of the body on its skids.
        super().__init__(transport, np.array([*ground, 0.1]), yaw, setup._replace(mode=""))
        self.armed, self.landed_state = False, mavlink.MAV_LANDED_STATE_ON_GROUND
        self.stick: np.ndarray = np.zeros(3)
        self._ground: np.ndarray = self.body.position.copy()

    def fly(self, t_s: float) -> None:
        """Fly up to path time ``t_s``, then send and receive; on the ground the position is fixed."""
        super().fly(t_s)
        if self.landed_state == mavlink.MAV_LANDED_STATE_ON_GROUND:
            self.body.position, self.body.velocity = self._ground.copy(), np.zeros(3)

    def _move(self, dt: float) -> None:
        control = self.control
        if self.mode == self.simulated.stick_mode:
            manner = Manner.STICK if self.stick.any() else Manner.HOLD
            if control.manner != manner:
                control.begin(manner, self.estimate, self.body.velocity, self.body.yaw)
            if manner == Manner.STICK:
                control.target = Target(velocity=self.stick.copy(), yaw=control.target.yaw)
        super()._move(dt)


class PilotPhase(enum.Enum):
    """Phases of the take-off, in their order."""

    CHECKS = "checking the vehicle"
    CLIMB = "climbing"
    HOVER = "hovering"
    HANDED_OVER = "hands off"


class SimulatedPilot:
    """Arms, climbs with the camera on the person, hovers, hands over; then takes the hands off.

    height_m : of the hover
    aim : (3,) m ENU, target of the camera until the hand-over
    """

    def __init__(self, copter: PilotedCopter, height_m: float, aim: np.ndarray) -> None:
        self._copter, self._height_m, self._aim = copter, height_m, aim
        self.phase = PilotPhase.CHECKS
        self._since_s = 0.0

    @property
    def handed_over(self) -> bool:
        """Whether the pilot has taken the hands off."""
        return self.phase == PilotPhase.HANDED_OVER

    def step(self, t_s: float) -> None:
        """Act on the vehicle's state at path time ``t_s``."""
        copter = self._copter
        if not self.handed_over:
            sight = self._aim - copter.body.position
            copter.mount.command(math.degrees(math.atan2(float(sight[2]), float(np.hypot(sight[0], sight[1])))))
        if self.phase == PilotPhase.CHECKS and t_s >= 1.0:  # on the ground
            copter.armed, copter.landed_state = True, mavlink.MAV_LANDED_STATE_TAKEOFF
            # Climb of the take-off.
            copter.stick = np.array([0.0, 0.0, 1.2])
            self._enter(PilotPhase.CLIMB, t_s)
        elif self.phase == PilotPhase.CLIMB:
            climb = float(copter.body.velocity[2])
            # By deceleration and lag of the simulated vehicle the pilot lets go of the stick in time.
            if copter.body.position[2] + climb * (0.35 + climb / (2 * 1.45)) >= self._height_m:
                copter.stick, copter.landed_state = np.zeros(3), mavlink.MAV_LANDED_STATE_IN_AIR
                self._enter(PilotPhase.HOVER, t_s)
        elif self.phase == PilotPhase.HOVER and t_s - self._since_s >= _HOVER_S:
            copter.set_mode(copter.kind.handed_over_mode, "pilot")
            self._enter(PilotPhase.HANDED_OVER, t_s)

    def _enter(self, phase: PilotPhase, t_s: float) -> None:
        self.phase, self._since_s = phase, t_s


#: The person stands until setpoints have steered the vehicle for this long, and pauses whenever they stop: a filmed
#: person sees the drone stop.
BEGINS_AFTER_S = 3.0
#: Setpoints that stop for so long have stopped: several periods of the slowest stream.
_GAP_S = 0.5
#: Rate and length of the pieces in which the person's motion is computed.
_TAKE_HZ = 100.0
_TAKE_CHUNK_S = 20.0  # s: a piece is computed while one is flown; a judgement


class Exposure(NamedTuple):
    """State at the exposure of one image.

    joints3d (17, 3) m ENU; rotation (3, 3) world -> optical; position (3,) m ENU
    """

    stamp_ns: int
    joints3d: np.ndarray
    rotation: np.ndarray
    position: np.ndarray


class FlightWorld:
    """Stepped in time; keeps its exposures as the truth.

    transport : the vehicle's end of the MAVLink link; closed by :meth:`close`
    """

    def __init__(self, config: FlightSimulatorConfig, transport: Transport) -> None:
        self.config = config
        self.camera_matrix = pinhole_matrix(config.image_width, config.image_height, config.horizontal_fov_deg)
        bearing = float(np.random.default_rng([config.seed, 0xF5]).uniform(-math.pi, math.pi))
        ground = config.start_distance_m * np.array([math.cos(bearing), math.sin(bearing)])
        self.copter = PilotedCopter(
            transport,
            ground,
            math.remainder(bearing + math.pi, 2 * math.pi),
            CopterSetup(
                config.autopilot,
                wind=(config.wind_m_s, 0.0, 0.0),
                seed=config.seed,
                mount=SimulatedMount(config.mount, config.camera_pitch_deg),
            ),
        )
        self._take = ActingPerson(config)
        aim = self._take.at(0.0)[0]
        self.pilot = SimulatedPilot(self.copter, config.takeoff_height_m, aim)
        self._t = self._take_s = 0.0
        self._pace = 0.0  # of the person, 0 standing to 1 acting
        self._setpoints = 0
        self._setpoint_s = self._steered_s = -math.inf  # last setpoint; first one after the last gap
        self._rows: list[Exposure] = []

    def step(self, t_s: float) -> None:
        """Advance to world time ``t_s``, which is also the vehicle's path time."""
        passed_s, self._t = t_s - self._t, t_s
        self.copter.fly(t_s)
        self.pilot.step(t_s)
        if self.copter.mode == self.copter.kind.control_mode and self.copter.accepted_setpoints > self._setpoints:
            if t_s - self._setpoint_s > _GAP_S:
                self._steered_s = t_s
            self._setpoint_s = t_s
        self._setpoints = self.copter.accepted_setpoints
        acts = t_s - self._setpoint_s <= _GAP_S and t_s - self._steered_s >= BEGINS_AFTER_S
        # Time constant of the person's start and stop.
        self._pace += (float(acts) - self._pace) * (1 - math.exp(-passed_s / 0.3))
        self._take_s += self._pace * passed_s

    def expose(self, stamp_ns: int) -> Exposure:
        """Expose an image now; ``stamp_ns`` is the present time of the stamps' clock."""
        rotation = camera_rotation(self.copter.camera_orientation())
        exposure = Exposure(stamp_ns, self._take.at(self._take_s), rotation, self.copter.body.position.copy())
        if len(self._rows) < MAX_EXPOSURES:
            self._rows.append(exposure)
        return exposure

    def truth(self) -> FlightTruth:
        """All exposures so far."""
        rows = self._rows
        return FlightTruth(
            np.array([row.stamp_ns for row in rows], np.int64),
            np.array([row.joints3d for row in rows]).reshape(-1, len(BODY_17), 3),
            np.array([row.rotation for row in rows]).reshape(-1, 3, 3),
            np.array([row.position for row in rows]).reshape(-1, 3),
            self.camera_matrix,
            (self.config.image_width, self.config.image_height),
        )

    def close(self) -> None:
        """Close the link."""
        self.copter.close()


class ActingPerson:
    """The person's motion, computed in pieces of 20 s and linear within 10 ms."""

    def __init__(self, config: FlightSimulatorConfig) -> None:
        self._config = config
        self._chunk = -1
        self._joints: np.ndarray = np.empty((0, len(BODY_17), 3))

    def at(self, t_s: float) -> np.ndarray:
        """(17, 3) m ENU."""
        chunk = int(t_s // _TAKE_CHUNK_S)
        if chunk != self._chunk:
            samples = np.arange(round(_TAKE_CHUNK_S * _TAKE_HZ) + 2) / _TAKE_HZ + chunk * _TAKE_CHUNK_S
            config = self._config
            self._joints = simulate_person(samples, config.action, config.seed, config.stature_m, BODY_17)
            self._chunk = chunk
        place = (t_s - chunk * _TAKE_CHUNK_S) * _TAKE_HZ
        i = int(place)
        joints: np.ndarray = (1 - (place - i)) * self._joints[i] + (place - i) * self._joints[i + 1]
        return joints
