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

from drocap_ros.contacts import ANKLES
from drocap_ros.geometry.interpolation import interpolate
from drocap_ros.geometry.rotations import exp_so3, hat, matrix_from_quaternion, project_to_so3, quaternion_from_matrix
from drocap_ros.reconstruction.camera.from_picture import fits
from drocap_ros.reconstruction.camera.fusion import joints_by_camera
from drocap_ros.reconstruction.camera.growth import Grown, Growth, adjusted, turns
from drocap_ros.reconstruction.camera.kinds import Kind, cut_at, kind_of
from drocap_ros.reconstruction.camera.path_model import KNOTS_HZ, Knots
from drocap_ros.reconstruction.camera.picture_world import (
    HELD_M,
    PictureWorld,
    metres_per_unit,
    picture_camera,
    seen_from_camera,
    with_camera,
)
from drocap_ros.reconstruction.camera.sightings import Sightings
from drocap_ros.reconstruction.camera.upright import FEET_TELL, LEAST_SCALE_STD, UpSource, by_contacts, set_upright
from drocap_ros.reconstruction.camera.views import views_of
from drocap_ros.reconstruction.common.poses import ImagePoses
from drocap_ros.reconstruction.lifted.even_frames import even_slots
from drocap_ros.reconstruction.live.window import Retry, camera_path
from drocap_ros.reconstruction.person_view import true_shape
from drocap_ros.reconstruction.world.placement import metres_per_px
from drocap_ros.reconstruction.world.world_model import WorldConfig
from drocap_ros.tracks import Tracks

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

    def metres_per_px(self, tracks: Tracks) -> np.ndarray:
        """(F,) in the images of tracks with a camera's matrix."""
        return metres_per_px(true_shape(self.poses.in_image, tracks.camera_matrix), tracks.stamp_ns, self.height_m)


@dataclass(frozen=True)
class PicturePath:
    """A window's camera in ``odom``; F images.

    tracks : with the camera; world : how it was found, with up, metres and their deviations; number : of the path
    begun_ns : stamp of the path's first image; drift_m, drift_rad : deviation of place and turn within a second
    subject : whose assumed stature gives its metres
    corrections : number of later windows that corrected its up or its metres
    """

    tracks: Tracks
    world: PictureWorld
    number: int
    begun_ns: int
    drift_m: float
    drift_rad: float
    subject: int
    corrections: int = 0

    @property
    def words(self) -> str:
        """For people: what the camera does, and how well up and metres are known."""
        upright = self.world.upright
        assert upright is not None
        scale = f", metres to {100 * upright.scale_std:.0f} %" if np.isfinite(upright.scale_std) else ""
        return f"path {self.number}, {self.world.camera.kind.value}; up to {upright.std_deg:.1f} deg{scale}"


class PictureOdometry:
    """Follows the camera from window to window; memory is that of a window."""

    def __init__(self) -> None:
        self._path: PicturePath | None = None
        #: First image, by its stamp, of the next path.
        self.since_ns = 0
        self._number, self._retry = 0, Retry()
        #: Why there is no path or the last one ended, in words, and how many were lost.
        self.lost, self.losses = "", 0

    def follow(self, tracks: Tracks, person: Person, config: WorldConfig) -> PicturePath | None:
        """The path in a window with fixed points; None = there is none, ``lost`` says why.

        tracks : with the camera's matrix where it is calibrated
        """
        before, stamps = self._path, tracks.stamp_ns
        if before is not None:
            shared = stamps[0] <= before.tracks.stamp_ns[-1]
            self._path = _continued(before, tracks, person) if shared else None
            if self._path is None:
                self._lose(before, tracks, shared)
        long = stamps[-1] - stamps[0] >= _FIRST_S * 1e9
        if self._path is None and self.since_ns <= stamps[0] and self._retry.due(int(stamps[-1])) and long:
            self._path = self._begun(tracks, person, config)
        return self._path

    def moved(self, about: np.ndarray, by: np.ndarray) -> PicturePath:
        """The path turned by (3, 3) about the origin and moved by (3,) m; it goes on there."""
        assert self._path is not None
        rotation, position = camera_path(self._path.tracks)
        there = replace(self._path.tracks, camera_rotation=rotation @ about.T, camera_position=position @ about.T + by)
        self._path = replace(self._path, tracks=there)
        return self._path

    def _lose(self, path: PicturePath, tracks: Tracks, shared: bool) -> None:
        last, seen = path.tracks, _Seen(tracks)
        if (cut := cut_at(seen.sightings, over_gaps=True)) is not None:
            at, why = int(tracks.stamp_ns[seen.image[seen.knots.frame[cut]]]), "a cut"
        elif shared and (kind := seen.kind(last)).known:
            # A camera that begins to move, say: nothing is wrong with the images of before.
            at, why = int(tracks.stamp_ns[0]), f"it is {kind.value} now"
        else:
            at, why = int(last.stamp_ns[-1]), kind.value if shared else "a pause"
        self.since_ns, self.lost = at, f"path {path.number} lost: {why}; another one begins"
        self.losses += 1

    def _begun(self, tracks: Tracks, person: Person, config: WorldConfig) -> PicturePath | None:
        """A path that begins in this window."""
        camera = picture_camera(tracks)
        if camera is None or not camera.kind.known:
            self._pause("too few images" if camera is None else camera.kind.value, tracks)
            return None
        tracks = replace(tracks, camera_matrix=camera.matrix)
        tracks, world = with_camera(tracks, camera, person.poses, person.metres_per_px(tracks), config)
        upright = world.upright
        assert upright is not None
        if upright.scale_std > _LARGEST_SCALE_STD:
            self._pause("neither feet nor ground give its metres", tracks)
            return None
        if world.config is not None:  # corrected by each window alone, the path would not be one
            world = replace(world, config=replace(world.config, position_wander_m=HELD_M))
        self._number, self._retry = self._number + 1, Retry()
        unit_m = metres_per_unit(camera, upright.position)
        drift = np.nan_to_num([unit_m * camera.position_std, np.deg2rad(camera.turn_std_deg)]) * np.sqrt(KNOTS_HZ)
        begun_ns = int(tracks.stamp_ns[0])
        return PicturePath(tracks, world, self._number, begun_ns, float(drift[0]), float(drift[1]), person.subject)

    def _pause(self, why: str, tracks: Tracks) -> None:
        self._retry.failed(int(tracks.stamp_ns[-1]))
        self.lost = f"no path: {why}"


class _Seen:
    """Fixed points of a window at its keyframes; image : (frames,) of each evenly spaced frame, -1 = there is none."""

    def __init__(self, tracks: Tracks) -> None:
        points = tracks.background
        assert points is not None
        slot, self.fps = even_slots(tracks.stamp_ns)
        self.slot, self.image = slot, np.full(int(slot[-1]) + 1, -1)
        self.image[slot] = np.arange(len(slot))
        frames = len(self.image)
        self.knots = Knots(frames, self.fps)
        views = views_of(slot[points.frame], points.track, points.point.astype(np.float64), frames, self.fps)
        self.sightings = Sightings(views, self.knots.frame)

    def kind(self, last: Tracks) -> Kind:
        """What the camera does, through the lens of the window before."""
        assert last.camera_matrix is not None
        return kind_of(self.sightings, last.camera_matrix, 1.0 / self.knots.step_s, last.image_size[0])


class Held(NamedTuple):
    """Images (N,) of a window in the time of the one before, and the camera there: rotations and positions (N,)."""

    image: np.ndarray
    rotation: np.ndarray
    position: np.ndarray


def camera_there(last: Tracks, stamp_ns: np.ndarray) -> Held:
    """The camera of the window before, at those images of stamps (F,) that lie in its time."""
    rotation, position = camera_path(last)
    inside = np.flatnonzero((stamp_ns >= last.stamp_ns[0]) & (stamp_ns <= last.stamp_ns[-1]))
    turn, place = (
        interpolate(last.stamp_ns, values, stamp_ns[inside], spherical=spherical, max_gap_s=_STRAIGHT_S)[0]
        for values, spherical in ((quaternion_from_matrix(rotation), True), (position, False))
    )
    known = np.isfinite(place).all(axis=1)
    return Held(inside[known], matrix_from_quaternion(turn[known]), place[known])


def _continued(before: PicturePath, tracks: Tracks, person: Person) -> PicturePath | None:
    """The path of the window before in a window that shares time with it; None = it is lost."""
    last, seen, held = before.tracks, _Seen(tracks), camera_there(before.tracks, tracks.stamp_ns)
    if cut_at(seen.sightings, over_gaps=True) is not None or not len(held.image):
        return None
    tracks = replace(tracks, camera_matrix=last.camera_matrix)
    grown = _grown(seen, last, held) if before.world.camera.kind is Kind.MOVES else None
    found = _in_place(seen, last) if grown is None else grown[:2]
    if found is None:
        return None
    rotation, position = _as_before(*found, held)
    path = replace(before, tracks=replace(tracks, camera_rotation=rotation, camera_position=position))
    # Another person's stature follows from the metres that the path has.
    return path if grown is None or person.subject != before.subject else _corrected(path, grown, person)


def _in_place(seen: _Seen, last: Tracks) -> tuple[np.ndarray, np.ndarray] | None:
    """Rotations (F, 3, 3) and zero positions of a camera that keeps its place; None = it does not."""
    assert last.camera_matrix is not None
    place, kind = np.zeros((len(seen.slot), 3)), seen.kind(last)
    if kind is Kind.STANDS:
        return np.tile(np.eye(3), (len(place), 1, 1)), place
    return (turns(seen.sightings, last.camera_matrix)[0][seen.slot], place) if kind is Kind.TURNS else None


def _grown(seen: _Seen, last: Tracks, held: Held) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Rotations, positions (F,) and points (J, 4) of a path that goes on, in a unit of its own; None = it does not."""
    assert last.camera_matrix is not None
    image = seen.image[seen.knots.frame]
    known = np.isin(image, held.image)
    theirs = np.searchsorted(held.image, image[known])
    rotation, position = np.tile(np.eye(3), (len(image), 1, 1)), np.zeros((len(image), 3))
    rotation[known], position[known] = held.rotation[theirs], held.position[theirs]
    if known.sum() < 2:
        return None
    growth = Growth(seen.sightings, Grown(rotation, position, known, last.camera_matrix), 1.0 / seen.knots.step_s, 0.0)
    while not growth.path.known.all() and growth.extend():
        pass
    path = growth.path
    found = adjusted(seen.sightings, path, seen.fps, 0.0, _STEPS)
    newest = seen.knots.frame > len(seen.image) - 1 - _NEWEST_S * seen.fps
    if found is None or not path.known[newest].any() or not fits(found, last.camera_matrix):
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
    tracks, upright = path.tracks, path.world.upright
    rotation, position = camera_path(tracks)
    assert upright is not None
    seen = seen_from_camera(tracks, person.poses, person.metres_per_px(tracks))
    scale = by_contacts((seen @ rotation)[:, ANKLES], position, tracks.stamp_ns)
    fresh = set_upright(*grown, seen, tracks.stamp_ns)
    factor, turn, lift = 1.0, np.eye(3), 0.0
    if scale is not None and scale.std < FEET_TELL and LEAST_SCALE_STD < abs(np.log(scale.factor)) < _MOST_SCALE:
        factor = scale.factor
        upright = upright._replace(scale_std=max(scale.std, LEAST_SCALE_STD))
    up = rotation[-1].T @ fresh.rotation[-1, :, 2]
    tilt = np.arccos(np.clip(up[2], -1.0, 1.0))
    if fresh.source is UpSource.GROUND and tilt > np.deg2rad(_TILTED_DEG):
        across = np.cross(up, [0.0, 0.0, 1.0])
        turn = exp_so3(tilt * across / np.linalg.norm(across))
        # The floor is where the ground is.
        lift = fresh.position[-1, 2] - factor * (turn @ position[-1])[2]
        upright = upright._replace(source=fresh.source, std_deg=fresh.std_deg)
    if upright is path.world.upright:
        return path
    place = factor * position @ turn.T + [0.0, 0.0, lift]
    tracks = replace(tracks, camera_rotation=rotation @ turn.T, camera_position=place)
    world = replace(path.world, upright=upright)
    return replace(path, tracks=tracks, world=world, corrections=path.corrections + 1)


def own_covariance(path: PicturePath, joints: np.ndarray, stature_std: float) -> np.ndarray:
    """(F, P, 3, 3) m^2 of joints (F, P, 3) m in ``odom`` by what is unknown of the path: up, metres and drift."""
    tracks, upright = path.tracks, path.world.upright
    assert upright is not None
    rotation, position = camera_path(tracks)
    moves = np.isfinite(upright.scale_std)
    # A way has an unknown factor as a whole; without one the distance of a person of unknown stature is unknown.
    arm = joints if moves else joints - position[:, None]
    out = (upright.scale_std if moves else stature_std) ** 2 * arm[..., :, None] * arm[..., None, :]
    tilted = hat(joints)[..., :2]
    out += np.deg2rad(upright.std_deg) ** 2 * (tilted @ np.swapaxes(tilted, -1, -2))
    lever = joints_by_camera(joints, rotation, position)
    seconds = np.maximum(tracks.stamp_ns - path.begun_ns, 0) * 1e-9
    drift = seconds[:, None] * np.repeat([path.drift_m, path.drift_rad], 3) ** 2
    return np.asarray(out + (lever * drift[:, None, None]) @ np.swapaxes(lever, -1, -2))
