"""BlazePose (Bazarevsky et al., 2020): outputs of its two TensorFlow Lite files as those of this package's layouts.

The detector's become a box for each anchor (``yolo``), those of the pose network the joints of ``coco21``
(``movenet``).  MediaPipe's graphs ``pose_detection`` and ``pose_landmark`` give the meaning of the numbers.
"""

from __future__ import annotations

import numpy as np

from drocap_ros.errors import InputError

#: Side of the detector's input, px, and the strides of its anchors: two anchors a cell for each entry.
_SIDE = 224
_STRIDES = (8, 16, 32, 32, 32)
#: Of a raw row of the detector: the middle of the hips, and a point on the circle about it that holds the body.
_HIPS, _CIRCLE = slice(4, 6), slice(6, 8)
#: Width and height of a standing person's box over the circle's radius.
_SIDES = np.array([1.0, 2.0], np.float32)
#: Least score of MediaPipe's detector; trees and furniture reach it.  Scores from here to 1 become those from 0 to 1.
_LEAST = 0.5
#: Side of the pose network's input, px, and its 39 points, of which these are the joints of ``coco21``.
_POSE_SIDE, _POINTS = 256, 39
_COCO_21 = (0, 2, 5, 7, 8, 11, 12, 13, 14, 15, 16, 23, 24, 25, 26, 27, 28, 31, 32, 29, 30)


def anchors() -> np.ndarray:
    """Centres (2254, 2) x y of the detector's anchors, px of its input: by stride, row and column."""
    centres = []
    for stride in sorted(set(_STRIDES)):
        n = _SIDE // stride
        y, x = np.mgrid[:n, :n]
        cells = (np.stack([x, y], -1).reshape(-1, 2) + 0.5) * stride
        centres.append(np.repeat(cells, 2 * _STRIDES.count(stride), axis=0))
    return np.concatenate(centres).astype(np.float32)


def as_layout(outputs: list[np.ndarray]) -> list[np.ndarray]:
    """The outputs of either network in its layout: ``yolo``, ``movenet`` with joints in space."""
    shapes = [output.shape for output in outputs]
    if shapes == [(1, 2254, 12), (1, 2254, 1)]:
        return [_people(outputs[0], outputs[1])]
    if len(shapes) == 5 and shapes[0] == (1, 5 * _POINTS) and shapes[4] == (1, 3 * _POINTS):
        return _joints(outputs[0], outputs[1], outputs[4])
    raise InputError(f"expected the detector or pose network BlazePose, found outputs {', '.join(map(str, shapes))}")


def _people(rows: np.ndarray, logits: np.ndarray) -> np.ndarray:
    """(1, 5, 2254): cx cy w h px and score of a standing person."""
    hips, circle = rows[..., _HIPS], rows[..., _CIRCLE]
    sides = np.linalg.norm(circle - hips, axis=2, keepdims=True) * _SIDES
    score = (_sigmoid(logits) - _LEAST) / (1 - _LEAST)
    rows = np.concatenate([hips + anchors(), sides, score], axis=2)
    return np.asarray(rows.swapaxes(1, 2))


def _joints(rows: np.ndarray, person: np.ndarray, space: np.ndarray) -> list[np.ndarray]:
    """(1, 1, 21, 3): y, x as shares of the input, and the visibility, less where the network sees nobody.

    And the joints in space (1, 21, 3): m about the hips' middle, x right, y down, z away along the ray to it.
    """
    points = rows.reshape(1, 1, _POINTS, -1)[:, :, list(_COCO_21)]
    seen = _sigmoid(points[..., 3:4]) * person
    places = np.concatenate([points[..., [1, 0]] / _POSE_SIDE, seen], axis=3)
    return [places.astype(np.float32), space.reshape(1, _POINTS, 3)[:, list(_COCO_21)]]


def _sigmoid(values: np.ndarray) -> np.ndarray:
    return np.asarray(0.5 + 0.5 * np.tanh(0.5 * values))
