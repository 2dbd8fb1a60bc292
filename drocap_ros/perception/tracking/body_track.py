"""The joints of one person from image to image: where each is expected next, and how well that is known."""

from __future__ import annotations

import numpy as np

from drocap_ros.perception.detection.nms import iou
from drocap_ros.perception.pose.body_pose import BodyPose
from drocap_ros.perception.tracking.person import Person
from drocap_ros.skeleton import JointSet

_ERROR = 0.05  # of an expected joint at once, lengths: networks err by 0.02, and persons are not steady
_ERROR_PER_S = {"wrist": 1.2, "elbow": 0.8, "ankle": 1.0, "knee": 0.7}  # and more per second since it was seen,
_TRUNK_PER_S = 0.5  # of others; a walk swings a wrist by 2 lengths/s, and the last speed predicts half of it
_LONGEST_S = 1.0  # over which it grows
_RATE = 0.6  # weight of a new speed
_DECAY_S = 0.3  # time in which a speed without measurement falls to a third
_MARGIN = 0.06  # of the box around the joints, as of a pose's own box
_SAME_BOX = 0.4  # overlap from which a detection is this person's
_LENGTH_RATE = 0.1  # weight of a new length
_COLOUR_RATE = 0.1  # and of a new colour


class BodyTrack:
    """One person: identity and look in ``person``, joints (P, 2) px as expected in the image of ``stamp_ns``.

    colours : (P, 3) L a b of the limbs that end at the joints, NaN = unknown
    length : px, usual longer side of the box around the joints
    joints_ns : (P,) when each joint was last this person's; seen_ns : when enough of them were
    detected_ns : last detection of the whole image on this person
    """

    def __init__(self, person: Person, pose: BodyPose, joints: JointSet, stamp_ns: int) -> None:
        self.person, self.joint_set = person, joints
        self.stamp_ns = self.seen_ns = self.detected_ns = stamp_ns
        self.xy: np.ndarray = pose.xy.astype(float)
        self.speed = np.zeros_like(self.xy)  # px/s
        self.joints_ns = np.full(len(joints), stamp_ns)
        self.colours: np.ndarray = np.full((len(joints), 3), np.nan)
        box = self.box  # a detection may be around two persons
        self.length = max(float((box[2:] - box[:2]).max()), 1.0)
        names = [name.lstrip("lr") for name in joints.joints]
        self._per_s = np.array([_ERROR_PER_S.get(name, _TRUNK_PER_S) for name in names])

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
        self.person.move_camera(matrix)

    @property
    def reach(self) -> np.ndarray:
        """(P,) px, standard deviation of the expected joints."""
        age = np.minimum((self.stamp_ns - self.joints_ns) * 1e-9, _LONGEST_S)
        return np.asarray(self.length * (_ERROR + self._per_s * age))

    @property
    def box(self) -> np.ndarray:
        """(4,) px around the expected joints, as a detector gives one."""
        low, high = self.xy.min(axis=0), self.xy.max(axis=0)
        margin = _MARGIN * float((high - low).max())
        return np.concatenate([low - margin, high + margin])

    def overlap(self, box: np.ndarray) -> float:
        """Intersection over union with a box (4,) px."""
        return float(iou(box[None].astype(float), self.box[None])[0, 0])

    def on(self, box: np.ndarray) -> bool:
        """Whether a box (4,) px may be this person's."""
        return self.overlap(box) > _SAME_BOX

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
            self.length += _LENGTH_RATE * (length - self.length)

    def look(self, colours: np.ndarray, free: np.ndarray) -> None:
        """Add colours (P, 3) of the limbs: unknown ones, and those at joints (P,) bool where nobody else is."""
        first = np.isnan(self.colours) & np.isfinite(colours)
        self.colours[first] = colours[first]
        self.colours += _COLOUR_RATE * np.nan_to_num(colours - self.colours) * free[:, None]

    def continue_as(self, found: BodyTrack) -> None:
        """Go on with the joints of a new track in which this lost person was found again."""
        found.person.continue_as(self.person)
        self.person, self.xy, self.speed, self.joints_ns = found.person, found.xy, found.speed, found.joints_ns
        self.stamp_ns, self.seen_ns, self.detected_ns = found.stamp_ns, found.seen_ns, found.detected_ns
        self.length = found.length
        self.colours = np.where(np.isnan(self.colours), found.colours, self.colours)
