"""From any input to a motion: the offline path, which calls the same core as the nodes."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterable
from pathlib import Path

from drocap_ros.config import DrocapConfig
from drocap_ros.errors import InputError
from drocap_ros.motion import Motion
from drocap_ros.perception.estimator import PoseEstimator
from drocap_ros.perception.models import models_folder
from drocap_ros.perception.sources import Frame, open_source
from drocap_ros.perception.tracking_run import tracks_from_observations
from drocap_ros.reconstruction.reconstruct import reconstruct
from drocap_ros.recording import session_reader
from drocap_ros.tracks import Tracks, load_tracks

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
    if session_reader.is_recording(path):
        with session_reader.open_session(path) as session:
            if session.has_pose2d:
                return session_reader.read_pose2d(session)
            return _watch(session_reader.read_images(session), None, config, models, progress, str(path))
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
    estimator = PoseEstimator(models_folder(models), config.pose_estimator)
    observations = []
    for frame in frames:
        observations.append(estimator.process(frame.image, frame.stamp_ns))
        if progress is not None:
            progress("2D pose", len(observations) / length if length else -1.0)
    if not any(observation.has_subject for observation in observations):
        raise InputError(
            f"{name}: expected a person in view, found none in {len(observations)} pictures; try another video or model"
        )
    return tracks_from_observations(observations)
