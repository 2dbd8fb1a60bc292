"""``drocap track``: 2D tracks of the subject of a video."""

from __future__ import annotations

import argparse
import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from drocap_ros.cli.motion_output import add_all_option, people_of, save_people_tracks
from drocap_ros.cli.options import (
    Subparsers,
    add_clip_options,
    add_command,
    add_config_option,
    add_network_options,
    add_quiet_option,
    add_threads_option,
    clip_of,
)
from drocap_ros.errors import InputError

if TYPE_CHECKING:
    from drocap_ros.clip import Progress
    from drocap_ros.config import DrocapConfig
    from drocap_ros.keypoints import PoseObservation
    from drocap_ros.perception.sources import Frame
    from drocap_ros.pipeline import Selection


def add_parser(subparsers: Subparsers) -> None:
    """Add the command's options; ``run`` is its action."""
    parser = add_command(
        subparsers,
        "track",
        run,
        help="2D tracks of the subject of a video",
        description="Track the subject of VIDEO and write tracks.npz: keypoints, covariance and confidence of each"
        " image. Each later subject is written to tracks_person_N.npz.",
    )
    parser.add_argument("video", metavar="VIDEO", help="video file, image, folder of images, or recording with images")
    parser.add_argument("--out", metavar="DIR", type=Path, help="output folder (default: VIDEO's name + _tracks)")
    parser.add_argument(
        "--list", action="store_true", help="only find the persons: persons.jpg has their numbers, person_N.jpg each"
    )
    add_all_option(parser, "tracks of each")
    add_clip_options(parser)
    add_network_options(parser)
    add_threads_option(parser)
    parser.add_argument("--wait", action="store_true", help="track no other person after the subject is lost")
    parser.add_argument("--overlay", action="store_true", help="also write overlay.mp4 with the subject drawn")
    parser.add_argument(
        "--points", action="store_true", help="with --overlay: draw the scene's fixed points and their last second, too"
    )
    add_config_option(parser)
    add_quiet_option(parser)


def run(args: argparse.Namespace) -> int:
    """Track, or find all persons, and write the output folder."""
    from drocap_ros.cli.atomic_output import check_output_folder, default_folder, output_folder, refuse_inputs
    from drocap_ros.cli.models import ensure_networks
    from drocap_ros.cli.running import progress_bars
    from drocap_ros.config import load_config
    from drocap_ros.perception.load_models import models_folder
    from drocap_ros.perception.tracking.pose_estimator_config import parse_subject
    from drocap_ros.pipeline import Selection

    if args.points and not args.overlay:
        raise InputError("--points: expected --overlay, whose video shows them, found none; add it")
    out = args.out or default_folder(Path(args.video), "tracks")
    check_output_folder(out)
    refuse_inputs([out / "persons.jpg"] if args.list else [out / "overlay.mp4"] * args.overlay, [args.video])
    people = people_of(args)
    if args.list and people is not None:
        raise InputError("--list: expected no --all and no --subject beside it, found one; leave it out")
    clip = clip_of(args)
    person, rule = parse_subject(args.subject if people is None else "")
    rule |= {"feet_model": args.feet} if args.feet else {}
    config = load_config(args.config).replace("pose_estimator", on_loss="wait" if args.wait else "next", **rule)
    folder = models_folder(args.models or config.pose_estimator.models_dir)
    ensure_networks(folder, args.video, args)
    write = _list if args.list else _track if people is None else _track_people
    selection = Selection(clip, person, topic=args.topic, people=people or (), threads=args.threads)
    with output_folder(out) as target, progress_bars(args.quiet) as progress:
        text = write(_Job(args, config, folder, selection, target, progress))
    if not args.quiet:
        tracks = "tracks.npz" if people is None else "person_N/tracks.npz"
        names = "persons.jpg" if args.list else f"{tracks}, overlay.mp4" if args.overlay else tracks
        print(f"{text}\nwritten: {out}/{names}")
    return 0


class _Job(NamedTuple):
    """What is tracked: options, parameters, folder of networks, part of the input; where to; the bars."""

    args: argparse.Namespace
    config: DrocapConfig
    models: Path
    selection: Selection
    target: Path
    progress: Progress


def _list(job: _Job) -> str:
    """Write the picture of the persons; returns a line for each."""
    args, config, models, selection, target, progress = job
    import cv2

    from drocap_ros.open_images import open_images
    from drocap_ros.pipeline import persons_of
    from drocap_ros.report.overlay import persons_picture

    persons = persons_of(args.video, config, models, selection, progress)
    with open_images(args.video, config.image_ingest, args.topic) as images:
        picture, each, begin_ns = persons_picture(images.frames, persons)
    for name, image in {"persons": picture, **{f"person_{number}": image for number, image in each.items()}}.items():
        # Unlike imwrite, this raises the system's error: a full disk.
        (target / f"{name}.jpg").write_bytes(cv2.imencode(".jpg", image)[1].tobytes())
    lines = [
        f"person {p.number}: {(p.first_ns - begin_ns) * 1e-9:.1f} to {(p.last_ns - begin_ns) * 1e-9:.1f} s"
        for p in persons
    ]
    return "\n".join([*lines, "`drocap reconstruct` and `drocap track` take the number: --subject N"])


def _track(job: _Job) -> str:
    """Write the tracks of every subject, and the overlay; returns a line about them."""
    args, config, models, selection, target, progress = job
    from drocap_ros.open_images import open_images
    from drocap_ros.perception.estimator import PoseEstimator
    from drocap_ros.perception.sources.base import in_order
    from drocap_ros.perception.track_video import observe, subjects, tracks_from_observations
    from drocap_ros.pipeline import follow_selected
    from drocap_ros.report.overlay import OverlayVideo
    from drocap_ros.tracks import change_lines, save_tracks

    settings, begin_ns = follow_selected(args.video, config, models, selection, progress)
    estimator = PoseEstimator(models, settings)
    with open_images(args.video, config.image_ingest, args.topic) as images, contextlib.ExitStack() as stack:
        drawn = OverlayVideo(target / "overlay.mp4", images.rate_hz, with_points=args.points)
        draw = stack.enter_context(in_order(stack.enter_context(drawn).add)) if args.overlay else None
        meter = selection.clip.meter(progress, "2D pose", images.duration_s)

        def on_frame(frame: Frame, observation: PoseObservation) -> None:
            meter(frame, observation)
            if draw is not None:
                draw(frame, [observation])

        frames = selection.clip.select(images.frames)
        observations = observe(frames, estimator, on_frame, begin_ns, args.threads)
    try:
        tracks_from_observations(observations)
    except InputError as error:  # a recording without a person, or without images
        raise InputError(f"{args.video}: {error}") from None
    found = subjects(observations)
    begin, changes = observations[0].stamp_ns, list(estimator.tracker.changes)[1:]
    for rank, (track_id, _) in enumerate(found):
        name = "tracks.npz" if rank == 0 else f"tracks_person_{track_id}.npz"
        save_tracks(target / name, tracks_from_observations(observations, track_id), changes)
    return "\n".join([_summary(found, len(observations)), *change_lines(changes, begin)])


def _track_people(job: _Job) -> str:
    """Write the tracks of everybody, or of the selected people, and the overlay; returns a line for each."""
    args, config, models, selection, target, progress = job
    from drocap_ros.open_images import open_images
    from drocap_ros.people import track_people, when
    from drocap_ros.report.overlay import OverlayVideo

    with open_images(args.video, config.image_ingest, args.topic) as images:
        drawn = OverlayVideo(target / "overlay.mp4", images.rate_hz, with_points=args.points)
    with drawn if args.overlay else contextlib.nullcontext():
        on_frame = drawn.add if args.overlay else None
        found, origin = track_people(args.video, config, models, selection, progress, on_frame)
    save_people_tracks(target, found)
    return "\n".join([*(f"person {n}: {when(tracks)}" for n, tracks in found.items()), *origin["left_out"]])


def _summary(found: list[tuple[int, int]], frames: int) -> str:
    first = found[0]
    text = f"{frames} images, the subject in {first[1]} ({first[1] / frames:.1%})"
    if len(found) > 1:
        text += f"; {len(found) - 1} further: " + ", ".join(f"person {i} in {n}" for i, n in found[1:])
    return text
