"""MoCap as the lifter's training draws it: all sequences in one array, and legs of other lengths."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.evaluation.truth_files import load_mocap
from drocap_ros.skeleton import BODY_17, indices
from lab.training.leg_lengths import leg_reach, refit_knees, shortening

_FEET = np.stack([indices(BODY_17.joints, (s + "ankle", s + "toe")) for s in "rl"])
_PELVIS, _NECK = indices(BODY_17.joints, ("pelvis", "neck"))
_RIGHT_LEG = indices(BODY_17.joints, ("rhip", "rknee", "rankle"))
#: Least flexion of the knees in a refitted sequence.
_LEAST_FLEXION = np.radians([0.0, 10.0])
_REFITTED = 0.7
#: Thigh and shank of people.
_LEG_MM = (300.0, 1500.0)


@dataclass(frozen=True)
class MocapBank:
    """Concatenated sequences: joints (N, 17, 3) float32 m, z up, NaN = no toe; first frame, length, rate of each.

    foot_speed : (N, 2) m/s of the right and the left foot, that of its faster joint
    reach : (S,) longest distance of hip and ankle over the length of thigh and shank
    low : (S,) share of the frames that show a person bent, crouching or on the floor
    """

    joints: np.ndarray
    start: np.ndarray
    length: np.ndarray
    fps: np.ndarray
    foot_speed: np.ndarray
    reach: np.ndarray
    low: np.ndarray


def load_bank(paths: list[Path]) -> MocapBank:
    """Read MoCap ``.npz`` files (X in mm, joints, fps, toes).

    Raises
    ------
    InputError
        When a file cannot be used or there is none.
    """
    if not paths:
        raise InputError("MoCap: expected at least one .npz file, found none; check the folder and the pattern")
    parts, rates, speeds = [], [], []
    for path in paths:
        x, fps = load_mocap(path, joints=BODY_17)
        if len(x) < 2:
            raise InputError(f"{path}: expected at least 2 frames, got {len(x)}; leave the file out")
        _check_person(path, x)
        parts.append(x.astype(np.float32) / 1000)
        rates.append(fps)
        speeds.append(_foot_speed(parts[-1], fps))
    length = np.array([len(p) for p in parts])
    return MocapBank(
        np.concatenate(parts),
        np.cumsum(length) - length,
        length,
        np.array(rates),
        np.concatenate(speeds),
        np.array([leg_reach(p) for p in parts]),
        np.array([_low(p) for p in parts]),
    )


def _check_person(path: Path, x: np.ndarray) -> None:
    thigh, shank = np.median(np.linalg.norm(np.diff(x[:, _RIGHT_LEG], axis=1), axis=-1), axis=0)
    if not (_LEG_MM[0] <= thigh + shank <= _LEG_MM[1] and min(thigh, shank) > 0):
        raise InputError(
            f"{path}: X: expected a person in millimetres, whose leg is {_LEG_MM[0]:.0f} to {_LEG_MM[1]:.0f} long, got"
            f" {thigh + shank:.4g}; change the unit, or leave the file out"
        )


def _foot_speed(joints: np.ndarray, fps: float) -> np.ndarray:
    speed = np.linalg.norm(np.gradient(joints[:, _FEET], axis=0), axis=-1) * fps
    fastest: np.ndarray = np.fmax.reduce(speed, axis=-1).astype(np.float32)
    return fastest


def _low(joints: np.ndarray) -> float:
    """Share of the frames (F, 17, 3) whose trunk leans by 45 degrees or whose pelvis is lower than 0.65 of the legs."""
    trunk = joints[:, _NECK] - joints[:, _PELVIS]
    legs = np.linalg.norm(np.diff(joints[:, _RIGHT_LEG], axis=1), axis=-1).sum(axis=1)
    height = joints[:, _PELVIS, 2] - np.nanmin(joints[..., 2], axis=1)
    leaning = trunk[:, 2] < np.sqrt(0.5) * np.linalg.norm(trunk, axis=-1)
    return float((leaning | (height < 0.65 * np.median(legs))).mean())


def straighten_legs(motion: np.ndarray, reach: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Most windows (B, T, 17, 3) with shorter legs; ``reach`` (B,) of the windows' sequences."""
    least = rng.uniform(_LEAST_FLEXION[0], _LEAST_FLEXION[1], len(motion))
    refit = rng.random(len(motion)) < _REFITTED
    factor = np.where(refit, shortening(motion, reach, least), 1.0).astype(np.float32)
    return refit_knees(motion, factor)
