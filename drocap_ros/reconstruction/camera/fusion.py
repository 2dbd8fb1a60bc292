"""Telemetry corrected by the fixed points of the picture, before any body: path, constant errors, and what is left.

The body turns with a camera that is turned wrongly; the scene does not.  So the points measure the telemetry, and the
adjustment in the world starts from the corrected path, with the little that points leave open.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from drocap_ros.background import Background
from drocap_ros.camera_path import CameraErrors, CameraPath, Teller
from drocap_ros.geometry.interpolation import without_steps
from drocap_ros.geometry.rotations import exp_so3, hat, log_so3, pack_covariance, project_to_so3
from drocap_ros.reconstruction.camera.causes import contradicted_share, single_causes
from drocap_ros.reconstruction.camera.path_adjustment import AdjustedPath, adjust_path, rough_path
from drocap_ros.reconstruction.camera.path_model import (
    ATTITUDE_LATENCY,
    KNOTS_HZ,
    LEFT,
    MISALIGNMENT,
    POSITION_LATENCY,
    PathConfig,
    PathInput,
    PathState,
    views_of,
)
from drocap_ros.reconstruction.common.refusal import Refusal, Why
from drocap_ros.reconstruction.common.windows import Faded, even_slots, fade_weights, windows
from drocap_ros.reconstruction.world.camera_telemetry import CameraTelemetry, at_other_time
from drocap_ros.reconstruction.world.even_capture import at_all_slots, capture_parts
from drocap_ros.reconstruction.world.refine import RefinedWorld, refinable
from drocap_ros.reconstruction.world.telemetry_checks import frozen, turned_at_once

#: Slots that neighbouring windows share, ten seconds: where GPS wanders, two windows differ by some decimetres.
_OVERLAP = 240
#: Errors that the second adjustment expects of telemetry worse than configured: those of GPS and of a cheap gimbal.
_WIDE = CameraErrors(tilt_deg=1.0, position_wander_m=0.5, attitude_wander_deg=0.3)
#: Time (s) over which the found errors tell how far they wander.
_LAG_S = 4.0
#: Share of the frames with enough points, below which the points do not tell the path.
_LEAST_COVERED = 0.5


class Fusion(NamedTuple):
    """Reports after the correction.

    camera : of all images; ``measured`` holds constant errors and their standard deviations, that of the path's mean
        position (xx, xy, xz, yy, yz, zz m^2), and the points, all of the longest part
    path : of that part, as adjusted; given : what the reports said of it
    wander : standard deviations (m; degrees) of slow errors that change as those of that part do
    """

    camera: CameraPath
    path: AdjustedPath
    given: CameraTelemetry
    wander: tuple[float, float]


def fuse_telemetry(
    camera: CameraPath, points: Background | None, known: np.ndarray | None = None
) -> Fusion | Refusal | None:
    """Correct reports by fixed points; None = there is none of both, or the points are too few.

    A refusal where no camera's path near the reports explains the points.  ``known`` : as of ``PathInput``.
    """
    if points is None or not refinable(camera):
        return None
    rotation, position = camera.pose
    slot, fps = even_slots(camera.stamp_ns)
    origin = position.mean(axis=0)
    path = at_all_slots(without_steps(position, camera.stamp_ns) - origin, slot)
    turn = project_to_so3(at_all_slots(rotation, slot))
    faded = Faded(len(turn))
    best: tuple[AdjustedPath, CameraTelemetry] | None = None
    for part in capture_parts(camera.stamp_ns, slot):
        # Points that contradict a part of a path lose their weight there: it would stay as reported.
        if refusal := frozen(turn[part], path[part], fps) or turned_at_once(turn[part], fps):
            return refusal
        # Slots of one adjustment, two minutes at 24 Hz, bound memory.
        for inside in windows(part.stop - part.start, 2880, _OVERLAP):
            rows = slice(part.start + inside.start, part.start + inside.stop)
            given = CameraTelemetry(turn[rows], path[rows], fps)
            found = _of_window(given, (slot, rows.start), camera, points, known)
            if isinstance(found, Refusal) or found is None:
                return found
            faded.add(rows, fade_weights(inside, part.stop - part.start, _OVERLAP), **_correction(given, found))
            if best is None or given.frames > best[1].frames:
                best = found, given
    assert best is not None  # a recording has a part, and it has a window
    change, covariance, steps = faded.mean().values()
    steps = steps[faded.weight > 0.0].mean(axis=0)
    wander = _wander(best[0].state, best[1], _errors(camera))
    corrected = replace(
        camera,
        rotation=(exp_so3(change[:, 3:]) @ turn)[slot],
        position=(path + change[:, :3])[slot] + origin,
        teller=Teller.POINTS_AND_REPORTS,
        errors=_left(_errors(camera), steps),
        covariance=covariance[slot],
        corrected=True,
        points_tell_up=True,
        measured=_measured(*best, wander),
    )
    return Fusion(corrected, *best, wander)


def with_causes(fusion: Fusion, errors: CameraErrors) -> CameraPath:
    """The camera, its measures with the single errors (``causes``) that explain most of what the points correct."""
    camera = fusion.camera
    assert camera.matrix is not None
    causes = single_causes(fusion.given, fusion.path, camera.matrix, PathConfig(errors))
    return replace(camera, measured={**(camera.measured or {}), "causes": causes})


def _errors(camera: CameraPath) -> CameraErrors:
    return camera.errors or CameraErrors()


def _of_window(
    given: CameraTelemetry,
    slots: tuple[np.ndarray, int],
    camera: CameraPath,
    points: Background,
    known: np.ndarray | None,
) -> AdjustedPath | Refusal | None:
    """The path of the images' slots (F,) from the first of some on; None = its points are too few."""
    (slot, begin), matrix = slots, camera.matrix
    assert matrix is not None
    frame = slot[points.frame] - begin
    inside = (frame >= 0) & (frame < given.frames)
    views = views_of(frame[inside], points.track[inside], points.point[inside], given.frames, given.fps)
    found = _adjusted(PathInput(given, matrix, views, PathConfig(_errors(camera)), known))
    if not isinstance(found, AdjustedPath) or found.covered < _LEAST_COVERED:
        return found if isinstance(found, Refusal) else None
    # Above a median residual of 3 px per 1000 px of focal length no camera's path explains the points.
    if found.residual_px > 3.0 * 1e-3 * float(matrix[0, 0]):
        return Refusal(Why.POINTS_MOVE_OTHERWISE, found.residual_px)
    return found


def _adjusted(data: PathInput) -> AdjustedPath | Refusal | None:
    """The path by errors as they are expected, or by larger ones where the points show such.

    Errors that are expected to wander far would take the part of a constant yaw.
    """
    given, own = data.path, data.config.errors
    if (state := rough_path(data)) is None:
        return None
    position_m, attitude_deg = _wander(state, given, own)
    tilt_deg = float(np.degrees(np.abs(given.gimbal_axes()[[0, 2]] @ state.shared[MISALIGNMENT])).max())
    over = (
        position_m / own.position_wander_m,
        attitude_deg / own.attitude_wander_deg,
        0.5 * tilt_deg / own.tilt_deg,  # two standard deviations of a constant are no exception
    )
    # From one and a half times the configured errors on, the configuration does not hold.
    if wide := max(over) >= 1.5:
        position_m = max(position_m, _WIDE.position_wander_m)
        own = replace(
            own,
            tilt_deg=max(own.tilt_deg, _WIDE.tilt_deg),
            position_wander_m=position_m,
            attitude_wander_deg=max(attitude_deg, _WIDE.attitude_wander_deg),
        )
        # An error that wanders leaves the line between two knots.
        jitter_m = max(data.config.jitter_m, position_m * float(np.sqrt(0.5 / KNOTS_HZ / own.position_wander_s)))
        data = replace(data, config=replace(data.config, errors=own, jitter_m=jitter_m))
    found = adjust_path(data, state)
    if found is None or found.posterior is None:
        return None
    if not wide:
        return _without_latency(data, found)
    left_deg = _wander(found.state, given, own)[1]
    # Another flight's: a gimbal's yaw that jumps by 9 degrees, the largest jump that is not refused as one, leaves 3;
    # logs of other flights left 17 to 57.
    if left_deg > 10.0 and found.covered >= _LEAST_COVERED:
        return Refusal(Why.POINTS_TURN_OTHERWISE, left_deg)
    return _in_its_place(_without_latency(data, found), own, given)


def _in_its_place(found: AdjustedPath, expected: CameraErrors, given: CameraTelemetry) -> AdjustedPath:
    """The path with a place as uncertain as the wander that was found: points tell nothing of the mean error.

    The size of the errors is known by so many independent changes only, so the place has Student's distribution.  What
    stays the same for hours, as a wrong datum, no wander shows.
    """
    assert found.posterior is not None
    changes = 3.0 * max(given.frames / given.fps / _LAG_S, 1.0)
    wander_m, _ = _wander(found.state, given, expected)
    wider = max(wander_m / expected.position_wander_m, 1.0) ** 2 * changes / (changes - 2.0)
    place, pose = found.posterior.place, found.posterior.pose.copy()
    pose[:, :3, :3] += (wider - 1.0) * place
    return replace(found, posterior=found.posterior._replace(place=wider * place, pose=pose))


def _without_latency(data: PathInput, found: AdjustedPath) -> AdjustedPath:
    """The path once more, by reports of the right time, where their latencies are found and are long.

    The adjustment shifts a path by its smoothed motion, which takes a tenth of a latency for a part of the wander.
    """
    latencies = found.shared[[ATTITUDE_LATENCY, POSITION_LATENCY]]
    std = found.shared_std[[ATTITUDE_LATENCY, POSITION_LATENCY]]
    # Reports are shifted by latencies from 20 ms on that are known to a fifth.
    if np.abs(latencies).max() < 0.02 or not (std < 0.2 * np.abs(latencies).max()).all():
        return found
    later = at_other_time(data.path, *latencies.tolist())
    shared = found.state.shared.copy()
    shared[[ATTITUDE_LATENCY, POSITION_LATENCY]] = 0.0
    again = adjust_path(replace(data, path=later), replace(found.state, shared=shared))
    if again is None or again.posterior is None:
        return found
    again.shared[[ATTITUDE_LATENCY, POSITION_LATENCY]] += latencies
    precision, vector = again.facts
    vector += precision[:, [ATTITUDE_LATENCY, POSITION_LATENCY]] @ latencies
    return again


def _wander(found: PathState, given: CameraTelemetry, expected: CameraErrors) -> tuple[float, float]:
    """Standard deviations (m; degrees) of slow errors that change as the found ones do."""
    errors = found.errors
    knots_hz = (len(errors) - 1) / max((given.frames - 1) / given.fps, 1e-9)
    lag = max(min(round(_LAG_S * knots_hz), len(errors) // 2), 1)
    change = np.square(errors[lag:] - errors[:-lag]).mean(axis=0) / (
        2 * (1 - np.exp(-lag / knots_hz / expected.wander_s))
    )
    return float(np.sqrt(change[:3].mean())), float(np.degrees(np.sqrt(change[3:].mean())))


def _correction(given: CameraTelemetry, found: AdjustedPath) -> dict[str, np.ndarray]:
    """What a window corrects, its covariance, and that of the motion within a second, of every frame."""
    assert found.posterior is not None
    turned = log_so3(found.rotation @ np.swapaxes(given.rotation, 1, 2))
    moved = found.position - given.position
    knots = np.linspace(0, len(found.posterior.pose) - 1, given.frames)
    near = np.round(knots).astype(np.intp)
    # Steps between knots add up to a second as independent ones do.
    hz = (len(found.posterior.pose) - 1) * given.fps / max(given.frames - 1, 1)
    steps = hz * np.diagonal(found.posterior.steps, axis1=1, axis2=2)
    return {
        "change": np.concatenate([moved, turned], axis=1),
        "covariance": found.posterior.pose[near],
        "steps": steps[np.minimum(near, len(steps) - 1)],
    }


def _left(errors: CameraErrors, steps: np.ndarray) -> CameraErrors:
    """What is left of them in the world: the path's motion within a second is known to variances (6,)."""
    wander = np.sqrt(0.5 * errors.wander_s * steps)
    return replace(
        errors,
        tilt_deg=LEFT.tilt_deg,
        yaw_deg=LEFT.yaw_deg,
        latency_s=LEFT.latency_s,
        position_wander_m=float(np.sqrt(np.square(wander[:3]).mean())),
        attitude_wander_deg=float(np.degrees(np.sqrt(np.square(wander[3:]).mean()))),
    )


def _measured(found: AdjustedPath, given: CameraTelemetry, wander: tuple[float, float]) -> dict[str, object]:
    """JSON-compatible: the telemetry's errors as the points show them, in the terms of a calibration."""
    axes, shared = given.gimbal_axes(), found.shared
    assert found.posterior is not None
    variance = axes @ found.posterior.shared[MISALIGNMENT, MISALIGNMENT] @ axes.T
    return {
        "misalignment_deg": np.degrees(axes @ shared[MISALIGNMENT]).tolist(),
        "misalignment_std_deg": np.degrees(np.sqrt(np.diag(variance))).tolist(),
        "attitude_latency_s": -float(shared[ATTITUDE_LATENCY]),
        "attitude_latency_std_s": float(found.shared_std[ATTITUDE_LATENCY]),
        "position_latency_s": -float(shared[POSITION_LATENCY]),
        "position_latency_std_s": float(found.shared_std[POSITION_LATENCY]),
        "place_covariance_m2": pack_covariance(found.posterior.place).tolist(),
        "measured_by": "background",
        "background": {
            "tracks": len(found.views.track),
            "residual_px": found.residual_px,
            "covered_share": found.covered,
            "contradicted_share": contradicted_share(found),
            "position_wander_m": wander[0],
            "attitude_wander_deg": wander[1],
        },
    }


def with_measured(refined: RefinedWorld, camera: CameraPath) -> RefinedWorld:
    """The adjusted world with what points measured, and with the camera's own uncertainty in the joints'."""
    if camera.measured is not None:
        # The place as a whole is the path's: the one of the adjustment has no more to say.
        about = refined.covariance - refined.place[:, None]
        place = np.broadcast_to(np.array(camera.measured["place_covariance_m2"]), refined.place.shape)
        calibration = [{**window, **camera.measured} for window in refined.calibration]
        refined = replace(refined, place=place, covariance=about, calibration=calibration)
    return refined if camera.covariance is None else with_camera_errors(refined, camera.covariance)


def with_camera_errors(
    refined: RefinedWorld, errors: np.ndarray, rotation: np.ndarray | None = None, position: np.ndarray | None = None
) -> RefinedWorld:
    """The adjusted world whose joints are as uncertain as a camera's errors (F, 6, 6) make them, too.

    rotation, position : of another camera than ``refined`` has
    """
    turn, place = (refined.rotation, refined.position) if rotation is None or position is None else (rotation, position)
    lever = joints_by_camera(refined.joints, turn, place)
    more = lever @ errors[:, None] @ np.swapaxes(lever, -1, -2)
    return replace(refined, covariance=refined.covariance + pack_covariance(more))


def joints_by_camera(joints: np.ndarray, rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    """(F, P, 3, 6) derivatives of places (F, P, 3) m of what a camera sees, by its position and its rotation.

    rotation : (F, 3, 3) world -> camera, which changes by a turn (rad) in camera axes; position : (F, 3) m
    """
    turned = hat(joints - position[:, None]) @ np.swapaxes(rotation, 1, 2)[:, None]
    return np.concatenate([np.broadcast_to(np.eye(3), turned.shape), turned], axis=-1)
