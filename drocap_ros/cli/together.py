"""``drocap reconstruct A B ... --together``: one motion from several recordings of one person."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import math
import time
from pathlib import Path
from typing import TYPE_CHECKING

from drocap_ros.cli.options import clip_of
from drocap_ros.errors import InputError

if TYPE_CHECKING:
    from drocap_ros.motion import Motion

#: Options of one recording, and their values where they are not given.
_OF_ONE = {
    "method": "ba",
    "start": 0.0,
    "end": math.inf,
    "subject": "",
    "topic": "",
    "redetect": False,
    "time_offset": None,
    "mount_pitch": None,
    "camera_pitch": None,
    "camera_roll": None,
    "evidence": None,
}
#: Of a camera without telemetry and fixed points that moves.
_BY_BODY = "; its camera moves as the body turns in its pictures"


def run_together(args: argparse.Namespace) -> int:
    """Reconstruct all recordings as one motion, and write it as every camera sees it."""
    begin = time.perf_counter()
    from drocap_ros.cli.atomic_output import default_folder
    from drocap_ros.cli.models import ensure_networks
    from drocap_ros.cli.motion_output import output_names, summary, write_outputs
    from drocap_ros.cli.progress import progress_bars
    from drocap_ros.cli.report import open_words
    from drocap_ros.config import load_config
    from drocap_ros.perception.load_models import models_folder
    from drocap_ros.pipeline import needs_networks
    from drocap_ros.recording.keypoints.files import as_tracks_file
    from drocap_ros.recording.video_telemetry import Telemetry
    from drocap_ros.report.motion_images import ImagesBeside, has_images
    from drocap_ros.together import reconstruct_together

    inputs = [args.input, *args.further]
    _check(args, inputs)
    out = args.out or default_folder(args.input, "motion")
    names = output_names(args, out, clip_of(args))
    beside = [f"camera_{number}.npz" for number in range(2, len(inputs) + 1)]
    config = load_config(args.config)
    if args.dictionary:
        config = config.replace("initializer", dictionary=str(args.dictionary))
    with contextlib.ExitStack() as stack:
        sources = [stack.enter_context(as_tracks_file(path, args.rate, args.image_size)) for path in inputs]
        progress = stack.enter_context(progress_bars(args.quiet))
        for source in sources:
            if needs_networks(source, redetect=False):
                ensure_networks(models_folder(args.models or config.pose_estimator.models_dir), source, args)
        found = reconstruct_together(
            sources,
            config=config,
            models=args.models,
            progress=progress,
            telemetry=Telemetry(args.telemetry),
            threads=args.threads,
        )
        motions = [
            dataclasses.replace(motion, meta={**motion.meta, "command": args.command_line}) for motion, _ in found
        ]
        video = sources[0] if sources[0] == args.input and has_images(sources[0]) else None
        images = stack.enter_context(ImagesBeside(video, progress))
        write_outputs(out, names, motions[0], found[0][1], images.of, motions[1:])
    if not args.quiet:
        print(summary(motions[0], "ba", time.perf_counter() - begin))
        print(view_words(motions[0]))
        print(f"written: {out}/{', '.join(names)}; as the other cameras see it: {', '.join(beside)}")
        if "report.html" in names:
            print(open_words(out / "report.html"))
    return 0


def view_words(motion: Motion) -> str:
    """A line for each further recording: its time and how well the common body fits it; one where there is no world."""
    together = motion.meta["together"]
    lines = []
    if motion.frame == "camera" and any(view["by_body"] for view in together["views"]):
        lines.append(
            "a camera moves, and no recording has telemetry or fixed points of the scene: the poses are right, a path"
            " through a world is not known; record either with one of the cameras"
        )
    for view in together["views"][1:]:
        first = together["views"][0]["name"]
        when = "after" if view["offset_s"] >= 0 else "before"
        lines.append(
            f"{view['name']}: its first image {abs(view['offset_s']):.3f} s (+- {1e3 * view['offset_std_s']:.1f} ms)"
            f" {when} that of {first}; keypoints {view['median_px']:.1f} px from the common body,"
            f" {view['median_px_alone']:.1f} from its own{_BY_BODY if view['by_body'] else ''}"
        )
    return "\n".join(lines)


def _check(args: argparse.Namespace, inputs: list[Path]) -> None:
    """Refuse recordings without the option, the option without them, and options of one recording."""
    from drocap_ros.recording.video_telemetry import NO_TELEMETRY

    if not args.together:
        raise InputError(
            f"INPUT: expected one, found {len(inputs)}; add --together where all show one person at the same time, else"
            " use `drocap batch`"
        )
    if len(inputs) < 2:
        raise InputError("--together: expected two INPUTs at least, found one; name the other recordings too")
    if len({path.resolve() for path in inputs}) < len(inputs):
        raise InputError("--together: expected different INPUTs, found the same one twice; name each once")
    given = [name for name, default in _OF_ONE.items() if getattr(args, name, default) not in (default, None)]
    if args.telemetry not in (None, NO_TELEMETRY):
        given.append("telemetry")
    if given:
        raise InputError(
            f"--together: expected whole recordings, got --{given[0].replace('_', '-')}; reconstruct that one alone so,"
            " then name its tracks.npz here"
        )
