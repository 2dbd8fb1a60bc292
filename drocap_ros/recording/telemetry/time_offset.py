"""Where a video lies on the clock of the telemetry log beside it.

The offset is the time from the log's first state to the video's first picture.  In this order: told by the user;
known, where the log counts by the video (DJI subtitles); found by comparing how the image moves sideways with how
the log says the camera turned; taken from the container's creation time, which is good to a second at best.  A
camera that turns evenly, or not at all, cannot be placed by its turning: then the offset must be told.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.flight.frames import camera_rotation
from drocap_ros.recording.telemetry.camera_poses import VehicleTrack, camera_attitude, interpolate
from drocap_ros.recording.telemetry.read import VIDEO, TelemetryLog

#: Rate at which the two turnings are compared.
RATE_HZ = 10.0
#: As much of a video is looked at.
MAX_VIDEO_S = 180.0
MIN_VIDEO_S = 5.0
#: Least correlation, and least distance from the next best place.
MIN_CORRELATION, MIN_LEAD = 0.7, 0.1
#: The log must say that the camera turned unevenly by at least so much, standard deviation.
MIN_TURN_DEG_S = 1.5
#: The container's time may be off by so much; within it the turning decides.
CREATION_SLACK_S = 5.0
_WIDTH = 160
_MP4_EPOCH_S = 2_082_844_800  # 1904 to 1970

Progress = Callable[[str, float], None]


class TimeOffset(NamedTuple):
    """Seconds from the log's first state to the video's first picture, how it is known, and what to say of it."""

    seconds: float
    source: str
    warning: str


def find_offset(
    video: Path,
    log: TelemetryLog,
    told_s: float | None,
    mount_pitch_deg: float | None = None,
    progress: Progress | None = None,
) -> TimeOffset:
    """The offset of a video and a log; see the module's text.

    Raises
    ------
    InputError
        When it is not told and cannot be found.
    """
    if told_s is not None:
        return TimeOffset(told_s, "told", "")
    if log.clock == VIDEO:
        return TimeOffset(0.0 - float(log.track.stamp_ns[0]) * 1e-9, "the log counts by the video", "")
    created_s = _offset_by_creation(video, log)
    moved = image_motion(video, progress)
    found = correlate_turning(log.track, *moved, mount_pitch_deg, near_s=created_s)
    if found is not None:
        seconds, correlation = found
        return TimeOffset(seconds, f"the camera's turning (correlation {correlation:.2f})", "")
    if created_s is not None:
        return TimeOffset(
            created_s,
            "the container's creation time",
            "the time offset is known to a second at best, which at 25 deg/s is 25 deg of camera rotation; give"
            " --time-offset",
        )
    raise InputError(
        f"{video}: expected a time offset between the video and the log, found no way to estimate it (the camera turned"
        " too evenly or too little, or the log does not cover the video; no usable creation time); give"
        " --time-offset S, the seconds from the log's first state to the video's first picture"
    )


def _offset_by_creation(video: Path, log: TelemetryLog) -> float | None:
    created_ns = creation_time_ns(video)
    if created_ns is None or log.utc_minus_stamp_ns is None:
        return None
    seconds = (created_ns - log.utc_minus_stamp_ns - int(log.track.stamp_ns[0])) * 1e-9
    # A camera that was set to local time, or never set, lies far outside the flight.
    return seconds if -CREATION_SLACK_S <= seconds <= log.duration_s else None


def creation_time_ns(video: Path) -> int | None:
    """Creation time (UTC ns) that an MP4 or MOV container tells in its ``mvhd`` box, None where it tells none."""
    try:
        with video.open("rb") as file:
            size = file.seek(0, 2)
            body = _find_box(file, 0, size, (b"moov", b"mvhd"))
            if body is None:
                return None
            file.seek(body)
            data = file.read(12)
    except OSError:
        return None
    if len(data) < 12:
        return None
    seconds = struct.unpack(">Q", data[4:12])[0] if data[0] == 1 else struct.unpack(">I", data[4:8])[0]
    unix_s = seconds - _MP4_EPOCH_S
    return unix_s * 10**9 if 946_684_800 < unix_s < 4_102_444_800 else None


def _find_box(file: IO[bytes], start: int, end: int, names: tuple[bytes, ...]) -> int | None:
    """Place of the content of a nested box."""
    place, looked = start, 0
    while place + 8 <= end and looked < 1000:
        looked += 1
        file.seek(place)
        head = file.read(16)
        if len(head) < 8:
            return None
        length, name, skip = struct.unpack(">I", head[:4])[0], head[4:8], 8
        if length == 1 and len(head) == 16:
            length, skip = struct.unpack(">Q", head[8:16])[0], 16
        elif length == 0:
            length = end - place
        if length < skip:
            return None
        if name == names[0]:
            if len(names) == 1:
                return place + skip
            return _find_box(file, place + skip, min(place + length, end), names[1:])
        place += length
    return None


def image_motion(video: Path, progress: Progress | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Times (N,) s from the first picture and sideways motion (N,) of the image, widths per second, right positive.

    By phase correlation of small grey pictures ``RATE_HZ`` apart: the background, which fills most of the picture,
    decides.
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
            if t > MAX_VIDEO_S:
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
    """Times (M,) s from the log's first state and turning (M,) rad/s to the left of the camera, or of the body.

    A camera whose mount is not told still turns with the vehicle.
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
    """Offset in s at which the image's motion fits the log's turning best, and the correlation there.

    None where no place fits clearly better than all others; the log must cover the video.

    Parameters
    ----------
    times, motion : (N,) of :func:`image_motion`
    near_s : only places within ``CREATION_SLACK_S`` of this one
    """
    log_t, turning = turning_rate(track, mount_pitch_deg)
    if len(times) < 2 or times[-1] - times[0] < MIN_VIDEO_S or len(turning) < 2:
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
    enough = variance > np.deg2rad(MIN_TURN_DEG_S) ** 2
    fit = np.where(enough, product / np.sqrt(np.maximum(variance * np.mean(x * x), 1e-30)), -1.0)
    # Windows with a gap in the log tell nothing.
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
    return float(offset[best] + _peak(fit, best) / RATE_HZ), float(fit[best])


def _smooth(values: np.ndarray) -> np.ndarray:
    kernel = np.array([0.25, 0.5, 0.25])
    return np.convolve(np.pad(values, 1, mode="edge"), kernel, mode="valid")


def _peak(fit: np.ndarray, best: int) -> float:
    """Place of the parabola's top through three neighbours, in steps from the middle one."""
    if not 0 < best < len(fit) - 1:
        return 0.0
    a, b, c = fit[best - 1 : best + 2]
    bend = a - 2 * b + c
    return float(np.clip(0.5 * (a - c) / bend, -0.5, 0.5)) if bend < 0 else 0.0
