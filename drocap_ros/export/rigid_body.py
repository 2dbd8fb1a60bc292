"""A rigid body with constant bone lengths, fitted to joints by inverse kinematics, all frames at once.

The pelvis and the chest are rigid; the spine between them divides their relative rotation evenly.  Neck, head, collar
bones and limb bones have constant lengths and free directions.  Damped Gauss-Newton minimizes the squared distances of
the joints from their measured positions (frames are independent); where a joint stays far from its position, the
farther joints gain weight.  What positions do not show is held by weak priors:
the spine stays straight forwards, neck and collar bones stay near their usual directions.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from drocap_ros.geometry.alignment import unit_or
from drocap_ros.geometry.rotations import exp_so3, hat, log_so3
from drocap_ros.skeleton import BODY_15, TOES, indices

#: Joints of the body, each after its parent, with their parents.
PARENTS = {
    "pelvis": "",
    "lhip": "pelvis", "lknee": "lhip", "lankle": "lknee", "ltoe": "lankle",
    "rhip": "pelvis", "rknee": "rhip", "rankle": "rknee", "rtoe": "rankle",
    "spine": "pelvis", "chest": "spine", "upperchest": "chest",
    "thorax": "upperchest", "neck": "thorax", "head": "neck",
    "lcollar": "upperchest", "lshoulder": "lcollar", "lelbow": "lshoulder", "lwrist": "lelbow",
    "rcollar": "upperchest", "rshoulder": "rcollar", "relbow": "rshoulder", "rwrist": "relbow",
}  # fmt: skip
BODY = tuple(PARENTS)
#: Share of the chest's rotation in the rotation of the segment that ends at a joint; other segments turn freely.
_SHARE = {"lhip": 0.0, "rhip": 0.0, "spine": 0.0, "chest": 1 / 3, "upperchest": 2 / 3, "thorax": 1.0}
_SHARE |= {"lcollar": 1.0, "rcollar": 1.0}
#: Segments of the spine: length as a share of the trunk, pitch in the rest pose, rad.  With this curve a shortened
#: spine bends forwards; a straight one would buckle either way.
_SPINE = {"spine": (0.12, -0.2), "chest": (0.22, -0.1), "upperchest": (0.22, 0.0), "thorax": (0.44, 0.1)}
#: Collar bones begin beside the thorax, at this share of the half width.
_COLLAR = 0.2
#: Weights of the priors, m per radian, chosen weak: pitch and other bends of the spine; directions of neck and collar
#: bones.
_BENDS = np.array([0.05, 0.02, 0.02])
_USUAL = 0.02  # m per radian, as the bends
_PRIORS = ("neck", "lshoulder", "rshoulder")
#: A joint farther from its position than this, m, gains weight, so that few joints do not bear a frame's whole misfit.
FAR_M = 0.02
#: Most rounds of weighing, and steps of one fit: both end before, when it has converged; a judgement.
_STEPS = 30
#: Frames that are solved together, to bound the memory.
_CHUNK = 256
#: Direction of what has none.
_UP = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True)
class RigidBody:
    """Constant sizes and the pose in each frame; y up, m.

    joints : J names, a subset of :data:`BODY` in its order; toes only where the motion has them
    positions : (F, J, 3)
    lengths : name -> length of the free bone that ends at the joint
    fixed : name -> (3,) offset of a joint from its parent in the rest pose, on pelvis, spine and chest
    pelvis, chest : (F, 3, 3) from the rest pose (x left, y up, z forwards) to the world
    """

    joints: tuple[str, ...]
    positions: np.ndarray
    lengths: dict[str, float]
    fixed: dict[str, np.ndarray]
    pelvis: np.ndarray
    chest: np.ndarray

    def at(self, joint: str) -> np.ndarray:
        """(F, 3) positions of a joint."""
        return self.positions[:, self.joints.index(joint)]


def fit_rigid_body(
    positions: np.ndarray, joints: tuple[str, ...], known: np.ndarray, far_m: float = FAR_M
) -> RigidBody:
    """Rigid body of a motion.

    positions : (F, P, 3) m, y up, without NaN
    joints : P names, those of ``BODY_15`` at least; ``rtoe``, ``ltoe`` are used, others are ignored
    known : (F, P) bool, False where a position was interpolated
    far_m : joints that stay farther from their position gain weight until they are nearer, or for a few rounds

    Lengths are those of the frames in which both ends are known.
    """
    problem = _problem_of(positions, joints, known)
    columns = indices(joints, problem.wanted)
    measured, sure = positions[:, columns], known[:, columns]
    at = {name: measured[:, i] for i, name in enumerate(problem.wanted)}
    start = problem.start(at)
    # Weight of an interpolated joint relative to a known one.
    weights = np.where(sure, 1.0, 0.02)
    parts = [slice(i, i + _CHUNK) for i in range(0, len(positions), _CHUNK)]
    solved = [problem.solve(start.part(p), measured[p], weights[p]) for p in parts]
    pose = _Pose(*(np.concatenate(values) for values in zip(*solved, strict=True)))
    for _ in range(_STEPS):
        off = np.linalg.norm(problem.observed @ problem.segments(pose) - measured, axis=2) * sure
        far = (off > far_m).any(axis=1)
        if not far.any():
            break
        weights[far] *= 1.0 + 0.5 * (off[far] / far_m) ** 2
        pose.replace(far, problem.solve(pose.part(far), measured[far], weights[far]))
    return problem.body(pose)


class LiveBody:
    """Rigid body of poses as they come: its bones point as measured, without a fit, which takes 7 ms a pose.

    positions, joints, known : as of :func:`fit_rigid_body`, of the poses that give the lengths; unknown is NaN
    """

    def __init__(self, positions: np.ndarray, joints: tuple[str, ...], known: np.ndarray) -> None:
        self._problem = _problem_of(positions, joints, known)
        self._columns = indices(joints, self._problem.wanted)

    def posed(self, positions: np.ndarray) -> RigidBody:
        """Body of F poses, (F, P, 3) m, y up; a bone with an unknown end points up."""
        measured = dict(zip(self._problem.wanted, np.moveaxis(positions[:, self._columns], 1, 0), strict=True))
        return self._problem.body(self._problem.start(measured))


def _problem_of(positions: np.ndarray, joints: tuple[str, ...], known: np.ndarray) -> _Problem:
    wanted = (*BODY_15.joints, *(TOES if set(TOES) <= set(joints) else ()))
    columns = indices(joints, wanted)
    at = dict(zip(wanted, np.moveaxis(positions[:, columns], 1, 0), strict=True))
    return _Problem(wanted, _sizes(at, dict(zip(wanted, known[:, columns].T, strict=True))))


def _sizes(at: dict[str, np.ndarray], sure: dict[str, np.ndarray]) -> dict[str, float]:
    """Lengths of free bones by their end, and ``hips``, ``shoulders`` (half widths), ``trunk``.

    Medians; of trunk and neck, which are not rigid, the middle of the 5th and 95th percentile.
    """

    def middle(a: np.ndarray, b: np.ndarray, seen: np.ndarray, spread: float = 0.0) -> float:
        lengths = np.linalg.norm(a - b, axis=1)
        ends = np.percentile(lengths[seen] if seen.any() else lengths, [50 - spread, 50 + spread])
        return float(
            np.nan_to_num(max(float(ends.mean()), 1e-4), nan=0.25)
        )  # m, of a bone that was never seen: assumed

    between = 0.5 * (at["lshoulder"] + at["rshoulder"])
    both = sure["lshoulder"] & sure["rshoulder"]
    sizes = {
        "hips": 0.5 * middle(at["lhip"], at["rhip"], sure["lhip"] & sure["rhip"]),
        "shoulders": 0.5 * middle(at["lshoulder"], at["rshoulder"], both),
        "trunk": middle(at["pelvis"], between, both & sure["pelvis"], 45),
        "neck": middle(at["neck"], between, both & sure["neck"], 45),
    }
    for end in ("head", *(side + name for side in "lr" for name in ("elbow", "wrist", "knee", "ankle", "toe"))):
        if end in at:
            sizes[end] = middle(at[end], at[PARENTS[end]], sure[end] & sure[PARENTS[end]])
    return sizes


def _fixed_offsets(sizes: dict[str, float]) -> dict[str, np.ndarray]:
    """Joint on pelvis, spine or chest -> (3,) offset from its parent in the rest pose, m."""
    out = {name: np.array([sign * sizes["hips"], 0, 0]) for name, sign in (("lhip", 1), ("rhip", -1))}
    curve = np.array([(0.0, share * np.cos(pitch), share * np.sin(pitch)) for share, pitch in _SPINE.values()])
    # The thorax rests above the pelvis.
    lean = np.arctan2(*curve.sum(axis=0)[[2, 1]])
    curve = sizes["trunk"] / np.linalg.norm(curve.sum(axis=0)) * curve @ exp_so3(np.array([lean, 0.0, 0.0]))
    out |= dict(zip(_SPINE, curve, strict=True))
    for name, sign in (("lcollar", 1), ("rcollar", -1)):
        out[name] = curve[-1] + (sign * _COLLAR * sizes["shoulders"], 0, 0)
    return out


class _Pose(NamedTuple):
    """Unknowns of F frames: root (F, 3), pelvis and chest (F, 3, 3), free unit directions (F, K, 3)."""

    root: np.ndarray
    pelvis: np.ndarray
    chest: np.ndarray
    free: np.ndarray

    def part(self, frames: slice | np.ndarray) -> _Pose:
        """Those of some frames."""
        return _Pose(*(values[frames] for values in self))

    def replace(self, frames: np.ndarray, other: _Pose) -> None:
        """Take those of some frames from another pose."""
        for values, changed in zip(self, other, strict=True):
            values[frames] = changed


class _Problem:
    """Least squares over the segments: joint = sum of the segment vectors on its path from the origin."""

    def __init__(self, wanted: tuple[str, ...], sizes: dict[str, float]) -> None:
        self.wanted = wanted
        self.joints = tuple(name for name in BODY if name in wanted or name not in (*BODY_15.joints, *TOES))
        self.offsets = _fixed_offsets(sizes)
        self.fixed = {self.joints.index(name): (offset, _SHARE[name]) for name, offset in self.offsets.items()}
        self.ends = [i for i in range(1, len(self.joints)) if i not in self.fixed]
        self.lengths = {
            self.joints[i]: sizes.get(self.joints[i], (1 - _COLLAR) * sizes["shoulders"]) for i in self.ends
        }
        self.free_lengths = np.array(list(self.lengths.values()))
        self.path = np.eye(len(self.joints))
        for i, name in enumerate(self.joints[1:], start=1):
            self.path[i] += self.path[self.joints.index(PARENTS[name])]
        self.observed = self.path[indices(self.joints, wanted)]
        self.priors = [self.ends.index(self.joints.index(name)) for name in _PRIORS]
        self.usual = np.zeros((len(_PRIORS), 3))

    def start(self, at: dict[str, np.ndarray]) -> _Pose:
        """Pelvis from hips and trunk, chest from shoulders and trunk, bones as measured; sets the usual directions."""
        between = 0.5 * (at["lshoulder"] + at["rshoulder"])
        up = between - at["pelvis"]
        pelvis, chest = (_frame(at["l" + j] - at["r" + j], up) for j in ("hip", "shoulder"))
        pose = _Pose(at["pelvis"], pelvis, chest, np.zeros((len(up), len(self.ends), 3)))
        posed = self.path @ self.segments(pose)
        for k, end in enumerate(self.ends):
            name = self.joints[end]
            foot = posed[:, self.joints.index(PARENTS[name])] if k in self.priors else at[PARENTS[name]]
            pose.free[:, k] = unit_or(at[name] - foot, _UP)
        local = np.einsum("fji,fkj->fki", chest, pose.free[:, self.priors])
        self.usual = unit_or(np.median(local, axis=0), _UP)
        return pose

    def body(self, pose: _Pose) -> RigidBody:
        """The rigid body in a pose."""
        posed = self.path @ self.segments(pose)
        return RigidBody(self.joints, posed, self.lengths, self.offsets, pose.pelvis, pose.chest)

    def segments(self, pose: _Pose) -> np.ndarray:
        """(F, J, 3) vector of the segment that ends at each joint; the first is the root's position."""
        out = np.empty((len(pose.root), len(self.joints), 3))
        out[:, 0] = pose.root
        bend = log_so3(np.swapaxes(pose.pelvis, 1, 2) @ pose.chest)
        for i, (offset, share) in self.fixed.items():
            out[:, i] = (pose.pelvis @ exp_so3(share * bend)) @ offset
        out[:, self.ends] = pose.free * self.free_lengths[:, None]
        return out

    def solve(self, pose: _Pose, measured: np.ndarray, weights: np.ndarray) -> _Pose:
        """Levenberg-Marquardt from ``pose`` to the joints ``measured`` (F, P, 3) with ``weights`` (F, P)."""
        scale = np.repeat(weights, 3, axis=1)
        # First damping of Levenberg-Marquardt, relative to the diagonal.
        damping = np.full(len(measured), 1e-6)
        active = np.arange(len(measured))
        pose = _Pose(*(values.copy() for values in pose))
        for _ in range(_STEPS):
            now = pose.part(active)
            residual = self._residual(now, measured[active], scale[active])
            across = _tangents(now.free)
            jacobian = self._jacobian(now, across, scale[active])
            transposed = np.swapaxes(jacobian, 1, 2)
            normal = transposed @ jacobian
            diagonal = np.einsum("fii->fi", normal)
            diagonal += damping[active, None] * (diagonal + 1.0)
            step = -np.linalg.solve(normal, transposed @ residual[..., None])[..., 0]
            turn = np.einsum("fkca,fka->fkc", across, step[:, 9:].reshape(len(step), -1, 2))
            moved = _Pose(
                now.root + step[:, :3],
                exp_so3(step[:, 3:6]) @ now.pelvis,
                exp_so3(step[:, 6:9]) @ now.chest,
                unit_or(now.free + turn, _UP),
            )
            new = self._residual(moved, measured[active], scale[active])
            better = np.sum(new**2, axis=1) < np.sum(residual**2, axis=1)
            pose.replace(active[better], moved.part(better))
            damping[active] *= np.where(better, 0.1, 100.0)
            # Largest change, m or rad, of a fit that has converged; a judgement.
            active = active[np.abs(step).max(axis=1) > 3e-4]
            if not len(active):
                break
        return pose

    def _residual(self, pose: _Pose, measured: np.ndarray, scale: np.ndarray) -> np.ndarray:
        """(F, R) of the joints' coordinates, then of the priors."""
        frames = len(measured)
        joints = (self.observed @ self.segments(pose) - measured).reshape(frames, -1) * scale
        bend = _BENDS * log_so3(np.swapaxes(pose.pelvis, 1, 2) @ pose.chest)
        away = _USUAL * (pose.free[:, self.priors] - self._expected(pose))
        return np.concatenate([joints, bend, away.reshape(frames, -1)], axis=1)

    def _expected(self, pose: _Pose) -> np.ndarray:
        return np.asarray(np.einsum("fij,kj->fki", pose.chest, self.usual))

    def _jacobian(self, pose: _Pose, across: np.ndarray, scale: np.ndarray) -> np.ndarray:
        """(F, R, 9 + 2 K) of the residuals.

        Unknowns: root, rotations of pelvis and chest (left increments), steps of the free directions
        along their tangents ``across`` (F, K, 3, 2).
        """
        frames, unknowns = len(pose.root), 9 + 2 * len(self.ends)
        segments = self.segments(pose)
        local = np.zeros((frames, len(self.joints), 3, unknowns))
        local[:, 0, :, :3] = np.eye(3)
        for i, (_, share) in self.fixed.items():
            turned = -hat(segments[:, i])
            local[:, i, :, 3:6], local[:, i, :, 6:9] = (1 - share) * turned, share * turned
        for k, end in enumerate(self.ends):
            local[:, end, :, 9 + 2 * k : 11 + 2 * k] = across[:, k] * self.free_lengths[k]
        joints = (self.observed @ local.reshape(frames, len(self.joints), -1)).reshape(frames, -1, unknowns)
        bend = np.zeros((frames, 3, unknowns))
        bend[:, :, 6:9] = _BENDS[:, None] * np.swapaxes(pose.pelvis, 1, 2)
        bend[:, :, 3:6] = -bend[:, :, 6:9]
        away = np.zeros((frames, len(self.priors), 3, unknowns))
        away[..., 6:9] = _USUAL * hat(self._expected(pose))
        for row, k in enumerate(self.priors):
            away[:, row, :, 9 + 2 * k : 11 + 2 * k] = _USUAL * across[:, k]
        return np.concatenate([joints * scale[..., None], bend, away.reshape(frames, -1, unknowns)], axis=1)


def _frame(left: np.ndarray, up: np.ndarray) -> np.ndarray:
    """(F, 3, 3) rotations with columns left, up (exact), forwards."""
    y = unit_or(up, _UP)
    z = np.cross(left, y)
    # A line of hips along the trunk: any perpendicular direction.
    z = np.where(np.linalg.norm(z, axis=1, keepdims=True) > 1e-6, z, _tangents(y)[..., 0])
    z = unit_or(z, _UP)
    return np.stack([np.cross(y, z), y, z], axis=-1)


def _tangents(direction: np.ndarray) -> np.ndarray:
    """(..., 3, 2) two unit vectors perpendicular to each other and to unit vectors (..., 3)."""
    helper = np.where(np.abs(direction[..., :1]) < 0.7, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    first = unit_or(np.cross(direction, helper), _UP)
    return np.stack([first, np.cross(direction, first)], axis=-1)
