"""What the autopilot is set to do when our setpoints stop coming: read from it, and judged in words.

After the bridge's own death only the autopilot's time-out ends the motion, so its length is a condition for flying.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

_TIMEOUT = {"ardupilot": "GUID_TIMEOUT", "px4": "COM_OF_LOSS_T"}
_ACTION = "COM_OBL_RC_ACT"
_READ = {"ardupilot": ("GUID_TIMEOUT",), "px4": ("COM_OF_LOSS_T", _ACTION)}
_FATAL = {6: "flight is terminated", 7: "the motors are stopped"}
_DRIFTING = {1: "altitude mode", 2: "manual flight"}
_RETRY_S, _TRIES, _AGAIN_S = 0.7, 10, 10.0
_ROUNDING_S = 1e-3


@dataclass
class _Setting:
    value: float = math.nan
    asked_s: float = -math.inf
    tries: int = 0


class AutopilotSettings:
    """The parameters of one autopilot that decide what becomes of it without us.  Time is an argument."""

    def __init__(self) -> None:
        self._autopilot = ""
        self._settings: dict[str, _Setting] = {}

    def set_autopilot(self, autopilot: str) -> None:
        """Which autopilot it is: "ardupilot" or "px4"."""
        self._autopilot = autopilot
        self._settings = {name: _Setting() for name in _READ.get(autopilot, ())}

    def due(self, now_s: float) -> list[str]:
        """Parameters to ask for now: until they are told, then ever more rarely, and once in a while again."""
        names = []
        for name, setting in self._settings.items():
            patient = setting.tries >= _TRIES or not math.isnan(setting.value)
            if now_s - setting.asked_s >= (_AGAIN_S if patient else _RETRY_S):
                setting.asked_s, setting.tries = now_s, setting.tries + 1
                names.append(name)
        return names

    def take(self, message: Any) -> None:
        """A PARAM_VALUE has come."""
        setting = self._settings.get(str(message.param_id).rstrip("\0"))
        if setting is None:
            return
        value = float(message.param_value)
        if self._autopilot == "px4" and message.param_type == mavlink.MAV_PARAM_TYPE_INT32:
            value = float(struct.unpack("<i", struct.pack("<f", value))[0])  # PX4 sends integers byte by byte
        setting.value = value if math.isfinite(value) else math.nan

    def problem(self, longest_s: float) -> str:
        """Why the vehicle must not be flown as it is set, in words; "" = it may.  ``longest_s`` 0 = no matter."""
        name = _TIMEOUT.get(self._autopilot)
        if name is None or longest_s == 0:
            return ""
        value = self._settings[name].value
        remedy = f"set {name} to {longest_s:g} on the autopilot, or change max_control_timeout_s"
        if math.isnan(value):
            return f"the autopilot has not told its {name}, how long it flies on without us; {remedy}"
        if value > longest_s + _ROUNDING_S:
            return f"the autopilot would fly on for {value:g} s without us; {remedy}"
        action = self._settings[_ACTION].value if _ACTION in self._settings else math.nan
        if action in _FATAL:
            return f"without us {_FATAL[int(action)]} ({_ACTION} {action:g}); set it to 5, hold, on the autopilot"
        return ""

    def warning(self) -> str:
        """What is not as it should be and does not forbid to fly, in words; "" = nothing."""
        action = self._settings[_ACTION].value if _ACTION in self._settings else math.nan
        if action in _DRIFTING:
            return (
                f"without us the vehicle drifts in {_DRIFTING[int(action)]} ({_ACTION} {action:g}); "
                "set it to 5, hold, on the autopilot"
            )
        return ""

    def told(self) -> dict[str, float]:
        """Values by their names, NaN = not told."""
        return {name: setting.value for name, setting in self._settings.items()}
