"""Motion capture files: one take per ``.npz``, read as joints of ``BODY_15``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.skeleton import BODY_15, in_body_order
from drocap_ros.tracks import read_npz


@dataclass(frozen=True)
class Sequence:
    """MoCap of one take: ``x`` (F, 15, 3) mm, world z up, joints of BODY_15."""

    name: str
    x: np.ndarray


def load_mocap(path: Path, required: tuple[str, ...] = BODY_15.joints) -> tuple[np.ndarray, float]:
    """Joints (T, 15, 3) mm, world z up, and frames per second of one MoCap ``.npz``.

    Joints that are neither in the file nor ``required`` are NaN.

    Raises
    ------
    InputError
        When the file cannot be used.
    """
    a = read_npz(path, ("X", "fps", "joints"))
    if a["X"].ndim != 3 or a["X"].shape[1:] != (a["joints"].size, 3) or len(a["X"]) == 0:
        raise InputError(f"{path}: X: expected (T, {a['joints'].size}, 3), got {a['X'].shape}")
    x = a["X"].astype(np.float64)
    if not np.isfinite(x).all():
        raise InputError(f"{path}: X: expected finite millimetres, got NaN or infinity; fill the gaps in")
    fps = float(a["fps"])
    if not 1.0 <= fps <= 1000.0:
        raise InputError(f"{path}: fps: expected 1 to 1000, got {fps:g}")
    return in_body_order(x, [str(j) for j in a["joints"]], required), fps


def mocap_files(folder: str | Path, include: str = "*") -> list[Path]:
    """``.npz`` files of a folder by name; ``include`` is a glob on the name without its ending.

    Raises
    ------
    InputError
        When there is none.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a folder of MoCap .npz files; no such folder")
    files = sorted(folder.glob(f"{include}.npz"))
    if not files:
        raise InputError(f"{folder}: expected MoCap files {include}.npz, found none; check the folder and the pattern")
    return files


def resample(x: np.ndarray, fps: float, wanted_fps: float) -> np.ndarray:
    """Cubic interpolation of joints (T, P, 3) at another frame rate, over the same span of time."""
    from scipy.interpolate import CubicSpline

    if len(x) < 2 or fps == wanted_fps:
        return x
    t = np.arange(len(x)) / fps
    wanted = np.arange(int(np.floor(t[-1] * wanted_fps + 1e-9)) + 1) / wanted_fps
    return CubicSpline(t, x, axis=0)(wanted)
