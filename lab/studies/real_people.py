"""Study of real people: videos of a phone with optical MoCap beside them, and what other systems made of the same."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from drocap_ros.api import reconstruct
from drocap_ros.config import DrocapConfig
from drocap_ros.evaluation.metrics import pa_mpjpe
from drocap_ros.report.movement import flexion
from drocap_ros.skeleton import BODY_15, LIMB_JOINTS, indices
from drocap_ros.tracks import read_npz

#: Video and MoCap start within this time of each other, s; the offset of least error is taken, as for every system.
_STARTS_S, _STEP_S = 4.0, 0.02
SYSTEMS = ("opencap_monocular", "wham")


class RealRow(NamedTuple):
    """One video and system: PA over the twelve joints mm, and of both knees mean absolute and mean error, degrees."""

    video: str
    system: str
    pa_mm: float
    knees_deg: float
    knees_signed_deg: float


def real_people_study(folder: Path, models: Path, config: DrocapConfig) -> list[RealRow]:
    """Every ``NAME.mp4`` of a folder with its ``NAME.npz``: the default method, and the results in the file."""
    rows = []
    for video in sorted(folder.glob("*.mp4")):
        arrays = read_npz(video.with_suffix(".npz"), ("mocap", "mocap_time_s", "joints"))
        names = tuple(str(name) for name in arrays["joints"])
        truth, at = _body(arrays["mocap"], names), arrays["mocap_time_s"]
        motion = reconstruct(video, models=models, config=config)
        found = {"drocap": (_body(motion.joints3d, motion.joints), 1e-9 * (motion.stamp_ns - motion.stamp_ns[0]))}
        found |= {name: (_body(arrays[name], names), arrays[f"{name}_time_s"]) for name in SYSTEMS}
        for system, (joints, time_s) in found.items():
            offsets = np.arange(-_STARTS_S, _STARTS_S, _STEP_S)
            best = min((errors(joints, time_s + offset, truth, at) for offset in offsets), key=lambda e: e[0])
            rows.append(RealRow(video.stem, system, *best))
    return rows


def _body(joints: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """(F, 15, 3) of BODY_15 whose limbs are known, NaN elsewhere."""
    body = np.full((len(joints), len(BODY_15), 3), np.nan)
    body[:, indices(BODY_15.joints, LIMB_JOINTS)] = joints[:, indices(names, LIMB_JOINTS)]
    return body


def errors(joints: np.ndarray, time_s: np.ndarray, truth: np.ndarray, at: np.ndarray) -> tuple[float, float, float]:
    """Errors of bodies (F, 15, 3) m at times (F,) s against true ones (N, 15, 3) m at (N,) s, as in :class:`RealRow`.

    Infinite where less than half of the shorter one is common to both.
    """
    common = (time_s >= at[0]) & (time_s <= at[-1])
    if common.sum() < 0.5 * len(time_s) * min(1.0, np.ptp(at) / np.ptp(time_s)):
        return np.inf, np.inf, np.inf
    here, there = joints[common], truth[np.clip(np.searchsorted(at, time_s[common]), 0, len(at) - 1)]
    knees = flexion(here, BODY_15.joints)["knee"] - flexion(there, BODY_15.joints)["knee"]
    return 1000 * float(pa_mpjpe(here, there).mean()), float(np.abs(knees).mean()), float(knees.mean())
