"""The camera of a recording without telemetry: what it does, its path and its lens, from fixed points alone."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from drocap_ros.camera_path import CameraErrors, CameraPath, Kind, PictureFacts, Teller
from drocap_ros.geometry.rotations import centred_camera
from drocap_ros.reconstruction.camera.growth import (
    ENOUGH_PARALLAX,
    LAST_STEPS,
    Growth,
    Pair,
    adjusted,
    begin,
    candidate_pairs,
    small_motion,
    turns,
    with_ends,
)
from drocap_ros.reconstruction.camera.kinds import Sightings, kind_of, turning_focal, with_focal
from drocap_ros.reconstruction.camera.path_adjustment import AdjustedPath, adjust_path
from drocap_ros.reconstruction.camera.path_model import FOCAL, Knots, PathConfig, PathInput, views_of
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig
from drocap_ros.reconstruction.world.camera_telemetry import CameraTelemetry

#: Focal length of an unknown lens over the image's longer side, and the deviation of its logarithm: a factor of 1.4.
FOCAL_SHARE: float = BundleAdjusterConfig.assumed_focal
FOCAL_STD = 0.34
#: Keyframes after which the starts are compared, and residuals over the least that are as good.
_COMPARED = 16
_AS_GOOD = 1.05
#: Share of the keyframes that need a camera.
_LEAST_KNOWN = 0.6


class _Start(NamedTuple):
    """What is known before a path is sought: what the camera does, its matrix (3, 3) px, whose focal length errs so."""

    kind: Kind
    matrix: np.ndarray
    focal_std: float


def camera_from_points(
    frame: np.ndarray,
    track: np.ndarray,
    point: np.ndarray,
    fps: float,
    frames: int,
    size: tuple[int, int],
    matrix: np.ndarray | None,
) -> CameraPath:
    """The camera of evenly spaced frames, in a unit and axes of its own; its stamps are the frames' numbers.

    frame, track, point : (N,), (N,), (N, 2) px observations of fixed points; size : width, height px
    matrix : (3, 3) px, None = unknown
    """
    focal_std = 0.0 if matrix is not None else FOCAL_STD
    if matrix is None:
        matrix = centred_camera(size, FOCAL_SHARE * max(size))
    views = views_of(frame, track, point, frames, fps)
    knots = Knots(frames, fps)
    sightings, key_hz = Sightings(views, knots.frame), 1.0 / knots.step_s
    kind = kind_of(sightings, matrix, key_hz, size[0])
    if focal_std and kind is Kind.MOVES:
        # Through another lens, what looks like a way may be a turn.
        other = with_focal(matrix, turning_focal(sightings, matrix, key_hz))
        if kind_of(sightings, other, key_hz, size[0]) is Kind.TURNS:
            kind, matrix = Kind.TURNS, other
    camera = _Start(kind, matrix, focal_std)
    found: AdjustedPath | Kind = kind
    if kind is Kind.TURNS:
        found = _turning(sightings, camera, fps)
    elif kind is Kind.MOVES:
        found, camera = _moving(sightings, camera, fps, key_hz)
    path = CameraPath(np.arange(frames), np.tile(np.eye(3), (frames, 1, 1)), np.zeros((frames, 3)), camera.matrix)
    path = replace(path, teller=Teller.PICTURE, metric=False, scale_source="assumed_height")
    if isinstance(found, AdjustedPath):
        return _with_facts(path, camera, found)
    facts = PictureFacts(found, camera.focal_std)
    return replace(path, picture=replace(facts, residual_px=0.0, covered=1.0) if kind is Kind.STANDS else facts)


def _moving(sightings: Sightings, camera: _Start, fps: float, key_hz: float) -> tuple[AdjustedPath | Kind, _Start]:
    """The path of a camera that moves, and its lens: grown from a pair, or all at once where it moves little."""
    every = _starts(sightings, camera, key_hz)
    # Rays through a wrong lens can meet behind the camera as well: paths that are turned inside out so had 5 to 54 % of
    # the points there, others 0.
    starts = [start for start in every if start[1].behind < 0.03] or every
    if not starts:
        return Kind.NOTHING_FIXED, camera
    least = min(start.path.residual_px for _, start in starts)
    small = None
    if starts[0][0] < 0.02:  # rad of parallax: the camera moves little
        small = _small_motion(sightings, camera, fps, _AS_GOOD * least)
    if small is None or small.residual_px > _AS_GOOD * least:
        # Where there is little parallax any path fits: of starts that fit as well the one with the most of it counts.
        start = next(start for _, start in starts if start.path.residual_px <= _AS_GOOD * least)
        grown, matrix = _grown(sightings, camera, start, fps)
        grown_px = grown.residual_px if isinstance(grown, AdjustedPath) else float("inf")
        # A path over more points and times than those few keyframes fits a little worse in any case.
        if small is None and starts[0][0] < ENOUGH_PARALLAX and grown_px > 1.5 * least:
            small = _small_motion(sightings, camera, fps, _AS_GOOD * least)
        if small is None or grown_px <= small.residual_px:
            return grown, camera._replace(matrix=matrix)
    return small, camera


def _small_motion(sightings: Sightings, camera: _Start, fps: float, enough_px: float) -> AdjustedPath | None:
    """The best path of a camera that moves little, of some that it may look down; the first one that fits."""
    best: AdjustedPath | None = None
    # Tangents up to the horizon, of cameras that look down by 15, 40 and 0 degrees.
    for horizon in (0.26, 0.8, 0.0):
        found = small_motion(sightings, camera.matrix, fps, camera.focal_std, horizon)
        if found is not None and (best is None or found.residual_px < best.residual_px):
            best = found
        if best is not None and best.residual_px <= enough_px:
            break
    return best


def _grown(sightings: Sightings, camera: _Start, start: Growth, fps: float) -> tuple[AdjustedPath | Kind, np.ndarray]:
    """The path that grows from a start over all keyframes that can be placed, and its matrix."""
    path = start.grow(len(sightings))
    found = adjusted(sightings, with_ends(sightings, path), fps, camera.focal_std, LAST_STEPS)
    if found is None or path.known.mean() < _LEAST_KNOWN:
        return Kind.FEW_POINTS, camera.matrix
    return found, path.matrix


def _starts(sightings: Sightings, camera: _Start, key_hz: float) -> list[tuple[float, Growth]]:
    """Paths of some keyframes about every promising pair, with its parallax (rad), those that tell most first."""
    growths: list[tuple[Pair, Growth]] = []
    enough = min(_COMPARED, int(_LEAST_KNOWN * len(sightings)))
    for factor in (0.7, 1.0, 1.5) if camera.focal_std else (1.0,):  # on the focal length of an unknown lens
        matrix = with_focal(camera.matrix, factor)
        for pair in candidate_pairs(sightings, matrix, key_hz):
            start = begin(sightings, pair, matrix)
            if start is not None:
                growth = Growth(sightings, start, key_hz, camera.focal_std)
                growth.grow(_COMPARED)
                growths.append((pair, growth))
    growths.sort(key=lambda entry: -entry[0].score)
    return [(pair.parallax, growth) for pair, growth in growths if growth.path.known.sum() >= enough]


def _turning(sightings: Sightings, camera: _Start, fps: float) -> AdjustedPath | Kind:
    """The turns of a camera that keeps its place."""
    turned, place = turns(sightings, camera.matrix)
    errors = CameraErrors(0.0, 0.0, 0.0, position_wander_m=1e-6, attitude_wander_deg=60.0)
    config = PathConfig(errors, focal=camera.focal_std, jitter_m=1e-6, jitter_deg=1.0)
    found = adjust_path(PathInput(CameraTelemetry(turned, place, fps), camera.matrix, sightings.views, config))
    return Kind.FEW_POINTS if found is None else replace(found, position=place)


def _with_facts(path: CameraPath, camera: _Start, found: AdjustedPath) -> CameraPath:
    """The camera with what its adjustment tells, and whether it fits."""
    focal = float(np.exp(found.shared[FOCAL]))
    shape = None if found.posterior is None else found.posterior.shape
    steps = None if found.posterior is None else np.sqrt(np.diagonal(found.posterior.steps, axis1=1, axis2=2))
    # Errors of tracks last, which the posterior does not know: focal lengths of orbits had 0.1 to 0.8 %.
    facts = PictureFacts(
        camera.kind if fits(found, camera.matrix) else Kind.NOTHING_FIXED,
        focal_std=float(np.hypot(found.shared_std[FOCAL], 0.01)) if camera.focal_std else 0.0,
        points=found.points,
        residual_px=found.residual_px,
        covered=found.covered,
        position_std=float("nan") if steps is None else float(np.median(steps[:, :3])),
        turn_std_deg=float("nan") if steps is None else float(np.degrees(np.median(steps[:, 3:]))),
        drift=None if shape is None else _at_frames(shape, len(path.stamp_ns)),
    )
    matrix = with_focal(camera.matrix, focal)
    return replace(path, rotation=found.rotation, position=found.position, matrix=matrix, picture=facts)


def _at_frames(values: np.ndarray, frames: int) -> np.ndarray:
    """Those (K, ...) of the nearest knots."""
    return np.asarray(values[np.round(np.linspace(0, len(values) - 1, frames)).astype(np.intp)])


def fits(found: AdjustedPath, matrix: np.ndarray) -> bool:
    """Whether a path explains the points that it was adjusted by."""
    near = found.residual_px < 2.5 * matrix[0, 2] * 2 / 1280.0  # 2.5 px of an image 1280 wide
    # Where fewer observations fit, what moves outnumbers what stands.
    return bool(near and np.mean(found.weight > 0.25) > 0.4)
