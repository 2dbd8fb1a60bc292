"""Checks whether the angles and positions of a DJI file can be those of a drone.

Such files have no published format: a value at an expected place may be something else, or may never have been filled
in.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.recording.telemetry.log import Lack, LogLack

#: Largest magnitudes of pitch, roll and yaw, deg.
_LIMITS_DEG = np.array([180.0, 180.0, 360.0])
#: Height, m, that no drone reaches.
_MAX_HEIGHT_M = 20_000.0
#: Largest share of states out of range that counts as damage, not as another meaning.
_DAMAGED_SHARE = 0.02
#: A turn, or a way, from one state to the next that no gimbal or drone makes.
_TURN_DEG = 30.0
_TURN_DEG_S = 360.0  # deg/s: twice what DJI's gimbals are specified to turn
_STEP_M = 20.0  # m: a fix that is renewed moves a place by some metres
_SPEED_M_S = 60.0  # m/s: beyond DJI's fastest drones, some 40 m/s
#: Largest share of such turns: angles jump where a gimbal is recentred.
_TURNS_SHARE = 0.05
#: Metres of a degree of latitude.
_METRES_PER_DEG = 111_320.0
#: States from which zeros throughout mean that nothing was filled in.
_LEAST_STATES = 10


class Series(NamedTuple):
    """What a file gives at N times, NaN where unknown.

    stamp_ns : (N,) strictly increasing
    gimbal, aircraft : (N, 3) deg pitch (positive up), roll, yaw (clockwise from north)
    geodetic : (N, 3) latitude deg, longitude deg, height m
    """

    stamp_ns: np.ndarray
    gimbal: np.ndarray
    aircraft: np.ndarray
    geodetic: np.ndarray


def plausible(path: Path, series: Series) -> tuple[Series, list[LogLack]]:
    """The series without damaged states and places without a fix, and what was left out."""
    lacks: list[LogLack] = []
    gimbal, aircraft, place = (series[i].copy() for i in (1, 2, 3))
    place[(place[:, :2] == 0).all(axis=1)] = np.nan  # no fix
    limits = {"gimbal angles": (gimbal, _LIMITS_DEG), "aircraft angles": (aircraft, _LIMITS_DEG)}
    limits["positions"] = (place, np.array([90.0, 180.0, _MAX_HEIGHT_M]))
    damaged = np.zeros(len(place), bool)
    for name, (values, limit) in limits.items():
        known = ~np.isnan(values).any(axis=1)
        wrong = known & ~(np.abs(values) <= limit).all(axis=1)
        if wrong.sum() > _DAMAGED_SHARE * known.sum():
            found = ", ".join(f"{v:.6g}" for v in values[np.argmax(wrong)])
            _refuse(path, f"{name} within {', '.join(f'{v:g}' for v in limit)}", f"({found})")
        damaged |= wrong
        values[wrong] = np.nan
    if damaged.any():
        lacks.append(LogLack(Lack.DAMAGED_STATES, str(int(damaged.sum()))))
    if _zero(gimbal):
        _refuse(path, "the gimbal's angles", "zeros throughout, which means that they were not recorded")
    if _zero(aircraft):
        if np.isnan(gimbal).any(axis=1).all():
            _refuse(path, "the aircraft's angles", "zeros throughout, which means that they were not recorded")
        aircraft[:] = np.nan
        lacks.append(LogLack(Lack.AIRCRAFT_ZERO))
    _check_turns(path, "gimbal", series.stamp_ns, gimbal)
    _check_turns(path, "aircraft", series.stamp_ns, aircraft)
    _check_path(path, series.stamp_ns, place)
    return Series(series.stamp_ns, gimbal, aircraft, place), lacks


def _zero(angles: np.ndarray) -> bool:
    known = angles[~np.isnan(angles).any(axis=1)]
    return len(known) >= _LEAST_STATES and not known.any()


def _check_turns(path: Path, name: str, stamp_ns: np.ndarray, angles: np.ndarray) -> None:
    known = ~np.isnan(angles).any(axis=1)
    turns = np.abs((np.diff(angles[known], axis=0) + 180.0) % 360.0 - 180.0).max(axis=1, initial=0.0)
    possible = _TURN_DEG + _TURN_DEG_S * np.diff(stamp_ns[known]) * 1e-9
    share = float(np.mean(turns > possible)) if len(turns) else 0.0
    if share > _TURNS_SHARE:
        _refuse(path, f"{name} angles that turn steadily", f"{share:.0%} of them jump, by up to {turns.max():.0f} deg")


def _check_path(path: Path, stamp_ns: np.ndarray, place: np.ndarray) -> None:
    known = ~np.isnan(place).any(axis=1)
    if not known.any():
        return
    step = np.diff(place[known], axis=0)
    step[:, 1] = (step[:, 1] + 180.0) % 360.0 - 180.0
    scale = np.array([_METRES_PER_DEG, _METRES_PER_DEG * np.cos(np.deg2rad(place[known][0, 0])), 1.0])
    way = np.linalg.norm(step * scale, axis=1)
    jumps = way > _STEP_M + _SPEED_M_S * np.diff(stamp_ns[known]) * 1e-9
    if jumps.any():
        _refuse(path, "positions that a drone can fly", f"{jumps.sum()} jumps, the longest by {way.max():.0f} m")


def _refuse(path: Path, expected: str, found: str) -> None:
    raise InputError(f"{path}: expected {expected}, found {found}; --telemetry LOG names another source")
