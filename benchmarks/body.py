"""The body in its own frame, on people that no model was trained on: `python benchmarks/body.py`, page accuracy_body.

Sequences, cameras and errors are those of the protocol (`docs/accuracy.md`), varied row by row.  Needs
../shared/mocap/dev.  `--every 3` takes every third sequence only, `--rows clean noisy` those rows only.
"""

from __future__ import annotations

import argparse
import multiprocessing
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from figures import ROOT, table, write_figures
from scipy.signal import lfilter

from drocap_ros.contacts import TRUE_REST_M_S
from drocap_ros.evaluation.metrics import pa_mpjpe
from drocap_ros.evaluation.truth_files import load_mocap
from drocap_ros.geometry.alignment import apply_similarity, similarity
from drocap_ros.geometry.rotations import unpack_covariance
from drocap_ros.reconstruction.lifted.lifter import Lifter
from drocap_ros.reconstruction.lifted.network import LifterInput
from drocap_ros.reconstruction.reconstruct import reconstruct
from drocap_ros.skeleton import BODY_15, BODY_17, LIMB_JOINTS, indices
from drocap_ros.tracks import Tracks
from lab.studies.protocol import (
    FPS,
    IMAGE_SIZE,
    NOISE_MM,
    OUTLIER_PROBABILITY,
    OUTLIER_RANGE_MM,
    PX_PER_MM,
    mocap_files,
    orbit_rotations,
    resample,
)  # fmt: skip
from lab.training.leg_lengths import leg_reach, refit_knees, shortening

SPEED_DEG_S = 25.0
_LIMBS = indices(BODY_17.joints, LIMB_JOINTS)
_TOES = indices(BODY_17.joints, ("rtoe", "ltoe"))
_ARM = indices(BODY_17.joints, ("relbow", "rwrist"))
_LEGS = indices(BODY_17.joints, ("rknee", "rankle", "rtoe", "lknee", "lankle", "ltoe"))
#: Bones whose sign counts, and the true depth from which it does: limbs, 50 mm.
_SIGNED = np.array([b for b in BODY_15.bones if b[0] not in (0, 7)])
_SIGNED_MM = 50.0
#: Square of the radius of the ellipsoid that holds 90 % of a normal distribution in three dimensions.
_NINETY = 6.251
_FLOOR = ("lie", "floor")


class Row(NamedTuple):
    """What differs from the protocol's clean row."""

    speed: float = SPEED_DEG_S
    elevation_deg: float = np.degrees(0.3)
    noise: str = "none"
    fps: float = FPS
    hidden: str = ""
    least_flexion_deg: float = -1.0
    toes_seen: bool = False
    covariance_given: bool = False
    rotation_known: bool = False


ROWS: dict[str, Row] = {
    "clean": Row(),
    "clean, camera's rotation known": Row(rotation_known=True),
    "noisy": Row(noise="protocol"),
    "clean, legs refitted to 3 degrees": Row(least_flexion_deg=3.0),
    "noisy, legs refitted to 3 degrees": Row(noise="protocol", least_flexion_deg=3.0),
    "still camera, clean": Row(speed=0.0),
    "still camera, noisy": Row(speed=0.0, noise="protocol"),
    "correlated noise, covariance given": Row(noise="correlated", covariance_given=True),
    "correlated noise": Row(noise="correlated"),
    "noisy, 10 fps": Row(noise="protocol", fps=10.0),
    "noisy, 5 fps": Row(noise="protocol", fps=5.0),
    "right arm hidden, 10 mm noise": Row(noise="white", hidden="arm"),
    "legs hidden, 10 mm noise": Row(noise="white", hidden="legs"),
    "52 degrees above, clean": Row(elevation_deg=52.0),
    "69 degrees above, clean": Row(elevation_deg=69.0),
    "toes seen, clean": Row(toes_seen=True),
}


@dataclass(frozen=True)
class Score:
    """Of one sequence: mm, shares, and what the share of ellipsoids and the ROC curve are made of."""

    name: str
    frames: int
    error_mm: float
    toes_mm: float
    wrong: float
    covered: float
    still: np.ndarray
    speed: np.ndarray


def keypoints_of(flat: np.ndarray, row: Row, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray | None]:
    """Keypoints (F, 17, 2) mm of the exact ones, and their covariance (F, 17, 3) where it is given."""
    out, covariance = flat.copy(), None
    if row.noise in ("protocol", "white"):
        out += rng.normal(0.0, NOISE_MM, flat.shape)
    if row.noise == "protocol":
        gross = rng.random(flat.shape[:2]) < OUTLIER_PROBABILITY
        out[gross] = (flat + rng.uniform(-OUTLIER_RANGE_MM, OUTLIER_RANGE_MM, flat.shape))[gross]
    if row.noise == "correlated":
        # 12 mm, lasting 0.1 s, three times as large along one direction of each joint as across.
        decay = np.exp(-1.0 / (0.1 * row.fps))
        draws = rng.standard_normal(flat.shape)
        draws[1:] *= np.sqrt(1.0 - decay**2)
        lasting = lfilter([1.0], [1.0, -decay], draws, axis=0)
        angle = rng.uniform(0, np.pi, flat.shape[1])
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]).transpose(2, 0, 1)
        shape = turn * (12.0 * np.sqrt(2.0 / 10.0) * np.array([3.0, 1.0]))
        out += np.einsum("pij,fpj->fpi", shape, lasting)
        full = shape @ shape.transpose(0, 2, 1)
        covariance = np.broadcast_to(
            np.stack([full[:, 0, 0], full[:, 0, 1], full[:, 1, 1]], axis=-1), (*out.shape[:2], 3)
        )
    if row.hidden:
        away = (np.arange(len(out)) / row.fps) % 4.0 >= 2.5
        out[np.ix_(away, _ARM if row.hidden == "arm" else _LEGS)] = np.nan
    if not row.toes_seen:
        out[:, _TOES] = np.nan
    return out, covariance if row.covariance_given else None


def _mahalanobis(error: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    weighted = np.linalg.solve(unpack_covariance(covariance), error[..., None])[..., 0]
    squared: np.ndarray = (error * weighted).sum(axis=-1)
    return squared


def score(job: tuple[Path, str]) -> Score:
    """One sequence of one row."""
    path, name = job
    row = ROWS[name]
    x, fps = load_mocap(path, joints=BODY_17)
    still = np.full((len(x), 2), np.nan)
    if np.isfinite(x[:, _TOES]).all():
        feet = x[:, [[3, _TOES[0]], [6, _TOES[1]]]]
        still = np.linalg.norm(np.gradient(feet, axis=0), axis=-1).max(axis=-1) * fps / 1000.0
    time = np.arange(len(x)) / fps
    x = resample(x, fps, row.fps)[: round(10.0 * row.fps)]
    speed = np.stack([np.interp(np.arange(len(x)) / row.fps, time, still[:, k]) for k in range(2)], axis=1)
    if row.least_flexion_deg >= 0:
        factor = shortening(x[None], np.array([leg_reach(x)]), np.radians([row.least_flexion_deg]))
        x = refit_knees(x[None], factor)[0]
    turn = orbit_rotations(len(x), row.speed * FPS / row.fps, elevation_rad=np.radians(row.elevation_deg))
    truth = (x - x[:, :1]) @ np.swapaxes(turn, 1, 2)
    keypoints, covariance = keypoints_of(truth[..., :2], row, np.random.default_rng(0))
    tracks = Tracks(
        keypoints=keypoints * PX_PER_MM + np.array(IMAGE_SIZE) / 2,
        joints=BODY_17.joints,
        stamp_ns=np.round(np.arange(len(x)) * (1e9 / row.fps)).astype(np.int64),
        image_size=IMAGE_SIZE,
        covariance=None if covariance is None else covariance * PX_PER_MM**2,
        camera_rotation=turn if row.rotation_known else None,
    )
    motion = reconstruct(tracks, method="ba")
    found = motion.joints3d * 1000.0
    if motion.frame == "world":
        found = (found - found[:, :1]) @ np.swapaxes(turn, 1, 2)
    fit = similarity(found[:, _LIMBS], truth[:, _LIMBS])
    aligned = apply_similarity(found, *fit)
    toes = np.linalg.norm(aligned - truth, axis=-1)[:, _TOES]
    ours, true = (v[:, _SIGNED[:, 1], 2] - v[:, _SIGNED[:, 0], 2] for v in (found, truth))
    wrong = ((ours * true < 0) & (np.abs(true) > _SIGNED_MM) & (np.abs(ours) > 0.5 * _SIGNED_MM)).any(axis=1)
    covered = np.nan
    if motion.covariance is not None and motion.frame == "camera":
        limbs = [np.linalg.norm(v[:, 1:15] - v[:, :1], axis=-1).mean() for v in (truth, found)]
        scale = limbs[0] / limbs[1]
        error = (found - found[:, :1]) * scale - (truth - truth[:, :1])
        squared = _mahalanobis(error[:, 1:15], motion.covariance[:, 1:15] * (1000.0 * scale) ** 2)
        covered = float((squared < _NINETY).mean())
    lifted = Lifter.load().lift(LifterInput(keypoints, focal=np.inf), row.fps)
    return Score(
        path.stem,
        len(x),
        float(pa_mpjpe(found[:, :15], truth[:, :15]).mean()),
        float(np.nanmean(toes)) if np.isfinite(toes).any() else np.nan,
        float(wrong.mean()),
        covered,
        lifted.still,
        speed,
    )


def area_under_roc(still: np.ndarray, score: np.ndarray) -> float:
    """Probability that a still foot's score is above that of a moving one."""
    order = np.argsort(score, kind="stable")
    rank = np.empty(len(score))
    rank[order] = np.arange(1, len(score) + 1)
    positive = still.sum()
    negative = len(still) - positive
    return float((rank[still].sum() - positive * (positive + 1) / 2) / (positive * negative))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mocap", type=Path, default=ROOT / ".." / "shared" / "mocap" / "dev")
    parser.add_argument("--every", type=int, default=1, help="take every n-th sequence (default 1)")
    parser.add_argument("--rows", nargs="+", choices=ROWS, default=list(ROWS), metavar="ROW", help="only these rows")
    parser.add_argument("--processes", type=int, default=1)
    args = parser.parse_args()

    paths = [p for p in mocap_files(args.mocap) if long_enough(p)][:: args.every]
    lines = []
    with multiprocessing.get_context("forkserver").Pool(args.processes) as pool:
        for name in args.rows:
            scores = pool.map(score, [(path, name) for path in paths], chunksize=1)
            lines.append(line := summary(name, scores))
            print(" | ".join(line), flush=True)
    page = f"{len(paths)} sequences of at least 5 s, their first 10 s. {__doc__.splitlines()[0]}\n\n"
    head = [
        "row",
        "PA mm",
        "floor mm",
        "toes mm",
        "frames with a wrong sign",
        "in 90 % ellipsoids (sequences)",
        "still feet, area under ROC",
    ]
    write_figures("accuracy_body", "The body in its own frame", page + table(head, lines))
    return 0


def long_enough(path: Path) -> bool:
    x, fps = load_mocap(path, joints=BODY_17)
    return len(x) >= 5.0 * fps


def summary(name: str, scores: list[Score]) -> list[str]:
    """A row of the page."""
    mean = np.mean([s.error_mm for s in scores])
    floor = [s.error_mm for s in scores if any(word in s.name.lower() for word in _FLOOR)]
    toes = np.array([s.toes_mm for s in scores])
    covered = np.array([s.covered for s in scores])
    true_speed = np.concatenate([s.speed.ravel() for s in scores])
    shown = np.concatenate([s.still.ravel() for s in scores])
    known = np.isfinite(true_speed)
    roc = area_under_roc(true_speed[known] < TRUE_REST_M_S, shown[known]) if known.any() else np.nan
    return [
        name,
        f"{mean:.1f}",
        f"{np.mean(floor):.1f}" if floor else "-",
        f"{np.nanmean(toes):.1f}" if np.isfinite(toes).any() else "-",
        f"{100 * np.mean([s.wrong for s in scores]):.0f} %",
        f"{100 * covered.mean():.0f} ({100 * covered.min():.0f} to {100 * covered.max():.0f})"
        if np.isfinite(covered).all()
        else "-",
        f"{roc:.3f}",
    ]


if __name__ == "__main__":
    raise SystemExit(main())
