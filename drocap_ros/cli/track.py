"""``drocap track``: 2D tracks of the person in a video."""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable

    from drocap_ros.observation import PoseObservation
    from drocap_ros.perception.pose_estimator_config import PoseEstimatorConfig
    from drocap_ros.perception.sources import Frame

SUBJECTS = ("largest", "centre")


def add_parser(subparsers: Any) -> argparse.ArgumentParser:
    """Add the command's options; ``run`` is its action."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "track",
        help="2D tracks of the person in a video",
        description="Follow the person in VIDEO and write tracks.npz: keypoints, covariance and confidence of every"
        " image. Each further person followed, one after another, is written as tracks_person_N.npz.",
    )
    parser.add_argument("video", metavar="VIDEO", help="video file, picture, or folder of pictures")
    parser.add_argument("--out", metavar="DIR", type=Path, required=True, help="output folder")
    parser.add_argument("--models", metavar="DIR", type=Path, help="folder of ONNX models (default: $DROCAP_MODELS)")
    parser.add_argument("--detector", metavar="NAME", help="detector in that folder (default: the best there)")
    parser.add_argument("--pose", metavar="NAME", help="2D pose model in that folder (default: the best there)")
    parser.add_argument(
        "--subject",
        metavar="WHO",
        default="largest",
        help="largest (default), centre, or the box x_min,y_min,x_max,y_max px in the first image",
    )
    parser.add_argument(
        "--wait", action="store_true", help="after the subject is lost follow nobody else (as in flight)"
    )
    parser.add_argument("--threads", metavar="N", type=int, help="threads of one model run (default: 1)")
    parser.add_argument("--overlay", action="store_true", help="also write overlay.mp4 with the subject drawn in")
    parser.add_argument("--config", metavar="FILE", type=Path, help="parameters of the components (YAML)")
    parser.add_argument("--quiet", action="store_true", help="no progress, only errors")
    parser.set_defaults(run=run)
    return parser


def run(args: argparse.Namespace) -> int:
    """Track and write the output folder."""
    from drocap_ros.cli.atomic_output import check_output_folder, output_folder
    from drocap_ros.cli.progress import progress_bars
    from drocap_ros.perception.estimator import PoseEstimator
    from drocap_ros.perception.load_models import models_folder
    from drocap_ros.perception.sources import open_source
    from drocap_ros.perception.track_video import observe, subjects, tracks_from_observations
    from drocap_ros.tracks import save_tracks

    check_output_folder(args.out)
    config, ingest = _configs(args)
    with open_source(args.video, ingest) as source:
        estimator = PoseEstimator(models_folder(args.models or config.models_dir or None), config)
        with output_folder(args.out) as folder, progress_bars(args.quiet) as progress:
            done: list[int] = [0]

            def on_frame(frame: Frame, observation: PoseObservation) -> None:
                done[0] += 1
                progress("2D pose", done[0] / source.length if source.length else -1.0)
                if writer is not None:
                    writer(frame, observation)

            writer, finish = _overlay_writer(folder / "overlay.mp4", source.size) if args.overlay else (None, None)
            observations = observe(source, estimator, on_frame)
            if finish is not None:
                finish([o.stamp_ns for o in observations])
            tracks_from_observations(observations)  # refuses a recording without a person
            found = subjects(observations)
            for place, (track_id, _) in enumerate(found):
                name = "tracks.npz" if place == 0 else f"tracks_person_{track_id}.npz"
                save_tracks(folder / name, tracks_from_observations(observations, track_id))
    if not args.quiet:
        print(_summary(found, len(observations), args.out))
    return 0


def _configs(args: argparse.Namespace) -> tuple[PoseEstimatorConfig, Any]:
    from drocap_ros.config import DrocapConfig, load_config

    whole = load_config(args.config) if args.config else DrocapConfig()
    changes: dict[str, Any] = {"on_loss": "wait" if args.wait else "next"}
    if args.subject in SUBJECTS:
        changes["subject"] = args.subject
    else:
        from drocap_ros.perception.pose_estimator_config import parse_box

        parse_box(args.subject)
        changes |= {"subject": "box", "subject_box": args.subject}
    named = {"detector": args.detector, "pose_model": args.pose, "threads": args.threads}
    changes |= {key: value for key, value in named.items() if value is not None}
    return dataclasses.replace(whole.pose_estimator, **changes), whole.image_ingest


def _overlay_writer(
    path: Path, size: tuple[int, int]
) -> tuple[Callable[[Frame, PoseObservation], None], Callable[[list[int]], None]]:
    """A function that adds a drawn frame, and one that ends the video."""
    import cv2

    from drocap_ros.errors import DrocapError
    from drocap_ros.perception.overlay import draw

    scale = min(1.0, 1280 / max(size))
    even = (max(2, round(size[0] * scale) // 2 * 2), max(2, round(size[1] * scale) // 2 * 2))
    stamps: list[int] = []
    pending: list[Any] = []
    video: list[Any] = []

    def begin(rate: float) -> None:
        video.append(cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), rate, even))
        if not video[0].isOpened():
            raise DrocapError(f"{path}: the video could not be written; is there space on the disk?")

    def add(frame: Frame, observation: PoseObservation) -> None:
        stamps.append(frame.stamp_ns)
        pending.append(cv2.resize(draw(frame.image, observation), even, interpolation=cv2.INTER_AREA))
        if not video and len(stamps) == 2:
            begin(min(max(1e9 / (stamps[1] - stamps[0]), 1.0), 120.0))
        while video and pending:
            video[0].write(pending.pop(0))

    def finish(_: list[int]) -> None:
        if not video:
            begin(1.0)
            for image in pending:
                video[0].write(image)
        video[0].release()

    return add, finish


def _summary(found: list[tuple[int, int]], frames: int, out: Path) -> str:
    first = found[0]
    text = f"{frames} images, the subject in {first[1]} ({first[1] / frames:.1%})"
    if len(found) > 1:
        text += f"; {len(found) - 1} further: " + ", ".join(f"person {i} in {n}" for i, n in found[1:])
    return f"{text}\nwritten: {out}/tracks.npz"
