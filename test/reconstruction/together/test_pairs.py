"""Pairs of phones that stand: lenses that nobody knows, pairs that do not belong together."""

from __future__ import annotations

import contextlib
from functools import cache
from typing import Any

import numpy as np
import pytest

from drocap_ros.background import Background
from drocap_ros.errors import InputError
from drocap_ros.evaluation.metrics import pa_mpjpe
from drocap_ros.motion import Motion
from drocap_ros.reconstruction.reconstruct import Solved, solve
from drocap_ros.reconstruction.together.joined import join_views
from drocap_ros.report.checks import MotionCheck, run_checks
from drocap_ros.report.statistics import motion_statistics
from drocap_ros.simulation.pinhole import project
from drocap_ros.simulation.simulated_person import simulate_person
from drocap_ros.skeleton import BODY_17
from drocap_ros.tracks import Tracks
from lab.simulation.orbit import orbit_camera

SIZE, FPS, SECONDS, LATER_S = (720, 1280), 24.0, 6.0, 0.375
#: Focal lengths over the longer side, of phones whose video is stabilized: 0.85 is assumed.
SHARES = (0.66, 0.73)


def truth(seed: int, begin_s: float, seconds: float, action: str = "mixed") -> np.ndarray:
    return simulate_person(begin_s + np.arange(0.0, seconds, 1 / FPS), action, seed, 1.75, BODY_17)


def seen(
    number: int,
    bearing_deg: float,
    seed: int,
    begin_s: float = 0.0,
    seconds: float = SECONDS,
    action: str = "mixed",
) -> Tracks:
    """A phone 4 m from the person; errors of a network that last for the whole clip, and those that change."""
    joints, focal = truth(seed, begin_s, seconds, action), SHARES[number] * max(SIZE)
    time_s = np.arange(len(joints)) / FPS
    middle = np.broadcast_to(joints[:, 0].mean(axis=0), (len(joints), 3))
    rotation, position = orbit_camera(time_s, middle, 4.0, 1.4, 0.0, bearing_deg)
    matrix = np.array([[focal, 0, SIZE[0] / 2], [0, focal, SIZE[1] / 2], [0, 0, 1]])
    rng = np.random.default_rng([number, seed])
    pixels = project(joints, rotation, position, matrix)
    pixels += rng.normal(0.0, 3.0, pixels.shape[1:]) + rng.normal(0.0, 2.0, pixels.shape)
    points, frames = rng.uniform((0, 0), SIZE, (60, 2)), np.repeat(np.arange(len(joints)), 60)
    track = np.tile(np.arange(60), len(joints))
    still = Background(frames.astype(np.int32), track, points[track].astype(np.float32))
    stamps = np.round(time_s * 1e9).astype(np.int64)
    return Tracks(pixels, BODY_17.joints, stamps, SIZE, background=still, real_lens=True)


@cache
def solved(*args: Any, action: str = "mixed") -> Solved:
    return solve(seen(*args, action=action))


def error_mm(motion: Motion, seed: int, begin_s: float = 0.0, seconds: float = SECONDS) -> float:
    joints = truth(seed, begin_s, seconds)
    return 1e3 * float(pa_mpjpe(motion.joints3d[:, :15], joints[:, :15]).mean())


@pytest.mark.parametrize(("apart_deg", "seed"), [(25, 3), (40, 1), (65, 2), (100, 1), (150, 3)])
def test_lenses_that_nobody_knows_are_found_with_the_body(apart_deg: float, seed: int) -> None:
    pair = [solved(0, 0.0, seed), solved(1, apart_deg, seed, LATER_S)]
    both = join_views(pair, ["first", "second"])[0]
    assert error_mm(both, seed) < 0.75 * error_mm(pair[0].motion, seed)
    found = both.meta["together"]["views"]
    assert found[1]["offset_s"] == pytest.approx(LATER_S, abs=0.03)
    off = [abs(np.log(view["focal_px"] / (share * max(SIZE)))) for view, share in zip(found, SHARES, strict=True)]
    assert np.mean(off) < 0.6 * np.mean(np.log(0.85 / np.array(SHARES)))
    assert max(view["misfit"] for view in found) < 2.0


def test_a_second_and_a_half_are_enough() -> None:
    pair = [solved(0, 0.0, 1, 1.0, 1.7), solved(1, 60.0, 1, 1.0, 1.7)]
    both = join_views(pair, ["first", "second"])[0]
    assert error_mm(both, 1, 1.0, 1.7) < error_mm(pair[0].motion, 1, 1.0, 1.7)
    assert both.meta["together"]["views"][1]["offset_s"] == pytest.approx(0.0, abs=0.02)


@pytest.mark.parametrize("apart_deg", [0, 40])
@pytest.mark.parametrize(
    "actions", [("kicking", "walk"), ("walk", "squats"), ("squats", "boxing"), ("boxing", "kicking")]
)
def test_other_motions_are_refused_or_doubted(apart_deg: float, actions: tuple[str, str]) -> None:
    pair = [solved(0, 0.0, 1, action=actions[0]), solved(1, apart_deg, 2, LATER_S, action=actions[1])]
    motion = None
    with contextlib.suppress(InputError):
        motion = join_views(pair, ["first", "second"])[0]
    found = set() if motion is None else {f.check for f in run_checks(motion, motion_statistics(motion))}
    assert motion is None or MotionCheck.MISFIT in found


def test_a_copy_of_a_recording_is_no_second_view() -> None:
    with pytest.raises(InputError, match=r"copy\.mp4: expected another view than that of first\.mp4"):
        join_views([solved(0, 0.0, 1), solved(0, 0.0, 1)], ["first.mp4", "copy.mp4"])
