"""The project's measuring protocol: MoCap seen by a virtual orthographic camera that orbits the subject.

All sequences of at least 5 s, their first 10 s, resampled to 24 fps, 15 joints and the toes where they are known; the
camera looks down by 0.3 rad.  Noisy input: Gaussian noise of 10 mm per coordinate, then each joint of each frame
replaced with probability 0.05 by a point uniform within +-300 mm of its true place.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TypeVar

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.evaluation.compare import TRUTH_SUFFIXES
from drocap_ros.evaluation.truth_files import load_mocap
from drocap_ros.skeleton import BODY_15, BODY_17
from drocap_ros.tracks import Tracks

T = TypeVar("T")
Progress = Callable[[str, float], None]

# The numbers of the protocol; docs/accuracy.md compares with published results under them.
FPS = 24.0
ELEVATION_RAD = 0.3  # rad, of the camera above the horizon
NOISE_MM = 10.0  # mm at the body, standard deviation per coordinate
#: Per joint and frame.
OUTLIER_PROBABILITY = 0.05
OUTLIER_RANGE_MM = 300.0  # mm at the body, largest shift per coordinate
#: Image scale of the virtual camera; a person of 1.7 m is 680 px tall.
PX_PER_MM = 0.4
#: Width and height px.
IMAGE_SIZE = (1280, 1024)


@dataclass(frozen=True)
class Sequence:
    """MoCap of one take: ``x`` (F, P, 3) mm, world z up, joints of BODY_17, or of BODY_15 without known toes."""

    name: str
    x: np.ndarray


@dataclass(frozen=True)
class OrbitView:
    """A sequence as the virtual camera sees it.

    tracks : keypoints in px, no confidences, no telemetry
    truth : (F, P, 3) mm, camera frame (x right, y down, z forward)
    rotation : (F, 3, 3) world -> camera
    """

    tracks: Tracks
    truth: np.ndarray
    rotation: np.ndarray


def mocap_files(folder: str | Path, include: str = "*") -> list[Path]:
    """``.npz`` files of a folder by name; ``include`` is a glob on the name without its ending."""
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a folder of MoCap .npz files; no such folder")
    found = (path for path in folder.glob("[!.]*") if path.suffix.lower() in TRUTH_SUFFIXES)
    files = sorted(path for path in found if fnmatchcase(path.stem, include))
    if not files:
        raise InputError(f"{folder}: expected MoCap files {include}.npz, found none; check the folder and the pattern")
    return files


def protocol_sequences(
    folder: str | Path, *, shortest_s: float = 5.0, longest_s: float = 10.0, limit: int | None = None
) -> list[Sequence]:
    """Sequences of a MoCap folder as the protocol takes them, by name; with ``BODY_15`` where there are no toes."""
    if limit is not None and limit < 1:
        raise InputError(f"--limit: expected at least 1, got {limit}")
    out = []
    for path in mocap_files(folder):
        x, fps = load_mocap(path, joints=BODY_17)
        if np.isnan(x).any():
            x = x[:, : len(BODY_15)]
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
    """View of joints (F, P, 3) mm of BODY_15 or BODY_17 by the protocol's camera; it follows the pelvis.

    Parameters
    ----------
    x : (F, P, 3) mm, world z up, at 24 fps
    speed_deg_s : orbit speed, counter-clockwise seen from above
    noisy : add the protocol's noise and outliers, drawn from ``seed``
    """
    rotation = orbit_rotations(len(x), speed_deg_s)
    truth = (x - x[:, :1]) @ np.swapaxes(rotation, 1, 2)
    flat = truth[..., :2]
    if noisy:
        # The toes have draws of their own: those of the other joints are the same with and without them.
        body, toes = np.split(flat, [len(BODY_15)], axis=1)
        flat = np.concatenate([_with_noise(body, seed), _with_noise(toes, [seed, len(BODY_15)])], axis=1)
    tracks = Tracks(
        keypoints=flat * PX_PER_MM + np.array(IMAGE_SIZE) / 2.0,
        joints=BODY_17.joints[: x.shape[1]],
        stamp_ns=np.round(np.arange(len(x)) * (1e9 / FPS)).astype(np.int64),
        image_size=IMAGE_SIZE,
    )
    return OrbitView(tracks, truth, rotation)


def _with_noise(flat: np.ndarray, seed: int | list[int]) -> np.ndarray:
    """Places (F, P, 2) mm with the protocol's noise and outliers."""
    rng = np.random.default_rng(seed)
    noisy = flat + rng.normal(0.0, NOISE_MM, flat.shape)
    gross = rng.random(flat.shape[:2]) < OUTLIER_PROBABILITY
    thrown = flat + rng.uniform(-OUTLIER_RANGE_MM, OUTLIER_RANGE_MM, flat.shape)
    return np.where(gross[..., None], thrown, noisy)


def reported(items: Iterable[T], count: int, stage: str, progress: Progress | None) -> Iterator[T]:
    """The items; reports the share of ``count`` that is done."""
    for done, item in enumerate(items, 1):
        yield item
        if progress is not None:
            progress(stage, done / count)


def resample(x: np.ndarray, fps: float, wanted_fps: float) -> np.ndarray:
    """Cubic interpolation of joints (T, P, 3) at another frame rate, over the same span of time.

    Joints that are NaN in any frame are NaN in all.
    """
    from scipy.interpolate import CubicSpline

    if len(x) < 2 or fps == wanted_fps:
        return x
    t = np.arange(len(x)) / fps
    wanted = np.arange(int(np.floor(t[-1] * wanted_fps + 1e-9)) + 1) / wanted_fps
    known = np.isfinite(x).all(axis=(0, 2))
    out = np.full((len(wanted), *x.shape[1:]), np.nan)
    out[:, known] = CubicSpline(t, x[:, known], axis=0)(wanted)
    return out
