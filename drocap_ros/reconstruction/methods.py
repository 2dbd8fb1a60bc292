"""The methods of ``drocap reconstruct``, over recordings of any length: overlapping windows, linear time."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from drocap_ros.geometry.interpolation import fill_frames
from drocap_ros.keypoints import Keypoints2D, isotropic_covariance
from drocap_ros.reconstruction.lifted.method import lifted_config, solve_window
from drocap_ros.reconstruction.paper.bundle_adjustment import MIN_WINDOW, bundle_adjust
from drocap_ros.reconstruction.paper.dictionary import Dictionary
from drocap_ros.reconstruction.paper.mf_nnm import factorize
from drocap_ros.reconstruction.paper.normalize import MIN_JOINTS, NormalizedTracks, normalize_tracks
from drocap_ros.reconstruction.paper.reprojection import Projection, frames_last, information_from
from drocap_ros.reconstruction.paper.single_view import initialize
from drocap_ros.reconstruction.reconstruction_config import BundleAdjusterConfig, InitializerConfig
from drocap_ros.reconstruction.stop_reason import START_ONLY, TOO_SHORT
from drocap_ros.tracks import Tracks

#: "ba" is the best there is, the others are the paper's method and its ablations.
METHODS = ("ba", "paper", "paper-no-articulation", "initial", "mf-nnm")

Progress = Callable[[str, float], None]

#: Poses (F, 15, 3) in camera axes, x and y where they are in the window's normalized image; cost per term,
#: iterations, stop reason.
WindowResult = tuple[np.ndarray, dict[str, float], int, str]


@dataclass(frozen=True)
class CameraPoses:
    """Poses in camera axes, in px, and how they were found.

    joints_px : (F, 15, 3), centred; ``keypoints ~ joints_px[..., :2] + translation_px``
    translation_px : (F, 2)
    seconds : wall-clock per stage
    """

    joints_px: np.ndarray
    translation_px: np.ndarray
    seconds: dict[str, float]
    iterations: int
    stop_reason: str
    cost_terms: dict[str, float]


def run_method(
    method: str,
    stamp_ns: np.ndarray,
    keypoints: Keypoints2D,
    tracks: Tracks,
    initializer: InitializerConfig,
    adjuster: BundleAdjusterConfig,
    dictionary: Dictionary,
    progress: Progress | None,
) -> CameraPoses:
    """Poses of BODY_15 keypoints (F, 15, 2) px by one of :data:`METHODS`.

    Frames that show fewer than four joints take no part; their poses are interpolated from those around them.
    """
    normalize_tracks(keypoints)  # refuses what no window can use
    use = shown_frames(keypoints)
    if not use.all():
        found = run_method(
            method,
            stamp_ns[use],
            keypoints[use],
            select_frames(tracks, use),
            initializer,
            adjuster,
            dictionary,
            progress,
        )
        return _spread(found, use, stamp_ns)
    clock = time.perf_counter()

    def factorized(_: slice, n: NormalizedTracks) -> WindowResult:
        poses, terms, iterations, stop = factorize(n.w, n.information, dictionary, adjuster)
        return placed(poses, n.w, n.information), terms, iterations, stop

    if method == "mf-nnm":
        poses = over_windows(
            keypoints,
            adjuster,
            factorized,
            progress,
        )
        return replace(poses, seconds={"initial": 0.0, "ba": time.perf_counter() - clock})
    if method == "ba":
        return _default(stamp_ns, keypoints, tracks, adjuster, progress)
    joints, credit = initial_poses(keypoints, initializer, dictionary, progress)
    seconds = {"initial": time.perf_counter() - clock, "ba": 0.0}
    if method == "initial":
        weights = credit if keypoints.confidence is None else credit * np.nan_to_num(keypoints.confidence)
        information = information_from(keypoints.xy, weights, keypoints.covariance)
        return CameraPoses(*split(placed(joints, keypoints.xy, information)), seconds, 0, START_ONLY, {})
    if method == "paper-no-articulation":
        adjuster = replace(adjuster, gamma=0.0)
    clock = time.perf_counter()
    poses = adjust(keypoints, joints, adjuster, progress, credit=credit)
    seconds["ba"] = time.perf_counter() - clock
    return replace(poses, seconds=seconds)


def _default(
    stamp_ns: np.ndarray,
    keypoints: Keypoints2D,
    tracks: Tracks,
    adjuster: BundleAdjusterConfig,
    progress: Progress | None,
) -> CameraPoses:
    """The default method (:mod:`drocap_ros.reconstruction.lifted.method`), window by window."""
    config = lifted_config(adjuster)
    seconds = {"initial": 0.0, "ba": 0.0}
    k = tracks.camera_matrix
    focal_px = None if k is None else 0.5 * float(k[0, 0] + k[1, 1])

    def solve(rows: slice, n: NormalizedTracks) -> WindowResult:
        points = np.where((n.weights > 0.0)[..., None], n.w, np.nan)
        variance = keypoints[rows].variance
        covariance = None if variance is None else isotropic_covariance(variance / n.scale_px**2)
        found = solve_window(
            stamp_ns[rows],
            Keypoints2D(points, n.weights, covariance),
            None if focal_px is None else focal_px / n.scale_px,
            config,
        )
        for stage, value in found.seconds.items():
            seconds[stage] += value
        return found.joints, found.cost_terms, found.iterations, found.stop_reason

    return replace(over_windows(keypoints, adjuster, solve, progress), seconds=seconds)


def shown_frames(keypoints: Keypoints2D) -> np.ndarray:
    """(F,) bool, frames with at least :data:`~drocap_ros.reconstruction.paper.normalize.MIN_JOINTS` joints apart."""
    seen = keypoints.weights > 0.0
    low = np.where(seen[..., None], keypoints.xy, np.inf).min(axis=1)
    high = np.where(seen[..., None], keypoints.xy, -np.inf).max(axis=1)
    with np.errstate(invalid="ignore"):
        apart = (high - low).max(axis=1) > 1e-6 * (1.0 + np.abs(np.nan_to_num(keypoints.xy)).max())
    return np.asarray((np.sum(seen, axis=1) >= MIN_JOINTS) & apart)


def select_frames(tracks: Tracks, use: np.ndarray) -> Tracks:
    """Tracks with some of the frames (F,) bool."""
    per_frame = ("keypoints", "stamp_ns", "confidence", "covariance", "camera_rotation", "camera_position")
    parts = {name: getattr(tracks, name)[use] for name in per_frame if getattr(tracks, name) is not None}
    return replace(tracks, **parts)


def _spread(found: CameraPoses, use: np.ndarray, stamp_ns: np.ndarray) -> CameraPoses:
    """Poses of the frames in use, interpolated over all frames."""
    joints = np.full((len(use), *found.joints_px.shape[1:]), np.nan)
    joints[use] = found.joints_px
    t = (stamp_ns - stamp_ns[0]).astype(np.float64)
    translation = np.stack([np.interp(t, t[use], found.translation_px[:, i]) for i in range(2)], axis=-1)
    return replace(found, joints_px=fill_frames(stamp_ns, joints), translation_px=translation)


def initial_poses(
    keypoints: Keypoints2D,
    config: InitializerConfig,
    dictionary: Dictionary,
    progress: Progress | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Single-view initialization, block by block.

    Returns
    -------
    poses (F, 15, 3) px in camera axes, centred
    credit (F, 15) in [0, 1]: how far the last E-step believes each 2D joint
    """
    out = np.zeros((*keypoints.xy.shape[:2], 3))
    credit = np.zeros(keypoints.xy.shape[:2])
    for rows, n in _blocks(keypoints, config.block_frames, 0):
        fit = initialize(n.w, n.information, dictionary, config)
        shape = fit.camera_shape
        given = n.information[..., 0] + n.information[..., 2]
        believed = fit.information[..., 0] + fit.information[..., 2]
        credit[rows] = believed / np.where(given > 0.0, given, 1.0)
        out[rows] = (shape - shape.mean(axis=1, keepdims=True)) * n.scale_px
        if progress is not None:
            progress("initial", rows.stop / len(keypoints))
    return out, credit


def adjust(
    keypoints: Keypoints2D,
    joints: np.ndarray,
    config: BundleAdjusterConfig,
    progress: Progress | None = None,
    *,
    credit: np.ndarray | None = None,
) -> CameraPoses:
    """Bundle adjustment of poses (F, 15, 3) px over overlapping windows; ``credit`` (F, 15) scales the information."""

    def solve(rows: slice, n: NormalizedTracks) -> WindowResult:
        start = joints[rows] / n.scale_px
        if len(start) < MIN_WINDOW:
            return placed(start, n.w, n.information), {}, 0, TOO_SHORT
        information = n.information if credit is None else n.information * credit[rows][..., None]
        result = bundle_adjust(n.w, information, start, config)
        poses = placed(result.camera_shape, n.w, information)
        return poses, result.cost_terms, result.iterations, result.stop_reason

    return over_windows(keypoints, config, solve, progress)


def over_windows(
    keypoints: Keypoints2D,
    config: BundleAdjusterConfig,
    solve: Callable[[slice, NormalizedTracks], WindowResult],
    progress: Progress | None = None,
) -> CameraPoses:
    """Solve window by window and cross-fade the poses where windows overlap."""
    out, weight = np.zeros((*keypoints.xy.shape[:2], 3)), np.zeros(len(keypoints))
    iterations, terms, stops = 0, dict[str, float](), set[str]()
    for rows, n in _blocks(keypoints, config.window_frames, config.overlap_frames):
        found, cost_terms, steps, stop = solve(rows, n)
        fade = _fade(len(found), config.overlap_frames, rows.start > 0, rows.stop < len(keypoints))
        in_image = found * n.scale_px
        in_image[..., :2] += n.centre_px[:, None]
        out[rows] += fade[:, None, None] * in_image
        weight[rows] += fade
        iterations += steps
        stops.add(stop)
        for name, value in cost_terms.items():
            terms[name] = terms.get(name, 0.0) + value
        if progress is not None:
            progress("ba", rows.stop / len(keypoints))
    return CameraPoses(*split(out / weight[:, None, None]), {}, iterations, ", ".join(sorted(stops)), terms)


def placed(poses: np.ndarray, w: np.ndarray, information: np.ndarray) -> np.ndarray:
    """Poses (F, P, 3) moved in the image so that they fit the joints ``w`` (F, P, 2) best."""
    moved = poses.copy()
    moved[..., :2] += Projection(w, information).translation(frames_last(poses[..., :2])).T[:, None]
    return moved


def split(poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centred poses (F, P, 3), and where their middle is in the image (F, 2)."""
    middle = poses.mean(axis=1, keepdims=True)
    return poses - middle, middle[:, 0, :2]


def windows(frames: int, length: int, overlap: int) -> list[slice]:
    """Windows of equal length, at most ``length``, neighbours sharing about ``overlap`` frames."""
    if frames <= length:
        return [slice(0, frames)]
    overlap = min(overlap, length // 2)
    count = int(np.ceil((frames - overlap) / (length - overlap)))
    # No longer than the overlap needs: 1000 frames take three windows of 374, not of 480.
    length = int(np.ceil((frames + (count - 1) * overlap) / count))
    starts = np.round(np.linspace(0, frames - length, count)).astype(int)
    return [slice(int(start), int(start) + length) for start in starts]


def _blocks(keypoints: Keypoints2D, length: int, overlap: int) -> Iterator[tuple[slice, NormalizedTracks]]:
    """Normalized tracks, window by window."""
    for rows in windows(len(keypoints), length, overlap):
        yield rows, normalize_tracks(keypoints[rows])


def _fade(count: int, overlap: int, at_start: bool, at_end: bool) -> np.ndarray:
    """Weights (count,) that rise over the overlap with the window before and fall over that with the next."""
    ramp = np.minimum(np.arange(1, count + 1) / (overlap + 1.0), 1.0)
    return (ramp if at_start else np.ones(count)) * (ramp[::-1] if at_end else np.ones(count))
