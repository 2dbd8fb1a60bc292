"""Several recordings of one person to one motion: times, places, then one body adjusted to all views.

Times and places come from the body as every recording alone gives it; the adjustment then measures both again.  A
camera is known by its own telemetry or picture up to the place of its world; one without either stands, or moves as the
body turns in its pictures.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.geometry.rotations import pack_covariance, unpack_covariance
from drocap_ros.motion import Motion
from drocap_ros.reconstruction.common.engine import blas_threads
from drocap_ros.reconstruction.in_metres import reprojection_px
from drocap_ros.reconstruction.reconstruct import Solved
from drocap_ros.reconstruction.together.placement import Placement, follow_view, place_view
from drocap_ros.reconstruction.together.problem import JoinedProblem
from drocap_ros.reconstruction.together.timing import LEAST_S, TimeOffset, time_offsets
from drocap_ros.reconstruction.together.view import View
from drocap_ros.reconstruction.world.refine import RefinedWorld
from drocap_ros.skeleton import BODY_17

#: Distance of keypoints from the common body over that from their own (:func:`misfit`): right pairs have at most 1.9.
_LARGEST_MISFIT = 2.5
#: Distance (m) and turn (deg) between a person's places and views in two reported worlds that are the same one.
_SAME_ORIGIN_M, _SAME_NORTH_DEG = 4.0, 10.0
#: Of a view whose world is the first one's.
_SAME_WORLD = Placement(1.0, np.eye(3), np.zeros(3), 0.0)


def join_views(solved: list[Solved], names: list[str]) -> list[Motion]:
    """One body from several recordings of one person, each solved alone.

    returns : the common body as each recording's camera sees it, at the first one's images on its own clock, in the
        order of the recordings; the first one's motion has all of its frames.  ``meta["together"]`` has times and
        places.
    """
    _refuse_copies(solved, names)
    views = [View.of(one, name) for one, name in zip(solved, names, strict=True)]
    home = _home(views)
    fits = [_best_fit(views[home], view, name, names[home]) for view, name in zip(views, names, strict=True)]
    offsets = [offset.seconds - fits[0][0].seconds for offset, _ in fits]
    moved = [view.moved(p.scale, p.rotation, p.translation) for view, (_, p) in zip(views, fits, strict=True)]
    at_rest = views[home].own_world or not any(p.moves for _, p in fits)
    problem = JoinedProblem(moved, home, offsets, at_rest)
    with blas_threads(solved[0].settings.adjuster.threads):
        refined = problem.with_home_errors(problem.solve())
        return _results(problem, refined, names)


def _refuse_copies(solved: list[Solved], names: list[str]) -> None:
    for n, (one, name) in enumerate(zip(solved, names, strict=True)):
        for other, to in zip(solved[:n], names, strict=False):
            if np.array_equal(one.keypoints.xy, other.keypoints.xy, equal_nan=True):
                raise InputError(f"{name}: expected another view than that of {to}, found the same; name each once")


def _best_fit(home: View, view: View, name: str, to: str) -> tuple[TimeOffset, Placement]:
    """Offset and place of a view: of the times at which the motions are alike, that at which the bodies fit best.

    A camera without a world stands, unless it moves at each of these times.
    """
    if view is home:
        return TimeOffset(0.0, 1.0), _SAME_WORLD
    found = time_offsets(home.shown(), view.shown())
    # Right pairs of motions of one person have a likeness of 0.9, others at most 0.8.
    if not found or found[0].likeness < 0.45:
        alike = f"a likeness of {found[0].likeness:.2f} at the best time" if found else "none that is alike"
        raise InputError(
            f"{name}: expected the motion that {to} shows, for at least {LEAST_S:g} s, found {alike}; are both of the"
            " same person at the same time?"
        )
    if home.reported and view.reported and (agreed := _agreed(home, view, found)):
        return agreed, _SAME_WORLD
    good = [offset for offset in found if offset.likeness > 0.8 * found[0].likeness]
    fits = [(offset, place_view(home, view, offset.seconds, upright=view.own_world)) for offset in good]
    if not view.own_world:
        followed = [(offset, follow_view(home, view, offset.seconds)) for offset in good]
        fits = followed if all(placement.moves for _, placement in followed) else fits
    return min(fits, key=lambda fit: fit[1].residual_m / fit[0].likeness)


def _agreed(home: View, view: View, found: list[TimeOffset]) -> TimeOffset | None:
    """The offset under which two reported worlds are the same one; None = they have different origins."""
    for offset in found:
        placed = place_view(home, view, offset.seconds, upright=True)
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


def _results(problem: JoinedProblem, refined: RefinedWorld, names: list[str]) -> list[Motion]:
    """The common body as every view's camera sees it, in metres of the common world."""
    metric = problem.views[problem.home].reported and refined.metric
    scale = 1.0 if metric else problem.scale(refined)
    inputs = problem.inputs()
    found = [problem.told(n, inputs[n], refined) for n in range(len(names))]
    worst = max(range(len(names)), key=lambda n: found[n]["misfit"])
    if found[worst]["misfit"] > _LARGEST_MISFIT:
        there, alone = found[worst]["median_px"], found[worst]["median_px_alone"]
        raise InputError(
            f"{names[worst]}: expected the motion that {names[problem.home]} shows, found keypoints {there:.0f} px from"
            f" the body that fits all, {alone:.1f} from its own; are all of the same person at the same time?"
        )
    told = [{"name": name, **view} for name, view in zip(names, found, strict=True)]
    together = {"world_of": names[problem.home], "views": told}
    out = []
    for n, view in enumerate(problem.views):
        stamp_ns, rows = problem.images(n)
        rotation, position = (values[rows] for values in problem.camera(n, inputs[n], refined))
        keypoints, seen = (values[rows] for values in problem.shown(n, inputs[n]))
        joints, own = refined.joints[rows], view.solved.motion.meta
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
            reprojection_px=reprojection_px(joints, rotation, position, view.camera.matrix, keypoints),
            meta={**own, **calibration, "frames": len(rows), "together": together},
            camera_position=position / scale,
            covariance=refined.covariance[rows] / scale**2,
        )
        out.append(motion if problem.at_rest else _in_camera(motion))
    return out


def _in_camera(motion: Motion) -> Motion:
    """The motion in the axes of each image's camera, about the pelvis: what moves in no world that is at rest."""
    assert motion.covariance is not None
    turn = motion.camera_rotation
    there = unpack_covariance(motion.covariance)
    return replace(
        motion,
        joints3d=(motion.joints3d - motion.joints3d[:, :1]) @ np.swapaxes(turn, 1, 2),
        frame="camera",
        camera_rotation=np.broadcast_to(np.eye(3), turn.shape).copy(),
        camera_position=None,
        covariance=pack_covariance(turn[:, None] @ there @ np.swapaxes(turn, 1, 2)[:, None]),
    )
