"""Left and right legs of a whole recording, in place of the network's exchanges.

From the side both legs look alike, and networks exchange them for some images at a time.  Each image has two
hypotheses: the network named the legs correctly, or it exchanged them.  A change of hypothesis costs the jump of the
legs in the image; the second hypothesis costs more the more confident the network is.  Dynamic programming (Viterbi)
finds the cheapest path, so later images correct earlier ones.
"""

from __future__ import annotations

import numpy as np

from drocap_ros.keypoints import Keypoints2D
from drocap_ros.skeleton import BODY_15, BODY_19

_LEFT = np.array([BODY_15.index("lknee"), BODY_15.index("lankle")])
_RIGHT = np.array([BODY_15.index("rknee"), BODY_15.index("rankle")])
#: The joints below the hip, which a network exchanges together.
_BELOW = ("knee", "ankle", "toe", "heel")
_HIPS = np.array([BODY_15.index("lhip"), BODY_15.index("rhip")])


def with_own_legs(keypoints: Keypoints2D, stamp_ns: np.ndarray, box_size: np.ndarray) -> Keypoints2D:
    """Keypoints with the legs exchanged back in the images in which the network most likely exchanged them.

    keypoints : of ``BODY_15``, ``BODY_17`` or ``BODY_19``, px
    stamp_ns : (F,)
    box_size : (F,) px, longer side of the person's box
    """
    return exchange_legs(keypoints, exchanged_legs(keypoints, stamp_ns, box_size))


def exchanged_legs(keypoints: Keypoints2D, stamp_ns: np.ndarray, box_size: np.ndarray) -> np.ndarray:
    """(F,) bool, images in which the network most likely exchanged the legs; arguments as :func:`with_own_legs`."""
    xy, weights = keypoints.xy, keypoints.weights
    step = _step_costs(xy, stamp_ns, box_size)
    certain = np.minimum(weights[:, _LEFT], weights[:, _RIGHT])
    # Of the second hypothesis, per pair of joints and unit of -log(1 - confidence).
    prices = (-0.12 * np.log1p(-np.clip(certain, 0.0, 0.999)).sum(axis=1)).tolist()
    right, wrong = 0.0, prices[0]
    origin = [(False, False)]  # per hypothesis: whether the image before has the other one
    for keep, change, price in zip(step[1:, 0].tolist(), step[1:, 1].tolist(), prices[1:], strict=True):
        stay_right, to_right, stay_wrong, to_wrong = right + keep, wrong + change, wrong + keep, right + change
        origin.append((to_right < stay_right, to_wrong < stay_wrong))
        right, wrong = min(stay_right, to_right), min(stay_wrong, to_wrong) + price
    out = np.zeros(len(xy), bool)
    now = wrong < right
    for t in range(len(xy) - 1, -1, -1):
        out[t] = now
        now ^= origin[t][now]
    return out


def _step_costs(xy: np.ndarray, stamp_ns: np.ndarray, box_size: np.ndarray) -> np.ndarray:
    """(F, 2) cost of the legs' step to each image, for equal and for different hypotheses of both images."""
    relative = xy - xy[:, _HIPS].mean(axis=1, keepdims=True)
    left, right = relative[:, _LEFT], relative[:, _RIGHT]
    out = np.zeros((len(xy), 2))
    # Standard deviation of a leg joint's step relative to the hips between two images, share of the box.
    scale = (0.04 * np.maximum(box_size[1:], 1.0))[:, None]

    def cost(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        squared = np.square((b[1:] - a[:-1]) / scale[..., None]).sum(axis=2)
        # A gross error carries no information about sides.
        costs = np.minimum(0.5 * squared, 8.0)
        costs[np.isnan(costs)] = 0.0
        return np.asarray(costs.sum(axis=1))

    out[1:, 0] = cost(left, left) + cost(right, right)
    out[1:, 1] = cost(left, right) + cost(right, left)
    # After such a gap the positions of the legs carry no information.
    out[1:][np.diff(stamp_ns) > 0.25 * 1e9] = 0.0
    return out


def exchange_legs(keypoints: Keypoints2D, exchanged: np.ndarray) -> Keypoints2D:
    """Keypoints with the legs of the images ``exchanged`` (F,) bool exchanged, and a lower confidence in them."""
    if not exchanged.any():
        return keypoints
    names = BODY_19.joints[: keypoints.xy.shape[1]]
    order = np.arange(len(names))
    for side, other in (("l", "r"), ("r", "l")):
        for part in _BELOW:
            if side + part in names:
                order[names.index(side + part)] = names.index(other + part)
    # Factor on the confidence of an exchanged joint, which the network named wrongly.
    trust = np.where(order != np.arange(len(names)), 0.85, 1.0)
    confidence, covariance, which = keypoints.confidence, keypoints.covariance, exchanged[:, None]
    return Keypoints2D(
        np.where(which[..., None], keypoints.xy[:, order], keypoints.xy),
        None if confidence is None else np.where(which, confidence[:, order] * trust, confidence),
        None if covariance is None else np.where(which[..., None], covariance[:, order], covariance),
    )
