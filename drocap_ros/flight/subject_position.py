"""Where the subject is: bearing and range from one image, fused over time.

Range comes from two independent sources.  *Body size*: the lengths of trunk, thighs and shanks in the image against
those of a body of the assumed height; a crouching, bent or striding subject shortens some of them, never all.
*Ground plane*: where the rays through the ankles meet level ground.  Both have errors that do not average out (the
stature is what it is), so the fused covariance carries them beside the filter's own.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from drocap_ros.flight.pose_history import CameraPose
from drocap_ros.flight.subject_config import SubjectConfig
from drocap_ros.perception.joint_maps import joint_map
from drocap_ros.perception.observation import PoseObservation
from drocap_ros.skeleton import BODY_15

_NS = 1_000_000_000
#: Lengths as shares of the stature (Winter, Biomechanics and Motor Control of Human Movement; trunk: hips to the
#: top of the neck): the long bones of each side and the trunk.
_BONES = tuple(
    (BODY_15.index(a), BODY_15.index(b), share)
    for a, b, share in (
        ("pelvis", "neck", 0.367), ("rhip", "rknee", 0.245), ("lhip", "lknee", 0.245),
        ("rknee", "rankle", 0.246), ("lknee", "lankle", 0.246),
    )
)  # fmt: skip
_ENDS_A, _ENDS_B = (np.array([bone[i] for bone in _BONES]) for i in (0, 1))
_SHARES = np.array([bone[2] for bone in _BONES])
_ANKLES = np.array([BODY_15.index("rankle"), BODY_15.index("lankle")])
_TRUNK = np.array([BODY_15.index(name) for name in ("pelvis", "rhip", "lhip", "neck")])
_PELVIS = BODY_15.index("pelvis")
_ANKLE_HEIGHT = 0.055  # share of the stature; a swinging foot lifts the mean a little
_CONFIDENCE = 0.25
_STRIDE_M = 0.15  # standard deviation of the mean of the feet about the pelvis
_STEEP = np.sin(np.deg2rad(75.0))
_SHALLOW = np.sin(np.deg2rad(4.0))
_MAX_RANGE_M = 200.0
_RATIO_IMAGES = 28  # over which the ratio of the two ranges is learned


class SubjectMeasurement(NamedTuple):
    """The subject's pelvis from one image.

    position : (3,) m ENU
    noise : (3, 3) m^2, what changes from image to image
    systematic : (3, 3) m^2, what stays: assumed stature, height above ground, attitude
    range_size_m, range_ground_m : horizontal range of each source, NaN without
    """

    position: np.ndarray
    noise: np.ndarray
    systematic: np.ndarray
    range_size_m: float
    range_ground_m: float


def locate_subject(
    observation: PoseObservation,
    camera_matrix: np.ndarray,
    camera: CameraPose,
    config: SubjectConfig,
    size_over_ground: float = float("nan"),
) -> SubjectMeasurement | None:
    """Locate the subject in one image.

    Parameters
    ----------
    observation : keypoints of any joint set that maps to ``BODY_15``
    camera_matrix : (3, 3) px
    camera : pose at the stamp of the observation
    size_over_ground : what the ratio of the two ranges has been over the last seconds; NaN = that of this image.
        The two disagree slowly for what they assume, and quickly when the subject crouches: then the ground is right

    Returns
    -------
    None when there is no subject, too little of it is seen, or the camera looks straight down on it.
    """
    if not observation.has_subject or len(observation.keypoints) == 0:
        return None
    points, _, confidence = joint_map(observation.joints.name).apply(
        observation.keypoints.astype(float), observation.covariance.astype(float),
        observation.confidence.astype(float), float(observation.image_size[1]),
    )  # fmt: skip
    seen = np.isfinite(points).all(axis=1) & (confidence >= _CONFIDENCE)
    trunk = _TRUNK[seen[_TRUNK]]
    if len(trunk) == 0:
        return None
    plane = (np.where(seen[:, None], points, 0.0) - camera_matrix[:2, 2]) / np.diag(camera_matrix)[:2]
    rays = np.concatenate([plane, np.ones((len(plane), 1))], axis=1) @ camera.rotation
    pelvis = rays[_PELVIS] if seen[_PELVIS] else rays[trunk].mean(axis=0)
    length = float(np.linalg.norm(pelvis))
    flat = float(np.hypot(pelvis[0], pelvis[1]))
    if flat < np.sqrt(1 - _STEEP**2) * length:
        return None
    size = _range_from_size(plane, seen, flat / length, config) * flat
    ground, ground_sd = _range_from_ground(rays, seen, camera.position, config)
    distance, sd = _fuse(size, config.size_error * size, ground, ground_sd, size_over_ground)
    if not 0.3 < distance < _MAX_RANGE_M:
        return None
    ahead = np.array([pelvis[0], pelvis[1], 0.0]) / flat
    position = camera.position + distance * (pelvis / flat)
    aside = np.array([-ahead[1], ahead[0], 0.0])
    slope = float(pelvis[2] / flat)
    along = ahead + np.array([0.0, 0.0, slope])
    turn = np.deg2rad(config.attitude_error_deg) * distance
    up = np.array([0.0, 0.0, 1.0])

    def spread(range_sd: float, across_sd: float) -> np.ndarray:
        return (
            range_sd**2 * np.outer(along, along)
            + across_sd**2 * np.outer(aside, aside)
            + (across_sd**2 + 1e-4) * np.outer(up, up)
        )

    return SubjectMeasurement(
        position, spread(0.04 * distance + 0.05, 0.012 * distance + 0.04), spread(sd, turn), size, ground
    )


def _range_from_size(plane: np.ndarray, seen: np.ndarray, upright: float, config: SubjectConfig) -> float:
    """Depth along the optical axis over 1: from the third longest of the bones, each against its own length.

    The longest may be made so by a wrong joint (which lengthens two bones at most), the shortest are foreshortened.
    ``upright`` is by how much a vertical bone is foreshortened by looking down on it.
    """
    bones = seen[_ENDS_A] & seen[_ENDS_B]
    if bones.sum() < 3:
        return float("nan")
    lengths = np.linalg.norm(plane[_ENDS_A] - plane[_ENDS_B], axis=1)[bones] / (_SHARES[bones] * config.body_height_m)
    third = float(np.sort(lengths)[-3])
    return 0.97 * upright / third if third > 1e-6 else float("nan")


def _range_from_ground(
    rays: np.ndarray, seen: np.ndarray, position: np.ndarray, config: SubjectConfig
) -> tuple[float, float]:
    """Horizontal range of the ankles on level ground and its standard deviation; NaN without them."""
    ankles = rays[_ANKLES[seen[_ANKLES]]]
    height = float(position[2]) - config.ground_height_m - _ANKLE_HEIGHT * config.body_height_m
    if not config.use_ground_plane or len(ankles) == 0 or height < 0.3:
        return float("nan"), float("nan")
    down = -ankles[:, 2]
    if np.any(down < _SHALLOW * np.linalg.norm(ankles, axis=1)):
        return float("nan"), float("nan")
    ranges = height * np.hypot(ankles[:, 0], ankles[:, 1]) / down
    # A lifted foot seems farther away than the one that stands.
    distance = float(ranges.min() if np.ptp(ranges) > 0.3 * ranges.min() else ranges.mean())
    turn = np.deg2rad(config.attitude_error_deg)
    errors = (turn * (height**2 + distance**2) / height, config.height_error_m * distance / height, _STRIDE_M)
    return distance, float(np.linalg.norm(errors))


def _fuse(a: float, a_sd: float, b: float, b_sd: float, ratio: float = float("nan")) -> tuple[float, float]:
    """Mean by information of size ``a`` and ground ``b``; ``ratio`` of the two is smoother than that of one image.

    Where the two contradict each other for long, body size alone, trusted half as much.
    """
    if np.isfinite(ratio) and np.isfinite(b):
        a, a_sd = ratio * b, a_sd if np.isfinite(a_sd) else b_sd
    if not np.isfinite(a):
        return b, b_sd
    if not np.isfinite(b):
        return a, a_sd
    if abs(a - b) > 3 * np.hypot(a_sd, b_sd):
        return a, 2 * a_sd
    wa, wb = a_sd**-2, b_sd**-2
    return (wa * a + wb * b) / (wa + wb), float((wa + wb) ** -0.5)


@dataclass(frozen=True)
class SubjectEstimate:
    """The subject at one instant.

    position, velocity : (3,) m, m/s ENU
    covariance : (6, 6) of the filter; ``position_sd_m`` holds the systematic error too
    stamp_ns : exposure of the last image that was accepted
    age_s : since then
    """

    position: np.ndarray
    velocity: np.ndarray
    covariance: np.ndarray
    position_sd_m: float
    stamp_ns: int
    age_s: float
    track_id: int


class SubjectFilter:
    """Kalman filter of position and velocity, white acceleration; measurements must come in the order of stamps.

    Nothing here reads a clock.  An image with a stamp but no news (the same keypoints bit for bit as before: a
    frozen picture) and a measurement outside the gate do not make the estimate younger.
    """

    def __init__(self, config: SubjectConfig) -> None:
        self._config = config
        self._state: np.ndarray | None = None
        self._covariance = np.eye(6)
        self._systematic = np.eye(3)
        self._stamp_ns = 0
        self._track_id = 0
        self._last_keypoints: np.ndarray | None = None
        self._ratio, self._ratio_count = float("nan"), 0
        self.rejected = 0

    def reset(self) -> None:
        """Forget the subject; the next measurement starts afresh."""
        self._state = None

    def update(
        self,
        observation: PoseObservation,
        camera_matrix: np.ndarray,
        camera: CameraPose | None,
        *,
        locked: bool = False,
    ) -> bool:
        """Take one image's keypoints; whether they were accepted.

        locked : the vehicle flies by this estimate: neither another track nor a far measurement may restart it
        """
        frozen = self._last_keypoints is not None and np.array_equal(
            self._last_keypoints, observation.keypoints, equal_nan=True
        )
        self._last_keypoints = observation.keypoints
        if camera is None or frozen or not observation.has_subject:
            return False
        measurement = locate_subject(observation, camera_matrix, camera, self._config, self._ratio)
        if measurement is None:
            return False
        gap_s = (observation.stamp_ns - self._stamp_ns) / _NS
        other = observation.track_id != self._track_id
        if locked and (self._state is None or other):
            self.rejected += 1
            return False
        if self._state is None or (not locked and (other or abs(gap_s) > 2.0)):
            self._start(observation, measurement)
            return True
        if gap_s <= 0:
            return False
        state, covariance = self._predicted(min(gap_s, 5.0))
        innovation = measurement.position - state[:3]
        spread = covariance[:3, :3] + measurement.noise
        inverse = np.linalg.inv(spread)
        if float(innovation @ inverse @ innovation) > self._config.subject_gate:
            self.rejected += 1
            if not locked and gap_s > 1.0:
                self._start(observation, measurement)
                return True
            return False
        gain = covariance[:, :3] @ inverse
        self._state = state + gain @ innovation
        covariance = covariance - gain @ covariance[:3]
        self._covariance = 0.5 * (covariance + covariance.T)
        self._systematic = measurement.systematic
        self._stamp_ns = observation.stamp_ns
        self._learn_ratio(measurement)
        return True

    def estimate(self, now_ns: int) -> SubjectEstimate | None:
        """The subject carried on to ``now_ns`` (for half a second at most); None before the first measurement."""
        if self._state is None:
            return None
        age_s = (now_ns - self._stamp_ns) / _NS
        state, covariance = self._predicted(min(max(age_s, 0.0), 0.5))
        total = covariance[:3, :3] + self._systematic
        return SubjectEstimate(
            position=state[:3], velocity=state[3:], covariance=covariance,
            position_sd_m=float(np.sqrt(np.linalg.eigvalsh(total[:2, :2])[-1])),
            stamp_ns=self._stamp_ns, age_s=age_s, track_id=self._track_id,
        )  # fmt: skip

    def _learn_ratio(self, measurement: SubjectMeasurement) -> None:
        """Follow the ratio of the two ranges, slowly and in small steps."""
        ratio = measurement.range_size_m / measurement.range_ground_m
        if not 0.5 < ratio < 2.0:  # NaN too
            return
        self._ratio_count = min(self._ratio_count + 1, _RATIO_IMAGES)
        if self._ratio_count == 1:
            self._ratio = ratio
        step = min(max(ratio - self._ratio, -0.15), 0.15)
        self._ratio += step / self._ratio_count

    def _start(self, observation: PoseObservation, measurement: SubjectMeasurement) -> None:
        self._state = np.concatenate([measurement.position, np.zeros(3)])
        self._covariance = np.diag([0.0] * 3 + [1.0, 1.0, 0.1])
        self._covariance[:3, :3] = measurement.noise
        self._systematic = measurement.systematic
        self._stamp_ns, self._track_id = observation.stamp_ns, observation.track_id

    def _predicted(self, dt: float) -> tuple[np.ndarray, np.ndarray]:
        assert self._state is not None
        move = np.eye(6)
        move[:3, 3:] = dt * np.eye(3)
        push = np.concatenate([0.5 * dt * dt * np.eye(3), dt * np.eye(3)])
        # White acceleration of this standard deviation over a second: its power does not depend on the step.
        variance = self._config.subject_acceleration_m_s2**2 * np.array([1.0, 1.0, 0.1]) / max(dt, 1e-3)
        noise = push @ (variance[:, None] * push.T)
        return move @ self._state, move @ self._covariance @ move.T + noise
