"""Fixed points of the scene, followed through the images of a recording: rows of a tracks file."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from drocap_ros.errors import InputError

#: Field -> the array of a tracks file that holds it.
ARRAYS = {"frame": "background_frame", "track": "background_track", "point": "background_point"}
#: Points and keypoints beyond it (px) lie in no image: a hundred times the width of the largest.
FARTHEST_PX = 1e6
#: Observations kept of a recording: 20 minutes at 30 Hz with 160 points, 120 MB; of an hour those of every fourth
#: image, with which the tracks of its 4K video stay within 1 GiB.
MOST_ROWS = 6_000_000


@dataclass(frozen=True)
class Background:
    """Observations of points of the scene; N rows in any order.  A track may slide, or lie on something that moves.

    frame : (N,) int32, index of the image
    track : (N,) int64, the same number for the same point
    point : (N, 2) float32 px
    """

    frame: np.ndarray
    track: np.ndarray
    point: np.ndarray

    def __post_init__(self) -> None:
        """Refuse arrays that do not fit each other."""
        rows = len(self.frame) if self.frame.ndim else 0
        expected = {"frame": ((rows,), "iu"), "track": ((rows,), "iu"), "point": ((rows, 2), "f")}
        for name, (shape, kinds) in expected.items():
            value = getattr(self, name)
            if value.shape != shape or value.dtype.kind not in kinds:
                kind = "px as float" if kinds == "f" else "integers"
                raise InputError(
                    f"{ARRAYS[name]}: expected {kind} {shape}, got {value.dtype} {value.shape}; one row per observation"
                )
        if not (np.isfinite(self.point).all() and np.abs(self.point).max(initial=0.0) <= FARTHEST_PX):
            raise InputError(
                f"{ARRAYS['point']}: expected finite px within {FARTHEST_PX:g}, got others; leave lost points out"
            )

    def __len__(self) -> int:
        return len(self.frame)

    def check_frames(self, frames: int) -> None:
        """Refuse observations in images that a recording of ``frames`` images does not have."""
        if len(self) and not (self.frame.min() >= 0 and self.frame.max() < frames):
            raise InputError(
                f"{ARRAYS['frame']}: expected indices of {frames} images from 0 on, got"
                f" {self.frame.min()} to {self.frame.max()}; cut both to the same images"
            )

    def of_frames(self, frames: np.ndarray) -> Background:
        """Those in some images (F',), distinct indices, in their numbering: a part of a recording, or it reversed."""
        last = max(int(self.frame.max(initial=0)), int(frames.max(initial=0)))
        place = np.full(last + 1, -1, np.int32)
        place[frames] = np.arange(len(frames), dtype=np.int32)
        now = place[self.frame]
        kept = now >= 0
        return Background(now[kept], self.track[kept], self.point[kept])

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays of a tracks file."""
        return {array: getattr(self, field) for field, array in ARRAYS.items()}


def read_background(arrays: Mapping[str, np.ndarray]) -> Background | None:
    """The observations among the arrays of a tracks file; None = it has none."""
    missing = [array for array in ARRAYS.values() if array not in arrays]
    if len(missing) == len(ARRAYS):
        return None
    if missing:
        raise InputError(f"expected the arrays {', '.join(ARRAYS.values())} together; missing {', '.join(missing)}")
    frame, track, point = (arrays[array] for array in ARRAYS.values())
    for name, value in zip(ARRAYS.values(), (frame, track, point), strict=True):
        if value.dtype.kind not in "iuf":
            raise InputError(f"{name}: expected numbers, got {value.dtype}")
    return Background(
        _whole(frame, "frame").astype(np.int32),
        _whole(track, "track").astype(np.int64),
        # Clipped values are refused, too: single precision cannot hold every double.
        np.clip(point, -2 * FARTHEST_PX, 2 * FARTHEST_PX).astype(np.float32),
    )


def _whole(values: np.ndarray, field: str) -> np.ndarray:
    """Indices that may have been saved as float."""
    limit = 2**31 if field == "frame" else 2**62
    if values.dtype.kind == "f" and not np.all(values == np.round(values)):
        raise InputError(f"{ARRAYS[field]}: expected integers, got fractions or NaN; round them")
    if values.size and not (np.abs(values.astype(np.float64)).max() < limit):
        raise InputError(f"{ARRAYS[field]}: expected indices, got up to {np.abs(values).max():g}; number them from 0")
    return values


@dataclass(frozen=True)
class FixedPoints:
    """Fixed points of the scene in one image.

    track : (N,) int64, the same number for the same point
    point : (N, 2) float32 px
    """

    track: np.ndarray
    point: np.ndarray

    def __len__(self) -> int:
        return len(self.track)


def of_images(images: Iterable[FixedPoints | None], most_rows: int = MOST_ROWS) -> Background | None:
    """Observations of a recording's images in their order; None = no image was searched for points.

    Of a recording with more than ``most_rows`` of them, those in every second, third ... image.
    """
    found = [(frame, points) for frame, points in enumerate(images) if points is not None]
    if not found:
        return None
    rows = sum(len(points) for _, points in found)
    found = found[:: -(-rows // most_rows) or 1]
    return Background(
        np.repeat(np.array([f for f, _ in found], np.int32), [len(p) for _, p in found]),
        np.concatenate([p.track for _, p in found]),
        np.concatenate([p.point for _, p in found]),
    )


class PointHistory:
    """Fixed points of the last images of a live stream, by their stamps; the same messages give the same answers.

    keep_s : age, before the newest image with points, up to which they are kept
    """

    def __init__(self, keep_s: float) -> None:
        self._keep_ns = round(keep_s * 1e9)
        self._images: OrderedDict[int, FixedPoints] = OrderedDict()
        #: Stamp of the last image that was taken; 0 = none.
        self.newest_ns = 0

    def add(self, stamp_ns: int, points: FixedPoints) -> None:
        """Take an image's points; one before the last image, as in a loop, ends what was before."""
        if stamp_ns <= self.newest_ns:
            self._images.clear()
        self._images[stamp_ns], self.newest_ns = points, stamp_ns
        while next(iter(self._images)) < stamp_ns - self._keep_ns:
            self._images.popitem(last=False)

    def along(self, stamp_ns: np.ndarray) -> Background | None:
        """The points in the images of stamps (F,); None = there are none."""
        return of_images([self._images.get(stamp) for stamp in stamp_ns.tolist()])
