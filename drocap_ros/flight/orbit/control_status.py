"""Outcome of one step of the control loop."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from drocap_ros.flight.conditions import Condition
from drocap_ros.flight.orbit.states import Action, CommandAnswer, OperatorCommand, State


class ControlStatus(NamedTuple):
    """Outcome of one step: the fields of ``msg/OrbitStatus.msg``, the commands it answered, and what was sent.

    mode_failure : why the autopilot did not enter the requested mode, as a sentence; "" = it did, or none was requested
    """

    state: State
    condition: Condition
    mode_failure: str
    answers: list[tuple[OperatorCommand, CommandAnswer]]
    radius_m: float
    height_m: float
    angular_speed_deg_s: float
    radius_error_m: float
    yaw_error_deg: float
    subject_position: np.ndarray
    action: Action

    @property
    def reason(self) -> str:
        """Why the controller is in its state, as a sentence."""
        return f"{self.condition} ({self.mode_failure})" if self.mode_failure else str(self.condition)
