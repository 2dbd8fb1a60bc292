"""Feet at rest: by speed, height and looks together, and by one sign alone."""

from __future__ import annotations

import numpy as np

from drocap_ros.contacts import (
    ANKLES,
    TRUE_REST_M_S,
    RestingFeet,
    parting_speed,
    rest_likelihood,
    rest_spans,
    speed_of_lowest,
    step_speed,
)

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
    feet = RestingFeet(np.ones((FRAMES, 17), bool), FPS, looks, joints if known else None)
    return feet.probability(bent, 0.0, 0.15)[:, :2]


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


def walking_feet() -> np.ndarray:
    """(F, 2, 3) m: each foot rests for a second, then swings forward by 0.8 m in 0.4 s, lifted by up to 0.1 m."""
    time = np.arange(int(6 * FPS)) / FPS
    feet = np.zeros((len(time), 2, 3))
    for foot, offset in enumerate((0.0, 0.7)):
        cycle, phase = np.divmod(time + offset, 1.4)
        swing = np.clip((phase - 1.0) / 0.4, 0.0, 1.0)
        feet[:, foot, 0] = 0.8 * (cycle + swing)
        feet[:, foot, 2] = 0.1 * np.sin(np.pi * swing)
    return feet


def test_every_sign_finds_the_same_rest() -> None:
    feet = walking_feet()
    slow = step_speed(feet, FPS) < TRUE_REST_M_S
    assert 0.5 < slow.mean() < 0.8
    assert speed_of_lowest(feet, np.full(len(feet) - 1, 1.0 / FPS)) < TRUE_REST_M_S
    for foot in range(2):
        held = np.zeros(len(feet), bool)
        for first, last in rest_spans(feet[:, foot], FPS):
            held[first:last] = True
        assert (held[1:] == slow[:, foot]).mean() > 0.9


def test_speed_of_uneven_frames_is_that_of_even_ones() -> None:
    points = np.linspace(0.0, 1.0, 10)[:, None, None] * np.array([3.0, 4.0, 0.0])
    rate = np.full(9, 2.0)
    np.testing.assert_allclose(step_speed(points, 2.0), step_speed(points, rate))
    np.testing.assert_allclose(step_speed(points[::3], rate[::3] / 3.0), step_speed(points, 2.0)[:3])


def test_likelihood_of_a_way_falls_with_its_length() -> None:
    likely = rest_likelihood(np.square([0.0, 0.03, 0.06]), 0.03)
    np.testing.assert_allclose(likely, np.exp([0.0, -0.5, -2.0]))
