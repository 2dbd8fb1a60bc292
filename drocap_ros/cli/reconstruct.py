"""``drocap reconstruct``: 3D motion from a video, recording or tracks file, or from several recordings together."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import itertools
import math
import time
from pathlib import Path
from typing import TYPE_CHECKING

from drocap_ros.cli.corrections import ONE, corrections_of, corrections_together, videos_of
from drocap_ros.cli.motion_output import add_all_option, people_of, reconstruct_people
from drocap_ros.cli.options import (
    Subparsers,
    add_clip_options,
    add_command,
    add_config_option,
    add_network_options,
    add_quiet_option,
    add_threads_option,
    clip_of,
    image_size,
    rate,
)
from drocap_ros.errors import InputError
from drocap_ros.reconstruction.methods import METHODS as OFFLINE

if TYPE_CHECKING:
    from drocap_ros.config import DrocapConfig
    from drocap_ros.motion import Motion
    from drocap_ros.recording.video_telemetry import Telemetry


METHODS = (*OFFLINE, "live")
#: Stages of the work on a video and their shares of its time, as of a walk of 8 s.
_SHARES = {"persons": 0.03, "2D pose": 0.8, "time offset": 0.02, "live": 0.05, "ba": 0.07, "report": 0.03}


def add_parser(subparsers: Subparsers) -> None:
    """Add the command's options; ``run`` is its action."""
    parser = add_command(
        subparsers,
        "reconstruct",
        run_command,
        help="3D motion from a video, recording or tracks file",
        description="Recover the 3D motion of the person in INPUT and write motion.npz, tracks.npz and report.html.",
    )
    parser.add_argument(
        "input",
        metavar="INPUT",
        type=Path,
        help="video file, image folder, .mcap, rosbag1 .bag, rosbag2 folder, tracks .npz, or 2D keypoints of another"
        " tool (.json or a folder of them, .csv, .npz, .npy); with --together several",
    )
    parser.add_argument("further", metavar="INPUT", nargs="*", default=[], type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--out", metavar="DIR", type=Path, help="output folder (default: INPUT's name + _motion)")
    parser.add_argument(
        "--together",
        action="store_true",
        help="one motion from several recordings of one person at the same time, by drones, phones or tripods; their"
        " times and places against each other are found",
    )
    add_all_option(parser, "one motion each")
    add_options(parser, videos="append")
    add_threads_option(parser)
    add_quiet_option(parser)


def add_options(parser: argparse.ArgumentParser, videos: str = "store") -> None:
    """Options of one reconstruction; ``drocap batch`` has them too.  ``videos`` : what a second ``--video`` does."""
    parser.add_argument(
        "--method",
        choices=METHODS,
        default="ba",
        help="; ".join(f"{name}: {offline.summary}" for name, offline in OFFLINE.items())
        + "; live: the live graph's sliding windows, from a recording's pose2d",
    )
    add_clip_options(parser)
    parser.add_argument(
        "--redetect", action="store_true", help="estimate 2D poses from a recording's images, not its recorded ones"
    )
    parser.add_argument(
        "--telemetry",
        metavar="LOG",
        type=Path,
        help="log beside a video: MAVLink .tlog, PX4 .ulg, ArduPilot .bin, DJI .srt, Airdata .csv, .gpx (default: the"
        " DJI track inside the video, else the .SRT of its name); LOG#NAME chooses one of several vehicles or mounts;"
        " none: no telemetry, nor that of a session or tracks file",
    )
    parser.add_argument(
        "--time-offset",
        metavar="S",
        type=float,
        help="seconds from the log's first state to the video's first image (default: estimated where possible)",
    )
    parser.add_argument(
        "--mount-pitch",
        metavar="DEG",
        type=float,
        help="pitch of a camera fixed to a vehicle without a gimbal, negative looks down; for telemetry, or a session,"
        " without the camera's attitude",
    )
    parser.add_argument(
        "--evidence",
        metavar="NPZ",
        type=Path,
        help="3D poses of the images by another system, in the camera's axes: they decide signs of depth",
    )
    for axis, sense in (("pitch", "negative looks down"), ("roll", "positive is clockwise")):
        parser.add_argument(
            f"--camera-{axis}",
            metavar="DEG",
            type=float,
            help=f"{axis} of a camera that stands still, where no telemetry says it: {sense} (default: 0 beside the"
            " other)",
        )
    parser.add_argument(
        "--level", action="store_true", help="the camera stands level: --camera-pitch 0 --camera-roll 0"
    )
    parser.add_argument("--height", metavar="M", type=float, help="the person's stature (default: 1.7, to 5 %%)")
    lens = parser.add_mutually_exclusive_group()
    lens.add_argument("--fov", metavar="DEG", type=float, help="width of the camera's field of view")
    lens.add_argument("--focal", metavar="PX", type=float, help="focal length in px of these images")
    lens.add_argument(
        "--calibration",
        metavar="FILE",
        type=Path,
        help="lens: YAML of ROS camera_calibration or OpenCV, TOML of Pose2Sim (FILE#CAMERA); distortion is taken off",
    )
    parser.add_argument(
        "--rate",
        metavar="HZ",
        type=rate,
        help="true rate of the images where a video plays them slower, or a file of keypoints does not say it",
    )
    parser.add_argument(
        "--image-size", metavar="WxH", type=image_size, help="px, where a file of keypoints does not say it"
    )
    parser.add_argument(
        "--order",
        metavar="NAME",
        help="order of the joints in a file of keypoints that does not name them, as coco17, h36m17, openpose25 or"
        " mediapipe33 (default: the one that makes a body)",
    )
    parser.add_argument(
        "--video",
        metavar="FILE",
        type=Path,
        action=videos,
        help="with tracks as INPUT, or a folder of person_N/tracks.npz: the images that they are of, for each INPUT;"
        " the report shows them",
    )
    parser.add_argument(
        "--corrections",
        metavar="YAML",
        type=Path,
        help="what is corrected by hand: joints, sides, feet, who is meant, what is vertical (`drocap app` writes it);"
        " of several persons or recordings the folder of their motions",
    )
    add_network_options(parser)
    parser.add_argument("--dictionary", metavar="NPZ", type=Path, help="pose dictionary instead of the shipped one")
    add_config_option(parser)
    parser.add_argument("--no-report", action="store_true", help="do not write report.html; that of an older run goes")


def run_command(args: argparse.Namespace) -> int:
    """Reconstruct one recording, or several together."""
    if not (args.together or args.further):
        return run(args, people_of(args))
    if args.all:
        raise InputError("--all: expected one recording, found several; leave out --together, or --all")
    return run_together(args)


def run(args: argparse.Namespace, people: tuple[int, ...] | None = None) -> int:
    """Reconstruct one recording and write the output folder; ``people`` : of these persons, () = of everybody."""
    begin = time.perf_counter()
    from drocap_ros.cli.atomic_output import default_folder
    from drocap_ros.cli.models import ensure_networks
    from drocap_ros.cli.motion_output import output_names, summary, write_outputs
    from drocap_ros.cli.report import open_words
    from drocap_ros.cli.running import progress_bars
    from drocap_ros.config import load_config
    from drocap_ros.corrections import Corrections
    from drocap_ros.perception.load_models import models_folder
    from drocap_ros.perception.tracking.pose_estimator_config import parse_subject
    from drocap_ros.pipeline import Selection, needs_networks, reconstruct_input
    from drocap_ros.recording.keypoints.files import Stated, as_tracks_file
    from drocap_ros.report.motion_images import ImagesBeside, has_images

    out, clip = args.out or default_folder(args.input, "motion"), clip_of(args)
    names = output_names(args, out, clip)
    person, rule = parse_subject(args.subject if people is None else "")
    rule |= {"feet_model": args.feet} if args.feet else {}
    config = with_known(load_config(args.config), args).replace("pose_estimator", **rule)
    telemetry = _telemetry(args)
    video, said = next(iter(videos_of(args, [args.input])), None), corrections_of(args, people)
    with (
        as_tracks_file(args.input, Stated(args.rate, args.image_size, args.order, person)) as source,
        progress_bars(args.quiet, _SHARES) as progress,
    ):
        if needs_networks(source, args.redetect):
            ensure_networks(models_folder(args.models or config.pose_estimator.models_dir), source, args)
        elif args.redetect:
            raise InputError(f"--redetect: expected a recording with images, found {args.input}; leave it out")
        elif args.topic:
            raise InputError(
                f"--topic {args.topic}: expected images, found recorded 2D poses; add --redetect, or leave it out"
            )
        rate_hz, person = (args.rate, person) if source == args.input else (None, None)
        selection = Selection(
            clip,
            person,
            args.redetect,
            args.topic,
            rate_hz,
            args.evidence,
            said.get(ONE, Corrections()),
            video,
            people or (),
            said,
            args.threads,
        )
        if people is not None:
            text = reconstruct_people(args, source, out, config, telemetry, selection, progress)
            if not args.quiet:
                print(text)
            return 0
        shown = video or (source if source == args.input and has_images(source) else None)
        with ImagesBeside(shown if "report.html" in names else None, progress, 4 if args.threads > 1 else 0) as images:
            selection = dataclasses.replace(selection, on_image=images.keep)
            if args.threads > 1:
                selection = dataclasses.replace(selection, on_tracks=images.begin)
            motion, tracks = reconstruct_input(
                source,
                method=args.method,
                config=config,
                models=args.models,
                progress=progress,
                telemetry=telemetry,
                selection=selection,
            )
            meta = {**motion.meta, "input": (video or args.input).name, "command": args.command_line}
            motion = dataclasses.replace(motion, meta=meta)
            write_outputs(out, names, motion, tracks, images.of)
    if not args.quiet:
        print(f"{summary(motion, args.method, time.perf_counter() - begin)}\nwritten: {out}/{', '.join(names)}")
        if "report.html" in names:
            print(open_words(out / "report.html"))
    return 0


def _telemetry(args: argparse.Namespace) -> Telemetry:
    from drocap_ros.recording.telemetry.read import split_choice
    from drocap_ros.recording.video_telemetry import NO_TELEMETRY, Telemetry

    if args.telemetry not in (None, NO_TELEMETRY) and not split_choice(args.telemetry)[0].exists():
        raise InputError(f"--telemetry {args.telemetry}: expected a log, found no such file; check the path")
    if args.time_offset is not None:
        _check_offset("--time-offset", args.time_offset, args, mount=False)
    if args.mount_pitch is not None:
        _check_offset("--mount-pitch", args.mount_pitch, args, mount=True)
        if abs(args.mount_pitch) > 90.0:
            raise InputError(f"--mount-pitch: expected -90 to 90 deg, got {args.mount_pitch}; choose another")
    return Telemetry(args.telemetry, args.time_offset, args.mount_pitch, attitude_of(args))


def attitude_of(args: argparse.Namespace) -> tuple[float, float] | None:
    """Pitch and roll of ``--camera-pitch``, ``--camera-roll`` or ``--level``, deg; None where nothing is said."""
    if args.level and (args.camera_pitch or args.camera_roll):
        raise InputError("--level: expected neither --camera-pitch nor --camera-roll beside it; leave one of them out")
    if args.camera_pitch is None and args.camera_roll is None:
        return (0.0, 0.0) if args.level else None
    for axis, value, most in (("pitch", args.camera_pitch, 90.0), ("roll", args.camera_roll, 180.0)):
        if value is not None and not abs(value) <= most:
            raise InputError(f"--camera-{axis}: expected -{most:g} to {most:g} deg, got {value:g}; choose another")
    return args.camera_pitch or 0.0, args.camera_roll or 0.0


def with_known(config: DrocapConfig, args: argparse.Namespace) -> DrocapConfig:
    """The configuration with what the options say of person and lens."""
    for name, value, low, high in (
        ("--height", args.height, 0.5, 2.5), ("--fov", args.fov, 5.0, 170.0), ("--focal", args.focal, 10.0, 1e6)
    ):  # fmt: skip
        if value is not None and not low <= value <= high:
            raise InputError(f"{name}: expected {low:g} to {high:g}, got {value:g}; correct it")
    if args.dictionary is not None:
        if not args.dictionary.is_file():
            raise InputError(f"--dictionary {args.dictionary}: expected a pose dictionary, found no file; correct it")
        config = config.replace("initializer", dictionary=str(args.dictionary))
    if args.height is not None:
        config = config.replace("initializer", assumed_height_m=args.height)
        config = config.replace("bundle_adjuster", stature_std=_MEASURED_STATURE)
    lens = {"horizontal_fov_deg": args.fov, "focal_px": args.focal, "calibration_file": args.calibration}
    given = {name: value for name, value in lens.items() if value is not None}
    if given:
        none = {"horizontal_fov_deg": 0.0, "focal_px": 0.0, "calibration_file": ""}
        config = config.replace("image_ingest", **{**none, **given, "calibration_file": str(args.calibration or "")})
    return config


def _check_offset(name: str, value: float, args: argparse.Namespace, *, mount: bool) -> None:
    """Refuse an offset that is no number, or without telemetry: a log, a video's own, of a mount a recording's."""
    from drocap_ros.recording.open_session import is_recording
    from drocap_ros.recording.video_telemetry import NO_TELEMETRY, own_telemetry

    own = own_telemetry(args.input) or (mount and args.input.exists() and is_recording(args.input))
    if args.telemetry == NO_TELEMETRY or (args.telemetry is None and not own):
        raise InputError(f"{name}: expected --telemetry LOG with it, found none; add the log")
    if not math.isfinite(value):
        raise InputError(f"{name}: expected a finite number, got {value}; correct the value")


_MEASURED_STATURE = 0.01  # relative deviation of a stature that somebody has measured: shoes, and the day
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
    "level": False,
    "fov": None,
    "focal": None,
    "calibration": None,
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
    from drocap_ros.cli.report import open_words
    from drocap_ros.cli.running import progress_bars
    from drocap_ros.config import load_config
    from drocap_ros.motion import FILE
    from drocap_ros.perception.load_models import models_folder
    from drocap_ros.pipeline import Selection, needs_networks, reconstruct_together
    from drocap_ros.recording.keypoints.files import Stated, as_tracks_file
    from drocap_ros.recording.video_telemetry import Telemetry
    from drocap_ros.report.motion_images import ImagesBeside, has_images

    inputs = [args.input, *args.further]
    _check(args, inputs)
    out = args.out or default_folder(args.input, "motion")
    names = output_names(args, out, clip_of(args))
    beside = [f"camera_{number}.npz" for number in range(2, len(inputs) + 1)]
    videos = videos_of(args, inputs)
    corrections = corrections_together(args, [FILE, *beside])
    config = with_known(load_config(args.config), args)
    with contextlib.ExitStack() as stack:
        sources = [
            stack.enter_context(as_tracks_file(path, Stated(args.rate, args.image_size, args.order))) for path in inputs
        ]
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
            selections=[
                Selection(corrections=said, images=video, threads=args.threads)
                for said, video in itertools.zip_longest(corrections, videos)
            ],
        )
        motions = [
            dataclasses.replace(motion, meta={**motion.meta, "command": args.command_line, "input": path.name})
            for (motion, _), path in zip(found, videos or inputs, strict=True)
        ]
        shown = videos[0] if videos else sources[0] if sources[0] == args.input and has_images(sources[0]) else None
        images = stack.enter_context(ImagesBeside(shown, progress))
        further = [(motion, tracks) for motion, (_, tracks) in zip(motions, found, strict=True)][1:]
        write_outputs(out, names, motions[0], found[0][1], images.of, further)
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
    from drocap_ros.perception.sources.image_files import SUFFIXES
    from drocap_ros.recording.video_telemetry import NO_TELEMETRY

    if not args.together:
        if all(path.suffix.lower() in SUFFIXES for path in inputs):
            raise InputError(f"INPUT: expected one, found {len(inputs)} images; name their folder {inputs[0].parent}")
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
