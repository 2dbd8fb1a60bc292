"""The newest pose as an avatar's bones: rotations against a T pose, one pose after the other (docs/live_out.md)."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from drocap_ros.export.rig import AGAINST, SOLE, TWIST_FADE_S, bone_rotations, jumps, rest_offsets, shortest_arc
from drocap_ros.export.rigid_body import PARENTS, LiveBody
from drocap_ros.skeleton import indices

_LIMBS = {
    "hip": "UpperLeg", "knee": "LowerLeg", "ankle": "Foot",
    "collar": "Shoulder", "shoulder": "UpperArm", "elbow": "LowerArm", "wrist": "Hand",
}  # fmt: skip
_TRUNK = ("Hips", "Spine", "Chest", "UpperChest", "Neck", "Head")
#: Joint -> bone of Unity's HumanBodyBones that begins there, each after its parent.  Of toes only their tips are seen.
BONES = dict(zip(("pelvis", "spine", "chest", "upperchest", "thorax", "neck"), _TRUNK, strict=True)) | {
    side + joint: word + bone for side, word in (("l", "Left"), ("r", "Right")) for joint, bone in _LIMBS.items()
}
_JOINTS = tuple(BONES)
#: Index of each bone's parent, -1 of the hips.
BONE_PARENTS = (-1, *(_JOINTS.index(PARENTS[joint]) for joint in _JOINTS[1:]))
#: Joints without which there is no pose: an avatar's hips and chest.
_NEEDED = ("pelvis", "lhip", "rhip", "lshoulder", "rshoulder")
_ANKLES = ("lankle", "rankle")
#: Lengths are medians over so many poses, found anew after each part of them.
_LENGTHS_OF, _RENEWED_AFTER = 300, 30
#: A twist below this, rad, is none.
_NO_TWIST = 1e-4
#: Mirror from our axes (y up, rest pose faces +z, left at +x) to Unity's, which are left-handed (left at -x).
_UNITY = np.array([-1.0, 1.0, 1.0])
_UNITY_ROTATION = np.array([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class AvatarPose:
    """One pose of the bones :data:`BONES`; y up, m, right-handed; the rest pose is a T that faces +z, left at +x.

    place : (3,) of the hips
    offsets : (J, 3) of each bone from its parent in the rest pose; of the hips 0
    rotations : (J, 4) of each bone relative to its parent, x y z w, identity at rest; of the hips in the world
    """

    place: np.ndarray
    offsets: np.ndarray
    rotations: np.ndarray

    def positions(self) -> np.ndarray:
        """(J, 3) of the bones, by forward kinematics as receivers do it."""
        out, turned = np.zeros((len(_JOINTS), 3)), [Rotation.from_quat(q) for q in self.rotations]
        out[0] = self.place
        for bone, parent in enumerate(BONE_PARENTS[1:], start=1):
            out[bone] = out[parent] + turned[parent].apply(self.offsets[bone])
            turned[bone] = turned[parent] * turned[bone]
        return out

    def unity(self) -> AvatarPose:
        """The same in Unity's axes: left-handed, y up, the rest pose faces +z, left at -x."""
        return AvatarPose(self.place * _UNITY, self.offsets * _UNITY, self.rotations * _UNITY_ROTATION)


def y_up_of(joints3d: np.ndarray, up: np.ndarray | None = None) -> np.ndarray:
    """(P, 3) with z up -> y up; those of a camera's optical frame with its direction (3,) ``up`` -> y up, leveled.

    Who faces the camera faces +z.
    """
    if up is None:
        return np.asarray(joints3d[:, [0, 2, 1]] * np.array([1.0, 1.0, -1.0]))
    level = np.array([1.0, -1.0, -1.0])
    return np.asarray(shortest_arc((up * level)[None], np.array([[0.0, 1.0, 0.0]])).apply(joints3d * level))


def up_of_pitch(pitch_rad: float) -> np.ndarray:
    """(3,) direction up in the optical frame of a camera of a pitch, negative = down, without roll."""
    return np.array([0.0, -np.cos(pitch_rad), np.sin(pitch_rad)])


class LiveRig:
    """Turns the poses of one person, as they come, into an avatar's; the rules are those of the export's rig.

    A bone is at rest while an end of it was never seen, or has no position.
    """

    def __init__(self, joints: tuple[str, ...]) -> None:
        self._joints = joints
        self._poses: deque[np.ndarray] = deque(maxlen=_LENGTHS_OF)
        self._count = 0
        self._seen = np.zeros(len(joints), bool)
        self._twists: dict[str, tuple[np.ndarray, float]] = {}
        self._stamp_ns = 0

    def pose(
        self, positions: np.ndarray, confidence: np.ndarray, stamp_ns: int, *, on_floor: bool = False
    ) -> AvatarPose | None:
        """The next pose; None where hips or shoulders are unknown.

        positions : (P, 3) m, y up, NaN where unknown
        confidence : (P,), 0 of what the image does not show
        on_floor : the lowest joint is put on the floor: the height of the pelvis is not known
        """
        if not np.isfinite(positions[indices(self._joints, _NEEDED)]).all():
            return None
        self._seen |= confidence > 0
        self._poses.append(positions)
        if self._count % _RENEWED_AFTER == 0:
            past = np.array(self._poses)
            self._body = LiveBody(past, self._joints, np.isfinite(past).all(axis=2))
            self._offsets = rest_offsets(self._body.posed(positions[None]), 0.0)
        self._count += 1
        known = np.isfinite(positions).all(axis=1) & self._seen
        self._shown = {name for name, yes in zip(self._joints, known, strict=True) if yes}
        self._fade = np.exp(-1e-9 * max(stamp_ns - self._stamp_ns, 0) / TWIST_FADE_S)
        self._stamp_ns = stamp_ns
        body = self._body.posed(positions[None])
        turned = bone_rotations(body, self._offsets, self._swing)
        world = Rotation.concatenate([turned[joint] for joint in _JOINTS])
        local = world[list(BONE_PARENTS)].inv() * world
        rotations = np.concatenate([world[:1].as_quat(), local[1:].as_quat()])
        pose = AvatarPose(body.positions[0, 0].copy(), np.array([self._offsets[joint] for joint in _JOINTS]), rotations)
        if on_floor:
            heights = pose.positions()[:, 1]
            soles = heights[[_JOINTS.index(ankle) for ankle in _ANKLES]] - SOLE * body.lengths[_ANKLES[0]]
            pose.place[1] -= min(heights.min(), soles.min())
        return pose

    def _swing(self, end: str, rest: np.ndarray, direction: np.ndarray) -> Rotation:
        """As :func:`~drocap_ros.export.rig.least_rotation`, of one pose after those before it."""
        ends = (end, PARENTS[end])
        if any(joint in self._joints and joint not in self._shown for joint in ends):
            self._twists.pop(end, None)
            return Rotation.identity(1)
        before, twist = self._twists.get(end, (direction[0], 0.0))
        both = np.stack([before, direction[0]])
        swing = shortest_arc(np.broadcast_to(rest, both.shape), both)
        if (both @ rest).min() < AGAINST:
            twist += float(jumps(rest, both, swing)[0])
        twist *= self._fade
        self._twists[end] = (direction[0], twist)
        return swing[1:] * Rotation.from_rotvec(twist * rest) if abs(twist) > _NO_TWIST else swing[1:]
