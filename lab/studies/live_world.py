"""Study of the live motion in the world: the world protocol through the live method, beside the offline result."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from drocap_ros.background import FixedPoints, PointHistory
from drocap_ros.evaluation.compare import WorldErrors, world_errors
from drocap_ros.evaluation.tables import WORLD_HEAD, markdown_table, world_cells
from drocap_ros.geometry.camera_history import CameraHistory
from drocap_ros.geometry.rotations import quaternion_from_matrix
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig
from drocap_ros.reconstruction.live.adjuster import LiveAdjuster
from drocap_ros.reconstruction.live.core import LiveCore, Step, live_results
from drocap_ros.reconstruction.live.initializer import LiveInitializer
from drocap_ros.reconstruction.reconstruct import reconstruct
from lab.studies.live_study import REFINED_AFTER_S, observations
from lab.studies.protocol import FPS, reported
from lab.studies.world_protocol import LONGEST_S, NONE, WorldCase, WorldView, world_sequences, world_view


class LiveWorldRow(NamedTuple):
    """One sequence: errors of ``pose3d/latest`` and ``refined`` in ``map``, and offline over the latter's frames.

    Without telemetry ``refined`` is in ``odom``, and ``latest`` in the camera's frame: None.

    first_s : time until the first pose in the world; share : of all later images with such a pose
    """

    sequence: str
    first_s: float
    share: float
    latest: WorldErrors | None
    refined: WorldErrors
    offline: WorldErrors


def live_world_study(
    folder: Path,
    case: WorldCase | None = None,
    *,
    every: int = 1,
    delay_s: float = 0.5,
    limit: int | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> list[LiveWorldRow]:
    """Every ``every``-th sequence of the world protocol; solutions arrive ``delay_s`` after their newest image.

    Sequences without a pose in ``map`` are left out.

    Raises
    ------
    InputError
        When the folder has no such sequence.
    """
    sequences = world_sequences(folder, every, limit)
    rows = [
        _row(sequence.name, world_view(sequence, case, seed=seed), delay_s)
        for seed, sequence in reported(sequences, len(sequences), "live world study", progress)
    ]
    return [row for row in rows if row is not None]


def _row(name: str, view: WorldView, delay_s: float) -> LiveWorldRow | None:
    latest, refined = _live(view, delay_s)
    in_world = latest or refined
    if min(len(in_world), len(refined)) < 10:
        return None
    stamps = view.tracks.stamp_ns
    motion = reconstruct(view.tracks)
    offline = {i: motion.joints3d[i] for i in refined}
    first = min(in_world)
    return LiveWorldRow(
        name,
        float((stamps[first] - stamps[0]) * 1e-9) + (0.0 if latest else REFINED_AFTER_S),
        len(in_world) / (len(stamps) - first),
        _errors(latest, view.truth) if latest else None,
        *(_errors(poses, view.truth) for poses in (refined, offline)),
    )


def _live(view: WorldView, delay_s: float) -> tuple[dict[int, np.ndarray], dict[int, np.ndarray]]:
    """Frame -> joints (17, 3) m in ``map``: as ``pose3d/latest`` is published, and refined 2 s later."""
    tracks, adjuster = view.tracks, BundleAdjusterConfig()
    stamps, core = tracks.stamp_ns, LiveCore(adjuster)
    core.cameras, core.points = _history(view), _points(view)
    place = {int(stamp): i for i, stamp in enumerate(stamps)}
    latest, refined = dict[int, np.ndarray](), dict[int, np.ndarray]()
    live = LiveInitializer(), core, LiveAdjuster(adjuster)
    for result in live_results(observations(view), *live, delay_s=delay_s):
        if isinstance(result, Step):
            if result.latest is not None and result.latest.rotation is not None:
                latest[place[result.latest.stamp_ns]] = result.latest.joints3d
            continue
        _, window = result
        age_s = (window.stamp_ns[-1] - window.stamp_ns) * 1e-9
        if window.in_map is not None:
            for i in np.flatnonzero(age_s + delay_s <= REFINED_AFTER_S):
                refined[place[int(window.stamp_ns[i])]] = window.joints3d[i].astype(np.float32).astype(float)
    last = int(stamps[-1] - REFINED_AFTER_S * 1e9)
    return latest, {i: joints for i, joints in refined.items() if stamps[i] <= last}


def _history(view: WorldView) -> CameraHistory:
    tracks = view.tracks
    assert tracks.camera_matrix is not None
    history = CameraHistory(2.0 * LONGEST_S)
    history.add_matrix(int(tracks.stamp_ns[0]), tracks.camera_matrix)
    if tracks.camera_rotation is not None and tracks.camera_position is not None:
        turns = quaternion_from_matrix(np.swapaxes(tracks.camera_rotation, 1, 2))
        for stamp, position, turn in zip(tracks.stamp_ns.tolist(), tracks.camera_position, turns, strict=True):
            history.add_pose(stamp, position, turn)
    return history


def _points(view: WorldView) -> PointHistory:
    history, points = PointHistory(2.0 * LONGEST_S), view.tracks.background
    if points is None:
        return history
    for i, stamp in enumerate(view.tracks.stamp_ns.tolist()):
        here = points.frame == i
        history.add(stamp, FixedPoints(points.track[here], points.point[here]))
    return history


def _errors(poses: dict[int, np.ndarray], truth: np.ndarray) -> WorldErrors:
    frames = sorted(poses)
    return world_errors(np.array([poses[i] for i in frames]), truth[frames], FPS / np.diff(frames))


def live_world_markdown(rows: list[LiveWorldRow], case: WorldCase) -> str:
    """Errors of every sequence as Markdown: latest, refined, offline."""
    frame = "odom" if case.telemetry == NONE else "map"
    head = f"Live in `{frame}`, {len(rows)} sequences, {case.words()}."
    cells = [
        [f"{row.sequence}, {kind}", *world_cells(errors)]
        for row in rows
        for kind, errors in (("latest", row.latest), ("refined", row.refined), ("offline", row.offline))
        if errors is not None
    ]
    first = float(np.median([row.first_s for row in rows])) if rows else float("nan")
    share = 100 * float(np.mean([row.share for row in rows])) if rows else float("nan")
    return "\n".join(
        [
            head,
            "",
            *markdown_table(["sequence", *WORLD_HEAD], cells),
            "",
            f"First pose in `{frame}` after {first:.1f} s in the median; {share:.0f} % of the later images have one.",
            "",
        ]
    )
