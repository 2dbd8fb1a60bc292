"""Observations of fixed points, in pieces of tracks, and the points that they triangulate."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

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
