"""Named joint sets and their bones.

``BODY_17`` is the set of the default method's 3D results, ``BODY_15`` (its first fifteen joints) that of the paper's
methods; ``BODY_19`` adds the heels where a 2D network sees them.  Each set begins with the joints of the one before.
The joints follow the MoCap convention of Human3.6M: ``pelvis`` is the middle of the hips, ``neck`` the top of the neck
(not the line of the shoulders), ``head`` the middle of the skull's upper half, ``rtoe`` and ``ltoe`` the tips of the
big toes.

Maps from the joint sets of public networks give ``BODY_15``, or ``BODY_19`` for networks that see toes and heels.
Each of their joints is a weighted mean of a network's joints.  Most are one joint; the pelvis is the middle of the
hips where the network has none; ``neck`` and ``head`` are extrapolated along the line from the middle of the
shoulders: in the MoCap convention the neck lies 135 mm and the head 232 mm above it, the ears about 190 mm.
Extrapolated joints have an extra variance for the lean of the head, in units of the network's own shoulder-to-ear or
neck-to-crown distance, and less confidence.  Networks that learned from COCO's annotations draw shoulders inside the
joints' centres: they are moved outwards along the line between them, and get an extra variance for the share that the
measure leaves open.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np

from drocap_ros.errors import InputError


@dataclass(frozen=True)
class JointSet:
    """An ordered set of named joints with its kinematic tree (parent index per joint, -1 at a root)."""

    name: str
    joints: tuple[str, ...]
    parents: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.joints)

    def index(self, joint: str) -> int:
        """Index of a joint by its name."""
        return self.joints.index(joint)

    @cached_property
    def bones(self) -> np.ndarray:
        """(L, 2) int, rows parent, child."""
        return np.array([(p, c) for c, p in enumerate(self.parents) if p >= 0])

    @cached_property
    def mirror(self) -> np.ndarray:
        """(P,) int, the joint of the other body side for each joint (itself on the midline)."""
        return np.array([self.joints.index(other_side(j, self.joints)) for j in self.joints])


def _names(words: str) -> tuple[str, ...]:
    return tuple(words.split())


def other_side(joint: str, joints: tuple[str, ...]) -> str:
    """The joint of the other body side by its name; itself on the midline."""
    for a, b in (("l", "r"), ("r", "l"), ("left_", "right_"), ("right_", "left_")):
        if joint.startswith(a) and b + joint[len(a) :] in joints:
            return b + joint[len(a) :]
    return joint


BODY_15 = JointSet(
    "body15",
    _names("pelvis rhip rknee rankle lhip lknee lankle neck head lshoulder lelbow lwrist rshoulder relbow rwrist"),
    (-1, 0, 1, 2, 0, 4, 5, 0, 7, 7, 9, 10, 7, 12, 13),
)

TOES = ("rtoe", "ltoe")

BODY_17 = JointSet("body17", (*BODY_15.joints, *TOES), (*BODY_15.parents, 3, 6))

#: ``BODY_17`` and the heels, which only some 2D networks see.
BODY_19 = JointSet("body19", (*BODY_17.joints, "rheel", "lheel"), (*BODY_17.parents, 3, 6))

COCO_17 = JointSet(
    "coco17",
    _names(
        "nose left_eye right_eye left_ear right_ear left_shoulder right_shoulder left_elbow right_elbow left_wrist"
        " right_wrist left_hip right_hip left_knee right_knee left_ankle right_ankle"
    ),
    (-1, 0, 0, 1, 2, 0, 0, 5, 6, 7, 8, 5, 6, 11, 12, 13, 14),
)

#: COCO's joints with toes and heels, as BlazePose gives them.
COCO_21 = JointSet(
    "coco21",
    (*COCO_17.joints, *_names("left_big_toe right_big_toe left_heel right_heel")),
    (*COCO_17.parents, 15, 16, 15, 16),
)

_HALPE_FEET = "left_big_toe right_big_toe left_small_toe right_small_toe left_heel right_heel"
HALPE_26 = JointSet(
    "halpe26",
    (*COCO_17.joints, *_names(f"head_top neck hip {_HALPE_FEET}")),
    (18, 0, 0, 1, 2, 18, 18, 5, 6, 7, 8, 19, 19, 11, 12, 13, 14, 18, 19, -1, 15, 16, 15, 16, 15, 16),
)

_WHOLEBODY_FEET = "left_big_toe left_small_toe left_heel right_big_toe right_small_toe right_heel"
#: COCO-WholeBody: the body, six points of the feet, 68 of the face, 21 of each hand.
WHOLEBODY_133 = JointSet(
    "wholebody133",
    (
        *(*COCO_17.joints, *_names(_WHOLEBODY_FEET), *(f"face_{i}" for i in range(68))),
        *(f"{side}_hand_{i}" for side in ("left", "right") for i in range(21)),
    ),
    (
        *(*COCO_17.parents, *[15] * 3, *[16] * 3, *[0] * 68),
        *(9 if i == 0 else 91 if i % 4 == 1 else 90 + i for i in range(21)),
        *(10 if i == 0 else 112 if i % 4 == 1 else 111 + i for i in range(21)),
    ),
)

MPII_16 = JointSet(
    "mpii16",
    _names(
        "right_ankle right_knee right_hip left_hip left_knee left_ankle pelvis thorax upper_neck head_top right_wrist"
        " right_elbow right_shoulder left_shoulder left_elbow left_wrist"
    ),
    (1, 2, 6, 6, 3, 4, -1, 6, 7, 8, 11, 12, 7, 7, 13, 14),
)

H36M_17 = JointSet(
    "h36m17",
    _names(
        "pelvis rhip rknee rankle lhip lknee lankle spine thorax neck head lshoulder lelbow lwrist rshoulder relbow"
        " rwrist"
    ),
    (-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 9, 8, 11, 12, 8, 14, 15),
)

JOINT_SETS: dict[str, JointSet] = {
    s.name: s for s in (BODY_15, BODY_17, BODY_19, COCO_17, COCO_21, HALPE_26, WHOLEBODY_133, MPII_16, H36M_17)
}

#: The twelve joints of the averages in the paper's tables.
LIMB_JOINTS = _names("rhip rknee rankle lhip lknee lankle lshoulder lelbow lwrist rshoulder relbow rwrist")

#: Bones of ``BODY_15`` of constant length on a real person (not the spine and the shoulder girdle).
RIGID_BONES = tuple(
    _names(bone)
    for bone in (
        *("rhip rknee", "rknee rankle", "lhip lknee", "lknee lankle", "rhip lhip"),
        *("lshoulder lelbow", "lelbow lwrist", "rshoulder relbow", "relbow rwrist", "neck head"),
    )
)


def joint_set(name: str) -> JointSet:
    """Joint set by its name."""
    try:
        return JOINT_SETS[name]
    except KeyError:
        raise InputError(f"skeleton: expected one of {', '.join(JOINT_SETS)}, got {name!r}") from None


#: Of the body's sides and the camera's path in markers and the viewer, RGB 0 to 255; the report has its own themes.
COLOURS = {"left": (36, 112, 163), "right": (191, 56, 43), "middle": (90, 90, 90), "path": (51, 179, 77)}


def side_of(joint: str, joints: tuple[str, ...]) -> str:
    """Body side of a joint by its name, "left", "right" or "middle"; both sides must be among ``joints``."""
    for own, other, side in (
        ("l", "r", "left"),
        ("r", "l", "right"),
        ("left_", "right_", "left"),
        ("right_", "left_", "right"),
    ):
        if joint.startswith(own) and other + joint[len(own) :] in joints:
            return side
    return "middle"


def indices(joints: tuple[str, ...] | list[str], wanted: tuple[str, ...]) -> np.ndarray:
    """(len(wanted),) int, indices of the wanted joints in ``joints``."""
    place = {name: i for i, name in enumerate(joints)}
    missing = [name for name in wanted if name not in place]
    if missing:
        raise InputError(f"joints: expected {', '.join(wanted)}; missing {', '.join(missing)}; rename or add them")
    return np.array([place[name] for name in wanted])


def in_body_order(values: np.ndarray, joints: tuple[str, ...] | list[str], required: tuple[str, ...]) -> np.ndarray:
    """Values (F, P, D) of named joints as (F, 17, D) of ``BODY_17``; NaN for a missing joint that is not required.

    A missing pelvis is the middle of the hips.
    """
    indices(joints, required)
    out = np.full((len(values), len(BODY_17), values.shape[2]), np.nan)
    for row, name in enumerate(BODY_17.joints):
        if name in joints:
            out[:, row] = values[:, list(joints).index(name)]
    if "pelvis" not in joints:
        out[:, BODY_17.index("pelvis")] = out[:, indices(BODY_17.joints, ("rhip", "lhip"))].mean(axis=1)
    return out


def body_set(joints: JointSet) -> bool:
    """Whether a set is ``BODY_15`` or begins with it: joints then have their places in every such set."""
    return joints.joints[: len(BODY_15)] == BODY_15.joints


#: Shares of the way from the middle of the shoulders to the middle of the ears.
_NECK_ON_EARS = 135 / 190
_HEAD_ON_EARS = 232 / 190  # likewise
#: Standard deviation of neck and head about that line, share of the same way: 20 and 25 mm of 190.
_NECK_SPREAD = 0.11
_HEAD_SPREAD = 0.14  # likewise
#: The same of the head about the line from neck to crown: 21 mm of 175.
_CROWN_SPREAD = 0.12
#: Distance of the shoulders' centres over that of the drawn ones, in the pictures of three phone videos with optical
#: MoCap: 1.17, 1.19, 1.23, the camera fitted to the other joints.
SHOULDERS_OUTWARDS = 1.2

_SIDES = (("l", "left_"), ("r", "right_"))
_LIMBS = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")

Weights = dict[str, float]

_SHOULDERS: Weights = {"left_shoulder": 0.5, "right_shoulder": 0.5}
_BOTH_EARS: Weights = {"left_ear": 0.5, "right_ear": 0.5}


def _mix(start: Weights, end: Weights, share: float) -> Weights:
    total = {name: (1 - share) * w for name, w in start.items()}
    for name, w in end.items():
        total[name] = total.get(name, 0.0) + share * w
    return total


def _limbs_by_side() -> dict[str, Weights]:
    return {short + part: {long + part: 1.0} for short, long in _SIDES for part in _LIMBS}


def _coco_like() -> dict[str, Weights]:
    return _limbs_by_side() | {
        "pelvis": {"left_hip": 0.5, "right_hip": 0.5},
        "neck": _mix(_SHOULDERS, _BOTH_EARS, _NECK_ON_EARS),
        "head": _mix(_SHOULDERS, _BOTH_EARS, _HEAD_ON_EARS),
    }


#: Tips of the big toes, and heels.
_FEET: dict[str, Weights] = {
    f"{short}{ours}": {f"{long}{theirs}": 1.0}
    for short, long in _SIDES
    for ours, theirs in (("toe", "big_toe"), ("heel", "heel"))
}

#: Joint of the body -> weights of the network's joints; they sum to 1.
TABLES: dict[str, dict[str, Weights]] = {
    **{body.name: {name: {name: 1.0} for name in body.joints} for body in (BODY_15, BODY_17, BODY_19)},
    "coco17": _coco_like(),
    "wholebody133": _coco_like() | _FEET,
    "halpe26": _coco_like() | _FEET,
    "coco21": _coco_like() | _FEET,
    # MPII's upper neck is BODY_15's neck; the crown lies about 310 mm above the middle of the shoulders.
    "mpii16": {
        **_limbs_by_side(),
        "pelvis": {"left_hip": 0.5, "right_hip": 0.5},
        "neck": {"upper_neck": 1.0},
        "head": _mix({"upper_neck": 1.0}, {"head_top": 1.0}, (232 - 135) / (310 - 135)),
    },
    "h36m17": {name: {name: 1.0} for name in BODY_15.joints},
}

#: Line whose length scales the extra variance of an extrapolated joint: from, to, spread.
_Line = tuple[Weights, Weights, float]
_EARS: dict[str, _Line] = {
    joint: (_SHOULDERS, _BOTH_EARS, spread) for joint, spread in (("neck", _NECK_SPREAD), ("head", _HEAD_SPREAD))
}
_EXTRA: dict[str, dict[str, _Line]] = {
    **dict.fromkeys(("coco17", "coco21", "wholebody133", "halpe26"), _EARS),
    "mpii16": {"head": ({"upper_neck": 1.0}, {"head_top": 1.0}, _CROWN_SPREAD)},
}
#: Sets whose shoulders are drawn as COCO's annotators draw them; of the others nothing was measured.
_DRAWN_INSIDE = ("coco17", "wholebody133", "halpe26")


@dataclass(frozen=True)
class JointMap:
    """Linear map of one joint set to the body's joints.

    joints : the B joints of the result, ``BODY_15`` at least
    weights : (B, P), rows summing to 1
    lines : (B, P), rows summing to 0: the line that scales the extra spread, 0 where there is none
    spread : (B,) standard deviation as a share of the line's length
    outwards : (B, P), rows summing to 0: what is added where all its parts are seen, 0 for most joints
    """

    joints: JointSet
    weights: np.ndarray
    lines: np.ndarray
    spread: np.ndarray
    outwards: np.ndarray

    def apply(
        self, xy: np.ndarray, covariance: np.ndarray, confidence: np.ndarray, box_size: float | np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Keypoints (..., P, 2) px, covariance (..., P, 3) px^2 and confidence (..., P) -> the same for ``joints``.

        A joint is NaN, its confidence 0, where one of its parts is NaN.  The line's length is at least 5 % of
        ``box_size`` (...) px: a view from above shortens the line, not the uncertainty of the head.
        """
        out, out_confidence = self.places(xy, confidence)
        points, moved, shift = self._shifted(xy)
        # The errors of the parts are assumed independent.
        parts = np.where(moved, self.weights + self.outwards, self.weights)
        out_covariance = parts**2 @ np.nan_to_num(covariance)
        # People and views differ more than these videos.
        out_covariance += 0.5**2 * shift[..., [0, 0, 1]] * shift[..., [0, 1, 1]]
        # Least length of the line, share of the person's box: a view from above shortens it.
        length = np.maximum(np.linalg.norm(self.lines @ points, axis=-1), 0.05 * np.asarray(box_size)[..., None])
        extra = np.where(self.spread > 0, (self.spread * length) ** 2, 0.0)
        out_covariance = out_covariance + extra[..., None] * np.array([1.0, 0.0, 1.0])
        out_covariance[np.isnan(out[..., 0])] = np.nan
        return out, out_covariance, out_confidence

    def places(self, xy: np.ndarray, confidence: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Keypoints and confidence of :meth:`apply`, without the work for the covariance."""
        used = self.weights != 0
        known = ~(used & ~np.isfinite(xy).all(axis=-1)[..., None, :]).any(axis=-1)
        points, _, shift = self._shifted(xy)
        out = np.where(known[..., None], self.weights @ points + shift, np.nan)
        lowest = np.where(used, np.nan_to_num(confidence)[..., None, :], np.inf).min(axis=-1)
        # The lean of the head is not seen.
        out_confidence = np.where(self.spread > 0, 0.85, 1.0) * lowest
        return out, np.where(known, out_confidence, 0.0)

    def _shifted(self, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Keypoints without NaN, which joints (..., B, 1) are moved outwards, and how far (..., B, 2) px."""
        points = np.nan_to_num(xy)
        seen = np.isfinite(xy).all(axis=-1)
        # A shoulder whose partner is not seen stays where it is drawn.
        moved = ~((self.outwards != 0) & ~seen[..., None, :]).any(axis=-1, keepdims=True)
        return points, moved, np.where(moved, self.outwards @ points, 0.0)


def joint_set_of(names: Sequence[str]) -> tuple[JointSet, np.ndarray]:
    """The joint set whose map gives most joints of the body from these names, and its names' places (P,), -1 = none.

    The spelling is free: ``left_shoulder``, ``leftShoulder`` and ``Left shoulder`` are one name.
    """
    place = {re.sub(r"(?<=[a-z])(?=[A-Z])|[\s-]+", "_", name).lower(): i for i, name in enumerate(names)}
    given = {name: sum(set(parts) <= place.keys() for parts in table.values()) for name, table in TABLES.items()}
    best = JOINT_SETS[max(given, key=lambda name: given[name])]
    return best, np.array([place.get(joint, -1) for joint in best.joints])


@cache
def joint_map(skeleton: str) -> JointMap:
    """Map of a joint set to those joints of the body that it gives."""
    from drocap_ros.skeleton import joint_set

    if skeleton not in TABLES:
        raise InputError(
            f"skeleton: expected one of {', '.join(TABLES)}, got {skeleton!r}; add a table to joint_maps.py"
        )
    source = joint_set(skeleton)
    joints = next(body for body in (BODY_15, BODY_17, BODY_19) if len(body) == len(TABLES[skeleton]))
    weights = np.zeros((len(joints), len(source)))
    lines = np.zeros_like(weights)
    spread = np.zeros(len(joints))
    for row, joint in enumerate(joints.joints):
        for name, weight in TABLES[skeleton][joint].items():
            weights[row, source.index(name)] = weight
        if joint in _EXTRA.get(skeleton, {}):
            start, end, spread[row] = _EXTRA[skeleton][joint]
            for name, weight in _mix({n: -w for n, w in start.items()}, {}, 0.0).items():
                lines[row, source.index(name)] = weight
            for name, weight in end.items():
                lines[row, source.index(name)] = weight
    outwards = np.zeros_like(weights)
    if skeleton in _DRAWN_INSIDE:
        left, right = (source.index(f"{side}_shoulder") for side in ("left", "right"))
        for joint, mine, other in (("lshoulder", left, right), ("rshoulder", right, left)):
            outwards[joints.index(joint), [mine, other]] = 0.5 * (SHOULDERS_OUTWARDS - 1.0) * np.array([1.0, -1.0])
    return JointMap(joints, weights, lines, spread, outwards)
