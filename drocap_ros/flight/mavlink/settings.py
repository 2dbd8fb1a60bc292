"""The autopilot's own parameters, read from it.

After the death of the bridge only the autopilot's time-out ends the motion, so its length is a condition for motion.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.flight.autopilot.autopilot import UNKNOWN, Autopilot, LossSettings
from drocap_ros.flight.mavlink.message import Message

_RETRY_S = 0.7  # between requests for a parameter: two round trips of a slow radio
_TRIES = 10  # then the autopilot lacks the parameter, or the link its answers
_AGAIN_S = 10.0  # between requests for a known one, which the ground station may change


@dataclass
class _Setting:
    value: float = math.nan
    requested_s: float = -math.inf
    tries: int = 0


class AutopilotSettings:
    """Parameters of one autopilot.  Time is an argument.

    mount_type : whether the kind of the camera's mount is read, where the autopilot has a parameter for it
    preflight : whether everything is read that a check before a flight judges
    """

    def __init__(self, mount_type: bool = False, preflight: bool = False) -> None:
        self._autopilot = UNKNOWN
        self._mount_type, self._preflight = mount_type, preflight
        self._settings: dict[str, _Setting] = {}

    def set_autopilot(self, autopilot: Autopilot) -> None:
        """Set the autopilot, and forget what another one has reported."""
        self._autopilot = autopilot
        names = autopilot.preflight_names if self._preflight else autopilot.loss_names
        if self._mount_type and autopilot.mount_type_setting:
            names = (*names, autopilot.mount_type_setting)
        self._settings = {name: _Setting() for name in names}

    def due(self, now_s: float) -> list[str]:
        """Parameters to request now: often until they are reported or the tries are used up, then every 10 s."""
        names = []
        for name, setting in self._settings.items():
            patient = setting.tries >= _TRIES or not math.isnan(setting.value)
            if abs(now_s - setting.requested_s) >= (_AGAIN_S if patient else _RETRY_S):
                setting.requested_s, setting.tries = now_s, setting.tries + 1
                names.append(name)
        return names

    def take(self, message: Message) -> None:
        """Take a PARAM_VALUE."""
        setting = self._settings.get(str(message.param_id).rstrip("\0"))
        if setting is None:
            return
        value = float(message.param_value)
        if self._autopilot.integers_in_bytes and message.param_type == mavlink.MAV_PARAM_TYPE_INT32:
            value = float(struct.unpack("<i", struct.pack("<f", value))[0])
        setting.value = value if math.isfinite(value) else math.nan

    def loss_settings(self) -> LossSettings | None:
        """Reaction to the loss of setpoints; None for an autopilot without such settings."""
        return self._autopilot.loss_settings(self.reported())

    def warning(self) -> str:
        """A setting that should change and does not forbid motion, as a sentence; "" = none."""
        settings, meaning = self.loss_settings(), self._autopilot.loss_action
        if settings is None or meaning is None or settings.action not in meaning.leaves:
            return ""
        return (
            f"without setpoints the vehicle {meaning.leaves[int(settings.action)]} "
            f"({meaning.setting} {settings.action:g}); set it to {meaning.hold}, hold, on the autopilot"
        )

    def reported(self) -> dict[str, float]:
        """Values by their names, NaN = not reported."""
        return {name: setting.value for name, setting in self._settings.items()}
