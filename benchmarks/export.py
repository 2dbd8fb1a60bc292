"""Figures of exports: `python benchmarks/export.py [MOTION ...]`, folders of `drocap reconstruct` or `drocap demo`.

Constant bones, joint angles and locked feet of each motion; angles of a simulated walk with known ones.  OpenSim's
columns need the package opensim.
"""

from __future__ import annotations

import argparse
import csv
import importlib.util
import sys
import tempfile
from pathlib import Path

import numpy as np
from figures import ROOT, table, write_figures

sys.path[:0] = [str(ROOT / "test" / "helpers")]

JOINTS = ("right_hip", "right_knee", "left_hip", "left_knee")
OPENSIM = {"hip": "hip_flexion", "knee": "knee_angle"}
RATE_HZ, FRAMES = 24.0, 240


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("motions", nargs="*", type=Path, metavar="MOTION")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="drocap_bench_") as name:
        folder = Path(name)
        text = known_angles(folder)
        if args.motions:
            text += "\n" + moved_joints(args.motions) + "\n" + angles_of_motions(args.motions, folder)
            text += "\n" + locked_feet(args.motions)
    write_figures("export", "Exports", text)
    return 0


def angles(source: object, folder: Path) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Flexion of :data:`JOINTS`, degrees, by our rigid body and by OpenSim (empty where it is not installed)."""
    from drocap_ros import export

    export(source, folder / "a.csv", "csv-angles")
    head, *rows = csv.reader((folder / "a.csv").read_text().splitlines())
    values = dict(zip(head, np.array(rows, float).T, strict=True))
    ours = {name: values[f"{name}_flexion_deg"] for name in JOINTS}
    if importlib.util.find_spec("opensim") is None:
        return ours, {}
    export(source, folder / "a.mot", "mot")
    head, *rows = (folder / "a.mot").read_text().split("endheader\n")[1].splitlines()
    values = dict(zip(head.split(), np.array([row.split() for row in rows], float).T, strict=True))
    return ours, {name: values[f"{OPENSIM[name.split('_')[1]]}_{name[0]}"] for name in JOINTS}


def known_angles(folder: Path) -> str:
    """The simulated walk of the tests: thighs and shanks that swing by stated angles."""
    from walking import make_walk, stamps

    from drocap_ros.motion import Motion
    from drocap_ros.skeleton import BODY_15

    walk = make_walk(FRAMES)
    shape = walk.shape.shape
    there = np.stack([0.8 * np.arange(FRAMES) / RATE_HZ, np.zeros(FRAMES), np.full(FRAMES, 1.0)], axis=1)
    motion = Motion(
        joints3d=walk.shape + there[:, None], joints=BODY_15.joints, parents=BODY_15.parents,
        stamp_ns=stamps(FRAMES), frame="world", metric=True, scale_source="truth",
        camera_rotation=walk.camera, confidence=np.ones(shape[:2]), keypoints=np.zeros((*shape[:2], 2)),
        reprojection_px=np.zeros(shape[:2]),
    )  # fmt: skip
    phase = 2.0 * np.pi * 0.9 * np.arange(FRAMES) / RATE_HZ
    truth = {}
    for side, sign in (("right", -1.0), ("left", 1.0)):
        truth[f"{side}_hip"] = np.degrees(0.5 * sign * np.sin(phase))
        truth[f"{side}_knee"] = np.degrees(0.5 + 0.3 * sign * np.cos(phase))
    rows = []
    for who, found in zip(("rigid body", "OpenSim"), angles(motion, folder), strict=True):
        if found:
            rows.append((who, *(f"{rms(found[name] - truth[name]):.1f}" for name in JOINTS)))
    return "Simulated walk, RMS error of flexion, degrees:\n\n" + table(("by", *map(words, JOINTS)), rows)


def angles_of_motions(motions: list[Path], folder: Path) -> str:
    rows = []
    for path in motions:
        ours, opensim = angles(path, folder)
        for name in JOINTS:
            row = [path.name, words(name), span(ours[name]), span(opensim[name]) if opensim else "-"]
            row.append(f"{rms(ours[name] - opensim[name]):.1f}" if same_length(ours, opensim, name) else "-")
            rows.append(row)
    head = ("motion", "flexion", "rigid body, degrees", "OpenSim, degrees", "RMS difference")
    return "Range of flexion; a knee that bends backwards is negative:\n\n" + table(head, rows)


def same_length(ours: dict[str, np.ndarray], opensim: dict[str, np.ndarray], name: str) -> bool:
    """OpenSim's table has an even time line, ours each frame's stamp."""
    return bool(opensim) and len(ours[name]) == len(opensim[name])


def moved_joints(motions: list[Path]) -> str:
    from drocap_ros.export.rigid_body import fit_rigid_body
    from drocap_ros.export.take import take_of, without_gaps, y_up
    from drocap_ros.motion import load_motion

    rows = []
    for path in motions:
        clip = y_up(take_of(load_motion(path)))
        known = np.isfinite(clip.positions).all(axis=2)
        body = fit_rigid_body(without_gaps(clip).positions, clip.joints, known)
        names = [name for name in clip.joints if name in body.joints]
        places = clip.positions[:, [clip.joints.index(name) for name in names]]
        off = 1000.0 * np.linalg.norm(np.stack([body.at(name) for name in names], axis=1) - places, axis=2)
        far = int((np.nan_to_num(off).max(axis=1) > 25.0).sum())
        row = (np.nanmean(off), np.nanpercentile(off, 99), np.nanmax(off))
        rows.append((path.name, len(off), *(f"{value:.1f}" for value in row), far))
    head = ("motion", "frames", "mean, mm", "99 %, mm", "largest, mm", "frames above 25 mm")
    return "Moves of joints for constant bone lengths (BVH, glTF, angles):\n\n" + table(head, rows)


def locked_feet(motions: list[Path]) -> str:
    from drocap_ros.errors import InputError
    from drocap_ros.export.take import at_constant_rate, lock_feet, take_of
    from drocap_ros.motion import load_motion

    rows = []
    for path in motions:
        clip = at_constant_rate(take_of(load_motion(path)))
        try:
            locked = lock_feet(clip)
        except InputError:
            continue
        knees = [clip.joints.index("rknee"), clip.joints.index("lknee")]
        speeds = [
            np.linalg.norm(np.diff(c.positions[:, knees], 2, axis=0), axis=2).max() * clip.rate_hz**2
            for c in (clip, locked)
        ]
        rows.append((path.name, locked.notes[-1], *(f"{value:.0f}" for value in speeds)))
    head = ("motion", "printed", "knees' largest acceleration before, m/s^2", "after")
    return "`--lock-feet`:\n\n" + table(head, rows) if rows else ""


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def span(values: np.ndarray) -> str:
    return f"{values.min():.1f} to {values.max():.1f}"


def words(name: str) -> str:
    return name.replace("_", " ")


if __name__ == "__main__":
    raise SystemExit(main())
