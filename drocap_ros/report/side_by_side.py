"""A video for people: what the camera saw, with the body drawn, beside the body in 3D, as in the report's player."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np

from drocap_ros.clip import Progress
from drocap_ros.motion import Motion, upright_joints
from drocap_ros.report.motion_images import Box, FollowingBox, each_image
from drocap_ros.report.overlay import VideoFile
from drocap_ros.report.statistics import Statistics, motion_statistics, smooth
from drocap_ros.skeleton import side_of

#: Sides of both panes, px.
_HEIGHT = 720
#: The 3D pane is drawn in this size and shrunk: smooth edges.
_FINE = 2
#: As in the report's light theme, BGR.
_GROUND, _GRID, _TEXT = (248, 246, 244), (226, 218, 211), (117, 103, 92)
_COLOURS = {"right": (47, 67, 200), "left": (176, 111, 42), "middle": (112, 100, 90)}
#: Distance of the viewer, half the view's height, radius and step of the grid, floor below the ankles, head: m.
_DISTANCE, _REACH, _GRID_REACH, _GRID_STEP, _FOOT, _HEAD = 6.0, 1.12, 1.4, 0.5, 0.06, 0.1
#: Widths of limbs, m.
_WIDTHS = {"hip": 0.05, "knee": 0.075, "ankle": 0.055, "neck": 0.055, "shoulder": 0.05, "elbow": 0.05}
_TRUNK = ("lshoulder", "rshoulder", "rhip", "lhip")
#: Bits of a fraction of a px in OpenCV's coordinates.
_SHIFT = 4


def save_side_by_side(path: Path, motion: Motion, video: Path, progress: Progress) -> None:
    """Write an H.264 video of a motion and its images, at the motion's rate.

    video : source of the motion
    progress : takes the stage's name and its share

    Raises DrocapError when the file cannot be written.
    """
    pictures = _pictures(motion, video, progress)
    first, rate_hz = next(pictures)
    with VideoFile(path, (first.shape[1], first.shape[0]), rate_hz) as out:
        out.write(first)
        for picture, _ in pictures:
            out.write(picture)


def _pictures(motion: Motion, video: Path, progress: Progress) -> Iterator[tuple[np.ndarray, float]]:
    """Pictures (720, W, 3) uint8 BGR at an even rate, each with that rate in images/s."""
    s = motion_statistics(motion)
    body, follow = BodyPicture(motion, s), FollowingBox()
    rate_hz = min(s.rate_hz or 1.0, 60.0)
    longest = int(rate_hz)  # where the motion has a gap a picture stands for a second at most
    count = 0
    picture: np.ndarray | None = None
    for index, image in each_image(video, motion):
        box = follow(int(motion.stamp_ns[index]), motion.keypoints[index], image.shape)
        due = int(s.times_s[index] * rate_hz + 0.5) + 1
        if due <= count:
            continue
        if picture is not None:
            yield from [(picture, rate_hz)] * min(due - count - 1, longest)
        picture = np.hstack([_as_filmed(image, box, motion, index), body.draw(index)])
        yield picture, rate_hz
        count = due
        progress("video", (index + 1) / len(s.times_s))


def _as_filmed(image: np.ndarray, box: Box, motion: Motion, index: int) -> np.ndarray:
    """The subject's part of an image, (720, 720, 3), with the keypoints that were found."""
    import cv2

    x0, y0, x1, y1 = box
    scale = _HEIGHT / max(x1 - x0, y1 - y0)
    # The box in the middle of the pane.
    to_pane = np.array(
        [[scale, 0.0, 0.5 * (_HEIGHT - scale * (x0 + x1))], [0.0, scale, 0.5 * (_HEIGHT - scale * (y0 + y1))]]
    )
    way = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_CUBIC
    part = cv2.resize(image[y0:y1, x0:x1], None, fx=scale, fy=scale, interpolation=way)
    pane = np.full((_HEIGHT, _HEIGHT, 3), _GROUND, np.uint8)
    top, left = (max(0, round(float(v))) for v in to_pane[[1, 0], 2] + scale * np.array([y0, x0]))
    part = part[: _HEIGHT - top, : _HEIGHT - left]
    pane[top : top + part.shape[0], left : left + part.shape[1]] = part
    places = motion.keypoints[index] @ to_pane[:, :2].T + to_pane[:, 2]
    known = np.isfinite(places).all(axis=1)
    bones = [
        (parent, joint) for joint, parent in enumerate(motion.parents) if parent >= 0 and known[[parent, joint]].all()
    ]
    for parent, joint in bones:
        _line(pane, places[[parent, joint]], (30, 30, 30), 6)
    for parent, joint in bones:
        _line(pane, places[[parent, joint]], _COLOURS[side_of(motion.joints[joint], motion.joints)], 4)
    for joint in np.flatnonzero(known):
        _disc(pane, places[joint], 4.0, (255, 255, 255))
    return pane


class BodyPicture:
    """The body of a motion in 3D from one direction of the world, with floor and shadow."""

    def __init__(self, motion: Motion, s: Statistics) -> None:
        self._motion, self._times = motion, s.times_s
        self._joints = upright_joints(motion)
        # rad from the front of the first pose, and above the horizon.
        azimuth, elevation = float(s.heading_rad[0]) + 0.75, 0.2
        cos, sin = np.cos([azimuth, elevation]), np.sin([azimuth, elevation])
        towards = np.array([cos[1] * cos[0], cos[1] * sin[0], sin[1]])
        right = np.array([-sin[0], cos[0], 0.0])
        #: (3, 3) rows: right, up, towards the viewer.
        self._axes = np.stack([right, np.cross(towards, right), towards])
        self._floors, self._targets = _stands(self._joints, motion, s.times_s)

    def draw(self, index: int) -> np.ndarray:
        """(720, 720, 3) uint8 BGR of a frame; without a pose the floor alone."""
        import cv2

        side = _FINE * _HEIGHT
        pane: np.ndarray = np.full((side, side, 3), _GROUND, np.uint8)
        target, floor = self._targets[index], self._floors[index]
        for axis in (0, 1):
            first, last = (target[axis] + np.array([-_GRID_REACH, _GRID_REACH])) / _GRID_STEP
            for at in np.arange(np.ceil(first), last) * _GRID_STEP:
                half = np.sqrt(max(_GRID_REACH**2 - (at - target[axis]) ** 2, 0.0))
                ends = np.full((2, 3), floor)
                ends[:, axis], ends[:, 1 - axis] = at, target[1 - axis] + half * np.array([-1.0, 1.0])
                _line(pane, self._project(ends, target)[:, :2], _GRID, _FINE)
        joints = self._joints[index]
        flat = self._project(np.column_stack([joints[:, :2], np.full(len(joints), floor)]), target)
        shadow = pane.copy()
        for parent, joint in self._bones(flat):
            _line(shadow, flat[[parent, joint], :2], _TEXT, round(0.07 * flat[joint, 3]))
        pane = np.asarray(cv2.addWeighted(shadow, 0.18, pane, 0.82, 0.0), np.uint8)
        for _, draw in sorted(self._parts(self._project(joints, target)), key=lambda part: part[0]):
            draw(pane)
        small = cv2.resize(pane, (_HEIGHT, _HEIGHT), interpolation=cv2.INTER_AREA)
        where = (16, _HEIGHT - 18)
        cv2.putText(small, f"{self._times[index]:.2f} s", where, cv2.FONT_HERSHEY_SIMPLEX, 0.6, _TEXT, 1, cv2.LINE_AA)
        return np.asarray(small)

    def _project(self, points: np.ndarray, target: np.ndarray) -> np.ndarray:
        """(N, 4): x, y px, nearness m, px per m of points (N, 3)."""
        right, up, near = self._axes @ (points - target).T
        scale = _FINE * _HEIGHT / 2 / _REACH * _DISTANCE / np.maximum(_DISTANCE - near, 0.5)
        middle = _FINE * _HEIGHT / 2
        return np.column_stack([middle + scale * right, middle - scale * up, near, scale])

    def _bones(self, at: np.ndarray) -> list[tuple[int, int]]:
        known = np.isfinite(at).all(axis=1)
        pairs = ((parent, joint) for joint, parent in enumerate(self._motion.parents) if parent >= 0)
        return [(parent, joint) for parent, joint in pairs if known[parent] and known[joint]]

    def _parts(self, at: np.ndarray) -> Iterator[tuple[float, Callable[[np.ndarray], None]]]:
        """Nearness and drawing of each part of the body."""
        names = self._motion.joints
        trunk = at[[names.index(name) for name in _TRUNK]]
        if np.isfinite(trunk).all():
            yield float(trunk[:, 2].mean()) - 0.05, partial(_trunk, places=trunk)
        for parent, joint in self._bones(at):
            near, name = float(at[[parent, joint], 2].mean()), names[joint]
            # Limbs without a width of their own have 4 cm.
            width = _WIDTHS.get(name.lstrip("lr") if name[0] in "lr" else name, 0.04) * float(at[joint, 3])
            colour = _shaded(_COLOURS[side_of(name, names)], near)
            yield near, partial(_limb, ends=at[[parent, joint], :2], colour=colour, width=width)
            if name == "head":
                head = partial(
                    _disc, at=at[joint], radius=_HEAD * at[joint, 3], colour=_shaded(_COLOURS["middle"], near)
                )
                yield float(at[joint, 2]) + 0.01, head


def _stands(joints: np.ndarray, motion: Motion, times_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(F,) height of the floor, (F, 3) place to look at, m: the pelvis, smoothed; as the player has them."""
    lowest = np.nanmin(np.where(np.isfinite(joints[..., 2]), joints[..., 2], np.inf), axis=1)
    known = np.isfinite(lowest)
    usual = float(np.quantile(lowest[known], 0.05)) - _FOOT
    floors = np.full(len(joints), usual)
    if motion.frame != "world":
        floors[known] = lowest[known] - _FOOT
    pelvis = joints[:, motion.joints.index("pelvis")]
    rows = np.isfinite(pelvis).all(axis=1)
    filled = np.stack([np.interp(times_s, times_s[rows], pelvis[rows, axis]) for axis in range(3)], axis=1)
    return floors, smooth(filled, times_s)


def _shaded(colour: tuple[int, int, int], near: float) -> tuple[int, ...]:
    """A colour, paler the farther away, m."""
    share = min(0.45, max(0.0, 0.14 - 0.42 * near))
    return tuple(round(c + (g - c) * share) for c, g in zip(colour, _GROUND, strict=True))


def _limb(pane: np.ndarray, ends: np.ndarray, colour: tuple[int, ...], width: float) -> None:
    _line(pane, ends, _GROUND, round(width) + 3 * _FINE)
    _line(pane, ends, colour, max(round(width), 2 * _FINE))


def _trunk(pane: np.ndarray, places: np.ndarray) -> None:
    import cv2

    colour = tuple(round(c + (g - c) * 0.72) for c, g in zip(_COLOURS["middle"], _GROUND, strict=True))
    corners = np.round(places[:, :2] * 2**_SHIFT).astype(np.int32)
    cv2.fillPoly(pane, [corners], colour, cv2.LINE_AA, _SHIFT)
    cv2.polylines(pane, [corners], True, colour, max(round(0.1 * float(places[0, 3])), 1), cv2.LINE_AA, _SHIFT)


def _line(pane: np.ndarray, ends: np.ndarray, colour: tuple[int, ...], width: int) -> None:
    import cv2

    start, end = np.round(ends * 2**_SHIFT).astype(int).tolist()
    cv2.line(pane, start, end, colour, max(width, 1), cv2.LINE_AA, _SHIFT)


def _disc(pane: np.ndarray, at: np.ndarray, radius: float, colour: tuple[int, ...]) -> None:
    import cv2

    x, y = np.round(at[:2] * 2**_SHIFT).astype(int).tolist()
    cv2.circle(pane, (x, y), round(float(radius) * 2**_SHIFT), colour, -1, cv2.LINE_AA, _SHIFT)
