"""``drocap models``: list, fetch and check networks; the offer of other commands to fetch them."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from drocap_ros.cli.options import Subparsers, add_command, add_quiet_option, table_lines
from drocap_ros.errors import DrocapError, InputError

if TYPE_CHECKING:
    from drocap_ros.keypoints import PoseObservation
    from drocap_ros.perception.models.fetch import KnownModel


def add_parser(subparsers: Subparsers) -> None:
    """Add the command's actions."""
    parser = subparsers.add_parser(
        "models",
        help="list, fetch or check the networks",
        description="Networks for person detection and 2D pose: list the known and the installed ones, fetch them from"
        " their publishers, check them on an image.",
    )
    actions = parser.add_subparsers(metavar="ACTION", required=True)
    for name, run, help in (
        ("list", run_list, "known and installed models"),
        ("fetch", run_fetch, "download known models and verify them"),
        ("check", run_check, "run the folder's models on an image and draw the result"),
    ):
        action = add_command(actions, name, run, help=help, description=help)
        action.add_argument(
            "--models",
            metavar="DIR",
            type=Path,
            help="folder of networks, or 'simulation' for the shipped ones for rendered images (default:"
            " $DROCAP_MODELS)",
        )
    actions.choices["list"].add_argument(
        "--write", action="store_true", help="write NAME.yaml beside each unknown network, to fill in what it is"
    )
    fetching, checking = actions.choices["fetch"], actions.choices["check"]
    fetching.add_argument("names", nargs="*", metavar="NAME", help="models by name (default: rtmdet-nano rtmpose-s)")
    add_quiet_option(fetching)
    checking.add_argument("image", nargs="?", type=Path, metavar="IMAGE", help="image of a person")
    checking.add_argument(
        "--out", metavar="PNG", type=Path, help="output image (default: IMAGE_check.png where it is called)"
    )


def run_list(args: argparse.Namespace) -> int:
    """Print the registry and the files of the folder."""
    from drocap_ros.perception.load_models import SIMULATION, models_folder
    from drocap_ros.perception.models.fetch import KNOWN_MODELS
    from drocap_ros.perception.models.runtime import network_files
    from drocap_ros.perception.models.spec import write_specs

    folder, shipped = models_folder(args.models), models_folder(SIMULATION)
    if args.models and not folder.is_dir():
        raise InputError(f"{folder}: expected a folder of models, found no such folder; check the path")
    for path in write_specs(folder) if args.write else ():
        print(f"written: {path}; fill in its layout")
    present = network_files(folder)
    names = {path.name for path in present}
    head = ("NAME", "TASK", "MB", "LICENCE", "TRAINED ON", "FROM", "FILE", "INSTALLED")
    print("\n".join(table_lines([head, *(_row(model, model.file in names) for model in KNOWN_MODELS)])))
    print(f"\nfolder {folder}: " + ("" if present else "no models; `drocap models fetch` downloads the default pair"))
    print("".join(f"  {describe(path)}\n" for path in present), end="")
    if folder != shipped:
        print(f"\nshipped, used only with `--models {SIMULATION}`:")
        print("".join(f"  {describe(path)}\n" for path in network_files(shipped)), end="")
    return 0


def _row(model: KnownModel, installed: bool) -> tuple[str, ...]:
    origin = model.home if model.offered else f"{model.home} (no download)"
    facts = (model.name, model.task, f"{model.size_mb:.1f}", model.licence, model.training_data, origin, model.file)
    return (*facts, "yes" if installed else "-")


def describe(path: Path) -> str:
    """One line on a model file: its layout and input, or the reason why it cannot be used."""
    from drocap_ros.perception.load_models import limited_use
    from drocap_ros.perception.models.runtime import open_model
    from drocap_ros.perception.models.spec import read_spec

    size = path.stat().st_size / 1e6
    try:
        model = open_model(path)
        spec = read_spec(model)
    except InputError as error:
        return f"{path.name}  {size:.1f} MB  cannot be used: {error}"
    what = {"both": "detector and 2D pose", "pose": "2D pose", "detector": "detector"}[spec.task]
    joints = f", {spec.skeleton}" if spec.skeleton else ""
    width, height = spec.input_size
    use = f"; {limits}" if (limits := limited_use(model)) else ""
    return f"{path.name}  {size:.1f} MB  {what}, {spec.layout}, {width}x{height}{joints}, on {model.provider}{use}"


def run_fetch(args: argparse.Namespace) -> int:
    """Download the named models."""
    from drocap_ros.perception.load_models import models_folder
    from drocap_ros.perception.models.fetch import DEFAULT_FETCH, KNOWN_MODELS, known_model

    chosen = []
    for name in args.names or DEFAULT_FETCH:
        if (model := known_model(name)) is None:
            known = ", ".join(model.name for model in KNOWN_MODELS)
            raise InputError(f"{name}: expected one of {known}; see `drocap models list`")
        chosen.append(model)
    errors = fetch_models(chosen, models_folder(args.models), quiet=args.quiet)
    for error in errors:
        print(f"drocap: {error}", file=sys.stderr)
    return 1 if errors else 0


def run_check(args: argparse.Namespace) -> int:
    """Load the models; with an image, run them and draw the result."""
    from drocap_ros.perception.estimator import PoseEstimator
    from drocap_ros.perception.load_models import models_folder
    from drocap_ros.perception.tracking.pose_estimator_config import PoseEstimatorConfig

    estimator = PoseEstimator(models_folder(args.models), PoseEstimatorConfig())
    if args.image is None:
        for loaded in (estimator.detector, estimator.pose_model):
            print(describe(loaded.model.path))
        return 0
    import cv2

    from drocap_ros.perception.sources.image_files import read_image
    from drocap_ros.report.overlay import draw

    image = read_image(args.image)
    observation = estimator.process(image, 0)
    print(f"detector {estimator.detector.model.path.name}, pose {estimator.pose_model.model.path.name}")
    if not observation.has_subject:
        print(f"{args.image}: no person found")
        return 0
    _print_keypoints(observation)
    out = args.out or Path(f"{args.image.stem}_check.png")
    if not out.parent.is_dir() or not cv2.imwrite(str(out), draw(image, observation)):
        raise InputError(f"--out {out}: expected an image name (.png, .jpg) in a writable folder; choose another")
    print(f"written: {out}")
    return 0


def _print_keypoints(observation: PoseObservation) -> None:
    import numpy as np

    sigmas = np.sqrt(np.maximum(0.5 * (observation.covariance[:, 0] + observation.covariance[:, 2]), 0.0))
    columns = (observation.joints.joints, observation.keypoints, sigmas, observation.confidence)
    for name, (x, y), sigma, confidence in zip(*columns, strict=True):
        print(f"{name:<10} {x:8.1f} {y:8.1f} px  sigma {sigma:6.1f} px  confidence {confidence:.2f}")


def ensure_networks(folder: Path, source: str | Path, args: argparse.Namespace) -> None:
    """Fetch the default networks into a folder without any, and known ones for feet, which ``--feet`` names.

    It needs ``--fetch``, or a yes at the terminal.
    """
    from drocap_ros.open_images import open_images
    from drocap_ros.perception.models.fetch import DEFAULT_FETCH, KNOWN_MODELS, known_model
    from drocap_ros.perception.models.runtime import network_files

    names = () if network_files(folder) else DEFAULT_FETCH
    feet = known_model(args.feet) if args.feet else None
    if feet and not (folder / feet.file).is_file():
        names = (*names, feet.name)
    if not names:
        return
    with open_images(source):
        pass  # nothing is downloaded for a source that cannot be used
    models = [model for model in KNOWN_MODELS if model.name in names]
    what = f"{' and '.join(names)}, {sum(model.size_mb for model in models):.0f} MB"
    if not (args.fetch or (not args.quiet and _agreed(f"{folder} lacks networks", what))):
        named = "" if names == DEFAULT_FETCH else f" {' '.join(names)}"
        raise InputError(
            f"{folder}: expected networks for detection and 2D pose (.onnx), found no {' and '.join(names)}; run"
            f" `drocap models fetch{named}` ({what}), add --fetch, or name a folder with --models or DROCAP_MODELS"
        )
    if errors := fetch_models(models, folder, quiet=args.quiet):
        raise DrocapError("; ".join(errors))


def _agreed(lack: str, pair: str) -> bool:
    """Whether somebody at the terminal agrees to a download."""
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        return False
    print(f"{lack}. Download {pair}? [y/N] ", end="", file=sys.stderr, flush=True)
    return sys.stdin.readline().strip().lower() in ("y", "yes")


def fetch_models(models: Sequence[KnownModel], folder: Path, *, quiet: bool = False) -> list[str]:
    """Download models and print one line for each; returns the failures of network or server."""
    from drocap_ros.cli.running import progress_bars
    from drocap_ros.perception.models.fetch import FetchError, fetch

    errors = []
    with progress_bars(quiet) as progress:
        for model in models:

            def show(have: int, total: int, name: str = model.name) -> None:
                progress(name, have / total if total else -1.0)

            try:
                path = fetch(model, folder, progress=show)
            except FetchError as error:
                errors.append(str(error))
                continue
            if not quiet:
                what = "its package's " if model.package else ""
                print(f"{model.name}: {path} ({what}SHA-256 verified), {model.licence}, from {model.home}")
    return errors
