"""One body in the views of several cameras at the same instants: their residuals at one point, and their equations.

Each view is one of :class:`WorldResiduals`; the first has the body's terms and the scale.  The unknowns of a frame are
the errors of every camera and the joints once; the shared ones are those of the first view, then each further camera's.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from drocap_ros.contacts import FEET
from drocap_ros.reconstruction.world.camera_telemetry import CameraTelemetry
from drocap_ros.reconstruction.world.world_equations import WIDTH, normal_matrix
from drocap_ros.reconstruction.world.world_model import (
    CAMERA,
    FRAME,
    GLOBALS,
    MISALIGNMENT,
    OF_VIEW,
    WorldInput,
    WorldState,
)
from drocap_ros.reconstruction.world.world_residuals import (
    Contacts,
    WorldResiduals,
    WorldWeights,
    gradient,
    weights_of,
)

#: Unknowns of a further view among the shared ones.
_OWN = OF_VIEW.stop - OF_VIEW.start


def joined_weights(data: WorldInput) -> tuple[WorldWeights, ...]:
    """Weights of every view; a further one has no body of its own, and a placed camera errs by its placement."""
    out = []
    for number, view in enumerate((data, *data.further)):
        weights, fact = weights_of(view), view.config.frames_per_fact
        if number:
            shared = np.zeros((GLOBALS, GLOBALS))
            shared[OF_VIEW, OF_VIEW] = weights.shared[OF_VIEW, OF_VIEW]
            weights = weights._replace(shared=shared, acceleration=0.0, body=0.0)
        if view.placed_m:
            first, shared = weights.first.copy(), weights.shared.copy()
            first[:3] = fact / (fact / first[:3] + view.placed_m**2)
            if view.placed_deg:
                shared[MISALIGNMENT, MISALIGNMENT] = fact * np.eye(3) / np.deg2rad(view.placed_deg) ** 2
            weights = weights._replace(first=first, shared=shared)
        out.append(weights)
    return tuple(out)


class Beside(NamedTuple):
    """Other cameras' views of the same body at all slots of the even grid, in the same world.

    placed_m, placed_deg : of the first view's own camera, as in :class:`WorldInput`
    lengths : (18,) m of the body, of the spans; None = those of the poses to start from
    """

    views: tuple[WorldInput, ...] = ()
    placed_m: float = 0.0
    placed_deg: float = 0.0
    lengths: np.ndarray | None = None

    def window(self, rows: slice, lengths: np.ndarray, origin: np.ndarray) -> tuple[WorldInput, ...]:
        """The views at some slots, about an origin (3,) m."""
        return tuple(_at_slots(view, rows, lengths, origin) for view in self.views)


def _at_slots(view: WorldInput, rows: slice, lengths: np.ndarray, origin: np.ndarray) -> WorldInput:
    path = view.telemetry
    return replace(
        view,
        keypoints=view.keypoints[rows],
        weight=view.weight[rows],
        depth=view.depth[rows],
        depth_sigma=view.depth_sigma[rows],
        seen=None if view.seen is None else view.seen[rows],
        still=None if view.still is None else view.still[rows],
        telemetry=CameraTelemetry(path.rotation[rows], path.position[rows] - origin, path.fps),
        lengths=lengths,
    )


class JoinedViews:
    """Residuals of all views at one point; parameters and members are those of :class:`WorldResiduals`."""

    def __init__(
        self, data: WorldInput, weights: tuple[WorldWeights, ...], state: WorldState, contacts: Contacts
    ) -> None:
        self.data, self.weights, self.state, self.contacts = data, weights, state, contacts
        nowhere = contacts._replace(probability=np.zeros((len(state.joints) - 1, len(FEET))))
        self.views = [
            WorldResiduals(view, weights[v], view_state(state, v), nowhere if v else contacts)
            for v, view in enumerate((data, *data.further))
        ]
        self.terms = {name: sum(view.terms[name] for view in self.views) for name in self.views[0].terms}
        self.cost = sum(view.cost for view in self.views)

    def moved(self, frames: np.ndarray, shared: np.ndarray) -> JoinedViews:
        """Residuals of the same cost after a step."""
        return JoinedViews(self.data, self.weights, self.state.moved(frames, shared), self.contacts)

    def usual_outlier(self) -> float:
        """The largest of the views'."""
        return max(view.usual_outlier() for view in self.views)

    @cached_property
    def _places(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Of every view: its unknowns' places among those of a frame, and among the shared ones."""
        views, body = len(self.views), np.arange(FRAME - CAMERA)
        return [
            (
                np.concatenate([np.arange(CAMERA) + CAMERA * v, body + CAMERA * views]),
                np.concatenate([np.arange(OF_VIEW.start), np.arange(OF_VIEW.start, GLOBALS) + _OWN * v]),
            )
            for v in range(views)
        ]

    def gradient(self) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives of the cost by the unknowns of every frame and by the shared ones."""
        frames = np.zeros((len(self.state.joints), self._size))
        shared = np.zeros(len(self.state.globals))
        for view, (own, common) in zip(self.views, self._places, strict=True):
            by_frame, by_shared = gradient(view)
            frames[:, own] += by_frame
            shared[common] += by_shared
        return frames, shared

    def normal_matrix(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Band, border and corner as of :func:`~drocap_ros.reconstruction.world.world_equations.normal_matrix`."""
        frames, size, shared = len(self.state.joints), self._size, len(self.state.globals)
        band, border = np.zeros((frames, size, 2 * size + 1)), np.zeros((frames, size, shared))
        corner = np.zeros((shared, shared))
        row, column = np.triu_indices(FRAME)
        for view, (own, common) in zip(self.views, self._places, strict=True):
            theirs, edge, square = normal_matrix(view)
            blocks = theirs.reshape(frames, FRAME, WIDTH)
            band[:, own[row], own[column] - own[row]] += blocks[:, row, column - row]
            for ahead in (1, 2):  # frames are coupled unknown by unknown
                band[:, own, ahead * size] += blocks[:, :, ahead * FRAME]
            border[:, own[:, None], common] += edge.reshape(frames, FRAME, GLOBALS)
            corner[np.ix_(common, common)] += square
        return band.reshape(frames * size, -1), border.reshape(frames * size, shared), corner

    @property
    def _size(self) -> int:
        return FRAME + CAMERA * len(self.data.further)


def view_state(state: WorldState, view: int) -> WorldState:
    """The point as one view has it."""
    shared = state.globals[:GLOBALS].copy()
    if view:
        begin = GLOBALS + _OWN * (view - 1)
        shared[OF_VIEW] = state.globals[begin : begin + _OWN]
    return WorldState(state.joints, state.camera[:, CAMERA * view : CAMERA * (view + 1)], shared)


def joined_state(state: WorldState, further: int) -> WorldState:
    """A point of one view with as many further ones, whose cameras stand where they were placed."""
    frames = len(state.joints)
    return WorldState(
        state.joints,
        np.concatenate([state.camera, np.zeros((frames, CAMERA * further))], axis=1),
        np.concatenate([state.globals, np.zeros(_OWN * further)]),
    )
