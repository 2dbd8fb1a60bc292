"""Time offset between a video and the telemetry log beside it.

The offset is the time from the log's first state to the video's first image.  Its sources, in this order: the user;
the log itself, where its clock is the video's (DJI); the correlation of the image's sideways motion with the camera's
turning in the log; the part of the log during which the camera recorded (Airdata); the container's creation time,
accurate to a second at best.  A camera that turns evenly, or not at all, allows no correlation: without such a part or
a creation time the user must give the offset.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import Enum
from pathlib import Path
from typing import NamedTuple

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.flight.vehicle import camera_rotation
from drocap_ros.geometry.interpolation import interpolate
from drocap_ros.recording.telemetry.camera_poses import camera_attitude
from drocap_ros.recording.telemetry.log import TelemetryLog, VehicleTrack
from drocap_ros.recording.telemetry.video_tracks import stated_times

#: Sampling rate of the correlation.
RATE_HZ = 10.0
#: Part of a video, from its start, that is used.
MAX_VIDEO_S = 180.0
#: Shorter videos hold too few turns.
MIN_VIDEO_S = 5.0
#: Least correlation, and its least lead over the second best offset.
MIN_CORRELATION = 0.7
MIN_LEAD = 0.1  # of the correlation, which is at most 1; a judgement
#: Least standard deviation of the camera's turning rate in the log.
MIN_TURN_DEG_S = 1.5
#: Largest error of the container's creation time; the correlation searches within it.
CREATION_SLACK_S = 5.0
#: Largest difference between a video's length and the part of a log that is marked as video.
PART_SLACK_S = 2.0
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
    """

    seconds: float
    source: OffsetSource
    correlation: float = math.nan

    def __str__(self) -> str:
        found = "" if math.isnan(self.correlation) else f" (correlation {self.correlation:.2f})"
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
    created_s = _offset_by_creation(video, log)
    part_s = _offset_by_part(video, log, created_s)
    moved = image_motion(video, progress)
    found = correlate_turning(log.track, *moved, mount_pitch_deg, near_s=created_s if part_s is None else part_s)
    if found is not None:
        seconds, correlation = found
        return TimeOffset(seconds, OffsetSource.CORRELATION, correlation)
    if part_s is not None:
        return TimeOffset(part_s, OffsetSource.RECORDED_PART)
    if created_s is not None:
        return TimeOffset(created_s, OffsetSource.CREATION_TIME)
    raise InputError(
        f"{video}: expected a time offset between the video and the log, found no way to estimate it (the camera turned"
        " too evenly or too little, or the log does not cover the video; no usable creation time); give"
        " --time-offset S, the seconds from the log's first state to the video's first image"
    )


def _offset_by_creation(video: Path, log: TelemetryLog) -> float | None:
    created_ns, _ = stated_times(video)
    if created_ns is None or log.utc_minus_stamp_ns is None:
        return None
    seconds = (created_ns - log.utc_minus_stamp_ns - int(log.track.stamp_ns[0])) * 1e-9
    # A camera clock in local time, or never set, gives a time far outside the flight.
    return seconds if -CREATION_SLACK_S <= seconds <= log.duration_s else None


def _offset_by_part(video: Path, log: TelemetryLog, created_s: float | None) -> float | None:
    """Start of the part of the log that lasts as long as the video; of several the one nearest the creation time."""
    _, length_s = stated_times(video)
    starts = [
        (first - int(log.track.stamp_ns[0])) * 1e-9
        for first, last in log.video_parts
        if length_s is None or abs((last - first) * 1e-9 - length_s) <= max(PART_SLACK_S, 0.05 * length_s)
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
    return float(offset[best] + _peak(fit, best) / RATE_HZ), float(fit[best])


def _smooth(values: np.ndarray) -> np.ndarray:
    kernel = np.array([0.25, 0.5, 0.25])
    return np.convolve(np.pad(values, 1, mode="edge"), kernel, mode="valid")


def _peak(fit: np.ndarray, best: int) -> float:
    """Vertex of the parabola through three neighbours, in steps from the middle one."""
    if not 0 < best < len(fit) - 1:
        return 0.0
    a, b, c = fit[best - 1 : best + 2]
    bend = a - 2 * b + c
    return float(np.clip(0.5 * (a - c) / bend, -0.5, 0.5)) if bend < 0 else 0.0
