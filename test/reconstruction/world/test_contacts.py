"""Feet in contact: what the motion of one foot against the other adds to the looks of each."""

from __future__ import annotations

import numpy as np

from drocap_ros.reconstruction.world.contacts import contact_probability, parting_speed
from drocap_ros.reconstruction.world.world_model import ANKLES, CAMERA, FLOOR, GLOBALS, WorldState

FPS, FRAMES = 15.0, 60
STEP = slice(30, 36)  # frames in which the right foot moves
RESTS = np.full((FRAMES, 2), 0.98)


def stepping(speed_m_s: float, noise_m: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Joints (F, 17, 3) m of one who makes a small step, and the same bent so that both feet rest."""
    rng = np.random.default_rng(0)
    joints = np.zeros((FRAMES, 17, 3))
    joints[:, ANKLES[0], 0], joints[:, ANKLES[1], 0] = 0.1, -0.1
    bent = joints + rng.normal(0.0, 1e-3, joints.shape)
    moved = np.zeros(FRAMES)
    moved[STEP] = speed_m_s / FPS
    joints[:, ANKLES[0], 1] += np.cumsum(moved)
    return joints + rng.normal(0.0, max(noise_m, 1e-3), joints.shape), bent


def contact(joints: np.ndarray, bent: np.ndarray, looks: np.ndarray, *, known: bool = True) -> np.ndarray:
    """(F - 1, 2) of right and left ankle."""
    shared = np.zeros(GLOBALS)
    shared[FLOOR] = 0.0
    state = WorldState(bent, np.zeros((FRAMES, CAMERA)), shared)
    parting = parting_speed(joints, FPS) if known else None
    return contact_probability(state, FPS, 0.15, np.ones((FRAMES, 17), bool), looks, parting)[:, :2]


def test_two_feet_that_part_do_not_both_rest_however_sure_the_network_is() -> None:
    joints, bent = stepping(0.5)
    sure = contact(joints, bent, RESTS, known=False)
    found = contact(joints, bent, RESTS)
    assert sure.min() > 0.95
    inside = slice(STEP.start, STEP.stop - 2)
    assert found[inside].sum(axis=1).max() < 1.05, "one of the two at most"
    assert found[: STEP.start - 3].min() > 0.95
    assert found[STEP.stop + 2 :].min() > 0.95


def test_the_foot_that_looks_less_at_rest_is_the_one_that_moves() -> None:
    joints, bent = stepping(0.5)
    looks = RESTS.copy()
    looks[:, 0] = 0.85
    found = contact(joints, bent, looks)[STEP.start : STEP.stop - 2]
    assert found[:, 0].max() < 0.2
    assert found[:, 1].min() > 0.8


def test_feet_that_do_not_both_look_at_rest_are_judged_one_by_one() -> None:
    joints, bent = stepping(0.5)
    looks = RESTS.copy()
    looks[:, 0] = 0.3
    np.testing.assert_allclose(contact(joints, bent, looks), contact(joints, bent, looks, known=False))


def test_noise_alone_does_not_end_contacts() -> None:
    joints, bent = stepping(0.0, noise_m=0.02)
    assert np.median(parting_speed(joints, FPS)[:, 0]) > 0.2
    assert np.median(contact(joints, bent, RESTS)) > 0.95
