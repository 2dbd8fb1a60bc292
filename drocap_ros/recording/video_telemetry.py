"""Telemetry of a video: from a log beside it or from the file itself, to the camera of its tracks.

The time offset goes from the log's first state to the video's first image.  Its sources, in this order: the user; the
log itself, where its clock is the video's (DJI); the correlation of the image's sideways motion with the camera's
turning in the log; the part of the log during which the camera recorded (Airdata); the container's creation time,
accurate to a second at best.  A camera that turns evenly, or not at all, allows no correlation: without such a part or
a creation time the user must give the offset.
"""

from __future__ import annotations

import dataclasses
import logging
import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import NamedTuple

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.file_kind import FileKind, file_kind
from drocap_ros.flight.vehicle import camera_rotation
from drocap_ros.geometry.interpolation import interpolate, peak
from drocap_ros.geometry.rotations import exp_so3
from drocap_ros.perception.calibration import camera_model
from drocap_ros.perception.sources.base import ImageIngestConfig
from drocap_ros.recording.open_session import is_recording
from drocap_ros.recording.telemetry import srt
from drocap_ros.recording.telemetry.log import Lack, TelemetryLog, VehicleTrack, camera_attitude, with_camera
from drocap_ros.recording.telemetry.read import read_telemetry
from drocap_ros.recording.telemetry.video_tracks import stated_times
from drocap_ros.tracks import Tracks

#: Sampling rate of the correlation.
RATE_HZ = 10.0
#: Least correlation, and its least lead over the second best offset.
MIN_CORRELATION = 0.7
MIN_LEAD = 0.1  # of the correlation, which is at most 1; a judgement
#: Largest error of the container's creation time; the correlation searches within it.
CREATION_SLACK_S = 5.0
#: Width, px, of the small images of the phase correlation.
_WIDTH = 160

Progress = Callable[[str, float], None]


class OffsetSource(Enum):
    """Source of a time offset; the value is its text."""

    GIVEN = "as given"
    VIDEO_CLOCK = "the log's clock is the video's"
    CORRELATION = "by the camera's turning"
    RECORDED_PART = "by the part of the log that is marked as video, accurate to about half a second"
    CREATION_TIME = (
        "by the container's creation time, accurate to a second at best, which at 25 deg/s is 25 deg of camera"
        " rotation; give --time-offset"
    )


class TimeOffset(NamedTuple):
    """Seconds from the log's first state to the video's first image, and their source.

    correlation : of the camera's turning with the image's motion; NaN for other sources
    zone_h : of the camera's clock, where it is that of a time zone
    """

    seconds: float
    source: OffsetSource
    correlation: float = math.nan
    zone_h: float = 0.0

    def __str__(self) -> str:
        found = "" if math.isnan(self.correlation) else f" (correlation {self.correlation:.2f})"
        if self.zone_h:
            found += f"; the creation time is taken as local time, {self.zone_h:+g} h from UTC"
        return f"time offset {self.seconds:.2f} s, {self.source.value}{found}"


def find_offset(
    video: Path,
    log: TelemetryLog,
    given_s: float | None,
    mount_pitch_deg: float | None = None,
    progress: Progress | None = None,
) -> TimeOffset:
    """The offset of a video and a log; see the module's text."""
    if given_s is not None:
        return TimeOffset(given_s, OffsetSource.GIVEN)
    if log.video_clock:
        return TimeOffset(0.0 - float(log.track.stamp_ns[0]) * 1e-9, OffsetSource.VIDEO_CLOCK)
    created_s, zone_h = _offset_by_creation(video, log)
    part_s = _offset_by_part(video, log, created_s)
    moved = image_motion(video, progress)
    found = correlate_turning(log.track, *moved, mount_pitch_deg, near_s=created_s if part_s is None else part_s)
    if found is not None:
        seconds, correlation = found
        return TimeOffset(seconds, OffsetSource.CORRELATION, correlation, zone_h if part_s is None else 0.0)
    if part_s is not None:
        return TimeOffset(part_s, OffsetSource.RECORDED_PART)
    if created_s is not None:
        return TimeOffset(created_s, OffsetSource.CREATION_TIME, zone_h=zone_h)
    raise InputError(
        f"{video}: expected a time offset between the video and the log, found no way to estimate it (the camera turned"
        " too evenly or too little, or the log does not cover the video; no usable creation time); give"
        " --time-offset S, the seconds from the log's first state to the video's first image"
    )


def _offset_by_creation(video: Path, log: TelemetryLog) -> tuple[float | None, float]:
    """Seconds from the log's first state to the creation time, None outside the log, and its hours from UTC.

    Cameras and phones write their local time in the place of UTC: whole and half hours are tried where UTC does not
    fit, and one is taken where no other fits.
    """
    created_ns, length_s = stated_times(video)
    if created_ns is None or log.utc_minus_stamp_ns is None:
        return None, 0.0
    seconds = (created_ns - log.utc_minus_stamp_ns - int(log.track.stamp_ns[0])) * 1e-9
    latest_s = log.duration_s - (length_s or 0.0) + CREATION_SLACK_S
    fits = [half / 2 for half in range(-24, 29) if -CREATION_SLACK_S <= seconds - 1800 * half <= latest_s]
    if -CREATION_SLACK_S <= seconds <= log.duration_s:
        fits = [0.0]
    elif len(fits) > 1:
        fits = [hours for hours in fits if hours.is_integer()]
    return (seconds - 3600 * fits[0], fits[0]) if len(fits) == 1 else (None, 0.0)


def _offset_by_part(video: Path, log: TelemetryLog, created_s: float | None) -> float | None:
    """Start of the part of the log that lasts as long as the video; of several the one nearest the creation time."""
    _, length_s = stated_times(video)
    # Largest difference between a video's length and the part of a log that is marked as video.
    starts = [
        (first - int(log.track.stamp_ns[0])) * 1e-9
        for first, last in log.video_parts
        if length_s is None or abs((last - first) * 1e-9 - length_s) <= max(2.0, 0.05 * length_s)
    ]
    if len(starts) > 1 and created_s is not None:
        starts = sorted(starts, key=lambda s: abs(s - created_s))[:1]
    return starts[0] if len(starts) == 1 else None


def image_motion(video: Path, progress: Progress | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Times (N,) s from the first image and sideways motion (N,) of the image, widths per second, right positive.

    Phase correlation of small grey images at ``RATE_HZ`` measures the motion of the background, which fills most of
    the image.
    """
    import cv2

    from drocap_ros.perception.sources.video import VideoSource

    times, motion = [], []
    before: tuple[float, np.ndarray] | None = None
    window = None
    source = VideoSource(video)
    try:
        while (frame := source.read()) is not None:
            t = frame.stamp_ns * 1e-9
            # Part of a video, from its start, that is used.
            if t > 180.0:
                break
            if before is not None and t - before[0] < 0.9 / RATE_HZ:
                continue
            height, width = frame.image.shape[:2]
            small = cv2.resize(frame.image, (_WIDTH, max(16, _WIDTH * height // width)), interpolation=cv2.INTER_AREA)
            grey = cv2.cvtColor(small, cv2.COLOR_BGR2GRAY).astype(np.float32)
            if window is None:
                window = cv2.createHanningWindow((grey.shape[1], grey.shape[0]), cv2.CV_32F)
            if before is not None:
                (right, _), _ = cv2.phaseCorrelate(before[1], grey, window)
                times.append(0.5 * (t + before[0]))
                motion.append(right / _WIDTH / (t - before[0]))
            before = (t, grey)
            if progress is not None and source.length:
                progress("time offset", min(1.0, t * 30.0 / source.length))
    finally:
        source.close()
    return np.array(times), np.array(motion)


def turning_rate(track: VehicleTrack, mount_pitch_deg: float | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Times (M,) s from the log's first state and turning rate (M,) rad/s, left positive, of the camera.

    Without a camera attitude the body's turning rate replaces it.
    """
    attitude = camera_attitude(track, mount_pitch_deg)
    if not np.isfinite(attitude).all(axis=1).any():
        attitude = track.orientation
    good = np.isfinite(attitude).all(axis=1)
    if good.sum() < 2:
        return np.zeros(0), np.zeros(0)
    t = (track.stamp_ns[good] - track.stamp_ns[0]) * 1e-9
    grid = np.arange(t[0], t[-1], 1.0 / RATE_HZ)
    at_ns = track.stamp_ns[0] + np.round(grid * 1e9).astype(np.int64)
    even, _ = interpolate(track.stamp_ns[good], attitude[good], at_ns, spherical=True)
    forward = np.swapaxes(camera_rotation(even), 1, 2)[:, :, 2]
    heading = np.arctan2(forward[:, 1], forward[:, 0])
    step = np.angle(np.exp(1j * np.diff(heading)))
    return grid[:-1] + 0.5 / RATE_HZ, step * RATE_HZ


def correlate_turning(
    track: VehicleTrack,
    times: np.ndarray,
    motion: np.ndarray,
    mount_pitch_deg: float | None = None,
    near_s: float | None = None,
) -> tuple[float, float] | None:
    """Offset in s with the highest correlation of the image's motion with the log's turning, and that correlation.

    None where no offset is clearly better than all others; the log must cover the video.

    times, motion : (N,) of :func:`image_motion`
    near_s : only offsets within ``CREATION_SLACK_S`` of this one
    """
    log_t, turning = turning_rate(track, mount_pitch_deg)
    # Shorter videos hold too few turns.
    if len(times) < 2 or times[-1] - times[0] < 5.0 or len(turning) < 2:
        return None
    grid = np.arange(times[0], times[-1], 1.0 / RATE_HZ)
    x = _smooth(np.interp(grid, times, motion))
    y = _smooth(np.nan_to_num(turning))
    n = len(x)
    if len(y) < n:
        return None
    x = x - x.mean()
    sums = np.concatenate([[0.0], np.cumsum(y)])
    squares = np.concatenate([[0.0], np.cumsum(y * y)])
    mean = (sums[n:] - sums[:-n]) / n
    variance = np.maximum((squares[n:] - squares[:-n]) / n - mean**2, 0.0)
    product = np.correlate(y, x, mode="valid") / n
    # Least standard deviation of the camera's turning rate in the log.
    enough = variance > np.deg2rad(1.5) ** 2
    fit = np.where(enough, product / np.sqrt(np.maximum(variance * np.mean(x * x), 1e-30)), -1.0)
    # Windows with gaps in the log are excluded.
    holes = np.concatenate([[0], np.cumsum(~np.isfinite(turning))])
    fit[holes[n:] - holes[:-n] > 0.1 * n] = -1.0
    offset = log_t[0] + np.arange(len(fit)) / RATE_HZ - grid[0]
    if near_s is not None:
        fit = np.where(np.abs(offset - near_s) <= CREATION_SLACK_S, fit, -1.0)
    best = int(np.argmax(fit))
    rivals = np.abs(np.arange(len(fit)) - best) > RATE_HZ
    second = fit[rivals].max(initial=-1.0)
    if fit[best] < MIN_CORRELATION or fit[best] - second < MIN_LEAD:
        return None
    return float(offset[best] + peak(fit, best) / RATE_HZ), float(fit[best])


def _smooth(values: np.ndarray) -> np.ndarray:
    kernel = np.array([0.25, 0.5, 0.25])
    return np.convolve(np.pad(values, 1, mode="edge"), kernel, mode="valid")


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
    if zoom := [str(lack) for lack in log.lacks if lack.kind is Lack.ZOOM]:
        sources["zoom"] = zoom[0]
    camera = camera_model(ingest, tracks.image_size)
    if camera is None and log.lens is not None and tracks.camera_rotation is not None:
        fov_deg = log.lens.horizontal_fov_deg(tracks.image_size)
        sources["lens"] = f"{fov_deg:.1f} deg across the image: {log.lens}"
        logger.warning("%s: %s; image_ingest.horizontal_fov_deg in --config replaces it", video, sources["lens"])
        camera = camera_model(dataclasses.replace(ingest, horizontal_fov_deg=fov_deg), tracks.image_size)
    if camera is not None:
        tracks = dataclasses.replace(tracks, camera_matrix=camera.matrix)
    return tracks, sources
