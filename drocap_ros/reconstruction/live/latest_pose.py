"""The newest pose at image rate: each image's initial pose with the bone lengths of the last adjusted window.

Only the lengths are taken over.  The newest poses of a window have no later images and err as much as initial poses,
and half a second on their errors differ.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from dataclasses import replace

import numpy as np

from drocap_ros.camera_path import CameraPath
from drocap_ros.geometry.alignment import bone_lengths
from drocap_ros.geometry.rotations import exp_so3, unpack_covariance
from drocap_ros.reconstruction.live.initializer import LivePose
from drocap_ros.reconstruction.live.window import AdjustedWindow
from drocap_ros.reconstruction.paper.normalize import MIN_JOINTS
from drocap_ros.reconstruction.world.world_model import MEASURED
from drocap_ros.skeleton import BODY_17

#: Images of the last half second (ns) have a say, in which a person moves straight on.
_PAST_NS = 5 * 10**8
#: Images that are kept, at most: a solution's ranges are compared over its last three seconds at 30 Hz.
_MOST_IMAGES = 90
#: Limits of the factor between ranges: people's statures differ by less.
_FACTORS = (0.8, 1.25)
#: Error (m) of the place that an image's pose leaves, over the speed (m/s) of a person who walks: 5 cm at 1 m/s.
_ERROR_OVER_SPEED_S = 0.05
#: Standard deviation (m) of the place across the line of sight; a judgement.
_ACROSS_M = 0.03


class _Blended:
    """A value that changes to each new one linearly within ``blend_s`` of stamps; None = there is none yet."""

    def __init__(self, blend_s: float) -> None:
        self._blend_ns = round(blend_s * 1e9)
        self.reset()

    def reset(self) -> None:
        """Forget the values."""
        self._before: np.ndarray | None = None
        self.newest: np.ndarray | None = None
        self._begin_ns = 0

    def set(self, value: np.ndarray, stamp_ns: int) -> None:
        """Change to a value from the image of a stamp on."""
        self._before, self.newest, self._begin_ns = self.at(stamp_ns), value, stamp_ns

    @property
    def first(self) -> bool:
        """Whether there was no value before the newest one."""
        return self._before is None

    def share(self, stamp_ns: int) -> float:
        """Share of the newest value at an image."""
        if not self._blend_ns:
            return 1.0
        return min(max((stamp_ns - self._begin_ns) / self._blend_ns, 0.0), 1.0)

    def at(self, stamp_ns: int) -> np.ndarray | None:
        """The value at an image."""
        if self.newest is None or self._before is None:
            return self.newest
        share = self.share(stamp_ns)
        return np.asarray((1.0 - share) * self._before + share * self.newest)


class LatestPlace:
    """Places rigid poses by the reported camera, with what the last solution says of both.

    The solution's corrections of the camera apply, and the factor between its ranges and those found here: initial
    poses know neither the lens nor the world, and lie some percent too near.  A new solution is blended in within
    ``blend_s``.
    """

    def __init__(self, blend_s: float) -> None:
        # (13,): correction of the camera (6), factor of the range, covariance (6, m^2) of the newest pelvis.
        self._solution = _Blended(blend_s)
        self.reset()

    def reset(self) -> None:
        """Forget the person and the solution."""
        self._solution.reset()
        self._past: deque[tuple[int, np.ndarray, np.ndarray]] = deque(maxlen=_MOST_IMAGES)
        self._ranges: OrderedDict[int, float] = OrderedDict()

    def set_solution(self, window: AdjustedWindow, stamp_ns: int) -> None:
        """Take a window's solution from the image of ``stamp_ns`` on."""
        if window.in_map is None or window.in_map.path:
            self._solution.reset()
            return
        correction, place = window.in_map.correction, window.covariance[-1, 0]
        self._solution.set(np.concatenate([correction, [self._factor(window)], place]), stamp_ns)

    def place(self, pose: LivePose, keypoints: np.ndarray, camera: CameraPath | None) -> LivePose | None:
        """The image's pose in ``map``; None without a solution there, the camera's pose or enough keypoints.

        pose : in camera axes
        keypoints : (P, 2) px, NaN where not seen
        camera : as reported at this image alone
        """
        joints, stamp_ns = pose.joints3d, pose.stamp_ns
        seen = np.isfinite(keypoints).all(axis=1)
        if camera is None or not camera.known[0] or not np.isfinite(joints).all() or seen.sum() < MIN_JOINTS:
            return None
        solution = self._solution.at(stamp_ns)
        correction = np.zeros(6) if solution is None else solution[:6]
        (turn, place), matrix = camera.pose, camera.matrix
        assert matrix is not None
        rotation: np.ndarray = exp_so3(correction[None, 3:])[0] @ turn[0]
        position = place[0] + correction[:3]
        body = joints @ rotation
        ray = np.column_stack([keypoints[seen] - matrix[:2, 2], np.full(seen.sum(), 1.0)])
        ray[:, :2] /= np.diagonal(matrix)[:2]
        ray = (ray / np.linalg.norm(ray, axis=1, keepdims=True)) @ rotation
        across = np.eye(3) - ray[:, :, None] * ray[:, None, :]
        target = (across @ (position - body[seen])[..., None])[..., 0]
        self._past.append((stamp_ns, across.mean(axis=0), target.mean(axis=0)))
        sight = self._root(stamp_ns) - position
        self._ranges[stamp_ns] = float(np.linalg.norm(sight))
        while len(self._ranges) > _MOST_IMAGES:
            self._ranges.popitem(last=False)
        if solution is None:
            return None
        root = position + solution[6] * sight
        covariance = _covariance(pose.covariance, rotation, sight) + solution[7:]
        return replace(pose, joints3d=root + body, covariance=covariance, rotation=rotation)

    def _root(self, now_ns: int) -> np.ndarray:
        """(3,) m, the pelvis now: least distances from all rays of the past, at a constant velocity."""
        while not 0 <= now_ns - self._past[0][0] <= _PAST_NS:
            self._past.popleft()
        ago = np.array([(stamp - now_ns) * 1e-9 for stamp, _, _ in self._past])
        across, target = (np.array([row[i] for row in self._past]) for i in (1, 2))
        time = np.stack([np.ones(len(ago)), ago], axis=1)
        matrix = np.einsum("fa,fb,fij->aibj", time, time, across).reshape(6, 6)
        matrix[3:, 3:] += _ERROR_OVER_SPEED_S**2 * np.eye(3)
        found: np.ndarray = np.linalg.lstsq(matrix, np.einsum("fa,fi->ai", time, target).reshape(6), rcond=1e-9)[0]
        return found[:3]

    def _factor(self, window: AdjustedWindow) -> float:
        """Factor from the ranges found here to those of the window, over the images that both have."""
        assert window.in_map is not None
        ranges = np.linalg.norm(window.joints3d[:, 0] - window.in_map.position, axis=1)
        both = [
            there / self._ranges[stamp]
            for stamp, there in zip(window.stamp_ns.tolist(), ranges.tolist(), strict=True)
            if stamp in self._ranges
        ]
        return float(np.clip(np.median(both), *_FACTORS)) if both else 1.0


def _covariance(packed: np.ndarray, rotation: np.ndarray, sight: np.ndarray) -> np.ndarray:
    """(P, 6) m^2 in ``map`` of a pose's covariances (P, 6) in camera axes, and of its place after the window.

    Along the line of sight the place is as uncertain as the scale of a window in ``map`` may be at most.
    """
    along = np.outer(sight, sight)
    place = _ACROSS_M**2 * (np.eye(3) - along / max(float(sight @ sight), 1e-12)) + MEASURED**2 * along
    full = rotation.T @ unpack_covariance(packed) @ rotation + place
    return np.asarray(full[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]])


_BONES = BODY_17.bones


def median_bone_lengths(joints: np.ndarray) -> np.ndarray:
    """Median length (16,) of each bone over the poses (F, 17, 3) of a window."""
    lengths: np.ndarray = np.median(bone_lengths(joints), axis=0)
    return lengths


class LatestPose:
    """Poses with the bone lengths of the last solution, blended in linearly within ``blend_s`` of stamps.

    From one image to the next, ``dt`` later, a new solution changes the length of a bone by no more than
    ``dt / blend_s`` of the difference between the solutions, and moves a joint by no more than the sum of that over
    the bones from the pelvis to it.  Before the first solution poses stay unchanged; it is blended in as well.
    """

    def __init__(self, blend_s: float) -> None:
        self._lengths = _Blended(blend_s)

    def reset(self) -> None:
        """Forget the person."""
        self._lengths.reset()

    @property
    def corrected(self) -> bool:
        """Whether a solution has arrived."""
        return self._lengths.newest is not None

    def set_solution(self, lengths: np.ndarray, stamp_ns: int) -> None:
        """Blend in a solution's bone lengths (16,) m from the image of ``stamp_ns`` on."""
        if np.isfinite(lengths).all():
            self._lengths.set(lengths, stamp_ns)

    def pose(self, stamp_ns: int, joints: np.ndarray) -> np.ndarray:
        """Joints (P, 3) m in camera axes, pelvis at the origin, from the image's initial ones; NaN stays NaN."""
        lengths = self._lengths.at(stamp_ns)
        if lengths is None or not np.isfinite(joints).all():
            return joints
        rigid = _with_lengths(joints, lengths)
        if not self._lengths.first:
            return rigid
        share = self._lengths.share(stamp_ns)
        return (1.0 - share) * joints + share * rigid


def _with_lengths(joints: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Joints (P, 3) whose bones keep their directions and have these lengths, where given; pelvis at the origin."""
    bones = _BONES[: len(joints) - 1]
    way = joints[bones[:, 1]] - joints[bones[:, 0]]
    known = way[: len(lengths)]
    known *= (lengths[: len(known)] / np.maximum(np.linalg.norm(known, axis=-1), 1e-9))[:, None]
    out = np.zeros_like(joints)
    for bone, (parent, child) in enumerate(bones):
        out[child] = out[parent] + way[bone]
    return out
