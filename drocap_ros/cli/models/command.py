"""``drocap models``: list, fetch and check networks."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from drocap_ros.errors import InputError


def add_parser(subparsers: Any) -> argparse.ArgumentParser:
    """Add the command's options; ``run`` is its action."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "models",
        help="list, fetch or check the networks",
        description="Networks for person detection and 2D pose: list the known and the installed ones, fetch them from"
        " their publishers, check them on an image.",
    )
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    listing = actions.add_parser("list", help="known and installed models")
    fetching = actions.add_parser("fetch", help="download known models and verify them")
    checking = actions.add_parser("check", help="run the folder's models on an image and draw the result")
    for sub in (listing, fetching, checking):
        sub.add_argument(
            "--models",
            metavar="DIR",
            type=Path,
            help="folder of ONNX models, or 'simulation' for the shipped ones for rendered images (default:"
            " $DROCAP_MODELS)",
        )
    fetching.add_argument("names", nargs="*", metavar="NAME", help="models by name (default: rtmdet-nano rtmpose-s)")
    fetching.add_argument("--quiet", action="store_true", help="no progress, only errors")
    checking.add_argument("image", nargs="?", type=Path, metavar="IMAGE", help="image of a person")
    checking.add_argument("--detector", metavar="NAME", default="auto", help="detector (default: the preferred one)")
    checking.add_argument("--pose", metavar="NAME", default="auto", help="2D pose model (default: the preferred one)")
    checking.add_argument("--out", metavar="PNG", type=Path, help="output image (default: IMAGE_check.png)")
    parser.set_defaults(run=run)
    return parser


def run(args: argparse.Namespace) -> int:
    """Run the chosen action."""
    actions = {"list": run_list, "fetch": run_fetch, "check": run_check}
    return actions[args.action](args)


def run_list(args: argparse.Namespace) -> int:
    """Print the registry and the files of the folder."""
    from drocap_ros.perception.load_models import SIMULATION, models_folder
    from drocap_ros.perception.models.registry import KNOWN_MODELS

    folder = models_folder(args.models)
    if args.models and not folder.is_dir():
        raise InputError(f"{folder}: expected a folder of models, found no such folder; check the path")
    present = sorted(folder.glob("*.onnx")) if folder.is_dir() else []
    names = {path.name for path in present}
    rows = [("NAME", "TASK", "MB", "LICENCE", "TRAINED ON", "FROM", "FILE", "INSTALLED")]
    for model in KNOWN_MODELS:
        origin = model.home if model.url else f"{model.home} (no ONNX download)"
        size, installed = f"{model.size_mb:.1f}", "yes" if model.file in names else "-"
        rows.append((model.name, model.task, size, model.licence, model.training_data, origin, model.file, installed))
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    for row in rows:
        print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())
    print(f"\nfolder {folder}: " + ("" if present else "no models; `drocap models fetch` downloads the default pair"))
    for path in present:
        print(f"  {describe(path)}")
    shipped = models_folder(SIMULATION)
    if folder != shipped:
        print(f"\nshipped, used only with `--models {SIMULATION}`:")
        for path in sorted(shipped.glob("*.onnx")):
            print(f"  {describe(path)}")
    return 0


def describe(path: Path) -> str:
    """One line on a model file: its layout and input, or the reason why it cannot be used."""
    from drocap_ros.perception.load_models import limited_use
    from drocap_ros.perception.models.runtime import OnnxModel
    from drocap_ros.perception.models.spec import read_spec

    size = path.stat().st_size / 1e6
    try:
        model = OnnxModel(path)
        spec = read_spec(model)
    except InputError as error:
        return f"{path.name}  {size:.1f} MB  cannot be used: {error}"
    what = {"both": "detector and 2D pose"}.get(spec.task, "2D pose" if spec.task == "pose" else "detector")
    joints = f", {spec.skeleton}" if spec.skeleton else ""
    width, height = spec.input_size
    use = f"; {limits}" if (limits := limited_use(model)) else ""
    return f"{path.name}  {size:.1f} MB  {what}, {spec.layout}, {width}x{height}{joints}, on {model.provider}{use}"


def run_fetch(args: argparse.Namespace) -> int:
    """Download the named models."""
    from drocap_ros.cli.models.on_demand import fetch_models
    from drocap_ros.perception.load_models import models_folder
    from drocap_ros.perception.models.registry import DEFAULT_FETCH, KNOWN_MODELS, known_model

    chosen = []
    for name in args.names or DEFAULT_FETCH:
        model = known_model(name)
        if model is None:
            raise InputError(
                f"{name}: expected one of {', '.join(m.name for m in KNOWN_MODELS)}; see `drocap models list`"
            )
        chosen.append(model)
    errors = fetch_models(chosen, models_folder(args.models), quiet=args.quiet)
    for error in errors:
        print(f"drocap: {error}", file=sys.stderr)
    return 1 if errors else 0


def run_check(args: argparse.Namespace) -> int:
    """Load the models; with an image, run them and draw the result."""
    from drocap_ros.perception.load_models import load_detector, load_pose_model, models_folder
    from drocap_ros.perception.pose_estimator_config import PoseEstimatorConfig

    folder = models_folder(args.models)
    config = PoseEstimatorConfig(detector=args.detector, pose_model=args.pose)
    if args.image is None:
        for loaded in (load_detector(folder, config), load_pose_model(folder, config)):
            print(describe(loaded.model.path))
        return 0
    import cv2
    import numpy as np

    from drocap_ros.perception.estimator import PoseEstimator
    from drocap_ros.perception.overlay import draw
    from drocap_ros.perception.sources.image_files import read_image

    image = read_image(args.image)
    estimator = PoseEstimator(folder, config)
    observation = estimator.process(image, 0)
    print(f"detector {estimator.detector.model.path.name}, pose {estimator.pose_model.model.path.name}")
    if not observation.has_subject:
        print(f"{args.image}: no person found")
        return 0
    for name, point, variance, confidence in zip(
        observation.joints.joints, observation.keypoints, observation.covariance, observation.confidence, strict=True
    ):
        sigma = (
            float(np.sqrt(max((variance[0] + variance[2]) / 2, 0.0))) if np.isfinite(variance).all() else float("nan")
        )
        print(f"{name:<10} {point[0]:8.1f} {point[1]:8.1f} px  sigma {sigma:6.1f} px  confidence {confidence:.2f}")
    out = args.out or args.image.with_name(f"{args.image.stem}_check.png")
    if not out.parent.is_dir() or not cv2.imwrite(str(out), draw(image, observation)):
        raise InputError(f"--out {out}: expected an image name (.png, .jpg) in a writable folder; choose another")
    print(f"written: {out}")
    return 0
