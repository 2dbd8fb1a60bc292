"""The numbers that the page's player draws, rounded to the resolution of a screen."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from drocap_ros.motion import Motion, upright_camera_rotation, upright_joints
from drocap_ros.report.motion_images import MotionImages
from drocap_ros.report.movement import Curve, movement
from drocap_ros.report.statistics import Statistics, motion_statistics
from drocap_ros.skeleton import side_of

#: Most poses in the page; of longer motions every n-th is shown.
MAX_POSES = 3000


def page_data(
    motion: Motion,
    s: Statistics,
    images: MotionImages | None,
    people: Mapping[int, Motion] | None = None,
    placed: Mapping[int, Motion] | None = None,
) -> dict[str, object]:
    """JSON-compatible data: integers, row-major, null where unknown.

    ``pose`` mm and ``camera`` (right, forward; thousandths) in axes with z up; ``keypoints`` tenths of a px;
    ``people`` holds poses, keypoints and movement of each of several persons on the same frames, None = there is one;
    ``lead`` is whose plots the page has, the first of ``people``; ``placed`` are all on the frames of ``motion``;
    ``heading`` milliradians; ``times`` ms; ``movement`` 1 / ``scale`` of its unit, a list per side.
    """
    shown = shown_frames(motion)
    axes = upright_camera_rotation(motion)[shown][:, [0, 2]]
    return {
        "joints": list(motion.joints),
        "parents": list(motion.parents),
        "sides": [side_of(name, motion.joints) for name in motion.joints],
        "world": motion.frame == "world",
        "frames": shown.tolist(),
        "times": _times(motion, shown),
        "pose": _integers(upright_joints(motion)[shown], 1000),
        "camera": _integers(axes, 1000),
        "heading": _integers(s.heading_rad[shown], 1000),
        "keypoints": _integers(motion.keypoints[shown], 10),
        "movement": [_curve(curve) for curve in movement(motion, s, shown)],
        "series": {"error": _numbers(s.error_px[shown]), "view": _numbers(s.view_deg[shown])},
        "image": None if images is None else _images(images, shown),
        "lead": str(next(iter(people or ()), "")),
        "people": [_person(number, other, people[number], shown) for number, other in placed.items()]
        if people and placed
        else None,
    }


def _person(number: int, placed: Motion, own: Motion, shown: np.ndarray) -> dict[str, object]:
    stamp_ns = placed.stamp_ns[shown]
    frames = np.searchsorted(own.stamp_ns, stamp_ns).clip(0, len(own.stamp_ns) - 1)
    curves = movement(own, motion_statistics(own), frames)
    for curve in curves:
        curve.values[(stamp_ns < own.stamp_ns[0]) | (stamp_ns > own.stamp_ns[-1])] = np.nan
    return {
        "name": str(number),
        "pose": _integers(upright_joints(placed)[shown], 1000),
        "keypoints": _integers(placed.keypoints[shown], 10),
        "movement": [_curve(curve) for curve in curves],
    }


def _curve(curve: Curve) -> dict[str, object]:
    scale = 10 if curve.unit == "°" else 100
    columns = {"values": curve.values, "deviation": curve.deviation}
    return {
        "name": curve.name,
        "unit": curve.unit,
        "words": curve.words,
        "sides": list(curve.sides),
        "scale": scale,
        **{key: None if v is None else [_integers(column, scale) for column in v.T] for key, v in columns.items()},
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
        "boxes": [list(images.boxes[i]) for i in first],
        "places": places.tolist(),
        "jpeg": [base64.b64encode(images.jpegs[i]).decode() for i in first],
    }


def images_of_page(page: Path, motion: Motion) -> MotionImages | None:
    """Images that an earlier report of the same keypoints and times holds; None = there is none, or no such report."""
    try:
        found = re.search(r'id="motion">(.*?)</script>', page.read_text(encoding="utf-8"), re.DOTALL)
        data = json.loads(found[1]) if found else {}
        shown = shown_frames(motion)
        if data.get("image") is None or data["frames"] != shown.tolist():
            return None
        if data["keypoints"] != _integers(motion.keypoints[shown], 10) or data["times"] != _times(motion, shown):
            return None
        image = data["image"]
        jpegs = tuple(base64.b64decode(text) for text in image["jpeg"])
        boxes = tuple((int(x0), int(y0), int(x1), int(y1)) for x0, y0, x1, y1 in image["boxes"])
        return MotionImages(tuple(shown[image["places"]].tolist()), jpegs, boxes)
    except (OSError, ValueError, KeyError, TypeError, IndexError, AttributeError):  # not a report, or one of old
        return None


def shown_frames(motion: Motion) -> np.ndarray:
    """Indices of the frames in the page."""
    return np.arange(0, len(motion.joints3d), -(-len(motion.joints3d) // MAX_POSES))


def _times(motion: Motion, shown: np.ndarray) -> list[int | None]:
    return _integers((motion.stamp_ns[shown] - motion.stamp_ns[0]) * 1e-9, 1000)


def _integers(values: np.ndarray, scale: float) -> list[int | None]:
    flat = np.asarray(values, float).ravel() * scale
    known = np.isfinite(flat)
    whole = np.rint(np.where(known, flat, 0.0)).astype(np.int64).astype(object)
    whole[~known] = None
    listed: list[int | None] = whole.tolist()
    return listed


def _numbers(values: np.ndarray) -> list[float | None]:
    return [round(v, 2) if np.isfinite(v) else None for v in np.asarray(values, float).tolist()]
