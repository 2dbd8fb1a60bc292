"""Bodies from image to image, and whose joints are these where persons overlap: each is one body's or nobody's.

Networks that see one box give the joints of whoever is in front.  A joint is where its body's motion lets it be, and
two bodies have no joint in common: what that leaves open is dropped.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from drocap_ros.keypoints import PoseObservation
from drocap_ros.perception.pose.body_pose import BOX_MARGIN, SAME_JOINTS, SEEN, BodyPose
from drocap_ros.perception.tracking.appearance import difference
from drocap_ros.skeleton import BODY_15, JointSet

_ERROR = 0.05  # of an expected joint at once, lengths: networks err by 0.02, and persons are not steady
_ERROR_PER_S = {"wrist": 1.2, "elbow": 0.8, "ankle": 1.0, "knee": 0.7}  # and more per second since it was seen,
_TRUNK_PER_S = 0.5  # of others; a walk swings a wrist by 2 lengths/s, and the last speed predicts half of it
_LONGEST_S = 1.0  # over which it grows
_RATE = 0.6  # weight of a new speed
_DECAY_S = 0.3  # time in which a speed without measurement falls to a third: beside another body the joint stays unseen
SLOW_RATE = 0.1  # weight of a new value in what hardly changes: of some ten images


LEAST_JOINTS = 4  # of BODY_15 that show a person


class ExpectedJoints:
    """Joints (P, 2) px of a person as expected in the image of ``stamp_ns``, from those of a pose on.

    colours : (P, 3) L a b of the limbs that end at the joints, NaN = unknown
    length : px, usual longer side of the box around the joints
    joints_ns : (P,) when each joint was last this person's; seen_ns : when enough of them were
    detected_ns : last detection of the whole image on this person
    seen : the observation of the newest image in which joints were this person's
    """

    def __init__(self, pose: BodyPose, joints: JointSet, stamp_ns: int) -> None:
        self.joint_set = joints
        self.stamp_ns = self.seen_ns = self.detected_ns = stamp_ns
        self.seen: PoseObservation | None = None
        self.xy: np.ndarray = pose.xy.astype(float)
        self.speed = np.zeros_like(self.xy)  # px/s
        self.joints_ns = np.full(len(joints), stamp_ns)
        self.colours: np.ndarray = np.full((len(joints), 3), np.nan)
        box = self.box  # a detection may be around two persons
        self.length = max(float((box[2:] - box[:2]).max()), 1.0)
        names = [name.lstrip("lr") for name in joints.joints]
        self._per_s = np.array([_ERROR_PER_S.get(name, _TRUNK_PER_S) for name in names])

    def seen_in(self, stamp_ns: int) -> PoseObservation | None:
        """The observation of the image of this stamp; None where it shows no joints of this person."""
        return self.seen if self.seen is not None and self.seen.stamp_ns == stamp_ns else None

    def predict(self, stamp_ns: int) -> None:
        """Expect the joints at a later time; a long gap between images is a time without measurement, too."""
        dt = (stamp_ns - self.stamp_ns) * 1e-9
        left = np.exp(-dt / _DECAY_S)
        self.xy += _DECAY_S * (1.0 - left) * self.speed
        unseen = (stamp_ns - self.joints_ns) * 1e-9 > 2 * dt
        self.speed[unseen] *= left
        self.stamp_ns = stamp_ns

    def move_camera(self, matrix: np.ndarray) -> None:
        """Follow the image's motion (2, 3) by the camera's."""
        self.xy = self.xy @ matrix[:, :2].T + matrix[:, 2]

    @property
    def reach(self) -> np.ndarray:
        """(P,) px, standard deviation of the expected joints."""
        age = np.minimum((self.stamp_ns - self.joints_ns) * 1e-9, _LONGEST_S)
        return np.asarray(self.length * (_ERROR + self._per_s * age))

    @property
    def box(self) -> np.ndarray:
        """(4,) px around the expected joints, as a detector gives one."""
        low, high = self.xy.min(axis=0), self.xy.max(axis=0)
        margin = BOX_MARGIN * float((high - low).max())
        return np.concatenate([low - margin, high + margin])

    def accept(self, xy: np.ndarray, own: np.ndarray, believed: bool) -> None:
        """Take over those measured joints (P, 2) px of the image that are this person's, (P,) bool."""
        if not own.any():
            return
        dt = max((self.stamp_ns - int(self.joints_ns[own].max())) * 1e-9, 1e-3)
        step = xy - self.xy
        shift = np.median(step[own], axis=0)
        # A joint without measurement goes with the body.
        self.xy[~own] += shift
        self.speed[~own] += _RATE * (np.median(self.speed[own], axis=0) - self.speed[~own])
        self.speed[own] += _RATE * step[own] / dt
        self.xy[own], self.joints_ns[own] = xy[own], self.stamp_ns
        if believed:
            self.seen_ns = self.stamp_ns
            extent = self.box
            length = float((extent[2:] - extent[:2]).max())
            self.length += SLOW_RATE * (length - self.length)

    def look(self, colours: np.ndarray, free: np.ndarray) -> None:
        """Add colours (P, 3) of the limbs: unknown ones, and those at joints (P,) bool where nobody else is."""
        first = np.isnan(self.colours) & np.isfinite(colours)
        self.colours[first] = colours[first]
        self.colours += SLOW_RATE * np.nan_to_num(colours - self.colours) * free[:, None]

    def keep_look(self, before: ExpectedJoints) -> None:
        """Take over the known colours of the joints of an earlier track."""
        self.colours = np.where(np.isnan(before.colours), self.colours, before.colours)


_FAR = 3.0  # standard deviations from which a joint's place says no more
_DROP = 0.5 * _FAR**2  # cost of a joint that is given to nobody,
_DROP_BODY = 3.0  # and mean cost of a pose that is nobody's
_OFF = 1.5  # deviations of a joint's place or of its limb's colour from which it may be another body's
_CLEARLY = 2.0  # times as far from the own body as from the other, from which a joint is the other's


class Poses(NamedTuple):
    """Poses of N boxes in one image: (N, P, 2) px, (N, P), and colours of the limbs (N, P, 3)."""

    xy: np.ndarray
    confidence: np.ndarray
    colours: np.ndarray


def own_joints(tracks: Sequence[ExpectedJoints], poses: Poses) -> tuple[np.ndarray, np.ndarray]:
    """Which of the poses in the boxes of overlapping bodies each (N,) has; of which each joint (N, P) is; -1 = none."""
    body = _bodies(tracks, poses)
    count = len(BODY_15)
    joint = np.repeat(body[:, None], poses.xy.shape[1], axis=1)
    for j in range(poses.xy.shape[1]):
        joint[:, j] = _joint(tracks, poses, body, j)
    for k, track in enumerate(tracks):
        others = [t for t in tracks if t is not track]
        xy = _of(poses, joint[k])
        colours = poses.colours[np.maximum(joint[k], 0), np.arange(len(joint[k]))]
        mixed = _mixed(track, others, xy[:count]) | _of_others_colour(track, others, xy[:count], colours[:count])
        joint[k, :count] = np.where(mixed, -1, joint[k, :count])
    return body, joint


def _of(poses: Poses, joint: np.ndarray) -> np.ndarray:
    """(P, 2) px of the joints that poses (P,) give, NaN for -1."""
    xy: np.ndarray = poses.xy[np.maximum(joint, 0), np.arange(len(joint))].copy()
    xy[joint < 0] = np.nan
    return xy


def _look(track: ExpectedJoints, colours: np.ndarray) -> np.ndarray:
    """(P,) how unlikely colours (P, 3) are on the body's limbs."""
    off = np.nan_to_num(difference(colours, track.colours), nan=1.0)
    return np.asarray(0.5 * np.minimum(off, _FAR) ** 2)


def _cost(track: ExpectedJoints, xy: np.ndarray) -> np.ndarray:
    """(..., P) how unlikely places (..., P, 2) px are of the body's joints: of a Gauss about the expected ones."""
    reach = track.reach
    off = np.linalg.norm(xy - track.xy, axis=-1) / reach
    return np.asarray(0.5 * np.minimum(off, _FAR) ** 2 + 2.0 * np.log(reach / reach.min()) * 0.25)


def _bodies(tracks: Sequence[ExpectedJoints], poses: Poses) -> np.ndarray:
    """(N,) index of the pose of each body, -1 = none: two boxes may have given the same body."""
    count = len(BODY_15)
    cost = np.full((len(tracks), 2 * len(tracks)), _DROP_BODY)
    for i in range(len(tracks)):
        seen = poses.confidence[i, :count] >= SEEN
        if seen.sum() < LEAST_JOINTS or _given_before(tracks, poses, i):
            cost[:, i] = 2 * _DROP_BODY
            continue
        for k, track in enumerate(tracks):
            each = np.minimum(_cost(track, poses.xy[i]), _cost(track, poses.xy[i][track.joint_set.mirror]))
            cost[k, i] = float((each + _look(track, poses.colours[i]))[:count][seen].mean()) + _age_cost(track)
    rows, columns = linear_sum_assignment(cost)
    found = np.full(len(tracks), -1)
    found[rows] = np.where(columns < len(tracks), columns, -1)
    return found


def _age_cost(track: ExpectedJoints) -> float:
    """A body unseen for long has no claim on what another one explains as well."""
    return min((track.stamp_ns - track.seen_ns) * 1e-9, 1.0)


def _given_before(tracks: Sequence[ExpectedJoints], poses: Poses, i: int) -> bool:
    """Whether another box gave the same body with more confidence."""
    count = len(BODY_15)
    for other in range(len(tracks)):
        if other == i:
            continue
        seen = np.minimum(poses.confidence[i], poses.confidence[other])[:count] >= SEEN
        if seen.sum() < LEAST_JOINTS:
            continue
        apart = np.linalg.norm(poses.xy[i] - poses.xy[other], axis=1)[:count][seen]
        better = float(poses.confidence[other, :count].mean()), -other
        if np.median(apart) < SAME_JOINTS * tracks[i].length and better > (
            float(poses.confidence[i, :count].mean()),
            -i,
        ):
            return True
    return False


def _joint(tracks: Sequence[ExpectedJoints], poses: Poses, body: np.ndarray, j: int) -> np.ndarray:
    """(N,) index of the pose whose joint ``j`` is each body's, its own or -1 = none."""
    result = body.copy()
    for k, i in enumerate(body):
        if i >= 0:
            cost = _cost(tracks[k], poses.xy[i])[j] + 0.5 * _look(tracks[k], poses.colours[i])[j]
            result[k] = i if poses.confidence[i, j] >= SEEN and cost < _DROP else -1
    return _once(tracks, poses, result, j)


def _once(tracks: Sequence[ExpectedJoints], poses: Poses, result: np.ndarray, j: int) -> np.ndarray:
    """The same where two bodies claim one place: it is the nearer one's, and nobody's where neither is so clearly."""
    for a in range(len(tracks)):
        for b in range(a + 1, len(tracks)):
            if result[a] < 0 or result[b] < 0:
                continue
            near = SAME_JOINTS * max(tracks[a].length, tracks[b].length)
            places = poses.xy[result[a], j], poses.xy[result[b], j]
            if np.linalg.norm(places[0] - places[1]) > near or np.linalg.norm(tracks[a].xy[j] - tracks[b].xy[j]) < near:
                continue
            off = [np.linalg.norm(places[n] - tracks[k].xy[j]) / tracks[k].reach[j] for n, k in enumerate((a, b))]
            if off[0] * _CLEARLY > off[1]:
                result[b] = -1
            if off[1] * _CLEARLY > off[0]:
                result[a] = -1
    return result


def _mixed(track: ExpectedJoints, others: Sequence[ExpectedJoints], xy: np.ndarray) -> np.ndarray:
    """(15,) bool: joints (15, 2) px off their expected places, or unseen for long, where another body's may be."""
    count = len(xy)
    own = np.linalg.norm(xy - track.xy[:count], axis=1) / track.reach[:count]
    stale = (track.stamp_ns - track.joints_ns[:count]) * 1e-9 > _DECAY_S
    mixed = np.zeros(count, bool)
    for other in others:
        reach = other.reach[:count]
        same = np.linalg.norm(xy - other.xy[:count], axis=1) / reach
        mirror = np.linalg.norm(xy - other.xy[BODY_15.mirror], axis=1) / reach[BODY_15.mirror]
        theirs = np.minimum(same, mirror)
        mixed |= ((own > _OFF) & (theirs * _CLEARLY < own) | stale) & (theirs < _FAR)
    return mixed


def _of_others_colour(
    track: ExpectedJoints, others: Sequence[ExpectedJoints], xy: np.ndarray, colours: np.ndarray
) -> np.ndarray:
    """(15,) bool: joints (15, 2) px at the end of limbs whose colours (15, 3) are another body's, where it may be."""
    count = len(xy)
    own = np.nan_to_num(difference(colours, track.colours[:count]))
    found = np.zeros(count, bool)
    for other in others:
        for side in (np.arange(count), BODY_15.mirror):
            theirs = np.nan_to_num(difference(colours, other.colours[side]), nan=np.inf)
            near = np.linalg.norm(xy - other.xy[side], axis=1) < _FAR * other.reach[side]
            found |= near & (own > _OFF) & (theirs * _CLEARLY < own)
    return found
