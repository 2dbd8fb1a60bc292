"""Accuracy studies over MoCap and simulation: `python benchmarks/accuracy.py`, or some of its parts by name.

rotation     every method at four orbit speeds, clean and noisy 2D (`python -m lab rotation`): page accuracy
live         the live method beside the offline one, clean and noisy 2D: page accuracy_live
live-world   the live method in the world beside the offline one, every third sequence: page accuracy_live_world
perspective  the default method with a camera 6 m and 10 m away, lens known and unknown: page accuracy_perspective
world        placement and scale from telemetry, on simulated captures: page accuracy_world
telemetry    the motion in the world by telemetry that errs (`python -m lab world`), every third sequence: page
             accuracy_telemetry
together     two cameras 120 degrees apart whose times and places nobody knows (`drocap reconstruct A B --together`),
             every third sequence: page accuracy_together
real         phone videos with optical MoCap (``--models DIR`` of the 2D networks): page accuracy_real
calibration  gimbal yaw and latency found from telemetry that errs, an orbit that reverses once, `--runs` flights: page
             accuracy_calibration

Needs ../shared/mocap/dev, `world` excepted.  `--limit 2` takes the first two sequences only (a minute in all).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from figures import ROOT, table, write_figures

from drocap_ros.cli.running import progress_bars
from drocap_ros.config import DrocapConfig
from drocap_ros.errors import InputError
from drocap_ros.evaluation.metrics import pa_mpjpe, scale_error, w_mpjpe
from drocap_ros.reconstruction.reconstruct import reconstruct
from drocap_ros.simulation.pinhole import project, to_camera
from drocap_ros.skeleton import BODY_15, BODY_17, indices
from drocap_ros.tracks import Tracks
from lab.simulation.capture import SimulationConfig, simulate_capture
from lab.studies.calibration import calibration_markdown, calibration_study
from lab.studies.live_study import live_study
from lab.studies.live_study_table import live_markdown
from lab.studies.live_world import live_world_markdown, live_world_study
from lab.studies.protocol import (
    FPS,
    IMAGE_SIZE,
    NOISE_MM,
    PX_PER_MM,
    orbit_rotations,
    protocol_sequences,
)  # fmt: skip
from lab.studies.real_people import SYSTEMS, real_people_study
from lab.studies.rotation import rotation_markdown, rotation_study
from lab.studies.together import together_markdown, together_study
from lab.studies.world import world_markdown, world_study
from lab.studies.world_protocol import NONE, WorldCase, world_sequences

SPEED_DEG_S = 25.0
SOLUTION_DELAY_S = 0.5


def rotation(args: argparse.Namespace) -> None:
    pages = []
    for noisy in (False, True):
        with progress_bars() as progress:
            sequences = protocol_sequences(args.mocap, limit=args.limit)
            rows = rotation_study(sequences, noisy=noisy, processes=args.processes, progress=progress)
        pages.append(f"## {'Noisy' if noisy else 'Clean'} 2D\n\n{rotation_markdown(rows)}")
    write_figures("accuracy", "Accuracy of every method over the camera's orbit speed", "\n".join(pages))


def live(args: argparse.Namespace) -> None:
    pages = []
    for noisy in (False, True):
        rows = live_study(args.mocap, noisy=noisy, delay_s=SOLUTION_DELAY_S, limit=args.limit)
        pages.append(f"## {'Noisy' if noisy else 'Clean'} 2D\n\n{live_markdown(rows, SOLUTION_DELAY_S)}")
    write_figures("accuracy_live", "Accuracy of the live method beside the offline one", "\n".join(pages))


def live_world(args: argparse.Namespace) -> None:
    pages = []
    cases = [WorldCase(telemetry, background=points) for telemetry in ("exact", "gps") for points in (False, True)]
    for case in [*cases, WorldCase(NONE, background=True)]:
        with progress_bars() as progress:
            rows = live_world_study(
                args.mocap, case, every=3, delay_s=SOLUTION_DELAY_S, limit=args.limit, progress=progress
            )  # fmt: skip
        pages.append(live_world_markdown(rows, case))
    title = "Live motion in the world beside the offline one"
    write_figures("accuracy_live_world", title, "\n".join(pages))


def perspective_view(x: np.ndarray, distance_m: float, noise_px: float) -> tuple[Tracks, np.ndarray, np.ndarray]:
    """Tracks, camera matrix (3, 3) and truth (F, 15, 3) mm of a camera that orbits the middle of the walked path.

    The focal length gives the person the same size in the image as the protocol's orthographic camera does.
    """
    turn = orbit_rotations(len(x), SPEED_DEG_S)
    position = x[:, 0].mean(axis=0) - 1000.0 * distance_m * turn[:, 2]
    focal = PX_PER_MM * 1000.0 * distance_m
    matrix = np.array([[focal, 0.0, IMAGE_SIZE[0] / 2], [0.0, focal, IMAGE_SIZE[1] / 2], [0.0, 0.0, 1.0]])
    keypoints = project(x, turn, position, matrix)
    keypoints += np.random.default_rng(0).normal(0.0, noise_px, keypoints.shape)
    stamp_ns = np.round(np.arange(len(x)) * (1e9 / FPS)).astype(np.int64)
    return Tracks(keypoints, BODY_15.joints, stamp_ns, IMAGE_SIZE), matrix, to_camera(x, turn, position)


def perspective(args: argparse.Namespace) -> None:
    sequences, rows = protocol_sequences(args.mocap, limit=args.limit), []
    for distance_m in (6.0, 10.0):
        for label, noise_px in (("clean", 0.0), (f"{NOISE_MM:g} mm noise", NOISE_MM * PX_PER_MM)):
            errors = []
            for sequence in sequences:
                body = sequence.x[:, indices(BODY_17.joints, BODY_15.joints)]
                tracks, matrix, truth = perspective_view(body, distance_m, noise_px)
                cases = ((tracks, "ba"), (replace(tracks, camera_matrix=matrix), "ba"), (tracks, "initial"))
                motions = (reconstruct(case, method=method) for case, method in cases)
                found = (m.joints3d[:, indices(m.joints, BODY_15.joints)] for m in motions)
                errors.append([pa_mpjpe(1000.0 * joints, truth).mean() for joints in found])
            rows.append([f"{distance_m:g} m", label, *(f"{error:.1f}" for error in np.mean(errors, axis=0))])
    head = ["distance", "2D", "ba, lens unknown", "ba, lens known (`camera_matrix`)", "initial"]
    text = f"Reconstruction error in mm, mean over {len(sequences)} sequences, {SPEED_DEG_S:g} deg/s.\n\n"
    write_figures("accuracy_perspective", "Accuracy with a camera nearby", text + table(head, rows))


def world(args: argparse.Namespace) -> None:
    """Error of the pelvis in the world, of the limbs' length, and W-MPJPE; a row per capture."""
    rows = []
    for label, attitude_deg, position_m in (("exact", 0.0, 0.0), ("off by 0.5 deg and 0.2 m (RMS)", 0.5, 0.2)):
        config = SimulationConfig(radius_m=6.0, attitude_error_deg=attitude_deg, position_error_m=position_m)
        for seed in range(3):
            capture = simulate_capture(12.0, 30.0, seed, config)
            motion = reconstruct(capture.tracks)
            estimate = motion.joints3d[:, indices(motion.joints, BODY_15.joints)]
            truth = capture.joints3d_world
            away = np.linalg.norm(estimate[:, 0] - truth[:, 0], axis=1)
            rows.append([
                label, seed, f"{100 * away.mean():.1f}", f"{100 * scale_error(estimate, truth):+.1f}",
                f"{1000 * w_mpjpe(estimate, truth).mean():.0f}", motion.scale_source,
            ])  # fmt: skip
    head = ["telemetry", "seed", "pelvis off by, cm", "limbs' length, %", "W-MPJPE, mm", "scale from"]
    text = "Simulated captures of 12 s at 6 m, default method, realistic noise in the 2D keypoints.\n\n"
    write_figures("accuracy_world", "Placement and scale in the world", text + table(head, rows))


def telemetry(args: argparse.Namespace) -> None:
    pages = []
    cases = [
        WorldCase(level, background=background) for background in (False, True) for level in ("exact", "rtk", "gps")
    ]
    for case in (*cases, WorldCase("exact", still=True), WorldCase("exact", still=True, background=True)):
        with progress_bars() as progress:
            rows = world_study(world_sequences(args.mocap, 3, args.limit), case, progress=progress)
        pages.append(world_markdown(rows, case))
    write_figures("accuracy_telemetry", "Motion in the world by telemetry that errs", "\n".join(pages))


def calibration(args: argparse.Namespace) -> None:
    pages = []
    for background in {"without": [False], "with": [True], "both": [False, True]}[args.background]:
        with progress_bars() as progress:
            options = {"runs": args.runs, "limit": args.limit, "background": background}
            rows = calibration_study(args.mocap, **options, progress=progress)
        title = "With fixed points of the scene:" if background else "By the body alone:"
        pages.append(f"{title}\n\n{calibration_markdown(rows)}")
    write_figures("accuracy_calibration", "Yaw and latency of the telemetry, found", "\n".join(pages))


def together(args: argparse.Namespace) -> None:
    """Two drones by exact and rough telemetry, two that hold still without any, two that fly apart without any."""
    pages = []
    there_and_back = WorldCase("none", reverse_s=8.0)
    cases: list[tuple[WorldCase, WorldCase | None]] = [
        (WorldCase("exact"), None),
        (WorldCase("gps"), None),
        (WorldCase("gps", background=True), None),
        (WorldCase("none", still=True), None),
        (WorldCase("none", still=True, background=True), None),
        (WorldCase("none", background=True), replace(there_and_back, background=True)),
        (WorldCase("none", background=True), there_and_back),
        (WorldCase("none"), there_and_back),
    ]
    for case, other in cases:
        with progress_bars() as progress:
            rows = together_study(world_sequences(args.mocap, 3, args.limit), case, progress, other)
        pages.append(together_markdown(rows, case, other))
    write_figures("accuracy_together", "One body in the views of two cameras", "\n".join(pages))


def real(args: argparse.Namespace) -> None:
    """Phone videos with optical MoCap: by keypoints alone, and with feet and depth by a second network."""
    models = args.models or ROOT.parent / "shared" / "models"
    feet = sorted(path.stem for path in models.glob("blazepose-*.onnx"))
    rows: dict[str, list[str]] = {}
    for second in ["", *feet[:1]]:
        config = DrocapConfig().replace("pose_estimator", feet_model=second)
        found = real_people_study(args.mocap.parents[1] / "real", models, config)
        for system in ("drocap", *SYSTEMS):
            of = [row for row in found if row.system == system]
            name = f"{system}, {second}" if second and system == "drocap" else system
            mean = np.mean([row[2:] for row in of], axis=0)
            cells = [(row.pa_mm, row.knees_deg, row.knees_signed_deg) for row in of] + [tuple(mean)]
            rows[name] = [name, *(f"{pa:.1f}, {knees:.1f} ({signed:+.1f})" for pa, knees, signed in cells)]
    head = ["system", *sorted({row.video for row in found}), "mean"]
    text = "PA over twelve joints, mm, and both knees' mean absolute (mean) error, degrees. No lens is given.\n\n"
    write_figures("accuracy_real", "Real people with optical MoCap", text + table(head, list(rows.values())))


PARTS: dict[str, Callable[[argparse.Namespace], None]] = {
    "rotation": rotation, "live": live, "live-world": live_world, "perspective": perspective,
    "world": world, "telemetry": telemetry, "together": together, "calibration": calibration,
    "real": real,
}  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []])
    parser.add_argument("--mocap", type=Path, default=ROOT.parent / "shared" / "mocap" / "dev")
    parser.add_argument("--models", type=Path, help="2D networks for real videos (default those beside the checkout)")
    parser.add_argument("--limit", type=int, help="only the first N sequences")
    parser.add_argument("--runs", type=int, default=20, help="flights of the calibration study (default 20)")
    words = "fixed points of the scene in the calibration study (default both)"
    parser.add_argument("--background", choices=("without", "with", "both"), default="both", help=words)
    parser.add_argument("--processes", type=int, default=2, help="of the rotation study (default 2)")
    args = parser.parse_args()
    status = 0
    for part in args.parts or PARTS:
        if part != "world" and not args.mocap.is_dir():
            print(f"accuracy: no {args.mocap.name} beside the checkout, {part} is left out")
            continue
        try:
            PARTS[part](args)
        except InputError as error:
            print(f"accuracy: {error}; {part} is left out", file=sys.stderr)
            status = error.exit_status
    return status


if __name__ == "__main__":
    raise SystemExit(main())
