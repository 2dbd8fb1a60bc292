"""Several recordings of one person to one motion: times, places, then one body adjusted to all views.

Times and places come from the body as every recording alone gives it; the adjustment then measures both again.  A
camera is known by its own telemetry or picture up to the place of its world; one without either is taken to stand.
"""

from __future__ import annotations

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.motion import Motion
from drocap_ros.reconstruction.common.threads import blas_threads
from drocap_ros.reconstruction.in_metres import reprojection_px
from drocap_ros.reconstruction.reconstruct import SolvedView
from drocap_ros.reconstruction.together.placement import Placement, place_view
from drocap_ros.reconstruction.together.problem import JoinedProblem
from drocap_ros.reconstruction.together.timing import TimeOffset, time_offsets
from drocap_ros.reconstruction.together.view import View
from drocap_ros.reconstruction.world.refine import RefinedWorld
from drocap_ros.skeleton import BODY_17

#: Least likeness of two motions of one person, as two views give them.
_LEAST_LIKENESS = 0.3
#: Distance (m) and turn (deg) between a person's places and views in two reported worlds that are the same one.
_SAME_ORIGIN_M, _SAME_NORTH_DEG = 4.0, 10.0
#: Of a view whose world is the first one's.
_SAME_WORLD = Placement(1.0, np.eye(3), np.zeros(3), 0.0)


def join_views(solved: list[SolvedView], names: list[str], threads: int = 1) -> list[Motion]:
    """One body from several recordings of one person, each solved alone, by so many threads.

    Returns
    -------
    list
        The common body as each recording's camera sees it, at the first one's images on its own clock, in the order of
        the recordings; the first one's motion has all of its frames.  ``meta["together"]`` has times and places.

    Raises
    ------
    InputError
        When two recordings do not show the same motion at any time.
    """
    views = [View.of(one, name) for one, name in zip(solved, names, strict=True)]
    first = views[0]
    offsets, placed = [0.0], [_SAME_WORLD]
    for name, view in zip(names[1:], views[1:], strict=True):
        offset, placement = _best_fit(first, view, name, names[0])
        offsets.append(offset.seconds)
        placed.append(placement)
    home = _home(views)
    moved = _in_world_of(home, views, placed)
    problem = JoinedProblem(moved, home, offsets)
    with blas_threads(threads):
        refined = problem.with_home_errors(problem.solve())
        return _results(problem, refined, names)


def _best_fit(first: View, view: View, name: str, to: str) -> tuple[TimeOffset, Placement]:
    """Offset and place of a view: of the times at which the motions are alike, that at which the bodies fit best."""
    found = time_offsets(first.shown(), view.shown())
    if not found or found[0].likeness < _LEAST_LIKENESS:
        alike = f"a likeness of {found[0].likeness:.2f}" if found else "too short a time"
        raise InputError(
            f"{name}: expected the motion that {to} shows, for at least 2 s, found {alike} at the best time; are both"
            " of the same person at the same time?"
        )
    if first.reported and view.reported and (agreed := _agreed(first, view, found)):
        return agreed, _SAME_WORLD
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


def _results(problem: JoinedProblem, refined: RefinedWorld, names: list[str]) -> list[Motion]:
    """The common body as every view's camera sees it, in metres of the common world."""
    metric = problem.views[problem.home].reported and refined.metric
    scale = 1.0 if metric else problem.scale(refined)
    inputs = problem.inputs()
    told = [{"name": name, **problem.told(n, inputs[n], refined)} for n, name in enumerate(names)]
    together = {"world_of": names[problem.home], "views": told}
    out = []
    for n, view in enumerate(problem.views):
        stamp_ns, rows = problem.images(n)
        rotation, position = (values[rows] for values in problem.camera(n, inputs[n], refined))
        keypoints, seen = (values[rows] for values in problem.shown(n, inputs[n]))
        joints, alone = refined.joints[rows], view.solved.motion.meta
        calibration: dict[str, object] = {"calibration": refined.calibration, "covariance_about": "origin"}
        motion = Motion(
            joints3d=joints / scale,
            joints=BODY_17.joints,
            parents=BODY_17.parents,
            stamp_ns=stamp_ns,
            frame="world",
            metric=metric,
            scale_source="telemetry" if metric else "assumed_height",
            camera_rotation=rotation,
            confidence=seen,
            keypoints=keypoints,
            reprojection_px=reprojection_px(joints, rotation, position, view.matrix, keypoints),
            meta={**alone, **calibration, "frames": len(rows), "together": together},
            camera_position=position / scale,
            covariance=refined.covariance[rows] / scale**2,
        )
        out.append(motion)
    return out
