"""``drocap track``: 2D tracks of the subject of a video."""

from __future__ import annotations

import argparse
import dataclasses
import itertools
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from drocap_ros.observation import PoseObservation
    from drocap_ros.perception.pose_estimator_config import PoseEstimatorConfig
    from drocap_ros.perception.sources import Frame

SUBJECTS = ("largest", "centre")


def add_parser(subparsers: Any) -> argparse.ArgumentParser:
    """Add the command's options; ``run`` is its action."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "track",
        help="2D tracks of the subject of a video",
        description="Track the subject of VIDEO and write tracks.npz: keypoints, covariance and confidence of each"
        " image. Each later subject is written to tracks_person_N.npz.",
    )
    parser.add_argument("video", metavar="VIDEO", help="video file, image, or folder of images")
    parser.add_argument("--out", metavar="DIR", type=Path, required=True, help="output folder")
    parser.add_argument("--models", metavar="DIR", type=Path, help="folder of ONNX models (default: $DROCAP_MODELS)")
    parser.add_argument("--detector", metavar="NAME", help="detector in that folder (default: the preferred one)")
    parser.add_argument("--pose", metavar="NAME", help="2D pose model in that folder (default: the preferred one)")
    parser.add_argument(
        "--subject",
        metavar="RULE",
        default="largest",
        help="largest (default), centre, or a box x_min,y_min,x_max,y_max px in the first image",
    )
    parser.add_argument("--wait", action="store_true", help="track no other person after the subject is lost")
    parser.add_argument("--threads", metavar="N", type=int, help="threads of one model run (default: 1)")
    parser.add_argument("--overlay", action="store_true", help="also write overlay.mp4 with the subject drawn")
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
            overlay = _OverlayWriter(folder / "overlay.mp4", source.size) if args.overlay else None
            done = itertools.count(1)

            def on_frame(frame: Frame, observation: PoseObservation) -> None:
                progress("2D pose", next(done) / source.length if source.length else -1.0)
                if overlay is not None:
                    overlay.add(frame, observation)

            observations = observe(source, estimator, on_frame)
            if overlay is not None:
                overlay.close()
            tracks_from_observations(observations)  # raises for a recording without a person
            found = subjects(observations)
            for rank, (track_id, _) in enumerate(found):
                name = "tracks.npz" if rank == 0 else f"tracks_person_{track_id}.npz"
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


class _OverlayWriter:
    """Writes the video with the subject drawn, at the rate of its first two frames."""

    def __init__(self, path: Path, size: tuple[int, int]) -> None:
        scale = min(1.0, 1280 / max(size))
        self._size = (max(2, round(size[0] * scale) // 2 * 2), max(2, round(size[1] * scale) // 2 * 2))
        self._path = path
        self._first: tuple[int, Any] | None = None
        self._video: Any = None

    def add(self, frame: Frame, observation: PoseObservation) -> None:
        import cv2

        from drocap_ros.perception.overlay import draw

        image = cv2.resize(draw(frame.image, observation), self._size, interpolation=cv2.INTER_AREA)
        if self._first is None:
            self._first = frame.stamp_ns, image
            return
        if self._video is None:
            self._open(1e9 / (frame.stamp_ns - self._first[0]))
        self._video.write(image)

    def close(self) -> None:
        if self._video is None and self._first is not None:  # a single image
            self._open(1.0)
        if self._video is not None:
            self._video.release()

    def _open(self, rate_hz: float) -> None:
        import cv2

        from drocap_ros.errors import DrocapError

        rate_hz = min(max(rate_hz, 1.0), 120.0)
        self._video = cv2.VideoWriter(str(self._path), cv2.VideoWriter.fourcc(*"mp4v"), rate_hz, self._size)
        if not self._video.isOpened():
            raise DrocapError(f"{self._path}: the video could not be written; check the space on the disk")
        assert self._first is not None
        self._video.write(self._first[1])


def _summary(found: list[tuple[int, int]], frames: int, out: Path) -> str:
    first = found[0]
    text = f"{frames} images, the subject in {first[1]} ({first[1] / frames:.1%})"
    if len(found) > 1:
        text += f"; {len(found) - 1} further: " + ", ".join(f"person {i} in {n}" for i, n in found[1:])
    return f"{text}\nwritten: {out}/tracks.npz"
