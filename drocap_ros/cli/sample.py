"""``drocap sample``: a real clip and networks from the package registry, reconstructed."""

from __future__ import annotations

import argparse
import shlex
import subprocess
import sys
import tempfile
import zipfile
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from drocap_ros.cli import reconstruct
from drocap_ros.cli.options import LineParser, Subparsers, add_command, add_quiet_option
from drocap_ros.errors import InputError
from drocap_ros.perception.models.fetch import FetchError

#: Seconds of one package, of at most 36 MB, on a line of 2 Mbit/s.
_TIMEOUT_S = 180


@dataclass(frozen=True)
class Package:
    """A wheel of PyPI, for one platform whatever the machine: its files are read, nothing is installed or run.

    pin : name and version
    sha256 : of the wheel; pip refuses another one
    tags : pip's words for the wheel of that sum
    members : path in the wheel -> name
    licence : of these files
    """

    pin: str
    sha256: str
    tags: tuple[str, ...]
    members: dict[str, str]
    licence: str


CLIP = Package(
    "sports2d==0.8.34",
    "733b6db70742636ae9c35d870c22bd416582f579abd5881bee93a14bb0e2655d",
    (),
    {"Sports2D/Demo/demo.mp4": "sample.mp4"},
    "demo video of Sports2D (David Pagnon and others), BSD-3-Clause",
)
NETWORKS = Package(
    "mediapipe==0.10.21",
    "05dc4a9e593655a79558d05d6227d31018c2537a4bd3362b51e230cf22aecfe3",
    ("--platform", "manylinux_2_28_x86_64", "--python-version", "3.11"),
    {
        "mediapipe/modules/pose_detection/pose_detection.tflite": "pose_detection.tflite",
        "mediapipe/modules/pose_landmark/pose_landmark_full.tflite": "pose_landmark_full.tflite",
    },
    "BlazePose of MediaPipe (Google), Apache-2.0",
)
#: A woman who walks through the picture: her seconds, and her box in the first image of them, px.
_WALK = ("--start", "2.8", "--end", "6.5", "--subject", "1100,520,1290,940")


def add_parser(subparsers: Subparsers) -> None:
    """Add the command's options; ``run`` is its action."""
    parser = add_command(
        subparsers,
        "sample",
        run,
        help="a real clip and networks from PyPI, reconstructed",
        description="Fetch a clip of a walking person and the networks BlazePose from packages of PyPI (45 MB, sums"
        " checked), reconstruct the clip and write its report. The networks serve your own videos too.",
    )
    parser.add_argument("--out", metavar="DIR", type=Path, default=Path("sample"), help="folder (default: sample)")
    add_quiet_option(parser)


def run(args: argparse.Namespace) -> int:
    """Fetch, convert, reconstruct."""
    from drocap_ros.cli.atomic_output import check_output_folder
    from drocap_ros.perception.models.blazepose import DETECTOR, POSE, write_blazepose

    check_output_folder(args.out)
    if find_spec("onnx") is None:
        raise InputError("expected the package onnx, which writes the networks, found none; run pip install onnx")
    args.out.mkdir(parents=True, exist_ok=True)
    video, models = args.out / "sample.mp4", args.out / "models"
    if not video.is_file():
        fetch(CLIP, args.out)
    if not all((models / f"{name}.onnx").is_file() for name in (DETECTOR, POSE)):
        with tempfile.TemporaryDirectory() as folder:
            detector, pose = fetch(NETWORKS, Path(folder))
            write_blazepose(detector, pose, models)
    parser: argparse.ArgumentParser = LineParser(prog="drocap")
    reconstruct.add_parser(parser.add_subparsers())
    words = ["reconstruct", str(video), *_WALK, "--models", str(models), "--out", str(args.out)]
    chosen = parser.parse_args([*words, *(["--quiet"] if args.quiet else [])])
    chosen.command_line = shlex.join(["drocap", *words])
    if not args.quiet:
        print(f"{video}: {CLIP.licence}; from {CLIP.pin}")
        print(f"{models}: {NETWORKS.licence}; from {NETWORKS.pin}")
        print(f"{chosen.command_line}  # with --models {models}, any video of yours", flush=True)
    return reconstruct.run(chosen)


def fetch(package: Package, folder: Path) -> list[Path]:
    """Files of a package, written into ``folder``; pip downloads it as this machine is set up, and checks its sum.

    Raises
    ------
    InputError
        When there is no pip.
    FetchError
        When pip cannot fetch the wheel of that sum.
    """
    with tempfile.TemporaryDirectory() as name:
        listed = Path(name) / "requirements.txt"
        listed.write_text(f"{package.pin} --hash=sha256:{package.sha256}\n", encoding="ascii")
        pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet", "download", "--no-deps"]
        options = ["--only-binary", ":all:", "--require-hashes", "--dest", name, *package.tags, "-r", str(listed)]
        try:
            done = subprocess.run([*pip, *options], capture_output=True, text=True, timeout=_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            raise FetchError(f"{package.pin}: no download in {_TIMEOUT_S} s; check the network, try again") from None
        wheels = list(Path(name).glob("*.whl"))
        if "No module named pip" in done.stderr:
            raise InputError(f"{package.pin}: expected pip, found none; run {sys.executable} -m ensurepip")
        if done.returncode or len(wheels) != 1:
            said = [line for line in done.stderr.splitlines() if line.startswith("ERROR:")] or [done.stderr.strip()]
            raise FetchError(f"{package.pin}: no download; pip says {said[-1][:300]!r}; check the network, try again")
        written = []
        with zipfile.ZipFile(wheels[0]) as wheel:
            for member, file in package.members.items():
                part = folder / f"{file}.part"
                part.write_bytes(wheel.read(member))
                written.append(part.replace(folder / file))
    return written
