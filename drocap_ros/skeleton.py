"""Named joint sets and their bones.

``BODY_17`` is the set of the default method's 3D results, ``BODY_15`` (its first fifteen joints) that of the paper's
methods; ``BODY_19`` adds the heels where a 2D network sees them.  Each set begins with the joints of the one before.
The joints follow the MoCap convention of Human3.6M: ``pelvis`` is the middle of the hips, ``neck`` the top of the neck
(not the line of the shoulders), ``head`` the middle of the skull's upper half, ``rtoe`` and ``ltoe`` the tips of the
big toes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

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
        return np.array([self.joints.index(_other_side(j, self.joints)) for j in self.joints])


def _names(words: str) -> tuple[str, ...]:
    return tuple(words.split())


def _other_side(joint: str, joints: tuple[str, ...]) -> str:
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


#: Colour of a body side in markers and in the viewer, RGB 0 to 255; the report's page has its own light and dark theme.
SIDE_COLOURS = {"left": (36, 112, 163), "right": (191, 56, 43), "middle": (90, 90, 90)}


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
