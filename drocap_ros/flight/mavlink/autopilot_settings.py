"""The autopilot's own settings for the loss of setpoints, read from it.

After the death of the bridge only the autopilot's time-out ends the motion, so its length is a condition for motion.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.flight.mavlink.mount import TYPE_PARAMETER

_TIMEOUT = {"ardupilot": "GUID_TIMEOUT", "px4": "COM_OF_LOSS_T"}
_ACTION = "COM_OBL_RC_ACT"
_READ = {"ardupilot": ("GUID_TIMEOUT",), "px4": ("COM_OF_LOSS_T", _ACTION)}
_LEAVING = {3: "flies home", 4: "lands where it is"}
_RETRY_S, _TRIES, _AGAIN_S = 0.7, 10, 10.0


class LossSettings(NamedTuple):
    """Reaction to the loss of setpoints: time-out in s and number of the action, with their parameters' names.

    NaN = not reported; action_name "" = the autopilot has no such setting.
    """

    timeout_name: str
    timeout_s: float
    action_name: str
    action: float


@dataclass
class _Setting:
    value: float = math.nan
    requested_s: float = -math.inf
    tries: int = 0


class AutopilotSettings:
    """The parameters of one autopilot that decide its flight without setpoints.  Time is an argument.

    mount_type : whether the kind of the camera's mount is read too, where the autopilot has a parameter for it
    """

    def __init__(self, mount_type: bool = False) -> None:
        self._autopilot = ""
        self._mount_type = mount_type
        self._settings: dict[str, _Setting] = {}

    def set_autopilot(self, autopilot: str) -> None:
        """Set the autopilot: "ardupilot" or "px4"."""
        self._autopilot = autopilot
        names = _READ.get(autopilot, ())
        if self._mount_type and autopilot == "ardupilot":
            names = (*names, TYPE_PARAMETER)
        self._settings = {name: _Setting() for name in names}

    def add(self, names: Iterable[str]) -> None:
        """Read these parameters of the autopilot too."""
        for name in names:
            self._settings.setdefault(name, _Setting())

    def due(self, now_s: float) -> list[str]:
        """Parameters to request now: often until they are reported or the tries are used up, then every 10 s."""
        names = []
        for name, setting in self._settings.items():
            patient = setting.tries >= _TRIES or not math.isnan(setting.value)
            if abs(now_s - setting.requested_s) >= (_AGAIN_S if patient else _RETRY_S):
                setting.requested_s, setting.tries = now_s, setting.tries + 1
                names.append(name)
        return names

    def take(self, message: Any) -> None:
        """Take a PARAM_VALUE."""
        setting = self._settings.get(str(message.param_id).rstrip("\0"))
        if setting is None:
            return
        value = float(message.param_value)
        if self._autopilot == "px4" and message.param_type == mavlink.MAV_PARAM_TYPE_INT32:
            value = float(struct.unpack("<i", struct.pack("<f", value))[0])  # PX4 sends integers byte by byte
        setting.value = value if math.isfinite(value) else math.nan

    def loss_settings(self) -> LossSettings | None:
        """Reaction to the loss of setpoints; None for an autopilot without such settings."""
        return loss_settings_of(self._autopilot, self.reported())

    def warning(self) -> str:
        """A setting that should change and does not forbid motion, as a sentence; "" = none."""
        settings = self.loss_settings()
        if settings is not None and settings.action in _LEAVING:
            return (
                f"without setpoints the vehicle {_LEAVING[int(settings.action)]} "
                f"({settings.action_name} {settings.action:g}); set it to 5, hold, on the autopilot"
            )
        return ""

    def reported(self) -> dict[str, float]:
        """Values by their names, NaN = not reported."""
        return {name: setting.value for name, setting in self._settings.items()}


def loss_settings_of(autopilot: str, values: Mapping[str, float]) -> LossSettings | None:
    """Reaction to the loss of setpoints by an autopilot's parameters; None for one without such settings."""
    name = _TIMEOUT.get(autopilot)
    if name is None:
        return None
    action = _ACTION if _ACTION in _READ[autopilot] else ""
    return LossSettings(name, values.get(name, math.nan), action, values.get(action, math.nan))
