"""Where the subject is: bearing and range from one image, fused over time.

Range comes from two independent sources.  *Body size*: the lengths of trunk, thighs and shanks, as a level camera
would see them that looks straight at the subject, against those of a body of the assumed height; a crouching, bent or
striding subject shortens some of them.  *Ground plane*: where the rays through the ankles meet level ground.  Both
have errors that do not average out (the stature is what it is), so the fused covariance carries them beside the
filter's own.

The two disagree by what they assume, which stays, and by what the body does, which passes and only ever makes it look
smaller, so farther.  So the ground tells where the subject is from image to image, and a low quantile of their ratio
over some seconds what the body size says.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from drocap_ros.flight.orbit.pose_history import CameraPose
from drocap_ros.flight.subject_config import SubjectConfig
from drocap_ros.joint_maps import joint_map
from drocap_ros.observation import PoseObservation
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
_NECK = BODY_15.index("neck")
_ANKLE_HEIGHT = 0.055  # share of the stature; a swinging foot lifts the mean a little
_CONFIDENCE = 0.25
_STRIDE_M = 0.15  # standard deviation of the mean of the feet about the pelvis
_STEEP = np.sin(np.deg2rad(75.0))
_SHALLOW = np.sin(np.deg2rad(4.0))
_MAX_RANGE_M = 200.0
_THIRD_LONGEST = 0.99  # of the true length
_GROUND_NOISE, _SIZE_NOISE, _BEARING_NOISE = 0.025, 0.06, 0.008  # of one image, shares of the range
_LIFTED, _APART_NOISE = 0.15, 0.1  # apart by this share, one foot is lifted; noise per distance between them
_DRIFT = 0.05  # m/sqrt(s): the vehicle's own position and height wander, feet are set down: no motion of the subject
_LEAN_RAD = 0.12  # standard deviation of the body's lean; looking down by a slope it changes lengths by as much
_RATIO_NOISE, _RATIO_WANDER = 0.035, 0.02  # of the logarithm of size over ground: of one image; 1/sqrt(s)
_BENDING_BY_NOISE = 0.1
_DOUBTED = 0.3  # share of the range


class SubjectMeasurement(NamedTuple):
    """The subject's pelvis from one image.

    position : (3,) m ENU
    noise : (3, 3) m^2, what changes from image to image
    systematic : (3, 3) m^2, what stays: assumed stature, height above ground, attitude
    range_size_m, range_ground_m : horizontal range of each source, NaN without
    bending : how unequally the bones are foreshortened, logarithm of a ratio: about 0.1 by noise alone
    """

    position: np.ndarray
    noise: np.ndarray
    systematic: np.ndarray
    range_size_m: float
    range_ground_m: float
    bending: float


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
    # Of pelvis and hips the middle one: one wrong joint does not turn the bearing.
    pelvis = np.median(rays[trunk[trunk != _NECK]], axis=0) if np.any(trunk != _NECK) else rays[_NECK]
    length = float(np.linalg.norm(pelvis))
    flat = float(np.hypot(pelvis[0], pelvis[1]))
    if flat < np.sqrt(1 - _STEEP**2) * length:
        return None
    slope = float(pelvis[2] / flat)
    size, bending = _range_from_size(rays, seen, pelvis[:2] / flat, config)
    size_error = float(np.hypot(config.size_error, _LEAN_RAD * slope))
    ground, ground_sd, noise = _range_from_ground(rays, seen, camera.position, config)
    if np.isfinite(size_over_ground) and np.isfinite(ground):
        distance, sd = _fuse(size_over_ground * ground, size_error, ground, ground_sd)
    else:
        distance, sd = _fuse(size, size_error, ground, ground_sd)
    if not 0.3 < distance < _MAX_RANGE_M:
        return None
    ahead = np.array([pelvis[0], pelvis[1], 0.0]) / flat
    position = camera.position + distance * (pelvis / flat)
    aside = np.array([-ahead[1], ahead[0], 0.0])
    along = ahead + np.array([0.0, 0.0, slope])
    turn = np.deg2rad(config.attitude_error_deg) * distance
    up = np.array([0.0, 0.0, 1.0])

    def spread(range_sd: float, across_sd: float) -> np.ndarray:
        return (
            range_sd**2 * np.outer(along, along)
            + across_sd**2 * np.outer(aside, aside)
            + (across_sd**2 + 1e-4) * np.outer(up, up)
        )

    # Feet tell the range finely from image to image; the bones do not.
    noise = noise if np.isfinite(noise) else _SIZE_NOISE * distance + 0.05
    return SubjectMeasurement(
        position, spread(noise, _BEARING_NOISE * distance + 0.03), spread(sd, turn), size, ground, bending
    )


def _range_from_size(
    rays: np.ndarray, seen: np.ndarray, ahead: np.ndarray, config: SubjectConfig
) -> tuple[float, float]:
    """Horizontal range from the third longest of the bones, each against its own length; and their bending.

    The bones are measured in the upright plane across the line of sight, at distance 1: looking down on the subject
    does not shorten them.  The longest may be made so by a wrong joint (which lengthens two bones at most), the
    shortest are foreshortened.
    """
    depth = rays[:, :2] @ ahead
    usable = seen & (depth > 0.05)
    bones = usable[_ENDS_A] & usable[_ENDS_B]
    if bones.sum() < 3:
        return float("nan"), float("nan")
    across = np.stack([rays[:, 1] * ahead[0] - rays[:, 0] * ahead[1], rays[:, 2]], axis=1)
    across = across / np.where(usable, depth, 1.0)[:, None]
    lengths = np.linalg.norm(across[_ENDS_A] - across[_ENDS_B], axis=1)[bones] / (_SHARES[bones] * config.body_height_m)
    order = np.sort(lengths)[::-1]
    if order[2] < 1e-6:
        return float("nan"), float("nan")
    return _THIRD_LONGEST / float(order[2]), float(np.log(order[1] / max(order[min(3, len(order) - 1)], 1e-6)))


def _range_from_ground(
    rays: np.ndarray, seen: np.ndarray, position: np.ndarray, config: SubjectConfig
) -> tuple[float, float, float]:
    """Horizontal range of the ankles on level ground, its standard deviation and that of one image; NaN without."""
    ankles = rays[_ANKLES[seen[_ANKLES]]]
    # A foot kicked up to the horizon says nothing; the other one stands.
    ankles = ankles[-ankles[:, 2] >= _SHALLOW * np.linalg.norm(ankles, axis=1)]
    height = float(position[2]) - config.ground_height_m - _ANKLE_HEIGHT * config.body_height_m
    if not config.use_ground_plane or len(ankles) == 0 or height < 0.3:
        return float("nan"), float("nan"), float("nan")
    ranges = height * np.hypot(ankles[:, 0], ankles[:, 1]) / -ankles[:, 2]
    apart, nearer = float(np.ptp(ranges)), float(ranges.min())
    # A lifted foot seems farther away than the one that stands; feet a stride apart stand about the pelvis.
    lifted = apart > _LIFTED * nearer
    distance = nearer if lifted else float(ranges.mean())
    turn = np.deg2rad(config.attitude_error_deg)
    errors = (turn * (height**2 + distance**2) / height, config.height_error_m * distance / height, _STRIDE_M)
    noise = _GROUND_NOISE * distance + 0.05 + _APART_NOISE * min(apart, 0.5 * nearer)
    return distance, float(np.linalg.norm(errors)), noise


def _fuse(size: float, size_error: float, ground: float, ground_sd: float) -> tuple[float, float]:
    """Mean by information and its standard deviation; ``size_error`` is a share.

    Where the two contradict each other, body size alone, trusted half as much.
    """
    if not np.isfinite(size):
        return ground, ground_sd
    size_sd = size_error * size
    if not np.isfinite(ground):
        return size, size_sd
    if abs(size - ground) > 3 * np.hypot(size_sd, ground_sd):
        return size, 2 * size_sd
    wa, wb = size_sd**-2, ground_sd**-2
    return (wa * size + wb * ground) / (wa + wb), float((wa + wb) ** -0.5)


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


def _doubt(
    measurement: SubjectMeasurement, innovation: np.ndarray, covariance: np.ndarray, camera: np.ndarray
) -> np.ndarray:
    """(3, 3) m^2 to add to the noise of a range that surprises: a lifted foot, a wrong ankle.

    The subject is where it is seen, only how far is doubted; what surprises beyond a share of the range is left to
    the gate.
    """
    ray = measurement.position - camera
    distance = float(np.hypot(ray[0], ray[1]))
    along = ray / max(distance, 1e-6)
    ahead = np.array([along[0], along[1], 0.0])
    usual = 2.0 * float(np.sqrt(ahead @ (covariance + measurement.noise) @ ahead))
    surprise = abs(float(innovation @ ahead)) - usual
    if not 0.0 < surprise < _DOUBTED * distance:
        return np.zeros((3, 3))
    return surprise**2 * np.outer(along, along)


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
        self._ratio = float("nan")
        self._ratio_variance = 0.0
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
        noise = measurement.noise + _doubt(measurement, innovation, covariance[:3, :3], camera.position)
        spread = covariance[:3, :3] + noise
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
        self._learn_ratio(measurement, gap_s)
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

    def _learn_ratio(self, measurement: SubjectMeasurement, gap_s: float) -> None:
        """Follow the ratio of the two ranges: a Kalman filter of its logarithm, a random walk.

        Bending makes the body look smaller, never larger, so what says "farther" and what comes from unequal bones
        counts less.
        """
        ratio = measurement.range_size_m / measurement.range_ground_m
        if not 0.5 < ratio < 2.0:  # NaN too
            return
        bent = max(measurement.bending - _BENDING_BY_NOISE, 0.0)
        if np.isnan(self._ratio):
            self._ratio, self._ratio_variance = ratio, _RATIO_NOISE**2 + bent**2
            return
        innovation = float(np.log(ratio / self._ratio))
        variance = _RATIO_NOISE**2 + bent**2 + max(innovation, 0.0) ** 2
        self._ratio_variance += _RATIO_WANDER**2 * gap_s
        gain = self._ratio_variance / (self._ratio_variance + variance)
        self._ratio *= float(np.exp(gain * innovation))
        self._ratio_variance *= 1 - gain

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
        noise[:3, :3] += _DRIFT**2 * dt * np.eye(3)
        return move @ self._state, move @ self._covariance @ move.T + noise
