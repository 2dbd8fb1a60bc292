"""The numbers that the page's player draws, rounded to the resolution of a screen."""

from __future__ import annotations

import base64
import json

import numpy as np

from drocap_ros.motion import Motion, upright_camera_rotation, upright_joints
from drocap_ros.report.motion_images import MotionImages
from drocap_ros.report.statistics import Statistics
from drocap_ros.skeleton import side_of

#: Most poses in the page; of longer motions every n-th is shown.
MAX_POSES = 3000


def page_data(motion: Motion, s: Statistics, images: MotionImages | None) -> dict[str, object]:
    """JSON-compatible data: integers, row-major, null where unknown.

    ``pose`` mm and ``camera`` (right, forward; thousandths) in axes with z up; ``keypoints`` tenths of a px;
    ``heading`` milliradians; ``times`` ms.
    """
    shown = np.arange(0, len(motion.joints3d), -(-len(motion.joints3d) // MAX_POSES))
    axes = upright_camera_rotation(motion)[shown][:, [0, 2]]
    return {
        "joints": list(motion.joints),
        "parents": list(motion.parents),
        "sides": [side_of(name, motion.joints) for name in motion.joints],
        "world": motion.frame == "world",
        "frames": shown.tolist(),
        "times": _integers(s.times_s[shown], 1000),
        "pose": _integers(upright_joints(motion)[shown], 1000),
        "camera": _integers(axes, 1000),
        "heading": _integers(s.heading_rad[shown], 1000),
        "keypoints": _integers(motion.keypoints[shown], 10),
        "series": {"error": _numbers(s.error_px[shown]), "view": _numbers(s.view_deg[shown])},
        "image": None if images is None else _images(images, shown),
    }


def script_json(data: object) -> str:
    """JSON for a script element: no character ends the element or a line."""
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    for character in "<>&\u2028\u2029":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text


def _images(images: MotionImages, shown: np.ndarray) -> dict[str, object]:
    """Images with the index of their frame among those shown, each index once."""
    places, first = np.unique(np.searchsorted(shown, images.frames).clip(0, len(shown) - 1), return_index=True)
    return {
        "box": list(images.box),
        "places": places.tolist(),
        "jpeg": [base64.b64encode(images.jpegs[i]).decode() for i in first],
    }


def _integers(values: np.ndarray, scale: float) -> list[int | None]:
    flat = np.asarray(values, float).ravel() * scale
    known = np.isfinite(flat)
    whole = np.rint(np.where(known, flat, 0.0)).astype(np.int64).astype(object)
    whole[~known] = None
    listed: list[int | None] = whole.tolist()
    return listed


def _numbers(values: np.ndarray) -> list[float | None]:
    return [round(v, 2) if np.isfinite(v) else None for v in np.asarray(values, float).tolist()]
