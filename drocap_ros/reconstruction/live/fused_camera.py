"""The reported camera of live windows, corrected by fixed points; what one window found is known in the next.

The core is that of recordings, :func:`~drocap_ros.reconstruction.camera.fusion.fuse_telemetry`.  It sees the reports
without the constant errors that are known, and expects as much of the rest as is unknown.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from drocap_ros.background import Background
from drocap_ros.camera_path import CameraPath
from drocap_ros.geometry.rotations import exp_so3, project_to_so3
from drocap_ros.reconstruction.camera.fusion import Fusion, fuse_telemetry
from drocap_ros.reconstruction.camera.path_model import ATTITUDE_LATENCY, MISALIGNMENT, POSITION_LATENCY
from drocap_ros.reconstruction.camera.path_residuals import expected_shared
from drocap_ros.reconstruction.common.refusal import Refusal, Why
from drocap_ros.reconstruction.lifted.even_frames import even_slots
from drocap_ros.reconstruction.live.window import Retry
from drocap_ros.reconstruction.world.camera_telemetry import CameraTelemetry, at_other_time
from drocap_ros.reconstruction.world.even_capture import at_all_slots
from drocap_ros.reconstruction.world.findings import Findings


class Calibration(NamedTuple):
    """Constant errors of the reports as all windows until now tell them; mean (SHARED,) and covariance.

    axes : (3, 3) of the gimbal, rows in camera axes
    """

    mean: np.ndarray
    covariance: np.ndarray
    axes: np.ndarray

    @property
    def gimbal_deg(self) -> np.ndarray:
        """(3,) pitch, yaw, roll."""
        return np.asarray(np.degrees(self.axes @ self.mean[MISALIGNMENT]))

    def __str__(self) -> str:
        pitch, yaw, roll = self.gimbal_deg
        turned = self.axes @ self.covariance[MISALIGNMENT, MISALIGNMENT] @ self.axes.T
        std, late_std = np.degrees(np.sqrt(np.diag(turned))), np.sqrt(np.diag(self.covariance))
        attitude, position = -self.mean[[ATTITUDE_LATENCY, POSITION_LATENCY]]
        return (
            f"pitch {pitch:+.2f} ± {std[0]:.2f}, yaw {yaw:+.2f} ± {std[1]:.2f}, roll {roll:+.2f} ± {std[2]:.2f} deg;"
            f" late by {attitude:.3f} ± {late_std[ATTITUDE_LATENCY]:.3f} s (attitude),"
            f" {position:.3f} ± {late_std[POSITION_LATENCY]:.3f} s (position)"
        )


class FusedCamera:
    """Corrects one window's reports after the other; memory is that of a window."""

    def __init__(self) -> None:
        self._known = Findings.unknown()
        #: Images (F,) of the last window, and the findings of their points.
        self._last: tuple[np.ndarray, Findings] | None = None
        self.calibration: Calibration | None = None
        #: Why points refuse the reports, and when they are asked again: that takes as long as some adjustments.
        self._refusal: Refusal | None = None
        self._retry = Retry()
        #: The largest errors (deg, m, deg) that points have shown, which later windows expect from the start.
        self._shown: np.ndarray = np.zeros(3)

    def correct(self, camera: CameraPath, points: Background | None) -> Fusion | Refusal | None:
        """The window's camera corrected; the answers are those of ``fuse_telemetry``."""
        if points is None:
            return None
        assert camera.errors is not None
        (rotation, position), (tilt_deg, place_m, turn_deg), stamp_ns = camera.pose, self._shown, camera.stamp_ns
        newest_ns = int(stamp_ns[-1])
        if self._refusal is not None and not self._retry.due(newest_ns):
            return self._refusal
        known = self._known if self._last is None else self._known.after(self._last[1], self._last[0], stamp_ns)
        errors = replace(
            camera.errors,
            tilt_deg=max(camera.errors.tilt_deg, float(tilt_deg)),
            position_wander_m=max(camera.errors.position_wander_m, float(place_m)),
            attitude_wander_deg=max(camera.errors.attitude_wander_deg, float(turn_deg)),
        )
        slot, fps = even_slots(stamp_ns)
        rotation, position = project_to_so3(at_all_slots(rotation, slot)), at_all_slots(position, slot)
        given = CameraTelemetry(rotation, position, fps)
        before = known.precision + expected_shared(errors, given.gimbal_axes())
        mean = _inverse(before) @ known.vector
        later = at_other_time(given, *mean[[ATTITUDE_LATENCY, POSITION_LATENCY]].tolist())
        turned = exp_so3(mean[None, MISALIGNMENT]) @ later.rotation
        without = replace(camera.moved(turned[slot], later.position[slot]), errors=errors)
        fused = fuse_telemetry(without, points, known.precision)
        self._refusal = None
        if isinstance(fused, Refusal) and fused.why in (Why.POINTS_MOVE_OTHERWISE, Why.POINTS_TURN_OTHERWISE):
            self._retry.failed(newest_ns)
            self._refusal = replace(fused, again_s=self._retry.last_s)
            return self._refusal
        if isinstance(fused, Refusal) or fused is None:
            return fused
        self._retry = Retry()
        precision, vector = fused.path.facts
        self._known = known
        self._last = stamp_ns, Findings(precision, vector + precision @ mean)
        self.calibration = Calibration(mean + fused.path.shared, _inverse(before + precision), given.gimbal_axes())
        tilt = self.calibration.gimbal_deg[[0, 2]]
        self._shown = np.maximum(self._shown, (0.5 * np.abs(tilt).max(), *fused.wander))
        return fused


def _inverse(precision: np.ndarray) -> np.ndarray:
    """Inverse (SHARED, SHARED) among the unknowns of which something is known, zeros elsewhere."""
    some = np.ix_(*2 * (np.diag(precision) > 0.0,))
    inverse = np.zeros_like(precision)
    inverse[some] = np.linalg.inv(precision[some])
    return inverse
