"""Several recordings of one person to one motion: times, places, then one body adjusted to all views.

Times and places come from the body as every recording alone gives it; the adjustment then measures both again.  A
camera is known by its own telemetry or picture up to the place of its world; one without either is taken to stand.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.geometry.rotations import exp_so3
from drocap_ros.motion import Motion
from drocap_ros.reconstruction.common.refusal import Refusal
from drocap_ros.reconstruction.lifted.adjustment import span_lengths
from drocap_ros.reconstruction.lifted.even_frames import even_slots
from drocap_ros.reconstruction.reconstruct import SolvedView
from drocap_ros.reconstruction.together.placement import Placement, place_view
from drocap_ros.reconstruction.together.timing import TimeOffset, time_offsets
from drocap_ros.reconstruction.together.view import Doubt, View
from drocap_ros.reconstruction.world.refine import Beside, RefinedWorld, refine_in_world
from drocap_ros.reconstruction.world.world_model import WorldInput

#: Least likeness of two motions of one person, as two views give them.
_LEAST_LIKENESS = 0.3
#: Errors of a place and an attitude that the bodies of single views give: their depths err by a tenth of the range,
_PLACED_M, _PLACED_DEG = 0.5, 5.0
#: and the slow errors of a path beside those that its own recording knows of, before they are measured.
_WANDER_M = 0.3
#: Distance (m) and turn (deg) between a person's places and views in two reported worlds that are the same one.
_SAME_ORIGIN_M, _SAME_NORTH_DEG = 4.0, 10.0
#: Time (s) in which a slow error is measured, and its change in that time over its standard deviation: the path's
#: errors of WorldResiduals have a time constant of 60 s.
_CHANGE_S, _CHANGE = 5.0, 0.4
#: Least error (m) of a place that is believed: that of the best receivers.
_LEAST_PLACED_M = 0.02
#: Adjustments, each from the times and places that the one before has measured, and the change that ends them.
_ROUNDS, _SAME_S = 5, 5e-4
#: Weight of the body as single views have it, in a start from the rays of all: deviation (m) of a joint.
_SINGLE_M = 0.3


@dataclass(frozen=True)
class JoinedView:
    """One recording in the common world.

    motion : the common body at the recording's own images' times as far as the first recording reaches, seen by its
        camera; offset_s : time of the first recording less this one's; offset_std_s : its standard deviation
    """

    motion: Motion
    offset_s: float
    offset_std_s: float


def join_views(solved: list[SolvedView], names: list[str]) -> list[JoinedView]:
    """One body from several recordings of one person, each solved alone.

    Returns
    -------
    list
        The views in the order of the recordings; the first one's motion has all of its frames.

    Raises
    ------
    InputError
        When two recordings do not show the same motion at any time.
    """
    views = [View.of(one) for one in solved]
    first = views[0]
    offsets, placed = [TimeOffset(0.0, 1.0, 0.0)], [Placement(1.0, np.eye(3), np.zeros(3), 0.0)]
    for name, view in zip(names[1:], views[1:], strict=True):
        offset, placement = _best_fit(first, view, name, names[0])
        offsets.append(offset)
        placed.append(placement)
    home = _home(views)
    moved = _in_world_of(home, views, placed)
    problem = _Problem(moved, home, [offset.seconds for offset in offsets])
    refined = problem.solve()
    return _results(problem, refined)


def _best_fit(first: View, view: View, name: str, to: str) -> tuple[TimeOffset, Placement]:
    """Offset and place of a view: of the times at which the motions are alike, that at which the bodies fit best."""
    found = time_offsets(first.joints, view.joints, (first.time_s, view.time_s))
    if not found or found[0].likeness < _LEAST_LIKENESS:
        alike = f"a likeness of {found[0].likeness:.2f}" if found else "too short a time"
        raise InputError(
            f"{name}: expected the motion that {to} shows, for at least 2 s, found {alike} at the best time; are both"
            " of the same person at the same time?"
        )
    if first.reported and view.reported and (agreed := _agreed(first, view, found)):
        return agreed, Placement(1.0, np.eye(3), np.zeros(3), 0.0)
    good = [offset for offset in found if offset.likeness > 0.8 * found[0].likeness]
    upright = first.own_world and view.own_world
    fits = [(offset, place_view(first, view, offset.seconds, upright)) for offset in good]
    return min(fits, key=lambda fit: fit[1].residual_m / fit[0].likeness)


def _agreed(first: View, view: View, found: list[TimeOffset]) -> TimeOffset | None:
    """The offset under which two reported worlds are the same one; None = they have different origins."""
    for offset in found:
        placed = place_view(first, view, offset.seconds, upright=True)
        turn = np.degrees(np.arctan2(placed.rotation[1, 0], placed.rotation[0, 0]))
        person = np.median(view.joints[:, 0], axis=0)
        apart = np.linalg.norm(placed.scale * placed.rotation @ person + placed.translation - person)
        if apart < _SAME_ORIGIN_M and abs(turn) < _SAME_NORTH_DEG:
            return offset
    return None


def _home(views: list[View]) -> int:
    """Number of the view whose world becomes the common one: a metric one, else one that moves, else that knows up."""

    def rank(view: View) -> tuple[bool, bool, bool]:
        return view.solved.motion.metric, view.own_world and not view.stands, view.own_world

    return max(range(len(views)), key=lambda n: (*rank(views[n]), -n))


def _in_world_of(home: int, views: list[View], placed: list[Placement]) -> list[View]:
    """The views in the world of one of them, from their placements in the first one's."""
    there = placed[home]
    back = there.rotation.T
    in_first = [view.moved(p.scale, p.rotation, p.translation) for view, p in zip(views, placed, strict=True)]
    return [view.moved(1.0 / there.scale, back, -back @ there.translation / there.scale) for view in in_first]


class _Problem:
    """The views at the times and places known so far."""

    def __init__(self, views: list[View], home: int, offsets: list[float]) -> None:
        self.views, self.home, self.offsets = views, home, offsets
        self.offset_std = [0.0] * len(views)
        slot, _ = even_slots(views[0].solved.tracks.stamp_ns)
        self._slot = slot
        self._time = np.interp(np.arange(slot[-1] + 1), slot, views[0].time_s)
        self._joints: np.ndarray | None = None
        self._doubts = [self._first_doubt(n) for n in range(len(views))]

    def solve(self) -> RefinedWorld:
        """Adjust body, cameras and times in turns."""
        for _ in range(_ROUNDS):
            inputs = self.inputs()
            start = self._start(inputs) if self._joints is None else self._joints
            refined = self._adjust(inputs, start)
            self._joints = refined.joints
            late = [self._late(view, n, refined) for n, view in enumerate(inputs)]
            change = [2.0 * (seconds - late[0][0]) for seconds, _ in late]
            self.offsets = [offset + more for offset, more in zip(self.offsets, change, strict=True)]
            self.offset_std = [std for _, std in late]
            self._doubts = [self._doubt(n, inputs, refined) for n in range(len(inputs))]
            if max(map(abs, change)) < _SAME_S:
                break
        return refined

    def inputs(self) -> list[WorldInput]:
        """Every view on the slots of the first one."""
        return [
            view.at(self._time - offset, self._doubts[n])
            for n, (view, offset) in enumerate(zip(self.views, self.offsets, strict=True))
        ]

    def _first_doubt(self, number: int) -> Doubt:
        if number == self.home:
            return Doubt(0.0, 0.0, 0.0)
        view, upright = self.views[number], self.views[number].own_world and self.views[self.home].own_world
        return Doubt(_PLACED_M, 0.0 if upright else _PLACED_DEG, 0.0 if view.stands else _WANDER_M)

    def _doubt(self, number: int, inputs: list[WorldInput], refined: RefinedWorld) -> Doubt:
        """The errors of a reported place as large as they are across the line to the other camera.

        Along that line they cannot be told from the scale; receivers err alike in all directions.
        """
        doubt, view = self._doubts[number], self.views[number]
        if number == self.home or not (view.reported and self.views[self.home].reported):
            return doubt
        (_, there), (_, here) = (self._camera(inputs[n], n, refined) for n in (number, self.home))
        line = there - here
        line /= np.linalg.norm(line, axis=1, keepdims=True)
        off = there - inputs[number].telemetry.position[self._slot]
        off -= here - inputs[self.home].telemetry.position[self._slot]
        off -= (off * line).sum(axis=1, keepdims=True) * line
        later = np.interp(self.views[0].time_s + _CHANGE_S, self.views[0].time_s, np.arange(len(off)))
        usable = later < len(off) - 1
        change = off[later[usable].astype(int)] - off[:-1][usable[:-1]] if usable.any() else np.zeros((1, 3))
        placed, wander = (float(np.sqrt(np.square(e).sum(-1).mean() / 2.0)) for e in (off, change))
        return Doubt(max(placed, _LEAST_PLACED_M), doubt.placed_deg, min(wander / _CHANGE, _WANDER_M * 2))

    def _start(self, inputs: list[WorldInput]) -> np.ndarray:
        """(F, 17, 3) m nearest to the rays of all views, and to the bodies of each."""
        single = np.mean([self._bodies(n) for n in range(len(self.views))], axis=0)
        normal = np.broadcast_to(np.eye(3) / _SINGLE_M**2, (*single.shape, 3)).copy()
        right = single / _SINGLE_M**2
        for view in inputs:
            focal, centre = np.diagonal(view.camera_matrix)[:2], view.camera_matrix[:2, 2]
            ray = np.concatenate([(view.keypoints - centre) / focal, np.ones((*view.weight.shape, 1))], axis=-1)
            ray = ray @ view.telemetry.rotation
            ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
            across = np.eye(3) - ray[..., :, None] * ray[..., None, :]
            range_m = np.linalg.norm(single[:, 0] - view.telemetry.position, axis=-1)
            precision = view.weight * np.square(focal.mean() / np.maximum(range_m, 0.3))[:, None]
            # Of a pixel's precision a tenth: places err more than pixels at first.
            across *= (0.01 * precision)[..., None, None]
            normal += across
            right += (across @ view.telemetry.position[:, None, :, None])[..., 0]
        joints = np.linalg.solve(normal, right[..., None])[..., 0]
        return np.asarray(joints[self._slot])

    def _bodies(self, number: int) -> np.ndarray:
        """(S, 17, 3) m of one view alone."""
        view, at = self.views[number], self._time - self.offsets[number]
        flat = view.joints.reshape(len(view.joints), -1)
        return np.stack([np.interp(at, view.time_s, column) for column in flat.T], axis=1).reshape(len(at), -1, 3)

    def _adjust(self, inputs: list[WorldInput], start: np.ndarray) -> RefinedWorld:
        """One adjustment."""
        first = self.views[0]
        tracks = replace(first.solved.tracks, camera_rotation=first.turn, camera_position=first.path)
        # Bones between joints that err are too long: those of the bodies that single views give.
        lengths = np.mean([np.median(span_lengths(view.joints), axis=0) for view in self.views], axis=0)
        beside = Beside(tuple(inputs[1:]), inputs[0].placed_m, inputs[0].placed_deg, lengths)
        found = refine_in_world(
            tracks, first.solved.keypoints, first.placed_poses(start), inputs[0].config, beside=beside
        )
        assert not isinstance(found, Refusal)
        return found

    def _camera(self, view: WorldInput, number: int, refined: RefinedWorld) -> tuple[np.ndarray, np.ndarray]:
        """Corrected rotation (F, 3, 3) and position (F, 3) of a view's camera at the first view's images."""
        if number == 0:
            return refined.rotation, refined.position
        correction, path = refined.further[number - 1], view.telemetry
        turn = exp_so3(correction[:, 3:]) @ path.rotation[self._slot]
        return turn, path.position[self._slot] + correction[:, :3]

    def _late(self, view: WorldInput, number: int, refined: RefinedWorld) -> tuple[float, float]:
        """Seconds by which a view's joints are ahead of the body's, and the standard deviation."""
        body = refined.joints[:, :17]
        velocity = np.gradient(body, axis=0) / np.gradient(self._time[self._slot])[:, None, None]
        rotation, position = self._camera(view, number, refined)
        seen = (body - position[:, None]) @ np.swapaxes(rotation, 1, 2)
        moving = velocity @ np.swapaxes(rotation, 1, 2)
        depth = np.maximum(seen[..., 2:], 0.3)
        focal, centre = np.diagonal(view.camera_matrix)[:2], view.camera_matrix[:2, 2]
        pixels = focal * seen[..., :2] / depth + centre
        flow = focal * (moving[..., :2] - seen[..., :2] / depth * moving[..., 2:]) / depth
        weight = view.weight[self._slot] * (view.seen[self._slot] if view.seen is not None else 1.0)
        off = view.keypoints[self._slot] - pixels
        square = np.square(off).sum(-1) * weight
        weight = weight / np.square(1.0 + square / max(9.0, 4.0 * float(np.median(square[weight > 0]))))
        total = float((weight[..., None] * np.square(flow)).sum())
        if total <= 0.0:
            return 0.0, np.inf
        return float((weight[..., None] * flow * off).sum()) / total, total**-0.5


def _results(problem: _Problem, refined: RefinedWorld) -> list[JoinedView]:
    raise NotImplementedError
