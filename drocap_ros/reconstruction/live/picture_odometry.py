"""Live windows without telemetry: the camera's path by fixed points alone, in a frame ``odom`` of the picture's own.

A path begins as a recording's does (``camera/picture_world.py``): upright, in metres by the body.  The next window goes
on with it: new keyframes are placed by its points, as a path grows offline, and images in the time of both windows keep
their camera.  They need not be the same images: a late adjustment takes every second to fourth.  Where that fails, the
path is lost, and another one begins.

A path begins in a few seconds, in which a drone hovers or climbs: its up and its metres are badly known.  Where ground
and feet of a later window contradict them, the path takes over theirs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from drocap_ros.camera_path import CameraPath, Kind, PictureFacts, UpSource
from drocap_ros.contacts import ANKLES
from drocap_ros.geometry.interpolation import interpolate
from drocap_ros.geometry.rotations import exp_so3, hat, matrix_from_quaternion, project_to_so3, quaternion_from_matrix
from drocap_ros.reconstruction.camera.from_picture import fits
from drocap_ros.reconstruction.camera.fusion import joints_by_camera
from drocap_ros.reconstruction.camera.growth import Grown, Growth, adjusted, turns
from drocap_ros.reconstruction.camera.kinds import Sightings, cut_at, kind_of
from drocap_ros.reconstruction.camera.path_model import KNOTS_HZ, Knots, views_of
from drocap_ros.reconstruction.camera.picture_world import (
    HELD_M,
    metres_per_unit,
    picture_camera,
    seen_from_camera,
    with_camera,
)
from drocap_ros.reconstruction.camera.upright import FEET_TELL, LEAST_SCALE_STD, by_contacts, set_upright
from drocap_ros.reconstruction.common.poses import ImagePoses
from drocap_ros.reconstruction.common.windows import even_slots
from drocap_ros.reconstruction.live.window import Retry, Window
from drocap_ros.reconstruction.person_view import true_shape
from drocap_ros.reconstruction.world.placement import metres_per_px

#: Shortest window (s) in which a path begins: a step and some way, and points in most of it.
_FIRST_S = 3.0
#: Deviation of the logarithm of a path's metres above which they are guessed: longer windows tell more, of a lens too.
_LARGEST_SCALE_STD = 0.3
#: Steps of a path that goes on: most of it is known.
_STEPS = 5
#: Error (m) of a place on a path, as windows differ in it.
_PLACE_M = 0.02
#: Longest time (s) between images of a window over which its path is straight.
_STRAIGHT_S = 0.5
#: Tilt (degrees) of a path from which the ground of a window contradicts it: three deviations of up by ground.
_TILTED_DEG = 1.5
#: Logarithm of a factor of two, above which feet contradict a path that hardly moves.
_MOST_SCALE = 0.7
#: Time (s) at a window's end in which a keyframe has to be placed.
_NEWEST_S = 0.5


class Person(NamedTuple):
    """A window's poses of a subject of an assumed stature."""

    poses: ImagePoses
    height_m: float
    subject: int

    def metres_per_px(self, camera: CameraPath) -> np.ndarray:
        """(F,) in the images of a camera."""
        return metres_per_px(true_shape(self.poses.in_image, camera.matrix), camera.stamp_ns, self.height_m)


@dataclass(frozen=True)
class PicturePath:
    """A window's camera in ``odom``; F images.

    camera : with up, metres and their deviations; number : of the path
    begun_ns : stamp of the path's first image; drift_m, drift_rad : deviation of place and turn within a second
    subject : whose assumed stature gives its metres
    corrections : number of later windows that corrected its up or its metres
    """

    camera: CameraPath
    number: int
    begun_ns: int
    drift_m: float
    drift_rad: float
    subject: int
    corrections: int = 0

    @property
    def words(self) -> str:
        """For people: what the camera does, and how well up and metres are known."""
        facts = self.facts
        scale = f", metres to {100 * facts.scale_std:.0f} %" if np.isfinite(facts.scale_std) else ""
        return f"path {self.number}, {facts.kind.value}; up to {facts.up_std_deg:.1f} deg{scale}"

    @property
    def facts(self) -> PictureFacts:
        """What the picture told of the camera."""
        assert self.camera.picture is not None
        return self.camera.picture


class PictureOdometry:
    """Follows the camera from window to window; memory is that of a window."""

    def __init__(self) -> None:
        self._path: PicturePath | None = None
        #: First image, by its stamp, of the next path.
        self.since_ns = 0
        self._number, self._retry = 0, Retry()
        #: Why there is no path or the last one ended, in words, and how many were lost.
        self.lost, self.losses = "", 0

    def follow(self, w: Window, person: Person) -> PicturePath | None:
        """The path in a window with fixed points; None = there is none, ``lost`` says why."""
        before, stamps = self._path, w.stamp_ns
        if before is not None:
            shared = stamps[0] <= before.camera.stamp_ns[-1]
            self._path = _continued(before, w, person) if shared else None
            if self._path is None:
                self._lose(before.camera, w, shared)
        long = stamps[-1] - stamps[0] >= _FIRST_S * 1e9
        if self._path is None and self.since_ns <= stamps[0] and self._retry.due(int(stamps[-1])) and long:
            self._path = self._begun(w, person)
        return self._path

    def moved(self, about: np.ndarray, by: np.ndarray) -> PicturePath:
        """The path turned by (3, 3) about the origin and moved by (3,) m; it goes on there."""
        assert self._path is not None
        rotation, position = self._path.camera.pose
        there = self._path.camera.moved(rotation @ about.T, position @ about.T + by)
        self._path = replace(self._path, camera=there)
        return self._path

    def _lose(self, last: CameraPath, w: Window, shared: bool) -> None:
        seen = _Seen(w)
        if (cut := cut_at(seen.sightings, over_gaps=True)) is not None:
            at, why = int(w.stamp_ns[seen.image[seen.knots.frame[cut]]]), "a cut"
        elif shared and (kind := seen.kind(last)).known:
            # A camera that begins to move, say: nothing is wrong with the images of before.
            at, why = int(w.stamp_ns[0]), f"it is {kind.value} now"
        else:
            at, why = int(last.stamp_ns[-1]), kind.value if shared else "a pause"
        self.since_ns, self.lost = at, f"path {self._number} lost: {why}; another one begins"
        self.losses += 1

    def _begun(self, w: Window, person: Person) -> PicturePath | None:
        """A path that begins in this window."""
        lens = CameraPath(w.stamp_ns, matrix=None if w.camera is None else w.camera.matrix)
        raw = picture_camera(lens, w.background, w.image_size)
        if raw is None or raw.picture is None or not raw.picture.kind.known:
            self._pause("too few images" if raw is None or raw.picture is None else raw.picture.kind.value, w)
            return None
        facts, camera = raw.picture, with_camera(raw, person.poses, person.metres_per_px(raw))
        if camera.picture is not None and camera.picture.scale_std > _LARGEST_SCALE_STD:
            self._pause("neither feet nor ground give its metres", w)
            return None
        camera = replace(camera, covariance=None)  # of this window alone
        assert camera.errors is not None
        # Corrected by each window alone, the path would not be one.
        camera = replace(camera, errors=replace(camera.errors, position_wander_m=HELD_M))
        self._number, self._retry = self._number + 1, Retry()
        unit_m = metres_per_unit(raw, camera.pose[1])
        drift = np.nan_to_num([unit_m * facts.position_std, np.deg2rad(facts.turn_std_deg)]) * np.sqrt(KNOTS_HZ)
        begun_ns = int(w.stamp_ns[0])
        return PicturePath(camera, self._number, begun_ns, float(drift[0]), float(drift[1]), person.subject)

    def _pause(self, why: str, w: Window) -> None:
        self._retry.failed(int(w.stamp_ns[-1]))
        self.lost = f"no path: {why}"


class _Seen:
    """Fixed points of a window at its keyframes; image : (frames,) of each evenly spaced frame, -1 = there is none."""

    def __init__(self, w: Window) -> None:
        points = w.background
        assert points is not None
        self._width = w.image_size[0]
        slot, self.fps = even_slots(w.stamp_ns)
        self.slot, self.image = slot, np.full(int(slot[-1]) + 1, -1)
        self.image[slot] = np.arange(len(slot))
        frames = len(self.image)
        self.knots = Knots(frames, self.fps)
        views = views_of(slot[points.frame], points.track, points.point.astype(np.float64), frames, self.fps)
        self.sightings = Sightings(views, self.knots.frame)

    def kind(self, last: CameraPath) -> Kind:
        """What the camera does, through the lens of the window before."""
        assert last.matrix is not None
        return kind_of(self.sightings, last.matrix, 1.0 / self.knots.step_s, self._width)


class Held(NamedTuple):
    """Images (N,) of a window in the time of the one before, and the camera there: rotations and positions (N,)."""

    image: np.ndarray
    rotation: np.ndarray
    position: np.ndarray


def camera_there(last: CameraPath, stamp_ns: np.ndarray) -> Held:
    """The camera of the window before, at those images of stamps (F,) that lie in its time."""
    rotation, position = last.pose
    inside = np.flatnonzero((stamp_ns >= last.stamp_ns[0]) & (stamp_ns <= last.stamp_ns[-1]))
    turn, place = (
        interpolate(last.stamp_ns, values, stamp_ns[inside], spherical=spherical, max_gap_s=_STRAIGHT_S)[0]
        for values, spherical in ((quaternion_from_matrix(rotation), True), (position, False))
    )
    known = np.isfinite(place).all(axis=1)
    return Held(inside[known], matrix_from_quaternion(turn[known]), place[known])


def _continued(before: PicturePath, w: Window, person: Person) -> PicturePath | None:
    """The path of the window before in a window that shares time with it; None = it is lost."""
    last, seen, held = before.camera, _Seen(w), camera_there(before.camera, w.stamp_ns)
    if cut_at(seen.sightings, over_gaps=True) is not None or not len(held.image):
        return None
    grown = _grown(seen, last, held) if before.facts.kind is Kind.MOVES else None
    found = _in_place(seen, last) if grown is None else grown[:2]
    if found is None:
        return None
    rotation, position = _as_before(*found, held)
    path = replace(before, camera=replace(last, stamp_ns=w.stamp_ns, rotation=rotation, position=position))
    # Another person's stature follows from the metres that the path has.
    return path if grown is None or person.subject != before.subject else _corrected(path, grown, person)


def _in_place(seen: _Seen, last: CameraPath) -> tuple[np.ndarray, np.ndarray] | None:
    """Rotations (F, 3, 3) and zero positions of a camera that keeps its place; None = it does not."""
    assert last.matrix is not None
    place, kind = np.zeros((len(seen.slot), 3)), seen.kind(last)
    if kind is Kind.STANDS:
        return np.tile(np.eye(3), (len(place), 1, 1)), place
    return (turns(seen.sightings, last.matrix)[0][seen.slot], place) if kind is Kind.TURNS else None


def _grown(seen: _Seen, last: CameraPath, held: Held) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Rotations, positions (F,) and points (J, 4) of a path that goes on, in a unit of its own; None = it does not."""
    assert last.matrix is not None
    image = seen.image[seen.knots.frame]
    known = np.isin(image, held.image)
    theirs = np.searchsorted(held.image, image[known])
    rotation, position = np.tile(np.eye(3), (len(image), 1, 1)), np.zeros((len(image), 3))
    rotation[known], position[known] = held.rotation[theirs], held.position[theirs]
    if known.sum() < 2:
        return None
    growth = Growth(seen.sightings, Grown(rotation, position, known, last.matrix), 1.0 / seen.knots.step_s, 0.0)
    while not growth.path.known.all() and growth.extend():
        pass
    path = growth.path
    found = adjusted(seen.sightings, path, seen.fps, 0.0, _STEPS)
    newest = seen.knots.frame > len(seen.image) - 1 - _NEWEST_S * seen.fps
    if found is None or not path.known[newest].any() or not fits(found, last.matrix):
        return None
    keys = seen.knots.frame[path.known]
    at = np.clip(seen.slot, keys[0], keys[-1]) - keys[0]
    return found.rotation[at], found.position[at], found.points


def _as_before(rotation: np.ndarray, position: np.ndarray, held: Held) -> tuple[np.ndarray, np.ndarray]:
    """The path (F,) in the axes, at the place and in the metres that the window before has."""
    turn = project_to_so3(np.einsum("fki,fkj->ij", held.rotation, rotation[held.image]))
    place, theirs_at = position[held.image] @ turn.T, held.position
    # The path keeps its metres, though the adjustment may shrink it: a way longer than the noise measures by how much.
    spread, theirs_spread = (np.square(p - p.mean(axis=0)).sum(axis=1).mean() for p in (place, theirs_at))
    scale = float(np.sqrt((theirs_spread + _PLACE_M**2) / (spread + _PLACE_M**2)))
    moved = scale * (position @ turn.T - place.mean(axis=0)) + theirs_at.mean(axis=0)
    return rotation @ turn.T, moved


def _corrected(path: PicturePath, grown: tuple[np.ndarray, np.ndarray, np.ndarray], person: Person) -> PicturePath:
    """The path in metres at which the window's feet rest, and upright by its ground, where its own contradict them."""
    camera, facts, (turned, moved, points) = path.camera, path.facts, grown
    rotation, position = camera.pose
    seen = seen_from_camera(camera, person.poses, person.metres_per_px(camera))
    scale = by_contacts((seen @ rotation)[:, ANKLES], position, camera.stamp_ns)
    fresh = set_upright(replace(camera.moved(turned, moved), picture=replace(facts, points=points)), seen)
    (their_turn, their_place), told = fresh.pose, fresh.picture
    assert told is not None
    factor, turn, lift = 1.0, np.eye(3), 0.0
    if scale is not None and scale.std < FEET_TELL and LEAST_SCALE_STD < abs(np.log(scale.factor)) < _MOST_SCALE:
        factor = scale.factor
        facts = replace(facts, scale_std=max(scale.std, LEAST_SCALE_STD))
    up = rotation[-1].T @ their_turn[-1, :, 2]
    tilt = np.arccos(np.clip(up[2], -1.0, 1.0))
    if told.up is UpSource.GROUND and tilt > np.deg2rad(_TILTED_DEG):
        across = np.cross(up, [0.0, 0.0, 1.0])
        turn = exp_so3(tilt * across / np.linalg.norm(across))
        # The floor is where the ground is.
        lift = their_place[-1, 2] - factor * (turn @ position[-1])[2]
        facts = replace(facts, up=told.up, up_std_deg=told.up_std_deg)
    if facts is path.facts:
        return path
    place = factor * position @ turn.T + [0.0, 0.0, lift]
    camera = replace(camera, rotation=rotation @ turn.T, position=place, picture=facts)
    return replace(path, camera=camera, corrections=path.corrections + 1)


def own_covariance(path: PicturePath, joints: np.ndarray, stature_std: float) -> np.ndarray:
    """(F, P, 3, 3) m^2 of joints (F, P, 3) m in ``odom`` by what is unknown of the path: up, metres and drift."""
    camera, facts = path.camera, path.facts
    rotation, position = camera.pose
    moves = np.isfinite(facts.scale_std)
    # A way has an unknown factor as a whole; without one the distance of a person of unknown stature is unknown.
    arm = joints if moves else joints - position[:, None]
    out = (facts.scale_std if moves else stature_std) ** 2 * arm[..., :, None] * arm[..., None, :]
    tilted = hat(joints)[..., :2]
    out += np.deg2rad(facts.up_std_deg) ** 2 * (tilted @ np.swapaxes(tilted, -1, -2))
    lever = joints_by_camera(joints, rotation, position)
    seconds = np.maximum(camera.stamp_ns - path.begun_ns, 0) * 1e-9
    drift = seconds[:, None] * np.repeat([path.drift_m, path.drift_rad], 3) ** 2
    return np.asarray(out + (lever * drift[:, None, None]) @ np.swapaxes(lever, -1, -2))
