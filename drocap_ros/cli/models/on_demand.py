"""Networks on demand: a command that needs them offers to fetch them."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from drocap_ros.errors import DrocapError, InputError

if TYPE_CHECKING:
    from drocap_ros.perception.models.registry import KnownModel


def add_fetch_option(parser: argparse.ArgumentParser) -> None:
    """Add ``--fetch``."""
    parser.add_argument(
        "--fetch", action="store_true", help="download the default networks first where the folder of models has none"
    )


def ensure_networks(folder: Path, source: str | Path, args: argparse.Namespace) -> None:
    """Fetch the default networks into a folder without any: with ``--fetch``, or after a yes at the terminal.

    Raises
    ------
    InputError
        When the source has no images, or the folder has no network and none is to be fetched.
    """
    from drocap_ros.perception.models.registry import DEFAULT_FETCH, known_model
    from drocap_ros.recording.open_images import open_images

    if folder.is_dir() and any(folder.glob("*.onnx")):
        return
    with open_images(source):
        pass  # nothing is downloaded for a source that cannot be used
    models = [model for name in DEFAULT_FETCH if (model := known_model(name)) is not None]
    pair = f"{' and '.join(model.name for model in models)}, {sum(model.size_mb for model in models):.0f} MB"
    fetch = args.fetch
    if not fetch and not args.quiet and sys.stdin.isatty() and sys.stderr.isatty():
        print(f"{folder} has no networks for detection and 2D pose. Download {pair}? [y/N] ", end="", file=sys.stderr)
        sys.stderr.flush()
        fetch = sys.stdin.readline().strip().lower() in ("y", "yes")
    if not fetch:
        raise InputError(
            f"{folder}: expected networks for detection and 2D pose (.onnx), found none; run `drocap models fetch`"
            f" ({pair}), add --fetch, or name a folder with --models or DROCAP_MODELS"
        )
    if errors := fetch_models(models, folder, quiet=args.quiet):
        raise DrocapError("; ".join(errors))


def fetch_models(models: Sequence[KnownModel], folder: Path, *, quiet: bool = False) -> list[str]:
    """Download models and print one line for each; returns the failures of network or server."""
    from drocap_ros.cli.progress import progress_bars
    from drocap_ros.perception.models.fetch import FetchError, fetch

    errors = []
    with progress_bars(quiet) as progress:
        for model in models:
            try:
                path = fetch(
                    model,
                    folder,
                    progress=lambda have, total, name=model.name: progress(name, have / total if total else -1.0),  # type: ignore[misc]
                )
            except FetchError as error:
                errors.append(str(error))
                continue
            if not quiet:
                print(f"{model.name}: {path} (SHA-256 verified)")
    return errors
