"""Outcome of one step of the control loop."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from drocap_ros.flight.conditions import Condition
from drocap_ros.flight.orbit.states import Action, CommandAnswer, OperatorCommand, State


class ControlStatus(NamedTuple):
    """Outcome of one step: the fields of ``msg/OrbitStatus.msg``, the commands it answered, and what was sent.

    failed : why the last engage ended without an orbit; None = it did not, or another command has followed
    mode_failure : why the autopilot did not enter the requested mode, as a sentence; "" = it did, or none was requested
    way_out : what the operator may do next, as a sentence; "" = nothing
    """

    state: State
    condition: Condition
    failed: Condition | None
    mode_failure: str
    way_out: str
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
        """Why the controller is in its state, and what leads out of it, as a sentence."""
        failed = "" if self.failed in (None, self.condition) else str(self.failed)
        present = f"{self.condition} ({self.mode_failure})" if self.mode_failure else str(self.condition)
        return "; ".join(filter(None, (present, failed, self.way_out)))
