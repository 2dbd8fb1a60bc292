"""Names of joints in files, orders of 2D keypoints in public use, and which of them makes a body of nameless points."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.recording.keypoints.body_check import body_likelihood, is_no_body, limbs_of
from drocap_ros.skeleton import JOINT_SETS, LIMB_JOINTS

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


def _order(words: str) -> tuple[str, ...]:
    """Names of joints; ``L:hip,knee`` are those of one side, ``LR:hip,knee`` go from side to side."""
    names: list[str] = []
    for word in words.split():
        sides, _, parts = word.rpartition(":")
        names += [f"{s}_{p}" for p in parts.split(",") for s in sides] if sides else [word]
    return tuple(map(joint_name, names))


_ARM, _LEG, _FACE = "shoulder,elbow,wrist", "hip,knee,ankle", "RL:eye RL:ear"
_LIMBS = f"R:{_ARM} L:{_ARM} R:{_LEG} L:{_LEG}"
_SMPL = "pelvis LR:hip spine1 LR:knee spine2 LR:ankle spine3 LR:ball neck LR:collar head LR:shoulder LR:elbow LR:wrist"
_KINECT = f"L:{_ARM},palm R:{_ARM},palm L:{_LEG},ball R:{_LEG},ball"
#: Name of an order -> its joints; of one with more points than names these are its first.
ORDERS: dict[str, tuple[str, ...]] = {
    **{name: JOINT_SETS[name].joints for name in ("coco17", "h36m17", "body17", "mpii16", "body15", "body19")},
    **{name: JOINT_SETS[name].joints for name in ("coco21", "halpe26", "wholebody133")},
    "coco18": (*JOINT_SETS["coco17"].joints, "neck"),
    "coco23": JOINT_SETS["wholebody133"].joints[:23],
    "halpe136": JOINT_SETS["halpe26"].joints,
    "openpose25": _order(
        f"nose neck R:{_ARM} L:{_ARM} hip R:{_LEG} L:{_LEG} {_FACE} L:big_toe,small_toe,heel R:big_toe,small_toe,heel"
    ),
    "openpose25b": _order(
        "nose LR:eye,ear,shoulder,elbow,wrist,hip,knee,ankle neck head_top L:big_toe,small_toe,heel"
        " R:big_toe,small_toe,heel"
    ),
    "openpose19": _order(f"nose neck R:{_ARM} L:{_ARM} hip R:{_LEG} L:{_LEG} {_FACE}"),
    "openpose18": _order(f"nose neck {_LIMBS} {_FACE}"),
    "openpose15": _order(f"head_top neck {_LIMBS} chest"),
    "mediapipe33": _order(
        "nose L:eye_inner,eye,eye_outer R:eye_inner,eye,eye_outer LR:ear,mouth,shoulder,elbow,wrist,pinky,index,thumb,"
        "hip,knee,ankle,heel,big_toe"
    ),
    "mpi3dhp17": _order(f"head_top neck {_LIMBS} hip spine head"),
    "h36m16": tuple(name for name in JOINT_SETS["h36m17"].joints if name != "neck"),
    "h36m32": _order(
        f"pelvis R:{_LEG},ball,toe_end L:{_LEG},ball,toe_end spine thorax neck_base head crown"
        f" L:collar,{_ARM},thumb,a,b,c R:collar,{_ARM},thumb,a,b,c"
    ),
    "lsp14": _order("R:ankle,knee,hip L:hip,knee,ankle R:wrist,elbow,shoulder L:shoulder,elbow,wrist neck head_top"),
    "crowdpose14": _order("LR:shoulder,elbow,wrist,hip,knee,ankle head_top neck"),
    "aichallenger14": _order(f"{_LIMBS} head_top neck"),
    "panoptic19": _order(f"neck nose hip L:{_ARM},{_LEG} R:{_ARM},{_LEG} L:eye,ear R:eye,ear"),
    "itop15": _order("head neck RL:shoulder,elbow,wrist torso RL:hip,knee,ankle"),
    "smpl22": _order(_SMPL),
    "smpl24": _order(f"{_SMPL} LR:palm"),
    "kinect20": _order(f"hip spine neck_base head {_KINECT}"),
    "kinect25": _order(f"hip spine neck head {_KINECT} neck_base L:finger,thumb R:finger,thumb"),
    "kinect32": _order(
        f"pelvis spine chest neck L:collar,{_ARM},palm,finger,thumb R:collar,{_ARM},palm,finger,thumb L:{_LEG},ball"
        f" R:{_LEG},ball head nose L:eye,ear R:eye,ear"
    ),
}
#: Points of an order where they are more than its names.
_COUNTS = {"halpe136": 136}


def counts() -> list[int]:
    """Numbers of points that some order has."""
    return sorted({_count(name) for name in ORDERS})


def _count(name: str) -> int:
    return _COUNTS.get(name, len(ORDERS[name]))


def orders_of(count: int) -> list[str]:
    """Names of the orders of so many points."""
    return [name for name in ORDERS if _count(name) == count]


def order_named(text: str, count: int) -> str:
    """The order of ``count`` points with a name, or with a begin of one."""
    wanted = re.sub(r"[\W_]+", "", text.lower())
    known = orders_of(count)
    found = [wanted] if wanted in known else [name for name in known if name.startswith(wanted)]
    if len(found) != 1:
        raise InputError(f"--order {text}: expected an order of {count} points ({', '.join(known) or 'none known'})")
    return found[0]


def name_points(xy: np.ndarray, stated: Sequence[str], wanted: str | None, tool: str) -> tuple[tuple[str, ...], str]:
    """Names of points (F, P, 2), or of their first, and words on what was taken and is doubtful.

    The user's order ``wanted`` comes first, then the file's names ``stated``, else the order among those of its
    ``tool`` that makes a body; where none does by a clear margin, the file is refused.
    """
    count = xy.shape[1]
    if wanted is not None:
        return ORDERS[order_named(wanted, count)], ""
    # Limb joints among stated names from which these are a body's.
    if len(stated) == count and len(limbs_of(names := names_of(stated))) >= 4:
        return names, _turned(xy, names) if is_no_body(xy, names) else ""
    known = [name for name in orders_of(count) if name.startswith(tool)] or orders_of(count)
    if not known:
        raise InputError(f"expected points with names, or {', '.join(map(str, counts()))} of them, found {count}")
    scores = sorted(((body_likelihood(xy, ORDERS[name]), name) for name in known), reverse=True)
    (best, name), others = scores[0], [s for s, other in scores[1:] if not _same_limbs(other, scores[0][1])]
    # Least leads of the likelihood over that of the points upside down, and of another order.
    if body_likelihood(xy * [1.0, -1.0], ORDERS[name]) > best + 0.5:
        raise InputError(f"expected y downwards, found a person upside down (order {name}); turn y, or {_say(known)}")
    if (others and best < others[0] + 0.25) or is_no_body(xy, ORDERS[name], strict=True):
        raise InputError(
            f"expected the names of {count} joints, found none, and no known order that clearly makes a body of them;"
            f" {_turned(xy, ORDERS[name]) or 'name the joints in the file'}, or {_say(known)}"
        )
    more = ", ".join(other for other in known if other != name)
    words = f"{count} points without names: taken in the order {name}, which makes a body"
    return ORDERS[name], f"{words} ({more}: no); --order NAME chooses another" if more else words


def _turned(xy: np.ndarray, names: Sequence[str]) -> str:
    """Words where points are a body's with x and y exchanged, as MoveNet and ViTPose write them."""
    is_one = not is_no_body(xy[..., ::-1], names, strict=True)
    return "x and y exchanged make a body of them: exchange them in the file" if is_one else ""


def _say(known: Sequence[str]) -> str:
    return f"--order NAME, of {', '.join(known)}"


def _same_limbs(one: str, other: str) -> bool:
    """Whether two orders have the limbs in the same places."""
    mine, its = (limbs_of(ORDERS[name]) for name in (one, other))
    return all(mine.get(joint) == its.get(joint) for joint in LIMB_JOINTS)


def names_of(stated: Sequence[str]) -> tuple[str, ...]:
    """Our names of a file's joints; a foot stands for an ankle where no other name does, as in Human3.6M."""
    names = [joint_name(name) for name in stated]
    for part, other in (("ankle", "foot"), ("wrist", "palm")):
        names = [f"{n[: -len(other)]}{part}" if n.endswith(f"_{other}") and f"{n[: -len(other)]}{part}" not in names
                 else n for n in names]  # fmt: skip
    if {"thorax", "head"} <= set(names) and not {"nose", "left_eye", "left_ear"} & set(names):
        names = [_HUMAN36M.get(name, re.sub(r"^(l|r)(?:eft|ight)_(?=\w+$)", r"\1", name)) for name in names]
    taken: set[str] = set()
    for i, name in enumerate(names):  # a hand beside a wrist keeps its own name
        names[i] = name if name not in taken else f"{stated[i]}_{i}"
        taken.add(names[i])
    return tuple(names)


#: Names of Human3.6M's other joints.
_HUMAN36M = {"root": "pelvis", "hip": "pelvis", "neck_base": "neck", "jaw": "neck"}
