"""From any input to a motion: the offline path, which calls the same core as the nodes."""

from __future__ import annotations

import dataclasses
import itertools
import logging
import time
from collections.abc import Callable, Iterable
from pathlib import Path

from drocap_ros.config import DrocapConfig
from drocap_ros.errors import InputError
from drocap_ros.motion import Motion
from drocap_ros.perception.estimator import PoseEstimator
from drocap_ros.perception.models import models_folder
from drocap_ros.perception.sources import Frame, open_source
from drocap_ros.perception.tracking_run import observe, tracks_from_observations
from drocap_ros.reconstruction.reconstruct import reconstruct
from drocap_ros.recording import session_reader
from drocap_ros.recording.session import is_recording, open_session
from drocap_ros.tracks import Tracks, load_tracks

logger = logging.getLogger(__name__)

Progress = Callable[[str, float], None]


def reconstruct_input(
    path: str | Path, *, method: str, config: DrocapConfig, models: Path | None = None, progress: Progress | None = None
) -> tuple[Motion, Tracks]:
    """Motion of the subject in a video file, image folder, recording or tracks file.

    Parameters
    ----------
    path : video, folder of pictures, ``.mcap``, rosbag1 ``.bag``, rosbag2 folder, or tracks ``.npz``
    method : one of :data:`drocap_ros.reconstruction.reconstruct.METHODS`
    models : folder of ONNX files; None = ``DROCAP_MODELS`` or the user's own
    progress : called with a stage's name and the share done

    Raises
    ------
    InputError
        When the input cannot be used.
    """
    begin = time.perf_counter()
    tracks = read_input(Path(path), config, models, progress)
    seconds = time.perf_counter() - begin
    motion = reconstruct(
        tracks, method=method, initializer=config.initializer, adjuster=config.bundle_adjuster, progress=progress
    )
    meta = {**motion.meta, "input": Path(path).name}
    meta["seconds"] = {"pose2d": round(seconds, 4), **meta.get("seconds", {})}
    return dataclasses.replace(motion, meta=meta), tracks


def read_input(path: Path, config: DrocapConfig, models: Path | None, progress: Progress | None = None) -> Tracks:
    """2D tracks of the subject: read where the input holds them, else seen in its pictures."""
    if not path.exists():
        raise InputError(f"{path}: no such file or folder; check the path")
    if path.suffix == ".npz":
        return load_tracks(path)
    if is_recording(path):
        with open_session(path) as session:
            if session.has_pose2d:
                tracks = session_reader.read_pose2d(session)
            else:
                tracks = _watch(session_reader.read_images(session), None, config, models, progress, str(path))
            for warning in session.warnings:
                logger.warning("%s: %s", path, warning)
            return tracks
    with open_source(str(path), config.image_ingest) as source:
        return _watch(source, source.length, config, models, progress, str(path))


def _watch(
    frames: Iterable[Frame],
    length: int | None,
    config: DrocapConfig,
    models: Path | None,
    progress: Progress | None,
    name: str,
) -> Tracks:
    done = itertools.count(1)

    def count(*_: object) -> None:
        if progress is not None:
            progress("2D pose", next(done) / length if length else -1.0)

    estimator = PoseEstimator(models_folder(models or config.pose_estimator.models_dir or None), config.pose_estimator)
    try:
        return tracks_from_observations(observe(frames, estimator, count))
    except InputError as error:
        raise InputError(f"{name}: {error}") from None
