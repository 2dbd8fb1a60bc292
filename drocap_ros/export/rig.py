"""An animation skeleton on the fitted rigid body: names, rest pose, joint rotations, feet on the floor.

A bone has the smallest rotation relative to its parent that brings it from its rest direction into its direction:
positions do not show the twist of forearms, thighs and other bones about their own axis.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from drocap_ros.errors import InputError
from drocap_ros.export.rigid_body import BODY, PARENTS, RigidBody, fit_rigid_body
from drocap_ros.export.take import ROOT_MOVES_M, Take, without_gaps
from drocap_ros.geometry.alignment import directions
from drocap_ros.geometry.rotations import exp_so3, log_so3
from drocap_ros.skeleton import BODY_15, TOES

#: Fading time of the twist that keeps a rotation continuous where a bone points against its rest direction.
TWIST_FADE_S = 0.5
#: Cosine between a bone and its rest direction below which the smallest rotation turns too fast.
AGAINST = -0.7
#: Rest poses: angle of the arms below the horizontal, degrees.
RESTS = {"t": 0.0, "a": 45.0}

_LAFAN1 = (
    "Hips", "LeftUpLeg", "LeftLeg", "LeftFoot", "LeftToe", "RightUpLeg", "RightLeg", "RightFoot", "RightToe",
    "Spine", "Spine1", "Spine2", "Neck", "Head", "", "LeftShoulder", "LeftArm", "LeftForeArm", "LeftHand",
    "RightShoulder", "RightArm", "RightForeArm", "RightHand",
)  # fmt: skip
_MIXAMO = {"LeftToe": "LeftToeBase", "RightToe": "RightToeBase", "": "HeadTop_End"}
#: Naming -> name of each joint of :data:`BODY`; without a name it is the end of its parent's bone.
NAMES = {
    "h36m": dict(zip(BODY, BODY, strict=True)),
    "lafan1": dict(zip(BODY, _LAFAN1, strict=True)),
    "mixamo": {joint: "mixamorig:" + _MIXAMO.get(name, name) for joint, name in zip(BODY, _LAFAN1, strict=True)},
}
# As three.js itself calls Mixamo's joints: a colon ends a name there.
NAMES["mixamo-three"] = {joint: name.replace(":", "") for joint, name in NAMES["mixamo"].items()}
#: Assumed sizes as shares of the shank: the foot's length from below the ankle to the toes, the ankle's height.
_FOOT = 0.45
SOLE = 0.16  # of the shank; assumed
#: Length of a hand as a share of the forearm; of what the head's joint is below the crown, of neck to head; assumed.
_HAND = 0.7
_CROWN = 0.9  # of neck to head; assumed


@dataclass(frozen=True)
class Rig:
    """Constant skeleton and its pose in each frame; y up, m; rest pose faces +z, left at +x, soles at y = 0.

    names : J joint names, each after its parent
    joints : J, the same joints as named in :data:`~drocap_ros.export.rigid_body.BODY`
    parents : J indices, -1 at the root, which is the first
    rest : (J, 3) positions in the rest pose
    ends : index of a last joint -> (3,) end of its bone relative to it in the rest pose
    root : (F, 3) positions of the root
    turned : J rotations (F,) from the rest pose to the world
    """

    names: tuple[str, ...]
    joints: tuple[str, ...]
    parents: tuple[int, ...]
    rest: np.ndarray
    ends: dict[int, np.ndarray]
    root: np.ndarray
    turned: tuple[Rotation, ...]

    def positions(self) -> np.ndarray:
        """(F, J, 3) joints by forward kinematics."""
        out = np.empty((len(self.root), len(self.parents), 3))
        out[:, 0] = self.root
        for joint, parent in enumerate(self.parents[1:], start=1):
            out[:, joint] = out[:, parent] + self.turned[parent].apply(self.rest[joint] - self.rest[parent])
        return out

    def local(self, joint: int) -> Rotation:
        """(F,) rotations of a joint relative to its parent."""
        parent = self.parents[joint]
        return self.turned[joint] if parent < 0 else self.turned[parent].inv() * self.turned[joint]


def rig_of(take: Take, *, names: str = "h36m", rest: str = "t") -> tuple[Rig, tuple[str, ...]]:
    """Rig of a take, and notes on the changes.

    take : y up; gaps are interpolated
    names : one of :data:`NAMES`
    rest : one of :data:`RESTS`
    """
    for option, value, table in (("names", names, NAMES), ("rest", rest, RESTS)):
        if value not in table:
            raise InputError(f"{option}: expected one of {', '.join(table)}, got {value!r}")
    body, notes = body_of(take)
    pelvis = take.positions[:, take.joints.index("pelvis")]
    lift, floor_note = onto_the_floor(body, pelvis)
    rig = _rig(body, take.rate_hz, lift, NAMES[names], rest)
    if not set(TOES) <= set(body.joints):
        notes = (*notes, "no toes in the motion: each foot is assumed, square to its shank")
    return rig, (*notes, floor_note)


def body_of(take: Take) -> tuple[RigidBody, tuple[str, ...]]:
    """Rigid body of a take, y up, with its gaps interpolated, and notes on the changes."""
    known = np.isfinite(take.positions).all(axis=2)
    take = without_gaps(take)
    body = fit_rigid_body(take.positions, take.joints, known)
    common = [name for name in take.joints if name in (*BODY_15.joints, *TOES) and name in body.joints]
    off = np.stack([body.at(name) for name in common], axis=1)
    off -= take.positions[:, [take.joints.index(name) for name in common]]
    moved = 1000.0 * np.linalg.norm(off, axis=2)
    notes = [
        *take.notes,
        f"bones made constant: joints moved by {moved.mean():.1f} mm on average, at most {moved.max():.1f} mm",
    ]
    if left := [name for name in take.joints if name not in common]:
        notes.append(f"left out, not in the rigid body: {', '.join(left)}")
    return body, tuple(notes)


def onto_the_floor(body: RigidBody, pelvis: np.ndarray) -> tuple[np.ndarray, str]:
    """(F,) heights to add, and a note.

    pelvis : (F, 3) m of the motion, NaN where unknown

    A moving root has one constant: the floor is a low percentile of the lower sole.  A root that stands still has no
    known height: in each frame the lowest of soles and joints is on the floor, in a flip or on the back not a sole.
    """
    ends = TOES if set(TOES) <= set(body.joints) else ("rankle", "lankle")
    soles = [body.at(end)[:, 1] - (0.0 if end in TOES else SOLE * body.lengths[end]) for end in ends]
    lower = np.min(soles, axis=0)
    if (np.nanmax(pelvis, axis=0) - np.nanmin(pelvis, axis=0)).max() <= ROOT_MOVES_M:
        lowest = np.minimum(lower, body.positions[..., 1].min(axis=1))
        return -lowest, "no root motion known: in each frame the lowest of soles and joints is on the floor"
    # Percentile of the lower foot's height that is the floor: the lowest would be an error of one frame.
    floor = float(np.percentile(lower, 5.0))
    way = "lowered" if floor > 0 else "raised"
    return np.full(len(lower), -floor), f"floor at 0: {way} by {abs(floor):.3f} m so that the feet stand on it"


def _rig(body: RigidBody, rate_hz: float, lift: np.ndarray, naming: dict[str, str], rest: str) -> Rig:
    offsets = rest_offsets(body, RESTS[rest])
    turned = bone_rotations(body, offsets, lambda _, at_rest, now: least_rotation(at_rest, now, rate_hz))
    kept = _kept_joints(body, naming)
    parents = (-1, *(kept.index(PARENTS[joint]) for joint in kept[1:]))
    tips = _tips(offsets)
    return Rig(
        names=tuple(naming[joint] for joint in kept),
        joints=kept,
        parents=parents,
        rest=_rest_positions(kept, parents, offsets, SOLE * body.lengths["lankle"]),
        ends={i: tips[joint] for i, joint in enumerate(kept) if i not in parents},
        root=body.positions[:, 0] + lift[:, None] * (0.0, 1.0, 0.0),
        turned=tuple(turned[joint] for joint in kept),
    )


def _kept_joints(body: RigidBody, naming: dict[str, str]) -> tuple[str, ...]:
    """Joints with a name; an assumed toe is one only where the naming is not complete without it."""
    assumed = TOES if naming is NAMES["h36m"] and not set(TOES) <= set(body.joints) else ()
    return tuple(joint for joint in BODY if naming[joint] and joint not in assumed)


def _rest_positions(
    kept: tuple[str, ...], parents: tuple[int, ...], offsets: dict[str, np.ndarray], ankle_m: float
) -> np.ndarray:
    """(J, 3) of the joints in the rest pose, the ankles at their height above the floor."""
    positions = np.zeros((len(kept), 3))
    for i, parent in enumerate(parents[1:], start=1):
        positions[i] = positions[parent] + offsets[kept[i]]
    positions[:, 1] += ankle_m - positions[kept.index("lankle"), 1]
    return positions


def _tips(offsets: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Joint that may end a chain -> (3,) end of its bone relative to it in the rest pose."""
    tips = {"head": _CROWN * offsets["head"], "neck": (1 + _CROWN) * offsets["head"]}
    for side in "lr":
        tips[side + "wrist"] = _HAND * offsets[side + "wrist"]
        tips[side + "ankle"] = offsets[side + "toe"]
        tips[side + "toe"] = 0.25 * offsets[side + "toe"] * (1, 0, 1)
    return tips


def rest_offsets(body: RigidBody, arms_down_deg: float) -> dict[str, np.ndarray]:
    """Offset of each joint of ``BODY`` from its parent in the rest pose."""
    cosine, sine = np.cos(np.radians(arms_down_deg)), np.sin(np.radians(arms_down_deg))
    toe = np.array([0.0, -SOLE, _FOOT]) * 0.5 * (body.lengths["lankle"] + body.lengths["rankle"])
    directions = {"shoulder": (1.0, 0.0, 0.0), "toe": tuple(toe / np.linalg.norm(toe))}
    directions |= dict.fromkeys(("knee", "ankle"), (0.0, -1.0, 0.0))
    directions |= dict.fromkeys(("neck", "head"), (0.0, 1.0, 0.0))
    directions |= dict.fromkeys(("elbow", "wrist"), (cosine, -sine, 0.0))
    out = {"pelvis": np.zeros(3), **body.fixed}
    for joint in set(BODY) - set(out):
        side = np.array([-1.0 if joint.startswith("r") else 1.0, 1.0, 1.0])
        direction = np.array(directions[joint if joint in directions else joint[1:]])
        out[joint] = body.lengths.get(joint, float(np.linalg.norm(toe))) * side * direction
    return out


def bone_rotations(
    body: RigidBody, offsets: dict[str, np.ndarray], swing: Callable[[str, np.ndarray, np.ndarray], Rotation]
) -> dict[str, Rotation]:
    """Joint of ``BODY`` -> rotations (F,) of its bones from the rest pose to the world.

    offsets : of :func:`rest_offsets`
    swing : rotations (F,) of the bone that ends at a joint from its rest direction (3,) to its directions (F, 3)
    """
    bend = log_so3(np.swapaxes(body.pelvis, 1, 2) @ body.chest)
    out = {
        joint: Rotation.from_matrix(body.pelvis @ exp_so3(share * bend))
        for joint, share in (("pelvis", 0.0), ("spine", 1 / 3), ("chest", 2 / 3), ("upperchest", 1.0))
    }
    for joint in BODY:
        if joint in out:
            continue
        above = out[PARENTS[joint]]
        child = next((c for c, parent in PARENTS.items() if parent == joint and c in body.joints), None)
        out[joint] = above
        if child is not None:
            rest = offsets[child] / np.linalg.norm(offsets[child])
            direction = directions(body.at(child) - body.at(joint))
            out[joint] = above * swing(child, rest, above.inv().apply(direction))
    return out


def least_rotation(rest: np.ndarray, direction: np.ndarray, rate_hz: float) -> Rotation:
    """Smallest rotations (F,) from ``rest`` (3,) to ``direction`` (F, 3), made continuous over time.

    Where a bone points against its rest direction, the smallest rotation is ambiguous and jumps; there the rotation
    continues from the previous frame, and the added twist fades out.
    """
    swing = shortest_arc(np.broadcast_to(rest, direction.shape), direction)
    if len(direction) < 2:
        return swing
    keep = float(np.exp(-1.0 / (rate_hz * TWIST_FADE_S)))
    twist = lfilter([keep], [1.0, -keep], np.concatenate([[0.0], jumps(rest, direction, swing)]))
    return swing * Rotation.from_rotvec(twist[:, None] * rest)


def jumps(rest: np.ndarray, direction: np.ndarray, swing: Rotation) -> np.ndarray:
    """(F - 1,) turns, rad, about ``rest`` that make each smallest rotation ``swing`` continue the one before.

    They are 0 where neither points against the rest direction.
    """
    carried = shortest_arc(direction[:-1], direction[1:]) * swing[:-1]
    quaternion = (swing[1:].inv() * carried).as_quat()
    jump = 2.0 * np.arctan2(quaternion[:, :3] @ rest, quaternion[:, 3])
    jump = (jump + np.pi) % (2.0 * np.pi) - np.pi
    against = np.minimum(direction[1:] @ rest, direction[:-1] @ rest) < AGAINST
    return np.where(against, jump, 0.0)


def shortest_arc(a: np.ndarray, b: np.ndarray) -> Rotation:
    """Smallest rotations (F,) from unit vectors ``a`` (F, 3) to ``b`` (F, 3)."""
    axis, cosine = np.cross(a, b), np.sum(a * b, axis=1)
    opposite = cosine < -1.0 + 1e-12
    if opposite.any():  # half a turn about any perpendicular axis
        across = np.cross(a, np.where(np.abs(a[:, :1]) < 0.7, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
        axis = np.where(opposite[:, None], across, axis)
    quaternion = np.concatenate([axis, 1.0 + cosine[:, None]], axis=1)
    quaternion[opposite, 3] = 0.0
    return Rotation.from_quat(quaternion)
