"""Fixed points of the scene, followed through the images: corners spread over a grid.

Pyramidal optical flow from image to image, there and back, finds a point to within half a px; aligning the patch that
was taken when the point began (:mod:`drocap_ros.perception.background_tracks`) keeps it from drifting.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from drocap_ros.background import FixedPoints

_REACH = 5  # px from a patch's centre to its edge
_STEPS = 2  # of the alignment: the flow ends within half a px, and a third changes nothing
_RIDGE = 0.05  # of the Hessian's mean that holds the shape where the patch does not show it
_FLAT = 1e-3  # least deviation of a patch's grey values

_AXIS = np.arange(-_REACH - 1, _REACH + 2, dtype=np.float32)
_WIDE = np.stack(np.meshgrid(_AXIS, _AXIS), axis=-1)  # (13, 13, 2) px, with a margin for the gradient
_GRID = _WIDE[1:-1, 1:-1].reshape(-1, 2)  # (121, 2) px


@dataclass
class Patches:
    """N patches.

    look : (N, 121) grey values, mean 0, deviation 1
    step : (N, 6, 121) change of place, px of the patch, and of shape, for a difference of the looks
    shape : (N, 2, 2) px of the image per px of the patch
    """

    look: np.ndarray
    step: np.ndarray
    shape: np.ndarray

    def __len__(self) -> int:
        return len(self.look)

    def __getitem__(self, kept: np.ndarray) -> Patches:
        """Those of a mask (N,)."""
        return Patches(self.look[kept], self.step[kept], self.shape[kept])

    def __add__(self, more: Patches) -> Patches:
        """These and more."""
        return Patches(*(np.concatenate([getattr(self, n), getattr(more, n)]) for n in ("look", "step", "shape")))

    def replace(self, which: np.ndarray, others: Patches) -> None:
        """Put others in the places (N,) bool of some."""
        self.look[which], self.step[which], self.shape[which] = others.look, others.step, others.shape

    def align(self, grey: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Places (N, 2) px in an image (H, W) from places near them, and (N,) correlation of the looks there."""
        place, shape = points.astype(np.float32), self.shape
        for _ in range(_STEPS):
            look = _look(_sampled(grey, place, shape))
            alike = np.einsum("np,np->n", look, self.look) / len(_GRID)
            change = np.einsum("nkp,np->nk", self.step, look - self.look)
            shape = shape @ np.linalg.inv(np.eye(2, dtype=np.float32) + change[:, 2:].reshape(-1, 2, 2))
            place = place - np.einsum("nij,nj->ni", shape, change[:, :2])
        self.shape = shape
        return place, alike


def patches_at(grey: np.ndarray, points: np.ndarray) -> Patches:
    """The patches of an image (H, W) around points (N, 2) px."""
    count, side = len(points), len(_AXIS)
    eye = np.broadcast_to(np.eye(2, dtype=np.float32), (count, 2, 2)).copy()
    wide = _sampled(grey, points, eye, _WIDE.reshape(-1, 2)).reshape(count, side, side)
    inner = wide[:, 1:-1, 1:-1].reshape(count, len(_GRID))
    deviation = np.maximum(inner.std(axis=1), _FLAT)[:, None]
    x = ((wide[:, 1:-1, 2:] - wide[:, 1:-1, :-2]) / 2).reshape(count, len(_GRID)) / deviation
    y = ((wide[:, 2:, 1:-1] - wide[:, :-2, 1:-1]) / 2).reshape(count, len(_GRID)) / deviation
    gx, gy = _GRID.T
    slope = np.stack([x, y, x * gx, x * gy, y * gx, y * gy], axis=1)
    hessian = slope @ slope.transpose(0, 2, 1)
    ridge = _RIDGE * np.einsum("nkk->nk", hessian) * np.array([0, 0, 1, 1, 1, 1], np.float32)
    hessian = hessian + (ridge + _FLAT)[:, :, None] * np.eye(6, dtype=np.float32)
    return Patches(_look(inner), np.linalg.solve(hessian, slope).astype(np.float32), eye)


def _sampled(grey: np.ndarray, place: np.ndarray, shape: np.ndarray, grid: np.ndarray = _GRID) -> np.ndarray:
    """(N, P) grey values at a grid (P, 2) of each patch."""
    if not len(place):
        return np.empty((0, len(grid)), np.float32)
    at = place[:, None].astype(np.float32) + grid @ shape.transpose(0, 2, 1)
    values = cv2.remap(grey, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return values.astype(np.float32)


def _look(values: np.ndarray) -> np.ndarray:
    """Grey values (N, P) with mean 0 and deviation 1: exposure does not matter."""
    centred = values - values.mean(axis=1, keepdims=True)
    deviation = np.sqrt(np.einsum("np,np->n", centred, centred) / values.shape[1])
    return np.asarray(centred / np.maximum(deviation, _FLAT)[:, None])


_SIDE_PX = 1440  # longest side of the images in which patches lie; larger ones are halved until they fit
_MOST = 160  # points at a time, and cells of the grid: ten times the least number that shows a motion
_ENOUGH = _MOST // 2  # of them: with fewer, cells take more than one
_IN_A_CELL = 3  # most that one takes, and that may gather there as the camera backs off
_GRADIENT = 2.5  # grey values per px along an edge's own direction, root mean square: sky, water and walls have less
_FAINT = 1.0  # where an image has too few of these: twice the noise of pictures; concrete and snow have it
_BLOCK_PX = _REACH  # over which that is measured, in the image at half the size
#: Least gradient of a corner, and points of its cell with it: in this order, until there are enough.
_SEARCHES = (*((_GRADIENT, most) for most in range(1, _IN_A_CELL + 1)), (_FAINT, 1))
_EDGE_PX = 2 * _REACH  # of the image, in which a patch would not fit
_WINDOW_PX = 2 * _REACH + 1  # of the optical flow around each point, in the image at half the size
_COARSEST_PX = 16  # least height or width of the flow's coarsest image: its window has to fit
_LEVELS = 4  # of the flow's pyramid: steps up to 5 * 2^4 = 80 px of half the size
_BACK_LEVELS = 1  # of the way back, which begins where the others' motion says,
_BACK_PX = 0.5  # and distance from its beginning at which a point may end, in the image at half the size
_FEW = 0.7  # share of the points that are found again below which the whole image's shift is tried
_CUT = 0.2  # and below which the scene is another: no point goes on
_SHIFT_PX = 480  # longer side of the images whose shift is measured
_ALIGN_PX = 2.0  # farthest from the flow's end that a patch may be found: the flow errs by less
_ALIKE = 0.6  # least correlation of a patch with what is there: below, something else is,
_FRESH = 0.85  # and where it is less than this, a new patch is taken: the view has changed
_MARGIN = np.array([-0.1, -0.1, 0.1, 0.2])  # around a person's box, lengths: below it feet and shadow
_SEARCH_NS = 190_000_000  # interval of the search for corners: a pan of 40 degrees/s brings in a tenth of an image
_SEARCH_SHARE = 0.75  # of the points after the last search, below which the next one is due at once


class BackgroundTracks:
    """Follows corners of what stands still; equal images give equal tracks."""

    def __init__(self) -> None:
        self._grey: np.ndarray | None = None
        self._small: np.ndarray = np.empty((0, 0), np.uint8)  # the same at half the size
        self._scale = 1.0  # px of the image per px of the grey one
        self._track: np.ndarray = np.empty(0, np.int64)
        self._point: np.ndarray = np.empty((0, 2), np.float32)  # px of the grey image
        self._patches = patches_at(np.zeros((1, 1), np.uint8), self._point)
        self._next = 0
        self._searched: tuple[int, int] | None = None  # stamp of the last search for corners, and points after it

    def reset(self) -> None:
        """End all tracks; their numbers are not used again."""
        self._grey, self._searched = None, None
        self._keep(np.zeros(len(self._track), bool))

    def follow(self, image: np.ndarray) -> FixedPoints:
        """Follow the points of the last image into this one (H, W, 3) uint8 BGR; those that it does not show end."""
        grey, scale = _grey(image)
        small = _half(grey) if min(grey.shape) > 1 else grey
        if self._grey is None or self._grey.shape != grey.shape:
            self.reset()
        elif len(self._track):
            moved, found = _followed(self._small, small, _halved(self._point))
            self._point = _doubled(moved)
            self._keep(found)
            self._align(grey)
        self._grey, self._small, self._scale = grey, small, scale
        return self.points

    def renew(self, persons: Sequence[np.ndarray], stamp_ns: int) -> FixedPoints:
        """End the points on persons, boxes (4,) px of this image, and begin new ones where the image has none."""
        if self._grey is None or min(self._grey.shape) <= 2 * _EDGE_PX:
            return self.points
        wide = [(box + (box[2:] - box[:2]).max() * _MARGIN) / self._scale for box in persons]
        for box in wide:
            self._keep(~((self._point >= box[:2]) & (self._point <= box[2:])).all(axis=1))
        if self._is_due(stamp_ns):
            self._keep(~_crowded(self._point, self._grey.shape))
            new = _corners(self._small, wide, self._point)
            self._track = np.append(self._track, np.arange(self._next, self._next + len(new)))
            self._point = np.concatenate([self._point, new])
            self._patches += patches_at(self._grey, new)
            self._next += len(new)
            self._searched = stamp_ns, len(self._track)
        return self.points

    @property
    def points(self) -> FixedPoints:
        """The points that are followed, in the last image."""
        return FixedPoints(self._track, (self._point + np.float32(0.5)) * np.float32(self._scale) - np.float32(0.5))

    def _is_due(self, stamp_ns: int) -> bool:
        if self._searched is None:
            return True
        at_ns, count = self._searched
        return stamp_ns - at_ns >= _SEARCH_NS or len(self._track) < _SEARCH_SHARE * count

    def _align(self, grey: np.ndarray) -> None:
        """Put the points where their patches are in the image; end those that something else has replaced."""
        place, alike = self._patches.align(grey, self._point)
        near = (alike >= _ALIKE) & (np.linalg.norm(place - self._point, axis=1) <= _ALIGN_PX)
        inside = ((place >= _EDGE_PX) & (place <= np.array(grey.shape[::-1]) - 1 - _EDGE_PX)).all(axis=1)
        self._point = place.astype(np.float32)
        self._keep(near & inside)
        old = alike[near & inside] < _FRESH
        if old.any():
            self._patches.replace(old, patches_at(grey, self._point[old]))

    def _keep(self, kept: np.ndarray) -> None:
        if not kept.all():
            self._track, self._point, self._patches = self._track[kept], self._point[kept], self._patches[kept]


def _grey(image: np.ndarray) -> tuple[np.ndarray, float]:
    """Grey image, halved until it fits, and how much smaller it is."""
    grey, scale = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), 1.0
    while max(grey.shape) > _SIDE_PX and min(grey.shape) > 1:
        grey, scale = _half(grey), 2 * scale
    return grey, scale


def _half(grey: np.ndarray) -> np.ndarray:
    """Means of four pixels, which are fast; a last odd row or column is left out."""
    height, width = (side // 2 * 2 for side in grey.shape)
    return cv2.resize(grey[:height, :width], (width // 2, height // 2), interpolation=cv2.INTER_AREA)


def _halved(points: np.ndarray) -> np.ndarray:
    """Places (N, 2) px in the image at half the size."""
    return np.asarray((points - 0.5) / 2, np.float32)


def _doubled(points: np.ndarray) -> np.ndarray:
    """Places (N, 2) px in the image at twice the size."""
    return np.asarray(2 * points + 0.5, np.float32)


def _followed(last: np.ndarray, grey: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 2) px in the next image, and which (N,) bool were found."""
    moved, found = _flow(last, grey, points, points)
    if found.mean() < _FEW:
        # A pan of a blurred image exceeds the reach of the flow: from the shift of the whole image once more.
        again, found_again = _flow(last, grey, points, points + _shift(last, grey))
        if found_again.sum() > found.sum():
            moved, found = again, found_again
    return moved, found if found.mean() >= _CUT else np.zeros_like(found)


def _flow(last: np.ndarray, grey: np.ndarray, points: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 2) followed from a start, and which come back to their beginning from where the others would."""
    moved, found = _step(last, grey, points, start, _LEVELS)
    if not found.any():
        return moved, found
    motion = np.median((moved - points)[found], axis=0)
    back, returned = _step(grey, last, moved, moved - motion, _BACK_LEVELS)
    return moved, found & returned & (np.linalg.norm(back - points, axis=1) <= _BACK_PX)


def _step(
    last: np.ndarray, grey: np.ndarray, points: np.ndarray, start: np.ndarray, levels: int
) -> tuple[np.ndarray, np.ndarray]:
    """Optical flow of points (N, 2) px from a start, and which (N,) bool it found inside the image."""
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
    place: np.ndarray = moved[:, 0]
    inside = ((place >= 0) & (place <= np.array(grey.shape[::-1]) - 1)).all(axis=1)  # False for NaN
    return place, (status[:, 0] == 1) & inside


def _shift(last: np.ndarray, grey: np.ndarray) -> np.ndarray:
    """(2,) px by which the image moved as a whole."""
    small = min(1.0, _SHIFT_PX / max(grey.shape))
    size = [max(1, round(side * small)) for side in grey.shape[::-1]]
    before, now = (cv2.resize(g, size, interpolation=cv2.INTER_AREA).astype(np.float32) for g in (last, grey))
    shift, _ = cv2.phaseCorrelate(before, now, cv2.createHanningWindow(size, cv2.CV_32F))
    way: np.ndarray = np.array(shift) / small
    return way


def _corners(half: np.ndarray, persons: Sequence[np.ndarray], points: np.ndarray) -> np.ndarray:
    """(N, 2) float32 px, the best corners of the cells of the grid without a point, not more than there is room for.

    half : the image at half the size.  Where little of it has texture, its cells take more than one, then faint corners
    count.  None lies on persons, boxes (4,) px.
    """
    response = cv2.cornerMinEigenVal(half, _BLOCK_PX)
    edge = _EDGE_PX // 2 + 1
    response[:edge], response[-edge:], response[:, :edge], response[:, -edge:] = 0, 0, 0, 0
    for box in persons:
        x0, y0, x1, y1 = np.clip(box / 2, 0, np.tile(half.shape[::-1], 2)).astype(int)
        response[y0 : y1 + 1, x0 : x1 + 1] = 0
    there = _halved(points)
    found = there
    _take(response, there)
    for least, most in _SEARCHES:
        if len(found) < (_MOST if (least, most) == _SEARCHES[0] else _ENOUGH):
            # OpenCV's scale: four times the mean square of the gradient, grey values from 0 to 1.
            new = _best(response - 4 * (least / 255) ** 2, found, most)
            _take(response, new)
            found = np.concatenate([found, new])
    return _doubled(found[len(there) :])


def _take(response: np.ndarray, points: np.ndarray) -> None:
    """Take the surroundings of points (N, 2) px out of a response (H, W)."""
    near = _grid(response.shape)[0] // 3
    taken = np.zeros(response.shape, np.uint8)
    x, y = np.clip(np.round(points), 0, np.array(response.shape[::-1]) - 1).astype(int).T
    taken[y, x] = 1
    response[cv2.dilate(taken, np.ones((2 * near + 1, 2 * near + 1), np.uint8)) > 0] = 0


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
    side = max(1, int(np.sqrt(shape[0] * shape[1] / _MOST)))
    return side, max(1, shape[0] // side), max(1, shape[1] // side)


def _cell(points: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """(N,) number of the cell of each point (N, 2) px."""
    side, rows, columns = _grid(shape)
    x, y = np.clip(points.astype(int) // side, 0, [columns - 1, rows - 1]).T
    return np.asarray(y * columns + x)


def _crowded(points: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """(N,) bool: points (N, 2) px, the oldest first, beside older ones that are enough for their cell."""
    cell = _cell(points, shape)
    order = np.argsort(cell, kind="stable")
    crowded = np.zeros(len(cell), bool)
    crowded[order] = np.arange(len(cell)) - np.searchsorted(cell[order], cell[order]) >= _IN_A_CELL
    return crowded
