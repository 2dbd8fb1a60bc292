"""Joints of other tools' 2D keypoints by our names: sets by their number of points, and free spellings."""

from __future__ import annotations

import re

from drocap_ros.skeleton import JOINT_SETS

#: OpenPose's order of COCO's points, and BlazePose's points.
_ARMS = "nose neck r_shoulder r_elbow r_wrist l_shoulder l_elbow l_wrist"
_LEGS = "r_hip r_knee r_ankle l_hip l_knee l_ankle"
_FACE = "r_eye l_eye r_ear l_ear"
_BLAZE = (
    "nose l_eye_inner l_eye l_eye_outer r_eye_inner r_eye r_eye_outer l_ear r_ear l_mouth r_mouth l_shoulder r_shoulder"
    " l_elbow r_elbow l_wrist r_wrist l_pinky r_pinky l_index r_index l_thumb r_thumb l_hip r_hip l_knee r_knee"
    " l_ankle r_ankle l_heel r_heel l_big_toe r_big_toe"
)
#: Other words for a joint -> ours.
_PARTS = {
    "sho": "shoulder", "elb": "elbow", "wri": "wrist", "kne": "knee", "ank": "ankle",
    "hand": "wrist", "foot_index": "big_toe", "bigtoe": "big_toe", "toe": "big_toe", "smalltoe": "small_toe",
}  # fmt: skip


def joint_name(name: str) -> str:
    """Our name of a joint: ``RHip``, ``hip_R`` and ``Hip.right`` are ``right_hip``; ours stay."""
    if any(name in joints.joints for joints in JOINT_SETS.values()):
        return name
    spaced = re.sub(r"(?<=[a-z])(?=[A-Z])|(?<=^[LR])(?=[A-Z][a-z])", "_", name)
    words = [{"l": "left", "r": "right"}.get(word, word) for word in re.split(r"[\W_]+", spaced.lower()) if word]
    part = "_".join(word for word in words if word not in ("left", "right"))
    return "_".join([*(word for word in words if word in ("left", "right")), _PARTS.get(part, part)])


def _names(words: str) -> tuple[str, ...]:
    return tuple(map(joint_name, words.split()))


#: Number of points of a public network -> their names; Halpe's 136 begin with its 26.
NAMES_BY_COUNT = {
    **{len(s): s.joints for name in ("mpii16", "coco17", "halpe26", "wholebody133") for s in (JOINT_SETS[name],)},
    18: _names(f"{_ARMS} {_LEGS} {_FACE}"),
    25: _names(f"{_ARMS} hip {_LEGS} {_FACE} l_big_toe l_small_toe l_heel r_big_toe r_small_toe r_heel"),
    33: _names(_BLAZE),
    136: JOINT_SETS["halpe26"].joints,
}
