"""The subject drawn into the image."""

from __future__ import annotations

import numpy as np

from drocap_ros.observation import PoseObservation
from drocap_ros.skeleton import BODY_15

_LEFT, _RIGHT, _MIDDLE = (60, 60, 255), (255, 160, 40), (90, 220, 90)
#: Ellipses are drawn at so many standard deviations.
_SIGMAS = 2.0


def draw(image: np.ndarray, observation: PoseObservation) -> np.ndarray:
    """Copy of the image (H, W, 3) uint8 BGR with box, bones and 2-sigma ellipses; left red, right blue.

    A box is drawn thin while it is only predicted.
    """
    import cv2

    out = image.copy()
    thick = max(1, round(max(image.shape[:2]) / 640))
    if not observation.has_subject:
        _label(out, "no subject", (8, 24 * thick), thick)
        return out
    x0, y0, x1, y1 = (round(float(v)) for v in observation.roi)
    cv2.rectangle(out, (x0, y0), (x1, y1), (0, 220, 255), thick if observation.detection_score == 0 else 2 * thick)
    _label(
        out, f"{observation.track_id}  {observation.detection_score:.2f}", (x0, max(y0 - 4 * thick, 12 * thick)), thick
    )
    points, seen = observation.keypoints, np.isfinite(observation.keypoints).all(axis=1)
    for parent, child in BODY_15.bones:
        if seen[parent] and seen[child]:
            start, end = (np.round(points[j]).astype(int).tolist() for j in (parent, child))
            cv2.line(out, start, end, _colour(BODY_15.joints[child]), 2 * thick, cv2.LINE_AA)
    for joint in np.nonzero(seen)[0]:
        _ellipse(out, points[joint], observation.covariance[joint], _colour(BODY_15.joints[joint]), thick)
    return out


def _colour(joint: str) -> tuple[int, int, int]:
    if joint in ("pelvis", "neck", "head"):
        return _MIDDLE
    return _LEFT if joint.startswith("l") else _RIGHT


def _ellipse(
    image: np.ndarray, centre: np.ndarray, covariance: np.ndarray, colour: tuple[int, int, int], thick: int
) -> None:
    import cv2

    xx, xy, yy = (float(v) for v in covariance)
    values, vectors = np.linalg.eigh(np.array([[xx, xy], [xy, yy]]))
    radii = _SIGMAS * np.sqrt(np.maximum(values, 0.25))
    angle = float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))
    place = tuple(int(v) for v in np.round(centre))
    cv2.ellipse(
        image, place, (round(float(radii[1])), round(float(radii[0]))), angle, 0, 360, colour, thick, cv2.LINE_AA
    )


def _label(image: np.ndarray, text: str, place: tuple[int, int], thick: int) -> None:
    import cv2

    for colour, width in (((0, 0, 0), 3 * thick), ((255, 255, 255), thick)):
        cv2.putText(image, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.5 * thick, colour, width, cv2.LINE_AA)
