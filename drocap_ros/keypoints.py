"""2D keypoints with their uncertainty: of one person over time, and what perception finds in one image."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from drocap_ros.background import FixedPoints
from drocap_ros.errors import InputError
from drocap_ros.skeleton import BODY_15, BODY_17, JointSet, body_set


@dataclass(frozen=True)
class Keypoints2D:
    """Keypoints of one person over F images, P joints; arrays of a single image lack the leading axis.

    xy : (F, P, 2) px, x right, y down; NaN = not seen
    confidence : (F, P) in [0, 1], or None
    covariance : (F, P, 3) px^2, xx xy yy, or None
    """

    xy: np.ndarray
    confidence: np.ndarray | None = None
    covariance: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.xy)

    def __getitem__(self, frames: slice | np.ndarray | None) -> Keypoints2D:
        """The keypoints of some frames; ``frames`` indexes the leading axis as it does in numpy."""
        return replace(self, **{name: value[frames] for name, value in vars(self).items() if value is not None})

    def with_joints(self, count: int) -> Keypoints2D:
        """The first ``count`` joints of a body set; those that it lacks are not seen."""
        added = max(count - self.xy.shape[-2], 0)

        def fit(values: np.ndarray, unknown: float) -> np.ndarray:
            # The joints are the axis before the columns; confidences have none.
            axis = self.xy.ndim - 2
            width = [(0, added if i == axis else 0) for i in range(values.ndim)]
            kept = (*[slice(None)] * axis, slice(count))
            return np.pad(values, width, constant_values=unknown)[kept]

        return Keypoints2D(
            fit(self.xy, np.nan),
            None if self.confidence is None else fit(self.confidence, 0.0),
            None if self.covariance is None else fit(self.covariance, np.nan),
        )

    def without_joints(self, count: int) -> Keypoints2D:
        """The joints after the first ``count``."""
        later = slice(count, None)
        return Keypoints2D(
            self.xy[..., later, :],
            None if self.confidence is None else self.confidence[..., later],
            None if self.covariance is None else self.covariance[..., later, :],
        )

    @property
    def seen(self) -> np.ndarray:
        """(F, P) bool, both coordinates are finite."""
        return np.asarray(np.isfinite(self.xy).all(axis=-1))

    @property
    def weights(self) -> np.ndarray:
        """(F, P) confidence of the seen joints, 1 without one; 0 where not seen."""
        return np.where(self.seen, 1.0 if self.confidence is None else np.nan_to_num(self.confidence), 0.0)

    @property
    def variance(self) -> np.ndarray | None:
        """(F, P) px^2 per coordinate, the mean of xx and yy; None without a covariance."""
        return None if self.covariance is None else 0.5 * (self.covariance[..., 0] + self.covariance[..., 2])


def _empty(*shape: int) -> np.ndarray:
    return np.empty(shape, np.float32)


@dataclass(frozen=True)
class PoseObservation:
    """The subject in one image; P joints, or empty arrays without a subject.

    stamp_ns : exposure time of the image
    track_id : 1, 2, ... for the subject; 0 = no subject
    joints : names and order of the keypoints
    image_size : (width, height) px
    roi : (4,) float32, the subject's box x_min y_min x_max y_max px; NaN without a subject
    detection_score : the detector's score of the box in [0, 1], the last one while the box is propagated by the pose
        network; 0 for a predicted box
    keypoints : (P, 2) float32 px, NaN = not seen
    covariance : (P, 3) float32 px^2, xx xy yy, NaN where the keypoint is
    confidence : (P,) float32 in [0, 1], calibrated: the share of such keypoints within 10 % of the box height of a
        human label
    background : fixed points of the scene; None = the image was not searched for them
    space : (P, 3) float32 m, the joints in space as a network sees them in the person's crop: x right, y down, z away
        along the ray to the person; None = no network gives it
    """

    stamp_ns: int
    track_id: int
    image_size: tuple[int, int]
    joints: JointSet = BODY_15
    roi: np.ndarray = field(default_factory=lambda: np.full(4, np.nan, np.float32))
    detection_score: float = 0.0
    keypoints: np.ndarray = field(default_factory=lambda: _empty(0, 2))
    covariance: np.ndarray = field(default_factory=lambda: _empty(0, 3))
    confidence: np.ndarray = field(default_factory=lambda: _empty(0))
    background: FixedPoints | None = None
    space: np.ndarray | None = None

    @property
    def has_subject(self) -> bool:
        """Whether the image has a subject."""
        return self.track_id > 0

    def body_keypoints(self) -> Keypoints2D:
        """The image's keypoints of ``BODY_17``, float64; toes that the network does not give are NaN."""
        if not body_set(self.joints):
            raise InputError(f"skeleton: expected body15, body17 or body19, got {self.joints.name}; map the joints")
        for name, columns in (("keypoints", (2,)), ("confidence", ()), ("covariance", (3,))):
            shape, expected = getattr(self, name).shape, (len(self.joints), *columns)
            if shape != expected:
                raise InputError(f"{name}: expected shape {expected}, got {shape}; use the {self.joints.name} joints")
        arrays = (values.astype(np.float64) for values in (self.keypoints, self.confidence, self.covariance))
        return Keypoints2D(*arrays).with_joints(len(BODY_17))


def nanmedian_small(values: np.ndarray, axis: int) -> np.ndarray:
    """Median that ignores NaN along a short axis; NaN where everything is (no warning, unlike numpy's)."""
    ordered = np.sort(values, axis=axis)
    count = np.isfinite(values).sum(axis=axis, keepdims=True)
    low = np.take_along_axis(ordered, np.maximum(count - 1, 0) // 2, axis=axis)
    high = np.take_along_axis(ordered, np.minimum(count // 2, values.shape[axis] - 1), axis=axis)
    median: np.ndarray = np.squeeze(0.5 * (low + high), axis=axis)
    return median


def difference_noise(points: np.ndarray) -> float:
    """Standard deviation per coordinate of points (F, P, 2), F > 3, from their third difference; 0 = none is seen.

    Motion contributes little to it, errors that last for some frames are underestimated.
    """
    third = nanmedian_small(np.abs(np.diff(points, n=3, axis=0)).reshape(-1), axis=0)
    return float(1.48 / np.sqrt(20) * float(np.nan_to_num(third)))
