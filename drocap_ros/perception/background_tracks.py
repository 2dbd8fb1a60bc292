"""Fixed points of the scene, followed through the images: corners spread over a grid, by pyramidal optical flow."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from drocap_ros.background import FixedPoints

_SIDE_PX = 1440  # longest side in which points are followed; larger images are halved until they fit
_CELLS = 160  # of the grid, one corner each
_MOST = 160  # points at a time: ten times the least number that shows a motion
_ENOUGH = 80  # of them: with fewer, cells take more than one
_IN_A_CELL = 3  # most that one takes, and that may gather there as the camera backs off
_GRADIENT = 2.5  # grey values per px along an edge's own direction, root mean square: sky, water and walls have less
_BLOCK_PX = 5  # over which that is measured, in the image at half the size
_EDGE_PX = 10  # of the image, in which the flow's window would not fit
_WINDOW_PX = 15  # of the optical flow around each point, as in the examples of OpenCV
_COARSEST_PX = 16  # least height or width of the flow's coarsest image: its window has to fit
_MOST_LEVELS = 5  # of the flow's pyramid: steps up to 7 * 2^5 = 224 px
_BACK_PX = 0.5  # distance from its beginning at which a point may end up when it is followed back
_BACK_LEVELS = 1  # of the way back, which begins where the others' motion says
_FEW = 0.7  # share of the points that are found again below which the whole image's shift is tried
_CUT = 0.2  # and below which the scene is another: no point goes on
_SHIFT_PX = 480  # longer side of the images whose shift is measured
_MARGIN = (0.1, 0.1, 0.1, 0.2)  # around a person's box, lengths: left, top, right, and below it feet and shadow
_RENEW_NS = (
    95_000_000  # interval of the search for new corners: a pan of 40 degrees/s brings in a twentieth of an image
)
_RENEW_SHARE = 0.75  # of the points after the last search, below which the next one is due at once


class BackgroundTracks:
    """Follows corners of what stands still; equal images give equal tracks."""

    def __init__(self) -> None:
        self._grey: np.ndarray | None = None
        self._scale = 1.0  # px of the image per px of the grey one
        self._track: np.ndarray = np.empty(0, np.int64)
        self._point: np.ndarray = np.empty((0, 2), np.float32)  # px of the grey image
        self._next = 0
        self._renewed: tuple[int, int] | None = None  # stamp of the last search for corners, and points after it

    def reset(self) -> None:
        """End all tracks; their numbers are not used again."""
        self._grey, self._renewed = None, None
        self._keep(np.zeros(len(self._track), bool))

    def follow(self, image: np.ndarray) -> FixedPoints:
        """Follow the points of the last image into this one (H, W, 3) uint8 BGR; those that it does not show end."""
        grey, self._scale = _grey(image)
        last, self._grey = self._grey, grey
        if last is None or last.shape != grey.shape or min(grey.shape) < 2 * _EDGE_PX + 1:
            self.reset()
            self._grey = grey
        elif len(self._track):
            self._point, found = _followed(last, grey, self._point)
            self._keep(found)
        return self.points

    def renew(self, persons: Sequence[np.ndarray], stamp_ns: int) -> FixedPoints:
        """End the points on persons, boxes (4,) px of this image, and begin new ones where the image has none."""
        if self._grey is None or min(self._grey.shape) < 2 * _EDGE_PX + 1:
            return self.points
        free = _free(self._grey.shape, self._scale, persons)
        at = np.round(self._point).astype(int)
        self._keep(free[at[:, 1], at[:, 0]] > 0)
        if self._renewed is not None:
            since_ns, count = stamp_ns - self._renewed[0], self._renewed[1]
            if since_ns < _RENEW_NS and len(self._track) >= _RENEW_SHARE * count:
                return self.points
        self._keep(~_crowded(self._point, self._grey.shape))
        new = _corners(self._grey, free, self._point)
        self._track = np.append(self._track, np.arange(self._next, self._next + len(new)))
        self._point = np.concatenate([self._point, new])
        self._next += len(new)
        self._renewed = stamp_ns, len(self._track)
        return self.points

    @property
    def points(self) -> FixedPoints:
        """The points that are followed, in the last image."""
        return FixedPoints(self._track, (self._point + np.float32(0.5)) * np.float32(self._scale) - np.float32(0.5))

    def _keep(self, kept: np.ndarray) -> None:
        self._track, self._point = self._track[kept], self._point[kept]


def _grey(image: np.ndarray) -> tuple[np.ndarray, float]:
    """Grey image, halved until it fits, and how much smaller it is: means of four pixels are fast."""
    grey, scale = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), 1.0
    while max(grey.shape) > _SIDE_PX and min(grey.shape) > 1:
        even = grey[: grey.shape[0] // 2 * 2, : grey.shape[1] // 2 * 2]
        grey, scale = cv2.resize(even, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), 2 * scale
    return grey, scale


def _followed(last: np.ndarray, grey: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 2) px in the next image, and which (N,) bool were found."""
    moved, found = _flow(last, grey, points, points)
    if found.mean() < _FEW:
        # A pan of a blurred image exceeds the reach of the flow: from the shift of the whole image once more.
        again, found_again = _flow(last, grey, points, points + _shift(last, grey))
        if found_again.sum() > found.sum():
            moved, found = again, found_again
    if found.mean() < _CUT:
        found[:] = False
    return moved, found


def _flow(last: np.ndarray, grey: np.ndarray, points: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 2) followed from a start, and which come back to their beginning from where the others would."""
    moved, found = _step(last, grey, points, start, _MOST_LEVELS)
    if not found.any():
        return moved, found
    motion = np.median((moved - points)[found], axis=0)
    back, returned = _step(grey, last, moved, moved - motion, _BACK_LEVELS)
    near = np.linalg.norm(back - points, axis=1) <= _BACK_PX
    size = np.array(grey.shape[::-1])
    inside = ((moved >= _EDGE_PX) & (moved <= size - 1 - _EDGE_PX)).all(axis=1)
    return moved, found & returned & near & inside


def _step(
    last: np.ndarray, grey: np.ndarray, points: np.ndarray, start: np.ndarray, levels: int
) -> tuple[np.ndarray, np.ndarray]:
    fitting = int(np.log2(min(grey.shape) / _COARSEST_PX))
    moved, status, _ = cv2.calcOpticalFlowPyrLK(
        last,
        grey,
        np.array(points, np.float32).reshape(-1, 1, 2),
        np.array(start, np.float32).reshape(-1, 1, 2),  # a copy: the flow ends in it
        winSize=(_WINDOW_PX, _WINDOW_PX),
        maxLevel=max(0, min(levels, fitting)),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    return moved[:, 0], (status[:, 0] == 1) & np.isfinite(moved[:, 0]).all(axis=1)


def _shift(last: np.ndarray, grey: np.ndarray) -> np.ndarray:
    """(2,) px by which the image moved as a whole."""
    small = min(1.0, _SHIFT_PX / max(grey.shape))
    size = [max(1, round(side * small)) for side in grey.shape[::-1]]
    before, now = (cv2.resize(g, size, interpolation=cv2.INTER_AREA).astype(np.float32) for g in (last, grey))
    shift, _ = cv2.phaseCorrelate(before, now, cv2.createHanningWindow(size, cv2.CV_32F))
    way: np.ndarray = np.array(shift) / small
    return way


def _free(shape: tuple[int, ...], scale: float, persons: Sequence[np.ndarray]) -> np.ndarray:
    """(H, W) uint8, 255 where points may be: away from the edges and the persons, boxes (4,) px of the image."""
    height, width = shape
    mask = np.zeros(shape, np.uint8)
    mask[_EDGE_PX : height - _EDGE_PX, _EDGE_PX : width - _EDGE_PX] = 255
    for box in persons:
        length = float((box[2:] - box[:2]).max())
        wide = (box + length * np.array(_MARGIN) * [-1, -1, 1, 1]) / scale
        x0, y0, x1, y1 = np.clip(wide, 0, [width, height, width, height]).astype(int)
        mask[y0 : y1 + 1, x0 : x1 + 1] = 0
    return mask


def _corners(grey: np.ndarray, free: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(N, 2) float32 px, the best corners of the cells of the grid without a point, not more than there is room for.

    Where little of the image has texture, its cells take more than one.
    """
    half = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    # OpenCV's scale: four times the mean square of the gradient, grey values from 0 to 1.
    response = cv2.cornerMinEigenVal(half, _BLOCK_PX) - 4 * (_GRADIENT / 255) ** 2
    response[cv2.resize(free, half.shape[::-1], interpolation=cv2.INTER_NEAREST) == 0] = 0
    found = points / 2
    _without(response, found)
    for most in range(1, _IN_A_CELL + 1):
        if len(found) < (_MOST if most == 1 else _ENOUGH):
            new = _best(response, found, most)
            _without(response, new)
            found = np.concatenate([found, new])
    new_points: np.ndarray = (2 * found[len(points) :] + 0.5).astype(np.float32)
    return new_points


def _without(response: np.ndarray, points: np.ndarray) -> None:
    """Take the surroundings of points (N, 2) px out of a response (H, W)."""
    near = _grid(response.shape)[0] // 3
    for x, y in np.round(points).astype(int):
        response[max(y - near, 0) : y + near + 1, max(x - near, 0) : x + near + 1] = 0


def _best(response: np.ndarray, points: np.ndarray, most: int) -> np.ndarray:
    """(M, 2) px, best corners of the cells with fewer than ``most`` of the points (N, 2) px, up to _MOST in all."""
    side, rows, columns = _grid(response.shape)
    cells = response[: rows * side, : columns * side].reshape(rows, side, columns, side)
    flat = cells.transpose(0, 2, 1, 3).reshape(rows * columns, side * side)
    best = flat.argmax(axis=1)
    quality = flat[np.arange(len(flat)), best]
    quality[np.bincount(_cell(points, response.shape), minlength=len(flat)) >= most] = 0
    chosen = np.argsort(-quality, kind="stable")[: _MOST - len(points)]
    chosen = chosen[quality[chosen] > 0]
    at = best[chosen]
    return np.column_stack([chosen % columns * side + at % side, chosen // columns * side + at // side])


def _grid(shape: tuple[int, ...]) -> tuple[int, int, int]:
    """Side of the square cells, px, and how many of them an image has from top to bottom and from left to right."""
    side = max(1, int(np.sqrt(shape[0] * shape[1] / _CELLS)))
    return side, max(1, shape[0] // side), max(1, shape[1] // side)


def _cell(points: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """(N,) number of the cell of each point (N, 2) px."""
    side, rows, columns = _grid(shape)
    x, y = np.minimum(points.astype(int) // side, [columns - 1, rows - 1]).T
    return np.asarray(y * columns + x)


def _crowded(points: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """(N,) bool: points (N, 2) px, the oldest first, beside older ones that are enough for their cell."""
    cell = _cell(points, shape)
    order = np.argsort(cell, kind="stable")
    rank = np.arange(len(cell)) - np.searchsorted(cell[order], cell[order])
    crowded = np.zeros(len(cell), bool)
    crowded[order] = rank >= _IN_A_CELL
    return crowded
