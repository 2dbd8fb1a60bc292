"""The camera's path as telemetry reports it, shifted in time by a latency."""

from __future__ import annotations

import numpy as np

from drocap_ros.geometry.interpolation import smoothed
from drocap_ros.geometry.rotations import exp_so3, log_so3


class CameraTelemetry:
    """Reported rotations (F, 3, 3) world -> camera and positions (F, 3) m of evenly spaced frames.

    turn_rate : (F, 3) rad/s in camera axes; velocity : (F, 3) m/s, both smooth
    A latency shifts the path by its smoothed motion only: interpolation between frames would average the noise of the
    reports, and an adjustment would take the latency that averages most.
    """

    def __init__(self, rotation: np.ndarray, position: np.ndarray, fps: float) -> None:
        from scipy.ndimage import gaussian_filter1d

        self.fps, self.frames = fps, len(rotation)
        self.rotation, self.position = rotation, position
        self.view_of_vertical = rotation[:, :, 2].mean(axis=0)
        turn: np.ndarray = np.zeros((self.frames, 3))
        if self.frames > 1:
            step = log_so3(rotation[1:] @ np.swapaxes(rotation[:-1], 1, 2)) * fps
            turn = np.concatenate([step[:1], 0.5 * (step[1:] + step[:-1]), step[-1:]])
        # Standard deviation (s) of the average of the reported motion: longer than noise lasts, shorter than a
        # manoeuvre.
        smoothing = 0.25 * fps
        self.turn_rate = gaussian_filter1d(turn, smoothing, axis=0, mode="nearest")
        self._smooth = smoothed(position, smoothing)
        self.velocity = np.gradient(self._smooth, axis=0) * fps if self.frames > 1 else np.zeros((self.frames, 3))

    def gimbal_axes(self) -> np.ndarray:
        """(3, 3) rows in camera axes, of the whole recording: pitch, yaw (about the vertical, clockwise) and roll."""
        up = self.view_of_vertical
        down = -up / max(float(np.linalg.norm(up)), 1e-12)
        right = np.eye(3)[np.argmin(np.abs(down) * [0.5, 1.0, 1.0])]
        right = right - (right @ down) * down
        right /= np.linalg.norm(right)
        return np.stack([right, down, np.cross(right, down)])

    def shifted(self, attitude_s: float, position_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Rotations (F, 3, 3) and positions (F, 3) of so many seconds later."""
        moved = self._smooth_at(position_s) - self._smooth
        rotation = exp_so3(self.turn_rate * attitude_s) @ self.rotation
        return rotation, self.position + moved

    def roughness(self) -> float:
        """Standard deviation (m) of the position's change from frame to frame that no camera could fly."""
        if self.frames < 5:
            return 0.0
        # The third difference: even a hard manoeuvre contributes less than a millimetre.
        third = np.diff(self.position, n=3, axis=0)
        return float(1.48 * np.median(np.abs(third)) / np.sqrt(6.0))

    def _smooth_at(self, later_s: float) -> np.ndarray:
        frame = np.arange(self.frames) + later_s * self.fps
        inside = np.clip(frame, 0, self.frames - 1)
        at = np.arange(self.frames)
        path = np.stack([np.interp(inside, at, self._smooth[:, axis]) for axis in range(3)], axis=1)
        ends = np.where((frame < inside)[:, None], self.velocity[0], self.velocity[-1])
        return np.asarray(path + ends * ((frame - inside) / self.fps)[:, None])


def at_other_time(given: CameraTelemetry, attitude_s: float, position_s: float) -> CameraTelemetry:
    """The path with the attitude and the position of so many seconds later, interpolated between its frames."""
    last = given.frames - 1
    step = log_so3(given.rotation[1:] @ np.swapaxes(given.rotation[:-1], 1, 2))
    at = np.arange(given.frames) + attitude_s * given.fps
    frame = np.clip(np.floor(at).astype(np.intp), 0, last - 1)
    rotation = exp_so3((at - frame)[:, None] * step[frame]) @ given.rotation[frame]
    at = np.arange(given.frames) + position_s * given.fps
    frame = np.clip(np.floor(at).astype(np.intp), 0, last - 1)
    way = given.position[frame + 1] - given.position[frame]
    return CameraTelemetry(rotation, given.position[frame] + (at - frame)[:, None] * way, given.fps)
