"""Constant-velocity Kalman filter of a box in the image, in units of the person's length."""

from __future__ import annotations

import numpy as np

#: Standard deviation of a measured box: centre in lengths, logarithm of the sizes.
_MEASURED = np.array([0.03, 0.03, 0.08, 0.08])
#: That of the acceleration, lengths/s^2 and 1/s^2: a runner turns at about 1 g, 5 lengths/s^2; the camera adds to it.
_ACCELERATION = np.array([4.0, 4.0, 2.0, 2.0])
#: That of the first rate, lengths/s and 1/s: a walk.
_FIRST_RATE = np.array([1.0, 1.0, 0.5, 0.5])
_DECAY_S = np.array([1.0, 1.0, 0.3, 0.3])  # time in which a rate without measurements falls to a third
_LONGEST_PREDICTION_S = 0.4  # persons turn, stoop or stop within it


class BoxFilter:
    """Kalman filter of centre (px) and logarithm of width and height.

    State ``x`` (4, 2): value, rate per second; covariance ``p`` (4, 2, 2).
    """

    def __init__(self, box: np.ndarray, stamp_ns: int) -> None:
        self.stamp_ns = stamp_ns
        self.x = np.stack([_to_state(box), np.zeros(4)], 1)
        self.p = np.zeros((4, 2, 2))
        self.p[:, 0, 0] = self._scaled(_MEASURED) ** 2
        self.p[:, 1, 1] = self._scaled(_FIRST_RATE) ** 2

    def _scaled(self, values: np.ndarray) -> np.ndarray:
        scaled: np.ndarray = values * np.array([self.length, self.length, 1.0, 1.0])
        return scaled

    def box(self) -> np.ndarray:
        """(4,) x_min y_min x_max y_max px."""
        return _to_box(self.x[:, 0])

    def box_at(self, stamp_ns: int) -> np.ndarray:
        """(4,) px predicted for a time; the state stays."""
        dt = float(np.clip((stamp_ns - self.stamp_ns) * 1e-9, 0.0, _LONGEST_PREDICTION_S))
        x = self.x[:, 0] + dt * self.x[:, 1]
        return _to_box(np.concatenate([x[:2], np.clip(x[2:], 0.0, 10.0)]))

    @property
    def length(self) -> float:
        """Longer side of the box, px: the size of a person in any posture."""
        return float(np.exp(self.x[2:, 0].max()))

    def predict(self, stamp_ns: int) -> None:
        """Advance to a later time; velocities decay without measurements."""
        dt = min((stamp_ns - self.stamp_ns) * 1e-9, _LONGEST_PREDICTION_S)
        self.stamp_ns = stamp_ns
        if dt <= 0:
            return
        self.x[:, 0] += dt * self.x[:, 1]
        self.x[:, 1] *= np.exp(-dt / _DECAY_S)
        self.x[2:, 0] = np.clip(self.x[2:, 0], 0.0, 10.0)
        q = self._scaled(_ACCELERATION) ** 2
        f = np.array([[1.0, dt], [0.0, 1.0]])
        noise = np.array([[dt**4 / 4, dt**3 / 2], [dt**3 / 2, dt**2]])
        self.p = f @ self.p @ f.T + q[:, None, None] * noise

    def move_camera(self, matrix: np.ndarray) -> None:
        """Follow the image's motion (2, 3) by the camera's."""
        self.x[:2] = matrix[:, :2] @ self.x[:2]
        self.x[:2, 0] += matrix[:, 2]
        self.x[2:, 0] += 0.5 * np.log(abs(np.linalg.det(matrix[:, :2])))

    def update(self, box: np.ndarray, noise: float = 1.0) -> None:
        """Update with a measured box; ``noise`` scales its standard deviation."""
        r = (noise * self._scaled(_MEASURED)) ** 2
        innovation = _to_state(box) - self.x[:, 0]
        gain = self.p[:, :, 0] / (self.p[:, 0, 0] + r)[:, None]
        self.x += gain * innovation[:, None]
        self.p -= gain[:, :, None] * self.p[:, None, 0, :]


def _to_state(box: np.ndarray) -> np.ndarray:
    x0, y0, x1, y1 = (float(v) for v in box)
    return np.array([(x0 + x1) / 2, (y0 + y1) / 2, np.log(max(x1 - x0, 1.0)), np.log(max(y1 - y0, 1.0))])


def _to_box(state: np.ndarray) -> np.ndarray:
    half = np.exp(state[2:]) / 2
    return np.concatenate([state[:2] - half, state[:2] + half])
