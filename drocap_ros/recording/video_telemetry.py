"""Telemetry of a video: from a log beside it or from the file itself, to the camera of its tracks."""

from __future__ import annotations

import dataclasses
import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.file_kind import FileKind, file_kind
from drocap_ros.geometry.rotations import exp_so3
from drocap_ros.perception.calibration import camera_model
from drocap_ros.perception.sources.base import ImageIngestConfig
from drocap_ros.recording.open_session import is_recording
from drocap_ros.recording.telemetry import srt
from drocap_ros.recording.telemetry.camera_poses import with_camera
from drocap_ros.recording.telemetry.log import TelemetryLog
from drocap_ros.recording.telemetry.read import read_telemetry
from drocap_ros.recording.telemetry.time_offset import Progress, find_offset
from drocap_ros.tracks import Tracks

logger = logging.getLogger(__name__)


#: In the place of a log: use none.
NO_TELEMETRY = Path("none")


@dataclass(frozen=True)
class Telemetry:
    """Source of a video's telemetry.

    path : log beside it (.tlog, .ulg, .bin, .srt, .csv), or ``NO_TELEMETRY``; None = the DJI track inside the video,
        else the subtitles of its name beside it, where there are any
    time_offset_s : from the log's first state to the video's first image; None = known or estimated
    mount_pitch_deg : of a camera fixed to the body of a vehicle without a gimbal, negative down
    attitude_deg : pitch, negative down, and roll, clockwise, of a camera that stands still
    """

    path: Path | None = None
    time_offset_s: float | None = None
    mount_pitch_deg: float | None = None
    attitude_deg: tuple[float, float] | None = None


def with_attitude(tracks: Tracks, attitude_deg: tuple[float, float] | None) -> Tracks:
    """Tracks of a camera that stands still, with its rotation by pitch and roll (deg); it looks north."""
    if attitude_deg is None:
        return tracks
    if tracks.camera_rotation is not None:
        raise InputError("--camera-pitch: expected no telemetry, found the camera's attitude; leave the option out")
    level = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    turns = exp_so3(np.deg2rad([[-attitude_deg[0], 0.0, 0.0], [0.0, 0.0, -attitude_deg[1]]]))
    rotation = np.broadcast_to(turns[1] @ turns[0] @ level, (len(tracks), 3, 3)).copy()
    return dataclasses.replace(tracks, camera_rotation=rotation)


def own_telemetry(video: Path) -> list[Path]:
    """What tells a video's telemetry without being named: the video itself, and subtitles of its name beside it."""
    from drocap_ros.recording.telemetry.djmd import has_djmd

    if not video.is_file() or file_kind(video) is not FileKind.VIDEO:
        return []
    suffix = srt.FORMAT.suffix  # in any case, and no name of the video is a pattern
    beside = (file for file in video.parent.iterdir() if file.suffix.lower() == suffix and file.stem == video.stem)
    return [video] * has_djmd(video) + sorted(beside)


def read_video_telemetry(video: Path, telemetry: Telemetry) -> tuple[Path, TelemetryLog] | None:
    """The named log of a video, else the first of :func:`own_telemetry` that can be used; None where there is none.

    Own telemetry that cannot be true is warned of and not used.
    """
    if telemetry.path == NO_TELEMETRY:
        return None
    if telemetry.path is not None:
        if video.is_dir() or video.suffix == ".npz" or is_recording(video):
            raise InputError(f"--telemetry: expected a video file, found {video}; recordings hold their telemetry")
        return telemetry.path, read_telemetry(telemetry.path)
    found, problems = read_own(video)
    for problem in problems:
        logger.warning("%s; the video is used without it", problem)
    return found


def read_own(video: Path) -> tuple[tuple[Path, TelemetryLog] | None, list[str]]:
    """The first of :func:`own_telemetry` that can be used, and why those before it cannot."""
    from drocap_ros.recording.telemetry.djmd import read_djmd

    problems: list[str] = []
    for source in own_telemetry(video):
        try:
            return (source, read_djmd(video) if source == video else read_telemetry(source)), problems
        except (InputError, OSError) as error:  # noqa: PERF203  # two files at most
            problems.append(f"{source}: {str(error).removeprefix(f'{source}: ')}")
    return None, problems


def with_telemetry(
    video: Path,
    tracks: Tracks,
    telemetry: Telemetry,
    found: tuple[Path, TelemetryLog],
    ingest: ImageIngestConfig,
    progress: Progress | None = None,
) -> tuple[Tracks, dict[str, str]]:
    """Tracks of a video with the camera of its telemetry, and the sources by name; warns of what is missing or assumed.

    The camera matrix comes from the configuration, else from the lens that the log describes.
    """
    (name, log), pitch = found, telemetry.mount_pitch_deg
    offset = find_offset(video, log, telemetry.time_offset_s, pitch, progress)
    beside = "" if name in (telemetry.path, video) else ", found beside the video (--telemetry none leaves it out)"
    logger.warning("%s: %s%s; %s", name, log.kind, beside, offset)
    for lack in log.lacks:
        logger.warning("%s: %s", name, lack)
    at_ns = tracks.stamp_ns + int(log.track.stamp_ns[0]) + round(offset.seconds * 1e9)
    tracks, reason = with_camera(tracks, log.track, at_ns, pitch)
    if reason:
        logger.warning("%s: camera telemetry incomplete: %s", name, reason)
    sources = {"file": name.name, "kind": log.kind, "time_offset": str(offset)}
    camera = camera_model(ingest, tracks.image_size)
    if camera is None and log.lens is not None and tracks.camera_rotation is not None:
        fov_deg = log.lens.horizontal_fov_deg(tracks.image_size)
        sources["lens"] = f"{fov_deg:.1f} deg across the image: {log.lens}"
        logger.warning("%s: %s; image_ingest.horizontal_fov_deg in --config replaces it", video, sources["lens"])
        camera = camera_model(dataclasses.replace(ingest, horizontal_fov_deg=fov_deg), tracks.image_size)
    if camera is not None:
        tracks = dataclasses.replace(tracks, camera_matrix=camera.matrix)
    return tracks, sources
