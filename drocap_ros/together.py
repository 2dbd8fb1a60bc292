"""Several recordings of one person to one motion."""

from __future__ import annotations

import time
from pathlib import Path

from drocap_ros.clip import Progress
from drocap_ros.config import DrocapConfig
from drocap_ros.motion import Motion
from drocap_ros.parameters import Values
from drocap_ros.pipeline import Selection, input_tracks, with_origin
from drocap_ros.reconstruction.reconstruct import Solved, solve
from drocap_ros.reconstruction.together.joined import join_views
from drocap_ros.recording.video_telemetry import Telemetry
from drocap_ros.tracks import Tracks


def reconstruct_together(
    paths: list[Path],
    *,
    config: DrocapConfig,
    telemetry: Telemetry,
    models: Path | None = None,
    progress: Progress | None = None,
    threads: int = 0,
) -> list[tuple[Motion, Tracks]]:
    """The one motion that several recordings of a person show, as each recording's camera sees it, and their tracks.

    paths : inputs of :func:`reconstruct_input`, two at least; the times of the first one's images are those of all
    telemetry : none, or that which the recordings have with them
    """
    solved: list[Solved] = []
    read: list[tuple[Path, Values, float]] = []
    tracks: list[Tracks] = []
    for path in paths:
        begin = time.perf_counter()
        own, origin = input_tracks(path, config, models, progress, telemetry, Selection(threads=threads))
        read.append((path, origin, time.perf_counter() - begin))
        tracks.append(own)
        solved.append(solve(own, initializer=config.initializer, adjuster=config.bundle_adjuster, progress=progress))
    begin = time.perf_counter()
    motions = join_views(solved, [path.name for path in paths])
    took = time.perf_counter() - begin
    for motion in motions:
        alone = motion.meta["seconds"]
        motion.meta["seconds"] = {**alone, "together": took, "total": alone["total"] + took}
    return [(with_origin(motion, *of), own) for motion, of, own in zip(motions, read, tracks, strict=True)]
