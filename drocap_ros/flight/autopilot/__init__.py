"""The autopilots that the bridge flies: one file each, found by the registry here."""

from __future__ import annotations

import importlib
import pkgutil

from drocap_ros.flight.autopilot.autopilot import UNKNOWN, Autopilot

__all__ = ["AUTOPILOTS", "UNKNOWN", "Autopilot", "autopilot_by_heartbeat", "autopilot_of", "supported_titles"]


def _found() -> dict[str, Autopilot]:
    modules = sorted(module.name for module in pkgutil.iter_modules(__path__))
    values = [value for name in modules for value in vars(importlib.import_module(f"{__name__}.{name}")).values()]
    return {value.name: value for value in values if isinstance(value, Autopilot) and value.supported}


#: Every instance of a file in this folder, by its name; the first one is the default of simulations.
AUTOPILOTS = _found()


def autopilot_of(name: str) -> Autopilot:
    """The autopilot of ``VehicleState.autopilot``; ``UNKNOWN`` for any other name."""
    return AUTOPILOTS.get(name, UNKNOWN)


def autopilot_by_heartbeat(mav_autopilot: int) -> Autopilot:
    """The autopilot of a heartbeat's MAV_AUTOPILOT; ``UNKNOWN`` for any other number."""
    return next((a for a in AUTOPILOTS.values() if a.mav_autopilot == mav_autopilot), UNKNOWN)


def supported_titles() -> str:
    """Names of the autopilots that the bridge flies, for people."""
    return " or ".join(autopilot.title for autopilot in AUTOPILOTS.values())
