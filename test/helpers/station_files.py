"""Files of parameters as ground stations load them: QGroundControl's and Mission Planner's."""

from pathlib import Path

CONFIG = Path(__file__).resolve().parents[2] / "config"
STATION_FILES = {"px4": CONFIG / "px4.params", "ardupilot": CONFIG / "ardupilot.param"}
_REAL32, _INT32 = "9", "6"  # MAV_PARAM_TYPE


def station_settings(autopilot):
    """Values by their names, as the ground station sends them."""
    values = {}
    for line in STATION_FILES[autopilot].read_text().splitlines():
        if line.startswith("#"):
            continue
        if autopilot == "ardupilot":
            name, value = line.split(",")
            values[name] = float(value)
        else:
            vehicle, component, name, value, kind = line.split("\t")
            assert (vehicle, component) == ("1", "1")
            values[name] = {_REAL32: float, _INT32: int}[kind](value)
    return values
