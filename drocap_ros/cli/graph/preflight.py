"""``drocap preflight``: what is missing before a flight, and how to mend it."""

from __future__ import annotations

import argparse
import itertools
import json
import logging
import math
import os
import statistics
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from drocap_ros.cli.atomic_output import check_output_file, output_file
from drocap_ros.cli.graph.common import PIPE_WIDTH, add_place_options, chosen_domain
from drocap_ros.cli.options import Subparsers, add_command, add_config_option, add_models_option
from drocap_ros.cli.running import progress_bars
from drocap_ros.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from drocap_ros.clip import Progress
    from drocap_ros.config import DrocapConfig
    from drocap_ros.flight.preflight.findings import Finding, Measured
    from drocap_ros.flight.preflight.setup_checks import Pace, Pictures, Setup
    from drocap_ros.perception.sources.base import ImageIngestConfig

_COLOURS = {"ok": "green", "waits": "cyan", "warning": "yellow", "missing": "red"}
#: Images of a camera whose size is not configured.
_USUAL_SIZE = (1280, 720)
#: Images that give the rate, two seconds at 15 Hz, and how long they may take.
_IMAGES, _LOOK_S = 30, 5.0
#: How long the networks are watched.
_PACE_S = 10.0


def add_parser(subparsers: Subparsers) -> None:
    """Add the command's options; ``run`` is its action."""
    parser = add_command(
        subparsers,
        "preflight",
        run,
        help="what is missing before a flight, and how to mend it",
        description="Listen to the autopilot of a configuration for some seconds and print every check: found, wanted, "
        "how to mend it. Sends requests for telemetry and parameters only; it never arms, moves or changes the "
        "vehicle. With a running graph it listens to that graph's bridge.",
    )
    parser.epilog = (
        "Exit status: 0 nothing is missing (warnings may remain, and what waits for the air), 1 something is "
        "missing, 2 the configuration or the link cannot be used, or no autopilot is heard."
    )
    add_config_option(parser, required=True)
    parser.add_argument(
        "--seconds", metavar="S", type=float, default=8.0, help="to listen, 2 to 300 (default 8); more finds rarer gaps"
    )
    parser.add_argument("--json", metavar="FILE", type=Path, help="write the checks with their values, for programs")
    add_models_option(parser)
    add_place_options(parser)
    parser.add_argument("--quiet", action="store_true", help="print what is missing only")


def run(args: argparse.Namespace) -> int:
    """Listen, check, print; the status says whether anything is missing."""
    from drocap_ros.config import load_config
    from drocap_ros.flight.preflight.measure import all_findings, is_ready

    if not 2 <= args.seconds <= 300:
        raise InputError(f"--seconds: expected 2 to 300, got {args.seconds:g}; choose another")
    config = load_config(args.config)
    if args.json:
        check_output_file(args.json, "--json")
    setup = setup_of(config, args.models)
    measured = _measure(config, args)
    if not measured.bridge:  # a running graph has its camera open
        setup = setup._replace(pictures=look(config.image_ingest))
        if setup.models and setup.pictures is not None and not setup.pictures.refusal:
            with progress_bars(args.quiet) as progress:
                pace = pace_of(config, Path(setup.models), setup.pictures.rate_hz, progress)
            setup = setup._replace(pictures=setup.pictures._replace(pace=pace))
    found = all_findings(config.mavlink_bridge, setup, measured)
    ready = is_ready(found)
    status = 2 if not measured.heard else 0 if ready else 1
    if args.json:
        _write(args.json, "silent" if status == 2 else "ready" if ready else "missing", status, found)
    _print(found, args.quiet)
    if status == 2:
        silence = found[-1]
        raise InputError(
            f"preflight: expected {silence.wanted} within {args.seconds:g} s, found {silence.found}; {silence.remedy}"
        )
    return status


def setup_of(config: DrocapConfig, models: Path | None = None) -> Setup:
    """Camera, source and networks that a configuration names."""
    from drocap_ros.flight.preflight.setup_checks import Setup
    from drocap_ros.perception.load_models import models_folder
    from drocap_ros.perception.models.runtime import network_files

    ingest = config.image_ingest
    matrix, size, words = _camera(ingest)
    folder = models_folder(models or config.pose_estimator.models_dir)
    present = folder.is_dir() and bool(network_files(folder))
    return Setup(
        camera_matrix=matrix, image_size=size, camera_words=words, calibrated=bool(ingest.calibration_file),
        source=ingest.source, assumed_height_m=config.initializer.assumed_height_m,
        models=str(folder) if present else "",
        models_remedy="run `drocap models fetch` or name a folder with --models or DROCAP_MODELS",
        wanted_size=(ingest.width_px, ingest.height_px),
    )  # fmt: skip


def look(ingest: ImageIngestConfig) -> Pictures | None:
    """Open the source of the images for at most some seconds; None = there is none, or it is a topic."""
    from drocap_ros.flight.preflight.setup_checks import DRIVER, Pictures
    from drocap_ros.open_images import is_blank
    from drocap_ros.perception.sources import open_source
    from drocap_ros.ros.topics import TOPIC_SOURCE

    if not ingest.source or ingest.source.startswith(TOPIC_SOURCE):
        return None
    stamps, late_s, blank = [], [], True
    try:
        with open_source(ingest.source, ingest) as source:
            ends = threading.Timer(_LOOK_S, source.close) if source.live else None  # a camera that stalls ends thus
            if ends:
                ends.start()
            for frame in itertools.islice(source, _IMAGES):
                stamps.append(frame.stamp_ns)
                late_s.append(1e-9 * (time.time_ns() - frame.stamp_ns))
                blank = blank and is_blank(frame.image)
            if ends:
                ends.cancel()
    except InputError as error:
        return Pictures(refusal=str(error))
    if not stamps:
        return Pictures(refusal=f"{ingest.source}: expected images, found none; check its cable and power")
    rate_hz = 1e9 * (len(stamps) - 1) / (stamps[-1] - stamps[0]) if len(stamps) > 1 else math.nan
    # Only a driver says when it exposed: stamps of a stream are times of arrival, of a file times since its start.
    latency_s = statistics.median(late_s) if ingest.source.startswith(DRIVER) else math.nan
    return Pictures("", source.size, rate_hz, latency_s, blank)


def pace_of(config: DrocapConfig, models: Path, rate_hz: float, progress: Progress) -> Pace | None:
    """Run the networks on the images of the source as the graph does; None where it has too few, or no rate."""
    from drocap_ros.flight.preflight.setup_checks import Pace
    from drocap_ros.perception.estimator import PoseEstimator
    from drocap_ros.perception.sources import open_source
    from drocap_ros.perception.sources.base import prefetch
    from drocap_ros.ros.own_process import LoadShedding

    logging.getLogger("drocap_ros.perception.estimator.networks").setLevel(logging.ERROR)  # the graph says it
    chosen = config.pose_estimator
    estimator, shedding = PoseEstimator(models, chosen), LoadShedding(chosen.max_load_level)
    begin_s = first_ns = took_s = shown_s = 0.0
    taken = looked = pixels = 0
    with open_source(config.image_ingest.source, config.image_ingest) as source:
        ends = threading.Timer(_PACE_S + _LOOK_S, source.close) if source.live else None
        if ends:
            ends.start()
        for frame in source if source.live else prefetch(source):
            level, pixels = 0, frame.image.shape[0] * frame.image.shape[1]
            if begin_s:
                shown_s, now_s = 1e-9 * (frame.stamp_ns - first_ns), time.perf_counter() - begin_s
                progress("networks", min(now_s / _PACE_S, 1.0))
                if max(shown_s, now_s) > _PACE_S:
                    break
                if now_s - shown_s > 2.0 / rate_hz:  # a file waits; a camera does not
                    continue
                time.sleep(max(0.0, shown_s - now_s))
                level = shedding.level(now_s, took_s > 1.0 / rate_hz, 0)
            work_s = time.perf_counter()
            estimator.process(frame.image, frame.stamp_ns, load_level=level)
            took_s = time.perf_counter() - work_s
            if begin_s:
                taken, looked = taken + 1, looked + (not estimator.propagated)
            else:  # the first one warms the networks up
                begin_s, first_ns = time.perf_counter(), frame.stamp_ns
        if ends:
            ends.cancel()
    seconds = min(time.perf_counter() - begin_s, _PACE_S)
    if not (looked and seconds * rate_hz >= _IMAGES):
        return None
    passed_over = max(0.0, 1.0 - taken / (seconds * rate_hz))
    return Pace(seconds, passed_over, taken / looked, pixels, chosen.threads, os.cpu_count() or 1)


def _camera(ingest: ImageIngestConfig) -> tuple[np.ndarray | None, tuple[int, int], str]:
    """Matrix of the camera, None = not known, size of the images, and both in words."""
    from drocap_ros.perception.calibration import camera_model, load_calibration

    size = (ingest.width_px or _USUAL_SIZE[0], ingest.height_px or _USUAL_SIZE[1])
    try:
        if ingest.calibration_file and not (ingest.width_px and ingest.height_px):
            calibration = load_calibration(Path(ingest.calibration_file))
            size = (calibration.width, calibration.height)
        camera = camera_model(ingest, size)
    except InputError as error:
        return None, size, str(error)
    if camera is None:
        return None, size, "neither calibration_file nor horizontal_fov_deg is set"
    width = f"{ingest.horizontal_fov_deg:g} deg wide as stated"
    how = f"calibrated by {ingest.calibration_file}" if ingest.calibration_file else width
    return camera.matrix, size, f"{size[0]}x{size[1]}, {how}"


def _measure(config: DrocapConfig, args: argparse.Namespace) -> Measured:
    from drocap_ros.cli.graph.running_bridge import listen_to_bridge
    from drocap_ros.flight.preflight.measure import Listening

    bridge = config.mavlink_bridge
    with progress_bars(args.quiet) as progress:
        # A link belongs to one program: two on a serial line or a TCP link would take each other's packets.
        measured = listen_to_bridge(bridge, args.namespace, chosen_domain(args), args.seconds, progress)
        if measured is not None:
            return measured
        listening = Listening(bridge, args.seconds)
        try:
            while not listening.done:
                listening.turn()
                progress("listening", listening.progress)
            return listening.measured()
        finally:
            listening.close()


def _print(found: Sequence[Finding], quiet: bool) -> None:
    from drocap_ros.flight.autopilot.autopilot import Level

    at = {level: [f for f in found if f.level == level] for level in Level}
    _print_table(at[Level.MISSING] if quiet else found)
    if quiet:
        return
    missing, waiting = (", ".join(f.name for f in at[level]) for level in (Level.MISSING, Level.WAITS))
    verdict = f"not ready, missing: {missing}" if missing else "ready"
    print(f"{verdict} ({len(at[Level.OK])} checks are ok, {len(at[Level.WARNING])} warnings)")
    if waiting:
        print(f"waits for the air: {waiting}")


def _print_table(shown: Sequence[Finding]) -> None:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table("", "check", box=None, pad_edge=False)
    for title, share in (("found", 3), ("wanted", 3), ("how to mend it", 5)):
        table.add_column(title, ratio=share)
    before = ""
    for finding in shown:
        word, remedy = finding.level.name.lower(), finding.remedy
        texts = (finding.name, finding.found, finding.wanted, "as above" if remedy and remedy == before else remedy)
        table.add_row(Text(word, _COLOURS[word]), *map(Text, texts))
        before = remedy or before
    if shown:
        Console(width=None if sys.stdout.isatty() else PIPE_WIDTH, highlight=False).print(table)


def _write(path: Path, status: str, exit_status: int, found: Sequence[Finding]) -> None:
    content = {"status": status, "exit_status": exit_status, "checks": [finding.as_dict() for finding in found]}
    with output_file(path, option="--json") as file:
        file.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
