"""The camera's reported poses of the last seconds, and their values at the images of a window."""

from __future__ import annotations

from bisect import bisect_left, bisect_right

import numpy as np

from drocap_ros.background import Background
from drocap_ros.camera_path import CameraPath, Teller
from drocap_ros.geometry.interpolation import MAX_GAP_S, interpolate
from drocap_ros.geometry.lens import CameraModel
from drocap_ros.geometry.rotations import matrix_from_quaternion, pixels_are_usual, unit_quaternions
from drocap_ros.keypoints import PoseObservation

#: A stamp further back than this restarts the history; others out of order are left out.
_LATE_NS = 10**9
#: Images may be so much older than the newest pose.
_BEHIND_NS = 5 * 10**9
_GAP_NS = round(MAX_GAP_S * 1e9)


class CameraHistory:
    """Takes reported poses and calibrations in the order of their arrival; the same order gives the same answers.

    keep_s : length of the longest window
    """

    def __init__(self, keep_s: float) -> None:
        self._keep_ns = round(keep_s * 1e9) + _BEHIND_NS
        self._stamps: list[int] = []
        self._poses: list[np.ndarray] = []
        self._lenses: list[tuple[int, CameraModel]] = []

    @property
    def newest_ns(self) -> int:
        """Stamp of the newest pose; 0 = there is none."""
        return self._stamps[-1] if self._stamps else 0

    def add_pose(self, stamp_ns: int, position: np.ndarray, orientation: np.ndarray) -> None:
        """Take a pose: position (3,) m ENU, orientation (4,) x y z w optical frame -> ENU; one with NaN is left out."""
        pose = np.concatenate([position, unit_quaternions(orientation[None])[0]])
        if not np.isfinite(pose).all():
            return
        if self._stamps and stamp_ns <= self._stamps[-1]:
            if self._stamps[-1] - stamp_ns <= _LATE_NS:
                return
            self._stamps.clear()
            self._poses.clear()
        self._stamps.append(stamp_ns)
        self._poses.append(pose)
        # The poses of the longest window at 100 Hz are kept.
        old = max(bisect_left(self._stamps, stamp_ns - self._keep_ns), len(self._stamps) - 15_000)
        del self._stamps[:old], self._poses[:old]

    def add_matrix(self, stamp_ns: int, matrix: np.ndarray, size: tuple[int, int] = (0, 0)) -> None:
        """Take the calibration (3, 3) px of the image of a stamp, of an ideal lens; the rest is as of a lens."""
        self.add_lens(stamp_ns, CameraModel(*size, matrix))

    def add_lens(self, stamp_ns: int, lens: CameraModel) -> None:
        """Take the lens of the image of a stamp; an unusable one is left out.  Its size is 0 where it is not stated."""
        matrix = lens.matrix
        whole = np.isfinite(matrix).all() and np.allclose(matrix[2], (0, 0, 1))
        if not whole or min(matrix[0, 0], matrix[1, 1]) < 1 or not pixels_are_usual(matrix):
            return
        if not self._lenses or not lens.equals(self._lenses[-1][1]):
            # The last changes are kept; a camera changes its mode a few times a flight.
            self._lenses = [*self._lenses[-19:], (stamp_ns, lens)]

    def lens(self, stamp_ns: int, size: tuple[int, int]) -> CameraModel | None:
        """The lens of an image of a stamp and of ``size`` (width, height) px, 0 = unknown; None = none is known.

        It is that of the last change up to the stamp; the first one before that.
        """
        fitting = [found for found in self._lenses if 0 in (*size, *found[1].size) or found[1].size == size]
        before = [lens for since_ns, lens in fitting if since_ns <= stamp_ns]
        return before[-1] if before else fitting[0][1] if fitting else None

    def flat(self, observation: PoseObservation) -> PoseObservation:
        """The keypoints of an image without the distortion of its lens."""
        lens = self.lens(observation.stamp_ns, observation.image_size)
        return observation if lens is None else lens.flat(observation)

    def flat_points(
        self, stamp_ns: np.ndarray, size: tuple[int, int], background: Background | None
    ) -> Background | None:
        """Fixed points of images of increasing stamps (F,) without the distortion of the last one's lens."""
        lens = self.lens(int(stamp_ns[-1]), size)
        return background if lens is None else lens.flat_points(background)

    def uncalibrated(self, size: tuple[int, int]) -> str:
        """Why images of ``size``, width and height px, have no calibration, as words; "" = they have, or no poses."""
        if self.lens(0, size) is not None or not (self._lenses or self._stamps):
            return ""
        if not self._lenses:
            return "no usable camera_info has arrived; calibrate the camera, or set image_ingest.horizontal_fov_deg"
        return "camera_info is for images of {}x{} px, pose2d of {}x{}".format(*self._lenses[-1][1].size, *size)

    def along(self, stamp_ns: np.ndarray, size: tuple[int, int] = (0, 0)) -> CameraPath | None:
        """The camera at images of increasing stamps (F,), NaN where unknown; None where no calibration is known.

        Only a calibration of images of ``size`` (width, height) px counts; 0 = unknown.
        Between two poses up to 2 s apart values are interpolated; beyond the newest one they hold for 0.1 s.
        """
        lens = self.lens(int(stamp_ns[-1]), size)
        if lens is None:
            return None
        matrix = lens.matrix
        first_ns, last_ns = stamp_ns[[0, -1]].tolist()  # from the pose before the one to that after the other
        begin = max(bisect_left(self._stamps, first_ns - _GAP_NS), bisect_right(self._stamps, first_ns) - 1)
        end = min(bisect_right(self._stamps, last_ns + _GAP_NS), bisect_left(self._stamps, last_ns) + 1)
        if begin >= end:
            unknown = np.full((len(stamp_ns), 3, 3), np.nan)
            return CameraPath(stamp_ns, unknown, unknown[:, 0], matrix, "given", Teller.REPORTS)
        known_ns, poses = np.array(self._stamps[begin:end], np.int64), np.array(self._poses[begin:end])
        position, _ = interpolate(known_ns, poses[:, :3], stamp_ns, spherical=False)
        orientation, _ = interpolate(known_ns, poses[:, 3:], stamp_ns, spherical=True)
        rotation = np.swapaxes(matrix_from_quaternion(orientation), 1, 2)
        return CameraPath(stamp_ns, rotation, position, matrix, "given", Teller.REPORTS)
