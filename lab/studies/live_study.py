"""The live method on simulated orbits: published poses beside the offline result on the same tracks."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.evaluation.metrics import pa_mpjpe
from drocap_ros.geometry.alignment import limb_lengths
from drocap_ros.keypoints import PoseObservation
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig, InitializerConfig
from drocap_ros.reconstruction.live.adjuster import LiveAdjuster
from drocap_ros.reconstruction.live.core import LiveCore, Step, live_results
from drocap_ros.reconstruction.live.initializer import LiveInitializer
from drocap_ros.reconstruction.live.latest_pose import LatestPose, median_bone_lengths
from drocap_ros.reconstruction.live.window import AdjustedWindow
from drocap_ros.reconstruction.reconstruct import reconstruct
from drocap_ros.skeleton import BODY_15, BODY_17
from lab.studies.protocol import OrbitView, Sequence, orbit_view, protocol_sequences, reported
from lab.studies.world_protocol import WorldView

#: Age at which the error of a refined pose counts.
REFINED_AFTER_S = 2.0


@dataclass(frozen=True)
class LiveRow:
    """One sequence through the live method.

    initial_mm, latest_mm : reconstruction error (12 limb joints) of ``pose3d/initial`` and ``pose3d/latest`` when they
        are published, over all frames
    refined_mm : of the newest refined pose 2 s after the image, over the frames of at least that age at the end
    offline_mm, offline_all_mm : of ``drocap reconstruct --method ba`` on the same tracks, over the same frames as
        refined_mm, and over all
    refined_std, initial_std : RMS of the standardized error, about the pelvis, at the true scale; 1 = consistent
    step_mm : the largest step of a joint of ``pose3d/latest`` between two images that new solutions cause
    initial_ms, initial_p95_ms, solve_p95_s : wall-clock of one image's initial pose, of one adjustment
    """

    sequence: str
    speed_deg_s: float
    noisy: bool
    frames: int
    initial_mm: float
    latest_mm: float
    refined_mm: float
    offline_mm: float
    offline_all_mm: float
    refined_std: float
    initial_std: float
    step_mm: float
    initial_ms: float
    initial_p95_ms: float
    solve_p95_s: float


def live_study(
    folder: Path,
    *,
    speed_deg_s: float = 25.0,
    noisy: bool = False,
    delay_s: float = 0.5,
    seed: int = 0,
    limit: int | None = None,
    initializer: InitializerConfig | None = None,
    adjuster: BundleAdjusterConfig | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> list[LiveRow]:
    """Every sequence of the protocol, one orbit each.

    Parameters
    ----------
    delay_s : from a window's newest image to the arrival of its solution

    Raises
    ------
    InputError
        When the folder has no such sequence, or a number is impossible.
    """
    if not abs(speed_deg_s) <= 360.0:
        raise InputError(f"--speed: expected -360 to 360 deg/s, got {speed_deg_s:g}; choose a slower orbit")
    if not 0.0 <= delay_s <= 10.0:
        raise InputError(f"--delay: expected 0 to 10 s, got {delay_s:g}; a solution takes less than a second")
    if limit is not None and limit < 1:
        raise InputError(f"--limit: expected at least 1, got {limit}")
    sequences = protocol_sequences(folder, limit=limit)
    rows = []
    # The protocol's camera is orthographic: it has no lens.
    settings = replace(adjuster or BundleAdjusterConfig(), assumed_focal=0.0)
    for sequence in reported(sequences, len(sequences), "live study", progress):
        view = orbit_view(sequence.x, speed_deg_s, noisy=noisy, seed=seed)
        result = simulate_live(view, delay_s, initializer or InitializerConfig(), settings)
        rows.append(_row(sequence, speed_deg_s, noisy, view, result))
    return rows


def observations(view: OrbitView | WorldView) -> Iterator[PoseObservation]:
    """The view's keypoints as the pose estimator publishes them, without a covariance."""
    t = view.tracks
    keypoints = t.keypoints.astype(np.float32)
    for i, stamp_ns in enumerate(t.stamp_ns.tolist()):
        points = keypoints[i]
        yield PoseObservation(
            stamp_ns,
            1,
            t.image_size,
            joints=BODY_15 if len(points) == len(BODY_15) else BODY_17,
            keypoints=points,
            covariance=np.full((len(points), 3), np.nan, np.float32),
            confidence=np.isfinite(points).all(axis=-1).astype(np.float32),
        )


@dataclass(frozen=True)
class LiveResult:
    """Published poses: F frames, m, camera axes.

    refined : (F, 17, 3) as of :data:`REFINED_AFTER_S` later; NaN where the sequence ended before
    initial_std_m, refined_std_m : (F, 17, 3) by the published covariances
    step_m : (F,) largest step of a joint by the change of the correction since the previous image
    """

    initial: np.ndarray
    latest: np.ndarray
    refined: np.ndarray
    initial_std_m: np.ndarray
    refined_std_m: np.ndarray
    step_m: np.ndarray
    initial_s: np.ndarray
    solve_s: np.ndarray


def simulate_live(
    view: OrbitView, delay_s: float, initializer: InitializerConfig, adjuster: BundleAdjusterConfig
) -> LiveResult:
    """Run the live method over a view; a window's solution arrives ``delay_s`` after its newest image."""
    stamps = view.tracks.stamp_ns
    place = {int(stamp): i for i, stamp in enumerate(stamps)}
    shape = (len(stamps), len(BODY_17), 3)
    initial, latest, refined = (np.full(shape, np.nan) for _ in range(3))
    initial_std, refined_std = np.full(shape, np.nan), np.full(shape, np.nan)
    initial_s, solve_s, steps = list[float](), list[float](), list[float]()
    newest, pending = LatestPose(adjuster.blend_s), deque[AdjustedWindow]()
    live = LiveInitializer(initializer), LiveCore(adjuster), LiveAdjuster(adjuster)
    clock = time.perf_counter()
    for result in live_results(observations(view), *live, delay_s=delay_s):
        took_s = time.perf_counter() - clock
        if isinstance(result, Step):
            assert result.latest is not None
            initial_s.append(took_s)
            now = result.initial.stamp_ns
            i, joints = place[now], result.initial.joints3d.astype(np.float32).astype(float)
            # The same image with the previous image's correction: the step that new solutions cause.
            before = newest.pose(int(stamps[max(i - 1, 0)]), joints)
            while pending and pending[0].stamp_ns[-1] + delay_s * 1e9 <= now:
                newest.set_solution(median_bone_lengths(pending.popleft().joints3d), now)
            initial[i], initial_std[i] = joints, _std(result.initial.covariance)
            latest[i] = result.latest.joints3d
            steps.append(float(np.linalg.norm(latest[i] - before, axis=-1).max()))
        else:
            _, window = result
            solve_s.append(took_s)
            pending.append(window)
            age_s = (window.stamp_ns[-1] - window.stamp_ns) * 1e-9
            rows = np.array([place[int(stamp)] for stamp in window.stamp_ns])
            # Later windows overwrite earlier ones until the pose has that age.
            chosen = (age_s + delay_s <= REFINED_AFTER_S) & (stamps[-1] - window.stamp_ns >= REFINED_AFTER_S * 1e9)
            refined[rows[chosen]] = window.joints3d[chosen].astype(np.float32)
            refined_std[rows[chosen]] = _std(window.covariance[chosen])
        clock = time.perf_counter()
    return LiveResult(
        initial,
        latest,
        refined,
        initial_std,
        refined_std,
        np.array(steps),
        np.array(initial_s),
        np.array(solve_s),
    )


def _row(sequence: Sequence, speed_deg_s: float, noisy: bool, view: OrbitView, result: LiveResult) -> LiveRow:
    old = np.isfinite(result.refined).all(axis=(1, 2))
    if not old.any():
        raise InputError(f"{sequence.name}: expected a refined pose within {REFINED_AFTER_S:g} s, got none")
    offline = pa_mpjpe(reconstruct(view.tracks, method="ba").joints3d * 1000.0, view.truth)
    return LiveRow(
        sequence=sequence.name,
        speed_deg_s=float(speed_deg_s),
        noisy=noisy,
        frames=len(view.truth),
        initial_mm=float(pa_mpjpe(result.initial * 1000.0, view.truth).mean()),
        latest_mm=float(pa_mpjpe(result.latest * 1000.0, view.truth).mean()),
        refined_mm=float(pa_mpjpe(result.refined[old] * 1000.0, view.truth[old]).mean()),
        offline_mm=float(offline[old].mean()),
        offline_all_mm=float(offline.mean()),
        refined_std=standardized_error(result.refined[old], result.refined_std_m[old], view.truth[old]),
        initial_std=standardized_error(result.initial, result.initial_std_m, view.truth),
        step_mm=float(np.nanmax(result.step_m, initial=0.0) * 1000.0),
        initial_ms=float(np.median(result.initial_s) * 1000.0),
        initial_p95_ms=float(np.quantile(result.initial_s, 0.95) * 1000.0),
        solve_p95_s=float(np.quantile(result.solve_s, 0.95)),
    )


def standardized_error(joints_m: np.ndarray, std_m: np.ndarray, truth_mm: np.ndarray) -> float:
    """RMS over frames, joints of ``BODY_15`` but the pelvis, and axes of the error over its standard deviation.

    joints_m, std_m : (F, 17, 3) camera axes, pelvis at the origin; truth_mm : (F, 17, 3).  The scale of a monocular
    pose rests on an assumed stature, so the limbs' mean length over the sequence is made the true one.
    """
    scale = limb_lengths(truth_mm).mean() / limb_lengths(joints_m).mean()
    body = slice(1, len(BODY_15))
    gap = (joints_m[:, body] * scale - truth_mm[:, body]) / (std_m[:, body] * scale)
    return float(np.sqrt(np.mean(np.square(gap))))


def _std(covariance: np.ndarray) -> np.ndarray:
    deviation: np.ndarray = np.sqrt(covariance[..., [0, 3, 5]])
    return deviation
