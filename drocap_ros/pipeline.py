"""Any input to a motion: the offline path, with the same core as the nodes."""

from __future__ import annotations

import dataclasses
import itertools
import logging
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from drocap_ros.config import DrocapConfig
from drocap_ros.errors import InputError
from drocap_ros.live_replay import reconstruct_live, recorded_config
from drocap_ros.motion import Motion
from drocap_ros.perception.estimator import PoseEstimator
from drocap_ros.perception.load_models import models_folder
from drocap_ros.perception.sources import Frame, open_source
from drocap_ros.perception.track_video import observe, tracks_from_observations
from drocap_ros.reconstruction.methods.method_input import Progress
from drocap_ros.reconstruction.reconstruct import reconstruct
from drocap_ros.recording.image_messages import read_images
from drocap_ros.recording.open_session import is_recording, open_session
from drocap_ros.recording.session_tracks import read_pose2d
from drocap_ros.recording.telemetry.camera_poses import with_camera
from drocap_ros.recording.telemetry.log import TelemetryLog
from drocap_ros.recording.telemetry.read import read_telemetry
from drocap_ros.recording.telemetry.time_offset import find_offset
from drocap_ros.tracks import Tracks, load_tracks

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Telemetry:
    """A telemetry log beside a video.

    path : .tlog, .ulg, .bin or .srt
    time_offset_s : from the log's first state to the video's first image; None = known or estimated
    mount_pitch_deg : of a camera fixed to the body of a vehicle without a gimbal, negative down
    """

    path: Path
    time_offset_s: float | None = None
    mount_pitch_deg: float | None = None


def reconstruct_input(
    path: str | Path,
    *,
    method: str,
    config: DrocapConfig,
    models: Path | None = None,
    progress: Progress | None = None,
    telemetry: Telemetry | None = None,
    mount_pitch_deg: float | None = None,
) -> tuple[Motion, Tracks]:
    """Motion of the subject in a video file, image folder, recording or tracks file.

    Parameters
    ----------
    path : video, folder of images, ``.mcap``, rosbag1 ``.bag``, rosbag2 folder, or tracks ``.npz``
    method : one of :data:`drocap_ros.reconstruction.methods.METHODS`, or "live": the sliding windows of the live
        graph on a recording with ``pose2d``, with the recorded parameters unless ``config`` differs from the defaults
    models : folder of ONNX files; None = ``DROCAP_MODELS`` or the user's own
    progress : called with a stage and its fraction done
    telemetry : log beside a video, with the camera's pose
    mount_pitch_deg : of a camera fixed to the body, negative down, for a recording without the camera's attitude

    Raises
    ------
    InputError
        When the input cannot be used.
    """
    if method == "live":
        return _reconstruct_live(Path(path), config, progress)
    begin = time.perf_counter()
    log = read_telemetry(telemetry.path) if telemetry is not None else None
    tracks = read_input(Path(path), config, models, progress, mount_pitch_deg)
    if telemetry is not None and log is not None:
        tracks = _with_telemetry(Path(path), tracks, telemetry, log, progress)
    seconds = time.perf_counter() - begin
    motion = reconstruct(
        tracks, method=method, initializer=config.initializer, adjuster=config.bundle_adjuster, progress=progress
    )
    meta = {**motion.meta, "input": Path(path).name}
    meta["seconds"] = {"pose2d": round(seconds, 4), **meta.get("seconds", {})}
    return dataclasses.replace(motion, meta=meta), tracks


def _reconstruct_live(path: Path, config: DrocapConfig, progress: Progress | None) -> tuple[Motion, Tracks]:
    if not path.exists() or not is_recording(path):
        raise InputError(f"{path}: expected a recording with pose2d for method live, found none; use another method")
    with open_session(path) as session:
        if config == DrocapConfig():
            config = recorded_config(session) or config
        motion, tracks, _ = reconstruct_live(session, config, progress)
        for warning in session.warnings:
            logger.warning("%s: %s", path, warning)
    return dataclasses.replace(motion, meta={**motion.meta, "input": path.name}), tracks


def _with_telemetry(
    path: Path, tracks: Tracks, telemetry: Telemetry, log: TelemetryLog, progress: Progress | None
) -> Tracks:
    """Tracks of a video with the camera's poses of the log beside it; warns of missing data."""
    if path.is_dir() or path.suffix == ".npz" or is_recording(path):
        raise InputError(f"--telemetry: expected a video file as input, found {path}; recordings hold their telemetry")
    pitch = telemetry.mount_pitch_deg
    offset = find_offset(path, log, telemetry.time_offset_s, pitch, progress)
    logger.warning("%s: %s; %s", telemetry.path, log.kind, offset)
    for lack in log.lacks:
        logger.warning("%s: %s", telemetry.path, lack)
    at_ns = tracks.stamp_ns - tracks.stamp_ns[0] + int(log.track.stamp_ns[0]) + round(offset.seconds * 1e9)
    tracks, reason = with_camera(tracks, log.track, at_ns, pitch)
    if reason:
        logger.warning("%s: camera telemetry incomplete: %s", telemetry.path, reason)
    return tracks


def read_input(
    path: Path,
    config: DrocapConfig,
    models: Path | None,
    progress: Progress | None = None,
    mount_pitch_deg: float | None = None,
) -> Tracks:
    """2D tracks of the subject: from the input where it holds them, else estimated from its images."""
    if not path.exists():
        raise InputError(f"{path}: no such file or folder; check the path")
    if path.suffix == ".npz":
        return load_tracks(path)
    if is_recording(path):
        with open_session(path) as session:
            if session.has_pose2d:
                tracks = read_pose2d(session, mount_pitch_deg)
            else:
                tracks = _track(read_images(session), None, config, models, progress, str(path))
            for warning in session.warnings:
                logger.warning("%s: %s", path, warning)
            return tracks
    with open_source(str(path), config.image_ingest) as source:
        return _track(source, source.length, config, models, progress, str(path))


def _track(
    frames: Iterable[Frame],
    length: int | None,
    config: DrocapConfig,
    models: Path | None,
    progress: Progress | None,
    name: str,
) -> Tracks:
    done = itertools.count(1)

    def report(*_: object) -> None:
        if progress is not None:
            progress("2D pose", next(done) / length if length else -1.0)

    # Offline the most frequent subject of the whole recording is chosen at the end.
    settings = dataclasses.replace(config.pose_estimator, on_loss="next")
    estimator = PoseEstimator(models_folder(models or settings.models_dir or None), settings)
    try:
        return tracks_from_observations(observe(frames, estimator, report))
    except InputError as error:
        raise InputError(f"{name}: {error}") from None
