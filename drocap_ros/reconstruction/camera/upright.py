"""Up, floor and metres of a camera's path that the picture alone gave: from the body, its feet and the ground's points.

- Metres: the factor of the path at which feet rest while the camera moves, for a body of the assumed stature.
- Up: the body's mean direction from feet to neck; then what is marked as vertical, the plane of resting feet, and that
  of the points about it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from drocap_ros.camera_path import CameraPath, UpSource
from drocap_ros.contacts import ANKLE_M, ANKLES, rest_likelihood
from drocap_ros.reconstruction.world.placement import ScaleEstimate, estimate_scale
from drocap_ros.reconstruction.world.world_model import SIZE_STD
from drocap_ros.skeleton import BODY_17

#: Points on the plane, at least, and share of all.
LEAST_ON_PLANE = 20
LEAST_SHARE = 0.15


def largest_plane(
    places: np.ndarray, position: np.ndarray, up: np.ndarray, within_deg: float
) -> tuple[np.ndarray, float] | None:
    """The plane below a path (K, 3) on which most of the points (N, 3) lie; None = there is none.

    It is of points x with ``normal @ x == level``; its normal (3,) of length 1 is on the path's side.

    up : (3,) about across it, to ``within_deg``
    """
    if len(places) < LEAST_ON_PLANE:
        return None
    rng = np.random.default_rng(0)
    corners = places[rng.integers(len(places), size=(1000, 3))]  # planes that are tried
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    normal *= np.sign(normal @ up)[:, None]
    level = np.einsum("ni,ni->n", normal, corners[:, 0])
    height = np.median(position @ normal.T, axis=0) - level
    usual = (normal @ up > np.cos(np.deg2rad(within_deg))) & (height > 0.0)
    if not usual.any():
        return None
    normal, level, height = normal[usual], level[usual], height[usual]
    # A point on the plane is off it by 3 % of the camera's height.
    on = (np.abs(places @ normal.T - level) < 0.03 * height).sum(axis=0)
    best = int(on.argmax())
    if on[best] < max(LEAST_ON_PLANE, LEAST_SHARE * len(places)):
        return None
    return normal[best], float(level[best])


_PELVIS, _NECK = BODY_17.index("pelvis"), BODY_17.index("neck")
#: Octaves about the first guess in which the factor of the path is sought.
_OCTAVES = 6
#: Deviation of the scale below which contacts measure it.
FEET_TELL = 0.05
#: Standard deviation (degrees) of the body's mean direction from the vertical: people lean, and the lifter does.
_BODY_STD_DEG = 3.0
#: Standard deviation (degrees) of a wall's edge, or a door's, that is marked by two clicks.
_LINE_STD_DEG = 1.0
#: Standard deviation (m) of a resting foot's height, and independent ones per second: a foot rests for half a second.
_FOOT_STD_M = 0.15
FEET_HZ = 2.0
#: The same of a point of the ground, and distance (m) from the feet up to which points count.
_GROUND_STD_M = 0.1
_GROUND_M = 15.0
#: Steps of reweighting.
_STEPS = 10


class Level(NamedTuple):
    """Ground in the unit of a path: up (3,), height along it, and the metres per unit at which feet stand on it.

    spread : standard deviation of the logarithm of one frame's scale
    """

    up: np.ndarray
    height: float
    scale: ScaleEstimate
    spread: float


class _Plane(NamedTuple):
    """Up (3,) of length 1, height of the plane along it, and the covariance (2, 2) rad^2 of up across itself."""

    up: np.ndarray
    height: float
    covariance: np.ndarray


def set_upright(camera: CameraPath, seen: np.ndarray) -> CameraPath:
    """The path in metres, z up, the floor at z = 0, and its facts with what tells both.

    camera : with facts of the picture, in any unit and orientation
    seen : (F, 17, 3) m, joints from the camera, in its axes, at the assumed stature
    """
    (rotation, position), facts, stamp_ns = camera.pose, camera.picture, camera.stamp_ns
    assert facts is not None
    points = facts.points
    from_camera = seen @ rotation
    up, std_deg = body_up(from_camera)
    source = UpSource.BODY
    if facts.told is not None and facts.told_std_deg < std_deg:
        up, std_deg, source = facts.told, facts.told_std_deg, UpSource.TOLD
    plane = _by_lines(_Plane(up, 0.0, np.deg2rad(std_deg) ** 2 * np.eye(2)), facts.lines)
    up, source = plane.up, UpSource.LINES if len(facts.lines) else source
    feet = from_camera[:, ANKLES]
    factor, factor_std, level, feet_tell = 1.0, float("nan"), None, False
    if np.ptp(position, axis=0).any():
        level = by_ground(up, feet, position, points)
        contacts = by_contacts(feet, position, stamp_ns)
        feet_tell = contacts is not None and contacts.std < FEET_TELL
        found = [None if level is None else level.scale, contacts]
        scale = _together([scale for scale in found if scale is not None] or [_guess(feet, position, points)])
        factor, factor_std = scale.factor, scale.std
    path, lying = factor * position, points * np.array([factor] * 3 + [1.0])
    feet = path[:, None] + feet
    by_feet = _by_feet(plane, feet, stamp_ns)
    # The tilt of feet on one line is known along it alone: half of the prior's variance stays.
    if np.trace(by_feet.covariance) < 0.75 * np.trace(plane.covariance):
        source = UpSource.FEET
    plane = by_feet
    if level is not None and source is not UpSource.TOLD:
        # A plane through three points is known to 3 degrees.
        begun = _Plane(level.up, factor * level.height + ANKLE_M, np.deg2rad(3.0) ** 2 * np.eye(2))
        begun = _by_lines(begun, facts.lines)
        plane, source = _by_points(begun, feet, lying) or begun, UpSource.GROUND
    turn = _axes(plane.up, rotation[0])
    middle = feet.reshape(-1, 3).mean(axis=0)
    origin = middle + (plane.height - middle @ plane.up - ANKLE_M) * plane.up
    moved = lying.copy()
    moved[:, :3] = (lying[:, :3] - lying[:, 3:] * origin) @ turn.T
    # Ground is no water level: it is known to half a degree at best.
    std = max(np.degrees(np.sqrt(0.5 * np.trace(plane.covariance))), 0.5)
    facts = replace(facts, points=moved, up=source, up_std_deg=float(std), scale_std=factor_std, feet_tell=feet_tell)
    return replace(camera, rotation=rotation @ turn.T, position=(path - origin) @ turn.T, picture=facts)


def _together(found: list[ScaleEstimate]) -> ScaleEstimate:
    """Scales, of metres per unit of a path, as one, by their deviations."""
    weight = np.array([scale.std**-2 for scale in found])
    log = np.log([scale.factor for scale in found])
    std = max(float(weight.sum() ** -0.5), SIZE_STD)
    return ScaleEstimate(float(np.exp(weight @ log / weight.sum())), std)


def _guess(feet: np.ndarray, position: np.ndarray, points: np.ndarray) -> ScaleEstimate:
    """The scale at which points (J, 4) are about as far as feet (F, 2, 3) m from the camera (F, 3): over water, say."""
    near = np.abs(points[:, 3]) > 1e-9
    away = np.linalg.norm(points[near, :3] / points[near, 3:] - position.mean(axis=0), axis=1)
    factor = float(np.median(np.linalg.norm(feet, axis=-1))) / float(np.median(away)) if near.any() else 1.0
    # The logarithm of a guess deviates by a factor of two.
    return ScaleEstimate(factor, 0.7)


def by_contacts(feet: np.ndarray, position: np.ndarray, stamp_ns: np.ndarray) -> ScaleEstimate | None:
    """The scale of a path (F, 3) at which feet (F, 2, 3) m from the camera rest; None = it moves too little."""
    way = float(np.linalg.norm(np.ptp(position, axis=0)))
    # A camera's way is about as long as its distance from the person.
    guess = float(np.median(np.linalg.norm(feet, axis=-1))) / way
    # Where fewer feet rest contacts give no scale.
    best, support = None, 0.1
    for octave in range(-_OCTAVES, _OCTAVES + 1):
        unit = guess * 2.0**octave
        found = estimate_scale(feet, unit * position, stamp_ns)
        if found is not None and found.support > support:
            # Contacts err by three times their formal deviation.
            best, support = replace(found, factor=unit / found.factor, std=3.0 * found.std), found.support
    return best


def by_ground(up: np.ndarray, feet: np.ndarray, position: np.ndarray, points: np.ndarray) -> Level | None:
    """The ground under a path (F, 3), of points (J, 4), and the scale at which feet (F, 2, 3) m from it stand there.

    The largest plane below the camera that is about level, as ``up`` (3,) tells; None = there is none.
    """
    near = np.abs(points[:, 3]) > 1e-9
    places = points[near, :3] / points[near, 3:]
    plane = largest_plane(places, position, up, 3.0 * _BODY_STD_DEG)
    if plane is None:
        return None
    normal, height = plane
    # The lower foot of a frame stands, mostly; its ankle is a little above the ground.
    down = -(feet @ normal)
    above = position @ normal - height
    standing = down.max(axis=1) + ANKLE_M
    fits = (standing > 0.0) & (above > 0.0)
    if fits.mean() < 0.5:
        return None
    log = np.log(standing[fits] / above[fits])
    spread = 1.48 * float(np.median(np.abs(log - np.median(log))))
    scale = ScaleEstimate(float(np.exp(np.median(log))), max(SIZE_STD, 0.5 * spread))
    return Level(normal, height, scale, spread)


def body_up(joints: np.ndarray) -> tuple[np.ndarray, float]:
    """(3,) mean direction of bodies (F, 17, 3), from the feet to the neck, and its standard deviation (degrees)."""
    trunk = _unit(joints[:, _NECK] - joints[:, _PELVIS])
    legs = _unit(joints[:, _PELVIS] - joints[:, ANKLES].mean(axis=1))
    each = _unit(trunk + legs)
    up = _unit(each.sum(axis=0))
    for _ in range(_STEPS):
        off = np.degrees(np.arccos(np.clip(each @ up, -1.0, 1.0)))
        # A direction 15 degrees from the mean has a quarter of its weight.
        weight = 1.0 / (1.0 + np.square(off / 15.0)) ** 2
        up = _unit(weight @ each)
    return up, max(_BODY_STD_DEG, 0.3 * float(np.median(off)))


def resting(feet: np.ndarray, stamp_ns: np.ndarray) -> np.ndarray:
    """(F, 2) weight of feet (F, 2, 3) m that stay where they are for a while."""
    lag = max(int(np.searchsorted(stamp_ns, stamp_ns[0] + round(0.25 * 1e9))), 1)
    rest = np.zeros(feet.shape[:2])
    if lag < len(feet):
        # The place of a foot that rests errs by 5 cm.
        stays = rest_likelihood(np.square(feet[lag:] - feet[:-lag]).sum(-1), 0.05)
        rest[: len(stays)] = stays
        rest[lag:] = np.maximum(rest[lag:], stays)
    return rest


def _by_lines(plane: _Plane, normals: np.ndarray) -> _Plane:
    """The plane whose up lies in planes through the camera and something vertical, by their normals (N, 3)."""
    if not len(normals):
        return plane
    rows = normals @ _two_across(plane.up).T
    precision = np.linalg.inv(plane.covariance) + rows.T @ rows / np.deg2rad(_LINE_STD_DEG) ** 2
    tilt = np.linalg.solve(precision, -rows.T @ (normals @ plane.up)) / np.deg2rad(_LINE_STD_DEG) ** 2
    return _Plane(_unit(plane.up + tilt @ _two_across(plane.up)), plane.height, np.linalg.inv(precision))


def _by_feet(prior: _Plane, feet: np.ndarray, stamp_ns: np.ndarray) -> _Plane:
    """The plane of resting feet; all rests on one place count once: what errs there errs every time."""
    weight, places = resting(feet, stamp_ns).reshape(-1), feet.reshape(-1, 3)
    # Rests within 0.6 m are on one place.
    cells = np.floor(places @ _two_across(prior.up).T / 0.6).astype(int)
    _, cell = np.unique(cells, axis=0, return_inverse=True)
    rests = np.bincount(cell.reshape(-1), weight)
    return _fit(prior, places, weight / np.maximum(rests, 1.0)[cell.reshape(-1)], _FOOT_STD_M)


def _by_points(plane: _Plane, feet: np.ndarray, points: np.ndarray) -> _Plane | None:
    """The plane of points about the feet, which resting feet agree with; None = too few lie on one."""
    middle = feet.reshape(-1, 3).mean(axis=0)
    near = np.abs(points[:, 3]) > 1e-9
    places = points[near, :3] / points[near, 3:]
    places = places[np.linalg.norm(places - middle, axis=1) < _GROUND_M]
    if len(places) < LEAST_ON_PLANE:
        return None
    floor = plane._replace(height=plane.height - ANKLE_M)
    found = _fit(floor, places, np.ones(len(places)), _GROUND_STD_M, hold_height=True)
    off = np.abs(places @ found.up - found.height)
    on = int((off < 2 * _GROUND_STD_M).sum())
    if on < max(LEAST_ON_PLANE, LEAST_SHARE * len(places)):
        return None
    return found._replace(height=found.height + ANKLE_M)


def _fit(prior: _Plane, places: np.ndarray, weight: np.ndarray, std_m: float, hold_height: bool = False) -> _Plane:
    """Robust plane of weighted places (N, 3) with a prior of its direction, and of its height where that is held."""
    across = _two_across(prior.up)
    up, height = prior.up, prior.height
    middle = np.average(places, axis=0, weights=weight + 1e-9)
    if not hold_height:
        height = float(np.average(places @ up, weights=weight + 1e-9))
    precision = np.zeros((3, 3))
    precision[:2, :2] = np.linalg.inv(prior.covariance)
    precision[2, 2] = _FOOT_STD_M**-2 if hold_height else 1e-6
    start = height - middle @ up
    tilt = np.zeros(3)
    for _ in range(_STEPS):
        offset = places - middle
        rows = np.concatenate([offset @ across.T, -np.ones((len(places), 1))], axis=1)
        rest = offset @ prior.up - start + rows @ tilt
        robust = weight / (1.0 + np.square(rest / (3.0 * std_m))) ** 2 / std_m**2
        matrix = precision + rows.T @ (robust[:, None] * rows)
        tilt = np.linalg.solve(matrix, -rows.T @ (robust * (offset @ prior.up - start)))
    up = _unit(prior.up + tilt[:2] @ across)
    return _Plane(up, float(start + tilt[2] + middle @ up), np.linalg.inv(matrix)[:2, :2])


def _two_across(up: np.ndarray) -> np.ndarray:
    """(2, 3) directions across a direction."""
    first = np.eye(3)[np.argmin(np.abs(up))]
    first = _unit(first - (first @ up) * up)
    return np.stack([first, np.cross(up, first)])


def _axes(up: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """(3, 3) rows of the new world in the old one: z up; the first camera looks along y, or its image's top does."""
    forward = rotation[2] - (rotation[2] @ up) * up
    if np.linalg.norm(forward) < 0.1:  # it looks down: a tenth of the length has no direction
        forward = -rotation[1] + (rotation[1] @ up) * up
    north = _unit(forward)
    return np.stack([np.cross(north, up), north, up])


def _unit(v: np.ndarray) -> np.ndarray:
    return np.asarray(v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12))
