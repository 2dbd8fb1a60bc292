"""Everybody in a recording's images: one pass over them, one camera, a motion of each."""

from __future__ import annotations

import dataclasses
import logging
import time
from collections.abc import Callable, Collection, Mapping
from pathlib import Path

import numpy as np

from drocap_ros.clip import Clip, Progress
from drocap_ros.config import DrocapConfig
from drocap_ros.corrections import Corrections
from drocap_ros.errors import InputError
from drocap_ros.keypoints import PoseObservation
from drocap_ros.motion import Motion, people_files
from drocap_ros.open_images import open_images
from drocap_ros.parameters import Values
from drocap_ros.perception.load_models import models_folder
from drocap_ros.perception.people import PeopleEstimator, observe_people
from drocap_ros.perception.sources import Frame
from drocap_ros.pipeline import (
    COUNTED_S,
    Selection,
    needs_networks,
    selected_tracks,
    tell_said_in_vain,
    with_corrections,
    with_origin,
    with_recorded,
)
from drocap_ros.reconstruction.people import reconstruct_people
from drocap_ros.recording.video_telemetry import Telemetry, read_video_telemetry, with_attitude, with_telemetry
from drocap_ros.tracks import Tracks, load_tracks

logger = logging.getLogger(__name__)

#: Least time for which a person is seen, s, and least number of images, for a motion: the lifter looks at a second and
#: a half about every image, and the adjustments need twelve images.
_LEAST_S, _LEAST_IMAGES = 1.0, 12


def track_people(
    path: str | Path,
    config: DrocapConfig,
    models: Path | None,
    selection: Selection,
    progress: Progress | None = None,
    on_frame: Callable[[Frame, list[PoseObservation]], None] | None = None,
) -> tuple[dict[int, Tracks], Values]:
    """2D tracks of everybody, or of the selected people, in the selected part of a source's images, and their origin.

    They have the numbers of ``drocap track --list``; ``left_out`` of the origin has words about others.
    """
    path = Path(path)
    if not needs_networks(path, selection.redetect):
        raise InputError(f"{path}: expected images for several persons, found 2D poses of one; name the video")
    people = PeopleEstimator(models_folder(models or config.pose_estimator.models_dir), config.pose_estimator)
    with open_images(path, config.image_ingest, selection.topic) as images:
        meter = selection.clip.meter(progress, "2D pose", images.duration_s)

        def each(frame: Frame, shown: list[PoseObservation]) -> None:
            meter(frame, None)
            if on_frame is not None:
                on_frame(frame, shown)

        frames = Clip(end_s=selection.clip.end_s + COUNTED_S).select(images.frames)
        found = observe_people(frames, people, each, selection.clip, selection.threads)
    kept, left_out = _long_enough(_chosen(found, selection.people))
    for words in left_out:
        logger.warning("%s: %s", path, words)
    if not kept:
        raise InputError(f"{path}: expected a person seen for {_LEAST_S:g} s, found none; try a longer part")
    size = list(next(iter(kept.values())).image_size)
    origin: Values = {"pose2d": "estimated", "people": list(kept), "left_out": left_out}
    origin["images"] = {"size": size, "length": images.length, "rate_hz": images.rate_hz}
    origin["images"] |= {"topic": selection.topic} if selection.topic else {}
    return kept, origin | ({} if selection.clip.whole else {"clip": selection.clip.meta})


def when(tracks: Tracks) -> str:
    """From when to when tracks show their person, and in how many of the images."""
    seen = np.isfinite(tracks.keypoints).all(axis=2).any(axis=1)
    first, last = ((int(tracks.stamp_ns[at]) - int(tracks.stamp_ns[0])) * 1e-9 for at in np.flatnonzero(seen)[[0, -1]])
    return f"{first:.1f} to {last:.1f} s, in {int(seen.sum())} of {len(tracks)} images"


def _long_enough(people: Mapping[int, Tracks]) -> tuple[dict[int, Tracks], list[str]]:
    """Those who are seen for as long as a motion needs, and words about the others."""
    kept, words = {}, []
    for number, tracks in people.items():
        seen = np.isfinite(tracks.keypoints).all(axis=2).any(axis=1)
        step_s = float(np.median(np.diff(tracks.stamp_ns))) * 1e-9 if len(tracks) > 1 else 0.0
        seen_s = float(seen.sum()) * step_s
        if seen_s >= _LEAST_S and seen.sum() >= _LEAST_IMAGES:
            kept[number] = tracks
        else:
            words.append(f"person {number} is seen for {seen_s:.1f} s, too short for a motion, and left out")
    return kept, words


def reconstruct_everybody(
    path: str | Path,
    *,
    method: str,
    config: DrocapConfig,
    models: Path | None = None,
    progress: Progress | None = None,
    telemetry: Telemetry | None = None,
    selection: Selection | None = None,
) -> dict[int, tuple[Motion, Tracks]]:
    """Motions and tracks of everybody in a source's images, or of the selected people, in one world, by their numbers.

    path : as of :func:`~drocap_ros.pipeline.reconstruct_input`, whose arguments the others are, or a folder of
        ``person_N/tracks.npz``, the tracks of the same images
    """
    path, selection = Path(path), selection or Selection()
    if method == "live":
        raise InputError("--method live: expected a recording of one person's poses; choose another method")
    begin = time.perf_counter()
    if selection.evidence is not None:
        raise InputError("--evidence: expected one person, found several to reconstruct; choose one with --subject N")
    telemetry = telemetry or Telemetry()
    if files := people_files(path, "tracks.npz"):
        chosen = _chosen({number: load_tracks(file) for number, file in files.items()}, selection.people)
        tracks = {number: selected_tracks(own, telemetry, selection) for number, own in chosen.items()}
        images, size = selection.images, list(next(iter(tracks.values())).image_size)
        origin: Values = {"people": list(tracks), "left_out": [], "images": {"size": size}}
    else:
        images = path
        tracks, origin = track_people(path, config, models, selection, progress)
        seen = {number: int(np.isfinite(t.keypoints).any(axis=(1, 2)).sum()) for number, t in tracks.items()}
        lead = max(seen, key=lambda number: (seen[number], -number))
        placed, more = _with_camera_of_input(path, tracks[lead], config, telemetry, selection, progress)
        tracks, origin = {number: _with_camera(t, placed) for number, t in tracks.items()}, origin | more
    meant = {}
    for number, own in tracks.items():
        said = dataclasses.replace(selection, corrections=selection.each_corrections.get(number, Corrections()))
        meant[number] = with_corrections(images, own, config, models, progress, said)
        if not np.isfinite(meant[number].keypoints).any():
            raise InputError(f"{path}: person {number}: expected some images that show it, found none; correct that")
    if selection.rate_hz:
        tracks = {number: own.at_rate(selection.rate_hz) for number, own in tracks.items()}
    seconds = time.perf_counter() - begin
    motions = reconstruct_people(
        meant, method=method, initializer=config.initializer, adjuster=config.bundle_adjuster, progress=progress
    )
    found = {}
    for number, motion in motions.items():
        told: Values = {**origin, "person": number, "seen": when(meant[number])}
        if corrections := selection.each_corrections.get(number):
            told["corrections"] = corrections.values
            tell_said_in_vain(path, corrections, motion)
        found[number] = with_origin(motion, path, told, seconds), tracks[number]
    return found


def _chosen(people: Mapping[int, Tracks], numbers: Collection[int]) -> dict[int, Tracks]:
    """Those of these numbers, all without any."""
    if missing := [number for number in numbers if number not in people]:
        there = ", ".join(map(str, people))
        raise InputError(f"--subject {missing[0]}: expected one of {there}; `drocap track --list` numbers the persons")
    return {number: people[number] for number in sorted(numbers or people)}


def _with_camera(tracks: Tracks, placed: Tracks) -> Tracks:
    """Tracks with the camera of others of the same images; in those images in which it is known."""
    rows = np.isin(tracks.stamp_ns, placed.stamp_ns)
    names = ("camera_rotation", "camera_position", "camera_matrix", "background")
    return dataclasses.replace(tracks.of_frames(rows), **{name: getattr(placed, name) for name in names})


def _with_camera_of_input(
    path: Path,
    tracks: Tracks,
    config: DrocapConfig,
    telemetry: Telemetry,
    selection: Selection,
    progress: Progress | None,
) -> tuple[Tracks, Values]:
    """Tracks of an input's images with the camera that its recording or its telemetry knows, and words for ``meta``."""
    origin: Values = {}
    found = read_video_telemetry(path, telemetry)
    tracks = with_recorded(path, tracks, telemetry, selection)
    if found is not None:
        ingest = config.image_ingest
        tracks, origin["telemetry"] = with_telemetry(path, tracks, telemetry, found, ingest, progress)
    return with_attitude(tracks, telemetry.attitude_deg), origin
