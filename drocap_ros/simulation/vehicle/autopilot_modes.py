"""Modes of the simulated autopilots: numbers, manners of flight, and PX4's intended mode."""

from __future__ import annotations

from drocap_ros.simulation.vehicle.flight_control import Manner

MODES = {
    "ardupilot": {
        "STABILIZE": 0, "ALT_HOLD": 2, "GUIDED": 4, "LOITER": 5, "RTL": 6, "LAND": 9, "POSHOLD": 16, "BRAKE": 17,
    },
    "px4": {
        "POSCTL": 3 << 16, "OFFBOARD": 6 << 16, "LOITER": 4 << 16 | 3 << 24, "RTL": 4 << 16 | 5 << 24,
        "LAND": 4 << 16 | 6 << 24, "ALTCTL": 2 << 16,
    },
}  # fmt: skip
#: The mode in which setpoints steer.
CONTROL_MODE = {"ardupilot": "GUIDED", "px4": "OFFBOARD"}
#: The mode in which the pilot hands over: ArduPilot waits for setpoints in GUIDED.  PX4 enters OFFBOARD only while
#: setpoints stream, so the pilot leaves it holding and the operator's `engage` requests OFFBOARD.
HANDED_OVER_MODE = {"ardupilot": "GUIDED", "px4": "LOITER"}
#: m/s, up; of modes that change the height by themselves.
CLIMB_M_S = {"RTL": 0.5, "LAND": -0.5}
#: Mode that PX4 enters when the setpoints of OFFBOARD cease, by COM_OBL_RC_ACT; without sticks it lands for 0.
OFFBOARD_LOST_MODE = {0: "POSCTL", 1: "ALTCTL", 3: "RTL", 4: "LAND", 5: "LOITER"}


def manner_of(autopilot: str, mode: str) -> Manner:
    """How the autopilot flies in this mode.  Where the pilot steers, the sticks are centred."""
    if mode == CONTROL_MODE[autopilot]:
        return Manner.SETPOINTS
    return Manner.BRAKE if mode == "BRAKE" else Manner.HOLD
