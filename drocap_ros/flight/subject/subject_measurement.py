"""Bearing and range of the subject from one image.

Range comes from two independent sources.  *Body size*: the lengths of trunk, thighs and shanks, as a level camera
that looks straight at the subject would see them, against those of a body of the assumed height.  *Ground plane*: the
intersection of the rays through the ankles with level ground.  Both have systematic errors (assumed stature, height,
attitude), which the measurement carries apart from its noise.

The two ranges disagree by their assumptions, which are constant, and by posture, which passes and only makes the body
look smaller, so farther.  So the feet give the range of each image, and body size over some seconds, see
``subject_filter.py``, the ground on which they stand: it is as far below the camera as they appear at that range.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from drocap_ros.flight.bridge_config import SubjectConfig
from drocap_ros.flight.observed import NO_HEIGHT, Height
from drocap_ros.flight.vehicle import CameraPose
from drocap_ros.keypoints import PoseObservation
from drocap_ros.skeleton import BODY_15, joint_map

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
_PELVIS_HEIGHT = 0.53  # share of the stature (Winter), standing
_STEEP = np.sin(np.deg2rad(75.0))
_SHALLOW = np.sin(np.deg2rad(4.0))
SIZE_NOISE = 0.06  # of one image, share of the range
BENT = 4.0  # times the noise: a bent body looks smaller, as does a trunk that leans; its size counts for less
MAX_BENDING = 0.3  # of a body whose size counts; 0.1 by noise alone


class SubjectMeasurement(NamedTuple):
    """The subject's pelvis from one image.

    position : (3,) m ENU
    noise : (3, 3) m^2, independent from image to image
    systematic : (3, 3) m^2, constant: assumed stature, height above ground, attitude
    range_size_m, range_ground_m : horizontal range of each source, NaN without
    bending : foreshortening of unequal bones, logarithm of a ratio; about 0.1 by noise alone; inf = the trunk alone,
        of a person whose legs are out of the picture
    nearer : share of the range by which the nearer of the two sources puts the subject nearer; 0 with one source
    ground : his ground by body size and bearing, which know nothing of any height
    """

    position: np.ndarray
    noise: np.ndarray
    systematic: np.ndarray
    range_size_m: float
    range_ground_m: float
    bending: float
    nearer: float = 0.0
    ground: Height = NO_HEIGHT


def locate_subject(
    observation: PoseObservation,
    camera_matrix: np.ndarray,
    camera: CameraPose,
    config: SubjectConfig,
    known: Height = NO_HEIGHT,
) -> SubjectMeasurement | None:
    """Locate the subject in one image.

    observation : keypoints of any joint set that maps to ``BODY_15``
    camera_matrix : (3, 3) px
    camera : pose at the stamp of the observation
    known : his ground by his body over the last seconds; unknown = that of this image.  It changes slowly by the
        assumptions, and quickly when the subject crouches: then the feet on it are right
    returns : None without a subject, with too few visible joints, or when the camera looks straight down on it
    """
    if not observation.has_subject or len(observation.keypoints) == 0:
        return None
    points, confidence = joint_map(observation.joints.name).places(
        observation.keypoints.astype(float), observation.confidence.astype(float)
    )
    seen = np.isfinite(points).all(axis=1) & (confidence >= 0.25)  # less counts as not seen
    trunk = _TRUNK[seen[_TRUNK]]
    if len(trunk) == 0:
        return None
    plane = (np.where(seen[:, None], points, 0.0) - camera_matrix[:2, 2]) / np.diag(camera_matrix)[:2]
    rays = np.concatenate([plane, np.ones((len(plane), 1))], axis=1) @ camera.rotation
    # The median of pelvis and hips: one wrong joint does not turn the bearing.
    hips = np.sort(rays[trunk[trunk != _NECK]], axis=0)
    pelvis = 0.5 * (hips[(len(hips) - 1) // 2] + hips[len(hips) // 2]) if len(hips) else rays[_NECK]
    length = float(np.linalg.norm(pelvis))
    flat = float(np.hypot(pelvis[0], pelvis[1]))
    if flat < np.sqrt(1 - _STEEP**2) * length:
        return None
    slope = float(pelvis[2] / flat)
    size, bending = _range_from_size(rays, seen, pelvis[:2] / flat, config)
    # A body leans by 0.12 rad; looking down by a slope that changes lengths by as much.
    size_error = float(np.hypot(config.size_error, 0.12 * slope))
    ground, height, noise = _range_from_ground(rays, seen, camera.position, config)
    steady = size
    if np.isfinite(known.m) and np.isfinite(ground):  # the feet on the known ground
        # Below a tenth of the assumed height a range by the ground means nothing.
        steady = ground * max(1.0 - (known.m - config.ground_height_m) / height, 0.1)
    distance, sd = _fuse(steady, size_error, ground, _ground_sd(ground, height, config))
    if _contradict(steady, size_error, ground, height, config):
        # On another ground than assumed the ratio changes with the camera's height: the size of this image counts.
        steady = distance = size if np.isfinite(size) else steady
        sd, noise = 2 * size_error * distance, np.nan
    # A person is less than 10 px high there.
    if not 0.3 < distance < 200.0:
        return None
    nearer = 1.0 - float(np.fmin(steady, ground)) / distance
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

    # Feet give a precise range from image to image, bones do not.
    if not np.isfinite(noise):
        noise = (BENT if np.isinf(bending) else 1.0) * SIZE_NOISE * distance + 0.05
    across = 0.008 * distance + 0.03
    level = _ground_by_body(size, size_error, rays, seen, camera.position, config)
    return SubjectMeasurement(position, spread(noise, across), spread(sd, turn), size, ground, bending, nearer, level)


def _range_from_size(
    rays: np.ndarray, seen: np.ndarray, ahead: np.ndarray, config: SubjectConfig
) -> tuple[float, float]:
    """Horizontal range from the third longest bone relative to its own length, and the bending.

    The bones are measured in the upright plane across the line of sight, at distance 1, so a camera that looks down
    does not shorten them.  A wrong joint lengthens two bones at most; the shortest bones are foreshortened.  Without
    shanks the third of three bones is the shortest: then the second longest counts, or the trunk if it is longer.
    Thighs bend towards the camera, and a network that misses shanks of the ground's colour puts the knees too high:
    both would put the subject much too far away.  The trunk counts alone where the picture's border cuts the legs off.
    """
    depth = rays[:, :2] @ ahead
    usable = seen & (depth > 0.05)
    bones = usable[_ENDS_A] & usable[_ENDS_B]
    if bones.sum() < 3 and not bones[0]:
        return float("nan"), float("nan")
    across = np.stack([rays[:, 1] * ahead[0] - rays[:, 0] * ahead[1], rays[:, 2]], axis=1)
    across = across / np.where(usable, depth, 1.0)[:, None]
    lengths = np.linalg.norm(across[_ENDS_A] - across[_ENDS_B], axis=1)[bones] / (_SHARES[bones] * config.body_height_m)
    if len(lengths) < 3:
        return 1.0 / max(float(lengths[0]), 1e-6), float("inf")
    order = np.sort(lengths)[::-1]
    length = float(order[2 if len(order) > 4 else 1])
    if len(order) == 3 and bones[0]:  # the trunk
        length = max(length, float(lengths[0]))
    if length < 1e-6:
        return float("nan"), float("nan")
    # The third longest has 0.99 of the true length.
    return 0.99 / length, float(np.log(order[1] / max(order[min(3, len(order) - 1)], 1e-6)))


def _range_from_ground(
    rays: np.ndarray, seen: np.ndarray, position: np.ndarray, config: SubjectConfig
) -> tuple[float, float, float]:
    """Horizontal range of the ankles on level ground, height above them, noise of one image; NaN without."""
    ankles = rays[_ANKLES[seen[_ANKLES]]]
    # A foot kicked up to the horizon is left out; the other one stands.
    ankles = ankles[-ankles[:, 2] >= _SHALLOW * np.linalg.norm(ankles, axis=1)]
    height = float(position[2]) - config.ground_height_m - _ANKLE_HEIGHT * config.body_height_m
    if not config.use_ground_plane or len(ankles) == 0 or height < 0.3:
        return float("nan"), float("nan"), float("nan")
    ranges = height * np.hypot(ankles[:, 0], ankles[:, 1]) / -ankles[:, 2]
    apart, nearer = float(np.ptp(ranges)), float(ranges.min())
    # A lifted foot appears farther than the one that stands; feet a stride apart stand about the pelvis.
    lifted = apart > 0.15 * nearer
    distance = nearer if lifted else float(ranges.mean())
    noise = 0.025 * distance + 0.05 + 0.1 * min(apart, 0.5 * nearer)
    return distance, height, noise


def _ground_by_body(
    size: float, size_error: float, rays: np.ndarray, seen: np.ndarray, position: np.ndarray, config: SubjectConfig
) -> Height:
    """The ground below the body, which is seen at this range by its size: as far below the camera as its feet appear.

    It needs no ground plane, and holds where feet appear at the horizon or above it: of a camera as low as they are.
    """
    # One of the feet is lifted by 0.1 m; the pelvis of one who may crouch is lower by 0.3 m.
    joints, above, sd = _ANKLES[seen[_ANKLES]], _ANKLE_HEIGHT, 0.1
    if len(joints) == 0:
        joints, above, sd = _TRUNK[:1][seen[_TRUNK[:1]]], _PELVIS_HEIGHT, 0.3
    if len(joints) == 0 or not np.isfinite(size):
        return NO_HEIGHT
    slope = float((rays[joints, 2] / np.maximum(np.hypot(rays[joints, 0], rays[joints, 1]), 1e-6)).mean())
    turn = np.deg2rad(config.attitude_error_deg) * (1.0 + slope**2) * size
    height = float(position[2]) + size * slope - above * config.body_height_m
    return Height(height, float(np.linalg.norm([size_error * size * slope, turn, sd])))


def _ground_sd(distance: float, height: float, config: SubjectConfig) -> float:
    """Standard deviation of a range of this length by the ground."""
    turn = np.deg2rad(config.attitude_error_deg)
    # The mean of the feet errs by 0.15 m about the pelvis: strides.
    errors = (turn * (height**2 + distance**2) / height, config.height_error_m * distance / height, 0.15)
    return float(np.linalg.norm(errors))


def _contradict(size: float, size_error: float, ground: float, height: float, config: SubjectConfig) -> bool:
    """Whether the two ranges contradict each other.

    A range that the ground puts far too far has a large standard deviation too: that of the nearer one counts.
    """
    spread = np.hypot(size_error * size, _ground_sd(min(size, ground), height, config))
    return bool(abs(size - ground) > 3 * spread)  # NaN: one source alone


def _fuse(size: float, size_error: float, ground: float, ground_sd: float) -> tuple[float, float]:
    """Information-weighted mean and its standard deviation; ``size_error`` is a share."""
    if not np.isfinite(size):
        return ground, ground_sd
    size_sd = size_error * size
    if not np.isfinite(ground):
        return size, size_sd
    wa, wb = size_sd**-2, ground_sd**-2
    return (wa * size + wb * ground) / (wa + wb), float((wa + wb) ** -0.5)
