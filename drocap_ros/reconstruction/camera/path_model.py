"""Unknowns and inputs of the adjustment of a camera's path by fixed points.

The corrected path is the given one, shifted by the latencies, turned by the misalignment, plus an error of its own at
every frame.  That error is linear between knots of time, plus a rest of each frame, which a second step finds.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from drocap_ros.camera_path import CameraErrors
from drocap_ros.reconstruction.world.camera_telemetry import CameraTelemetry

#: Longest piece of a track (s): it bounds the band of the adjustment.
PIECE_S = 4.0
#: Fewer observations of a piece tell nothing: two always fit a depth.
LEAST_VIEWS = 3


@dataclass(frozen=True)
class Views:
    """N observations of J pieces of tracks, in the order of pieces and, within one, of frames.

    frame : (N,) index of a frame; piece : (N,) index of a piece, ascending; point : (N, 2) px
    track : (J,) the track of each piece; frames : number of frames
    """

    frame: np.ndarray
    piece: np.ndarray
    point: np.ndarray
    track: np.ndarray
    frames: int

    @cached_property
    def begin(self) -> np.ndarray:
        """(J,) first observation of each piece."""
        return np.searchsorted(self.piece, np.arange(len(self.track)))

    @cached_property
    def by_frame(self) -> tuple[np.ndarray, np.ndarray]:
        """Order (N,) of the observations by frame, and the place (N,) of each of these within its frame."""
        order = np.argsort(self.frame, kind="stable")
        count = np.bincount(self.frame, minlength=self.frames)
        return order, np.arange(len(order)) - np.repeat(np.cumsum(count) - count, count)

    def of_pieces(self, values: np.ndarray) -> np.ndarray:
        """Sums (J, ...) of values (N, ...) over the observations of each piece."""
        return np.asarray(np.add.reduceat(values, self.begin, axis=0))

    def of_frames(self, values: np.ndarray) -> np.ndarray:
        """Values (N, ...) by frame, (F, M, ...), with zeros where a frame has fewer than the M views of the fullest."""
        order, place = self.by_frame
        out = np.zeros((self.frames, int(place.max(initial=0)) + 1, *values.shape[1:]))
        out[self.frame[order], place] = values[order]
        return out

    def at_frames(self, keep: np.ndarray) -> tuple[Views, np.ndarray]:
        """The observations in frames with ``keep`` (F,), of the pieces (J,) that are still long enough, and these."""
        kept = keep[self.frame]
        enough = np.bincount(self.piece[kept], minlength=len(self.track)) >= LEAST_VIEWS
        return self._rows(kept & enough[self.piece], enough), enough

    def of(self, pieces: np.ndarray) -> Views:
        """The observations of some pieces (J,) bool."""
        return self._rows(pieces[self.piece], pieces)

    def _rows(self, rows: np.ndarray, pieces: np.ndarray) -> Views:
        number = np.cumsum(pieces) - 1
        return Views(self.frame[rows], number[self.piece[rows]], self.point[rows], self.track[pieces], self.frames)


def views_of(frame: np.ndarray, track: np.ndarray, point: np.ndarray, frames: int, fps: float) -> Views:
    """Observations (N,), (N,), (N, 2) px of any order; tracks are cut into pieces of ``PIECE_S``.

    Of several observations of one track in one frame the first counts.
    """
    order = np.lexsort((frame, track))
    frame, track, point = frame[order], track[order], point[order]
    new = np.ones(len(track), bool)
    new[1:] = track[1:] != track[:-1]
    own = new.copy()
    own[1:] |= frame[1:] != frame[:-1]
    first = frame[np.maximum.accumulate(np.where(new, np.arange(len(track)), 0))] if len(track) else frame
    part = (frame - first) // max(round(PIECE_S * fps), LEAST_VIEWS)
    new[1:] |= part[1:] != part[:-1]
    piece = np.cumsum(new) - 1
    enough = np.bincount(piece[own], minlength=int(new.sum())) >= LEAST_VIEWS
    own &= enough[piece] if len(piece) else own
    number = np.cumsum(enough) - 1
    return Views(
        frame[own].astype(np.intp), number[piece[own]], np.asarray(point[own], np.float64), track[new][enough], frames
    )


def triangulate(views: Views, rotation: np.ndarray, position: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Points (J, 4) of unit length, x y z w, that the rays of a path see; w = 0 = infinitely far.

    rotation : (F, 3, 3) world -> camera; position : (F, 3) in a unit in which points are about one away
    """
    ray = (views.point - matrix[:2, 2]) / np.diagonal(matrix)[:2]
    seen, at = rotation[views.frame], position[views.frame]
    camera = np.concatenate([seen, -np.einsum("nij,nj->ni", seen, at)[..., None]], axis=2)
    rows = camera[:, :2] - ray[..., None] * camera[:, 2:]
    square = views.of_pieces(np.swapaxes(rows, 1, 2) @ rows)
    if np.ptp(position, axis=0).any():
        point = np.linalg.eigh(square)[1][..., 0]
    else:  # rays from one place: directions alone
        point = np.zeros((len(square), 4))
        point[:, :3] = np.linalg.eigh(square[:, :3, :3])[1][..., 0]
    depth = views.of_pieces(np.einsum("ni,ni->n", camera[:, 2], point[views.piece]))
    return np.asarray(np.where(depth < 0.0, -1.0, 1.0)[:, None] * point)


#: Unknowns of a knot: position error (3) m, rotation error (3) rad in camera axes.
KNOT = 6
#: The unknowns of the whole recording, in this order.
MISALIGNMENT = slice(0, 3)
ATTITUDE_LATENCY = 3
POSITION_LATENCY = 4
FOCAL = 5
SHARED = 6
#: Couplings of the acceleration: two knots on.
LEAST_REACH = 3
#: Errors that a path by fixed points may still have: constant ones that no body could tell, as the points turn with the
#: camera, and the least slow one.
LEFT = CameraErrors(tilt_deg=0.02, yaw_deg=0.02, latency_s=1e-3, attitude_wander_deg=0.05)
#: Knots per second: between them a camera that accelerates with 3 m/s^2 leaves a straight line by 6 mm.
KNOTS_HZ = 8.0


@dataclass(frozen=True)
class PathConfig:
    """Expected errors of a given path; a standard deviation of 0 holds an unknown.

    focal : of the logarithm of the focal length
    jitter_m, jitter_deg : of the rest of each frame
    noise_px : of a point's coordinate
    views_per_fact : observations of a track, one per knot, that carry one independent piece of information, as errors
        of tracks last: the priors count as much more
    iterations : most steps
    """

    errors: CameraErrors = field(default_factory=CameraErrors)
    focal: float = 0.0
    jitter_m: float = 0.005
    jitter_deg: float = 0.2
    noise_px: float = 0.5
    views_per_fact: float = 3.0
    iterations: int = 12


@dataclass(frozen=True)
class PathInput:
    """What is given: the path of F evenly spaced frames, camera matrix (3, 3) px, and observations of fixed points.

    known : (SHARED, SHARED) inverse covariance of the shared unknowns about zero, beside the expected errors
    """

    path: CameraTelemetry
    matrix: np.ndarray
    views: Views
    config: PathConfig = field(default_factory=PathConfig)
    known: np.ndarray | None = None

    @cached_property
    def knots(self) -> Knots:
        """The knots of the path's errors."""
        return Knots(self.path.frames, self.path.fps)

    @cached_property
    def couplings(self) -> Couplings:
        """Which knots each piece of a track couples."""
        return Couplings(self.views, self.knots)


class Knots:
    """Knots of time, evenly spaced from the first frame to the last.

    count : K, at least 2; step_s : between two
    before : (F,) knot at or before each frame, below K - 1; share : (F,) of the knot after it
    """

    def __init__(self, frames: int, fps: float) -> None:
        spans = max(round((frames - 1) / max(fps / KNOTS_HZ, 1.0)), 1)
        at = np.arange(frames) * (spans / max(frames - 1, 1))
        self.count, self.step_s = spans + 1, max(frames - 1, 1) / fps / spans
        self.before = np.minimum(at.astype(np.intp), spans - 1)
        self.share = at - self.before
        #: (K,) frame nearest to each knot
        self.frame = np.round(np.linspace(0, frames - 1, self.count)).astype(np.intp)

    def at_frames(self, values: np.ndarray) -> np.ndarray:
        """Values (K, ...) at the frames."""
        share = self.share.reshape(-1, *(1,) * (values.ndim - 1))
        return np.asarray((1.0 - share) * values[self.before] + share * values[self.before + 1])


class Couplings:
    """The knots beside the views of each piece of a track.

    order : (J,) the pieces by the first of their knots; first : (J,) that knot, in that order
    reach : most knots from the first one of a piece to its last
    sums : (3 J reach, 3 N) sparse: rows (N, 3, M) of the views to those (J, reach, M) of the pieces' three unknowns, by
        the shares of the knots
    """

    def __init__(self, views: Views, knots: Knots) -> None:
        from scipy.sparse import csr_array

        before, share, pieces = knots.before[views.frame], knots.share[views.frame], len(views.track)
        first = before[views.begin] if pieces else np.zeros(0, np.intp)
        self.order = np.argsort(first, kind="stable")
        self.first = first[self.order]
        since = before - first[views.piece]
        self.reach = max(min(int(since.max(initial=0)) + 2, knots.count), LEAST_REACH)
        rank = np.empty(pieces, np.intp)
        rank[self.order] = np.arange(pieces)
        row = ((3 * rank[views.piece] + np.arange(3)[:, None]) * self.reach + since).T.reshape(-1)
        column, share = np.arange(len(row)), np.repeat(share, 3)
        values, at = np.concatenate([1.0 - share, share]), (np.r_[row, row + 1], np.r_[column, column])
        self.sums = csr_array((values, at), shape=(3 * pieces * self.reach, len(row)))


@dataclass(frozen=True)
class PathState:
    """One point in the space of the unknowns.

    errors : (K, 6) at the knots; rest : (F, 6) of each frame; shared : (SHARED,)
    points : (J, 4) of unit length: x y z in ``unit`` m, w
    """

    errors: np.ndarray
    rest: np.ndarray
    shared: np.ndarray
    points: np.ndarray
    unit: float

    def moved(self, errors: np.ndarray, shared: np.ndarray, points: np.ndarray) -> PathState:
        """The point after a step of the knots (K, 6), the shared unknowns and the points (J, 3)."""
        there = self.points + np.einsum("jik,jk->ji", tangents(self.points), points)
        there /= np.linalg.norm(there, axis=1, keepdims=True)
        return PathState(self.errors + errors, self.rest, self.shared + shared, there, self.unit)


def tangents(points: np.ndarray) -> np.ndarray:
    """(J, 4, 3) three directions across each point (J, 4) of unit length: products of a quaternion with i, j, k."""
    a, b, c, d = points.T
    columns = [[-b, a, d, -c], [-c, -d, a, b], [-d, c, -b, a]]
    return np.stack([np.stack(column, axis=1) for column in columns], axis=2)
