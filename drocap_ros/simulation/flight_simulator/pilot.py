"""A simulated pilot with sticks: takes off, hovers, and hands over control in the way of the autopilot."""

from __future__ import annotations

import enum
import math

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.flight.mavlink.transport import Transport
from drocap_ros.simulation.vehicle.copter import SimulatedCopter
from drocap_ros.simulation.vehicle.copter_reports import CopterSetup
from drocap_ros.simulation.vehicle.flight_control import Manner, Target

#: Climb of the take-off.
_CLIMB_M_S = 1.2
#: Deceleration and lag of the simulated vehicle, by which the pilot lets go of the stick in time.
_BRAKING_M_S2 = 1.45
_LAG_S = 0.35  # s, of the simulated vehicle as well
#: Height of the body on its skids.
_SKIDS_M = 0.1
#: Time on the ground, and of the hover before the hand-over.
_READY_S = 1.0
_HOVER_S = 1.5  # s; a judgement


class PilotedCopter(SimulatedCopter):
    """A copter that stands on the ground until its pilot takes off.

    ground : (2,) m ENU, initial position
    stick : (3,) m/s ENU, the velocity commanded by the sticks
    The other parameters are those of :class:`SimulatedCopter`.
    """

    def __init__(self, transport: Transport, ground: np.ndarray, yaw: float, setup: CopterSetup) -> None:
        super().__init__(transport, np.array([*ground, _SKIDS_M]), yaw, setup._replace(mode=""))
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
        if self.phase == PilotPhase.CHECKS and t_s >= _READY_S:
            copter.armed, copter.landed_state = True, mavlink.MAV_LANDED_STATE_TAKEOFF
            copter.stick = np.array([0.0, 0.0, _CLIMB_M_S])
            self._enter(PilotPhase.CLIMB, t_s)
        elif self.phase == PilotPhase.CLIMB:
            climb = float(copter.body.velocity[2])
            if copter.body.position[2] + climb * (_LAG_S + climb / (2 * _BRAKING_M_S2)) >= self._height_m:
                copter.stick, copter.landed_state = np.zeros(3), mavlink.MAV_LANDED_STATE_IN_AIR
                self._enter(PilotPhase.HOVER, t_s)
        elif self.phase == PilotPhase.HOVER and t_s - self._since_s >= _HOVER_S:
            copter.set_mode(copter.kind.handed_over_mode, "pilot")
            self._enter(PilotPhase.HANDED_OVER, t_s)

    def _enter(self, phase: PilotPhase, t_s: float) -> None:
        self.phase, self._since_s = phase, t_s
