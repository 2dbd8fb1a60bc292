"""Any input to a motion: the offline path, with the same core as the nodes; several recordings of one person to one."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import itertools
import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from drocap_ros.clip import Clip, Progress
from drocap_ros.config import DrocapConfig
from drocap_ros.corrections import Corrections, corrected, spliced
from drocap_ros.errors import InputError
from drocap_ros.file_kind import missing
from drocap_ros.keypoints import PoseObservation
from drocap_ros.motion import Motion, people_files
from drocap_ros.open_images import open_images, refuse_other_inputs
from drocap_ros.parameters import Values
from drocap_ros.perception.calibration import with_lens_of
from drocap_ros.perception.estimator import PoseEstimator
from drocap_ros.perception.load_models import models_folder
from drocap_ros.perception.people import FoundPerson, find_persons, following, in_view
from drocap_ros.perception.sources import Frame
from drocap_ros.perception.track_video import observe, subjects, tracks_from_observations
from drocap_ros.perception.tracking.pose_estimator_config import PoseEstimatorConfig
from drocap_ros.reconstruction.reconstruct import Solved, solve
from drocap_ros.reconstruction.together.joined import join_views
from drocap_ros.recording.evidence import with_evidence
from drocap_ros.recording.image_messages import choose_images
from drocap_ros.recording.open_session import is_recording, open_session
from drocap_ros.recording.session import POSE2D, Session
from drocap_ros.recording.session_tracks import read_pose2d, with_recorded_camera
from drocap_ros.recording.video_telemetry import (
    NO_TELEMETRY,
    Telemetry,
    read_video_telemetry,
    with_attitude,
    with_telemetry,
)
from drocap_ros.tracks import Tracks, change_lines, load_tracks

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Selection:
    """Part of an input that is reconstructed.

    person : number of a person of :func:`~drocap_ros.perception.people.find_persons`; None = as configured
    redetect : estimate the 2D poses of a recording from its images, although it holds recorded ones
    topic : of the images of a recording; empty: colour before grey, then that with most messages
    rate_hz : true rate of the images where a video plays them slower
    evidence : file of 3D poses of its images by another system
    corrections : by hand; their times are those of the motion
    images : of an input that has none
    people : numbers of those whom :mod:`drocap_ros.people` reconstructs; empty = everybody
    each_corrections : by hand, of people by their numbers
    threads : that share the work on the images; the result is the same with any number
    on_image : called with each image of a video and its pose, in the order of time
    on_tracks : called with the tracks and their origin, as in ``meta`` of the motion, before that is computed
    """

    clip: Clip = field(default_factory=Clip)
    person: int | None = None
    redetect: bool = False
    topic: str = ""
    rate_hz: float | None = None
    evidence: Path | None = None
    corrections: Corrections = field(default_factory=Corrections)
    images: Path | None = None
    people: tuple[int, ...] = ()
    each_corrections: Mapping[int, Corrections] = field(default_factory=dict)
    threads: int = field(default=2, compare=False)
    on_image: Callable[[Frame, PoseObservation], None] = field(default=lambda *_: None, compare=False)
    on_tracks: Callable[[Tracks, Values], None] = field(default=lambda *_: None, compare=False)


#: A person counts after a confirmation, s; whoever is first seen before a clip's end is counted by then.
COUNTED_S = 5.0
_WHOLE, _FOUND = Selection(), Telemetry()


def reconstruct_input(
    path: str | Path,
    *,
    method: str,
    config: DrocapConfig,
    models: Path | None = None,
    progress: Progress | None = None,
    telemetry: Telemetry = _FOUND,
    selection: Selection = _WHOLE,
) -> tuple[Motion, Tracks]:
    """Motion of the subject in a video file, image folder, recording or tracks file, and its tracks before corrections.

    path : video, folder of images, ``.mcap``, rosbag1 ``.bag``, rosbag2 folder, or tracks ``.npz``
    method : one of :data:`drocap_ros.reconstruction.methods.METHODS`, or "live": the sliding windows of the live
        graph on a recording with ``pose2d``, with the recorded parameters unless ``config`` differs from the defaults
    models : folder of ONNX files; None = ``DROCAP_MODELS`` or the user's own
    progress : called with a stage and its fraction done
    telemetry : source of the camera's pose of a video; default: the DJI track inside it or the subtitles beside it.
        With ``NO_TELEMETRY`` that of a recording or tracks file is not used either; its pitch of a mount is that of a
        recording without the camera's attitude, too
    selection : part of the input; default: all images, the person in most of them
    """
    if method == "live":
        if selection != _WHOLE:
            raise InputError("--method live: expected a whole recording with its recorded poses; choose another method")
        if telemetry != _FOUND:
            raise InputError("--method live: expected the recorded telemetry, got other; leave the options out")
        from drocap_ros.live_replay import replay

        return replay(Path(path), config, progress)
    begin = time.perf_counter()
    tracks, origin = input_tracks(Path(path), config, models, progress, telemetry, selection)
    if selection.evidence is not None:
        tracks = with_evidence(tracks, selection.evidence)
    meant = with_corrections(selection.images or Path(path), tracks, config, models, progress, selection)
    if selection.corrections:
        origin["corrections"] = selection.corrections.values
    if selection.rate_hz:
        tracks = tracks.at_rate(selection.rate_hz)
    seconds = time.perf_counter() - begin
    selection.on_tracks(tracks, origin)
    from drocap_ros.reconstruction.reconstruct import reconstruct

    motion = reconstruct(
        meant, method=method, initializer=config.initializer, adjuster=config.bundle_adjuster, progress=progress
    )
    tell_said_in_vain(Path(path), selection.corrections, motion)
    return with_origin(motion, Path(path), origin, seconds), tracks


def tell_said_in_vain(path: Path, corrections: Corrections, motion: Motion) -> None:
    """Warn of corrections that the motion could not follow."""
    if corrections.feet and motion.frame == "camera":
        logger.warning("%s: feet: the motion has no world in which a foot rests; they change nothing", path)
    if corrections.upright and (motion.frame == "camera" or "camera" not in motion.meta):
        by = "the motion has no world" if motion.frame == "camera" else "telemetry tells up"
        logger.warning("%s: upright: %s; it changes nothing", path, by)


def with_corrections(
    images: Path | None,
    tracks: Tracks,
    config: DrocapConfig,
    models: Path | None,
    progress: Progress | None,
    selection: Selection,
) -> Tracks:
    """Tracks at their true rate, as corrected by hand; ``images`` : where another person can be found, or None."""
    rated = tracks.at_rate(selection.rate_hz) if selection.rate_hz else tracks
    for span, box in selection.corrections.person:
        rows = span.of((rated.stamp_ns - rated.stamp_ns[0]) * 1e-9)
        if not rows.any():
            raise InputError(f"person: expected a time within the recording, found {span.from_s:g} s; correct it")
        other = None
        if box is not None:
            if images is None or images.suffix == ".npz":
                raise InputError("person: expected images for whoever is in a box, found none; name them: --video FILE")
            settings = config.pose_estimator
            settings = dataclasses.replace(settings, subject="box", subject_box=",".join(map(str, box)), on_loss="wait")
            other = _person_at(images, tracks.stamp_ns[rows], config, settings, models, progress, selection)
        rated = spliced(rated, rows, other)
    return corrected(rated, selection.corrections)


def _person_at(
    path: Path,
    stamp_ns: np.ndarray,
    config: DrocapConfig,
    settings: PoseEstimatorConfig,
    models: Path | None,
    progress: Progress | None,
    selection: Selection,
) -> Tracks:
    """2D tracks of another person in the images of these times (F,)."""
    estimator = PoseEstimator(models_folder(models or settings.models_dir), settings)
    with open_images(path, config.image_ingest, selection.topic) as images:
        until = itertools.takewhile(lambda frame: frame.stamp_ns <= stamp_ns[-1], images.frames)
        meter = Clip().meter(progress, "2D pose", float(stamp_ns[-1] - stamp_ns[0]) * 1e-9)
        frames = (frame for frame in until if frame.stamp_ns >= stamp_ns[0])
        observations = observe(frames, estimator, meter, threads=selection.threads)
    if [o.stamp_ns for o in observations] != stamp_ns.tolist():
        raise InputError(f"{path}: expected the images of these tracks, found others; name the video that they are of")
    if not subjects(observations):
        raise InputError(f"{path}: person: expected one in the box {settings.subject_box}, found none; draw it anew")
    return tracks_from_observations(observations)


def input_tracks(
    path: Path,
    config: DrocapConfig,
    models: Path | None,
    progress: Progress | None,
    telemetry: Telemetry = _FOUND,
    selection: Selection = _WHOLE,
) -> tuple[Tracks, Values]:
    """2D tracks with the camera's pose as telemetry or options give it, and their origin for ``meta``."""
    found = read_video_telemetry(path, telemetry)
    tracks, origin = read_input(path, config, models, progress, telemetry, selection)
    origin.setdefault("images", {"size": list(tracks.image_size)})
    if found is not None:
        tracks, origin["telemetry"] = with_telemetry(path, tracks, telemetry, found, config.image_ingest, progress)
    return with_attitude(with_lens_of(tracks, config.image_ingest), telemetry.attitude_deg), origin


def with_origin(motion: Motion, path: Path, origin: Values, seconds: float) -> Motion:
    """A motion whose ``meta`` says what it was made from; ``seconds`` : of reading the input."""
    meta = {**motion.meta, "input": path.name, **origin}
    stages = {"pose2d": seconds, **meta.get("seconds", {})}
    meta["seconds"] = {**stages, "total": seconds + stages.get("total", 0.0)}
    return dataclasses.replace(motion, meta=meta)


def needs_networks(path: Path, redetect: bool) -> bool:
    """Whether the 2D poses of an input have to be estimated from its images."""
    if not path.exists():
        raise missing(path, "a video, folder of images, recording or tracks file")
    refuse_other_inputs(path)
    if path.suffix == ".npz" or people_files(path, "tracks.npz"):
        return False
    if redetect or not is_recording(path):
        return True
    with open_session(path) as session:
        return not session.topics_of(POSE2D)


def read_input(
    path: Path,
    config: DrocapConfig,
    models: Path | None,
    progress: Progress | None = None,
    telemetry: Telemetry = _FOUND,
    selection: Selection = _WHOLE,
) -> tuple[Tracks, Values]:
    """2D tracks of the subject, of the input where it holds them, else of its images, and their origin for ``meta``."""
    origin: Values = {} if selection.clip.whole else {"clip": selection.clip.meta}
    if needs_networks(path, selection.redetect):
        # The most frequent subject of the whole recording is chosen at the end.
        tracks, more = _track(path, config.replace("pose_estimator", on_loss="next"), models, progress, selection)
        return with_recorded(path, tracks, telemetry, selection), origin | more
    if path.suffix == ".npz":
        return selected_tracks(load_tracks(path), telemetry, selection), origin
    if people_files(path, "tracks.npz"):
        raise InputError(f"{path}: expected one person, found tracks of several; add --all, or name those of one")
    if selection.person is not None:
        raise InputError(f"--subject {selection.person}: expected images, found 2D poses of one person; add --redetect")
    with open_session(path) as session:
        tracks = read_pose2d(session, telemetry.mount_pitch_deg, telemetry=telemetry.path != NO_TELEMETRY)
        _log_warnings(session)
    return selection.clip.cut(tracks), {**origin, "pose2d": "recorded"}


def with_recorded(path: Path, tracks: Tracks, telemetry: Telemetry, selection: Selection) -> Tracks:
    """Tracks of an input's images with the camera that a recording holds."""
    if not is_recording(path):
        return tracks
    with open_session(path) as session:
        near = choose_images(session, selection.topic).name
        session.warnings.clear()  # reported with the images
        pitch, in_use = telemetry.mount_pitch_deg, telemetry.path != NO_TELEMETRY
        tracks = with_recorded_camera(session, tracks, near, pitch, telemetry=in_use)
        _log_warnings(session)
    return tracks


def selected_tracks(tracks: Tracks, telemetry: Telemetry, selection: Selection) -> Tracks:
    """The part of 2D tracks that is reconstructed, with ``NO_TELEMETRY`` without the camera's pose."""
    if selection.person is not None:
        raise InputError(
            f"--subject {selection.person}: expected images, found 2D tracks of one person; leave the option out, or"
            " name the video, or a recording with images and --redetect"
        )
    if telemetry.path == NO_TELEMETRY:
        tracks = dataclasses.replace(tracks, camera_rotation=None, camera_position=None)
    elif telemetry.path is not None:
        raise InputError("--telemetry: expected a video as input, found 2D tracks; they hold the camera's pose")
    return selection.clip.cut(tracks)


def persons_of(
    source: str | Path, config: DrocapConfig, models: Path, selection: Selection, progress: Progress | None
) -> list[FoundPerson]:
    """Persons in the selected part of a source's images, with the numbers that they have in the whole recording."""
    clip, first = selection.clip, list[int]()
    with open_images(source, config.image_ingest, selection.topic) as images:
        meter = clip.meter(progress, "persons", images.duration_s)

        def on_frame(frame: Frame, _: None) -> None:
            first.extend([frame.stamp_ns] * (not first))
            meter(frame, None)

        frames = Clip(end_s=clip.end_s + COUNTED_S).select(images.frames)
        persons = find_persons(frames, models, config.pose_estimator, on_frame)
    found = [person for each in persons if (person := each.within(clip, first[0])) is not None]
    if not found:
        raise InputError(f"{source}: expected a person from --start to --end, found none; choose another part")
    return found


def follow_selected(
    source: str | Path, config: DrocapConfig, models: Path, selection: Selection, progress: Progress | None
) -> tuple[PoseEstimatorConfig, int | None]:
    """Parameters of the estimator that follow the selected person; stamp (ns) of its first detection, or None."""
    if selection.person is None:
        return config.pose_estimator, None
    persons = persons_of(source, config, models, selection, progress)
    settings = following(config.pose_estimator, persons, selection.person)
    return settings, next(person.first_ns for person in persons if person.number == selection.person)


def _track(
    path: Path, config: DrocapConfig, models: Path | None, progress: Progress | None, selection: Selection
) -> tuple[Tracks, Values]:
    if selection.threads > 1:
        threading.Thread(target=_load_reconstruction, args=(config.bundle_adjuster.lifter,)).start()
    folder, clip = models_folder(models or config.pose_estimator.models_dir), selection.clip
    settings, begin_ns = follow_selected(path, config, folder, selection, progress)
    crowded, topic = list[bool](), selection.topic
    with open_images(path, config.image_ingest, topic) as images:
        estimator = PoseEstimator(folder, settings)
        meter = clip.meter(progress, "2D pose", images.duration_s)

        def on_frame(frame: Frame, observation: PoseObservation) -> None:
            meter(frame, observation)
            selection.on_image(frame, observation)
            crowded.append(in_view(estimator.tracker.persons, frame.stamp_ns) > 1)

        observations = observe(clip.select(images.frames), estimator, on_frame, begin_ns, selection.threads)
    try:
        tracks = tracks_from_observations(observations)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    words = change_lines(list(estimator.tracker.changes)[1:], int(tracks.stamp_ns[0]))
    seen = {"size": list(tracks.image_size), "length": images.length, "rate_hz": images.rate_hz}
    origin: Values = {"pose2d": "estimated", "subject": words, "images": seen | ({"topic": topic} if topic else {})}
    logger.log(logging.WARNING if words else logging.DEBUG, "%s: %s", path, "; ".join(words))
    if selection.person is not None:
        return tracks, {**origin, "person": selection.person}
    if (in_turn := len(subjects(observations)) > 1) or sum(crowded) > 1:  # the whole image is searched once a second
        chosen = "the one in most images" if in_turn else "one of them"
        text = "%s: several persons, %s is reconstructed; `drocap track %s --list` numbers them for --subject N"
        logger.warning(text, path, chosen, path)
    return tracks, origin


def _load_reconstruction(lifter: str) -> None:
    """Load what works on boxes and tracks: 0.6 s (measured), in which the networks see their first images."""
    for name in ("scipy.optimize", "drocap_ros.reconstruction.reconstruct"):  # one thread alone imports scipy
        importlib.import_module(name)
    from drocap_ros.reconstruction.lifted.lifter import Lifter

    with contextlib.suppress(InputError):  # the method refuses it
        Lifter.load(lifter or None)


def _log_warnings(session: Session) -> None:
    for warning in session.warnings:
        logger.warning("%s: %s", session.path.name, warning)


def reconstruct_together(
    paths: list[Path],
    *,
    config: DrocapConfig,
    telemetry: Telemetry,
    models: Path | None = None,
    progress: Progress | None = None,
    selections: Sequence[Selection] | None = None,
) -> list[tuple[Motion, Tracks]]:
    """The one motion that several recordings of a person show, as each recording's camera sees it, and their tracks.

    paths : inputs of :func:`reconstruct_input`, two at least; the times of the first one's images are those of all
    telemetry : none, or that which the recordings have with them
    selections : the corrections of each, its images, and threads
    """
    solved: list[Solved] = []
    read: list[tuple[Path, Values, float]] = []
    tracks: list[Tracks] = []
    selections = selections or [_WHOLE] * len(paths)
    for path, selection in zip(paths, selections, strict=True):
        begin = time.perf_counter()
        own, origin = input_tracks(path, config, models, progress, telemetry, selection)
        meant = with_corrections(selection.images or path, own, config, models, progress, selection)
        if selection.corrections:
            origin["corrections"] = selection.corrections.values
        read.append((path, origin, time.perf_counter() - begin))
        tracks.append(own)
        solved.append(solve(meant, initializer=config.initializer, adjuster=config.bundle_adjuster, progress=progress))
    begin = time.perf_counter()
    names = [path.name for path in paths]
    motions = join_views(solved, [p.name if names.count(p.name) == 1 else f"{p.parent.name}/{p.name}" for p in paths])
    took = time.perf_counter() - begin
    for motion in motions:
        alone = motion.meta["seconds"]
        motion.meta["seconds"] = {**alone, "together": took, "total": alone["total"] + took}
    for path, selection, motion in zip(paths, selections, motions, strict=True):
        tell_said_in_vain(path, selection.corrections, motion)
    return [(with_origin(motion, *of), own) for motion, of, own in zip(motions, read, tracks, strict=True)]
