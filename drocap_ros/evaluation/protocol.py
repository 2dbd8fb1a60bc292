"""The project's measuring protocol: MoCap seen by a virtual orthographic camera that orbits the subject.

All sequences of at least 5 s, their first 10 s, resampled to 24 fps, 15 joints; the camera looks down by
0.3 rad.  Noisy input: Gaussian noise of 10 mm per coordinate, then each joint of each frame replaced with
probability 0.05 by a point uniform within +-300 mm of its true place.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.skeleton import BODY_15, indices
from drocap_ros.tracks import Tracks, read_npz

FPS = 24.0
ELEVATION_RAD = 0.3
NOISE_MM = 10.0
OUTLIER_PROBABILITY = 0.05
OUTLIER_RANGE_MM = 300.0
#: Image scale of the virtual camera; a person of 1.7 m is 680 px tall.
PX_PER_MM = 0.4
IMAGE_SIZE = (1280, 1024)


@dataclass(frozen=True)
class Sequence:
    """MoCap of one take: ``x`` (F, 15, 3) mm, world z up, joints of BODY_15."""

    name: str
    x: np.ndarray


@dataclass(frozen=True)
class OrbitView:
    """A sequence as the virtual camera sees it.

    tracks : keypoints in px, no confidences, no telemetry
    truth : (F, 15, 3) mm, camera frame (x right, y down, z forward)
    rotation : (F, 3, 3) world -> camera
    """

    tracks: Tracks
    truth: np.ndarray
    rotation: np.ndarray


def load_mocap(path: Path) -> tuple[np.ndarray, float]:
    """Joints (T, 15, 3) mm, world z up, and frames per second of one MoCap ``.npz``.

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
    return x[:, indices([str(j) for j in a["joints"]], BODY_15.joints)], fps


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


def protocol_sequences(
    folder: str | Path, *, shortest_s: float = 5.0, longest_s: float = 10.0, limit: int | None = None
) -> list[Sequence]:
    """Sequences of a MoCap folder as the protocol takes them, by name.

    Raises
    ------
    InputError
        When the folder has no usable sequence.
    """
    out = []
    for path in mocap_files(folder):
        x, fps = load_mocap(path)
        if len(x) >= shortest_s * fps:
            out.append(Sequence(path.stem, resample(x, fps, FPS)[: round(longest_s * FPS)]))
            if limit is not None and len(out) >= limit:
                break
    if not out:
        raise InputError(f"{folder}: expected a sequence of at least {shortest_s:g} s, found none")
    return out


def orbit_rotations(frames: int, speed_deg_s: float, *, elevation_rad: float = ELEVATION_RAD) -> np.ndarray:
    """(F, 3, 3) world (z up) -> camera (x right, y down, z forward) of an orbit that looks at its centre."""
    angle = np.deg2rad(speed_deg_s) * np.arange(frames) / FPS
    c, s = np.cos(angle), np.sin(angle)
    ce, se = np.cos(elevation_rad), np.sin(elevation_rad)
    forward = -np.stack([c * ce, s * ce, np.full(frames, se)], axis=-1)
    right = np.stack([-s, c, np.zeros(frames)], axis=-1)
    return np.stack([right, np.cross(forward, right), forward], axis=1)


def orbit_view(x: np.ndarray, speed_deg_s: float, *, noisy: bool = False, seed: int = 0) -> OrbitView:
    """View of joints (F, 15, 3) mm by the protocol's camera; it follows the pelvis.

    Parameters
    ----------
    x : (F, 15, 3) mm, world z up, at 24 fps
    speed_deg_s : orbit speed, counter-clockwise seen from above
    noisy : add the protocol's noise and outliers, drawn from ``seed``
    """
    rotation = orbit_rotations(len(x), speed_deg_s)
    truth = (x - x[:, :1]) @ np.swapaxes(rotation, 1, 2)
    flat = truth[..., :2].copy()
    if noisy:
        rng = np.random.default_rng(seed)
        clean = flat.copy()
        flat += rng.normal(0.0, NOISE_MM, flat.shape)
        gross = rng.random(flat.shape[:2]) < OUTLIER_PROBABILITY
        flat[gross] = (clean + rng.uniform(-OUTLIER_RANGE_MM, OUTLIER_RANGE_MM, flat.shape))[gross]
    tracks = Tracks(
        keypoints=flat * PX_PER_MM + np.array(IMAGE_SIZE) / 2.0,
        joints=BODY_15.joints,
        stamp_ns=np.round(np.arange(len(x)) * (1e9 / FPS)).astype(np.int64),
        image_size=IMAGE_SIZE,
    )
    return OrbitView(tracks, truth, rotation)
