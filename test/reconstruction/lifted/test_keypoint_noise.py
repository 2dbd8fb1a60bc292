"""What the keypoints' distances from the lifter's places say of their noise, and which of them the second look sees."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from drocap_ros.keypoints import Keypoints2D
from drocap_ros.reconstruction.lifted.body_size import EvenView, measure_size, without_outliers
from drocap_ros.reconstruction.lifted.lifted_config import LiftedConfig
from drocap_ros.reconstruction.lifted.lifter import Lifter
from drocap_ros.reconstruction.lifted.network import LiftedMotion, LifterInput
from drocap_ros.reconstruction.lifted.window_solver import WindowModel, solve_signs_and_adjust, window_model
from drocap_ros.simulation.simulated_person import simulate_person
from drocap_ros.skeleton import BODY_17

FPS, FRAMES = 24.0, 240
WRIST = BODY_17.index("rwrist")


def places() -> np.ndarray:
    """(F, 17, 2) mm of a body that moves by metres, as a lifter without an error would put it."""
    time = np.arange(FRAMES)[:, None, None] / FPS
    return 800.0 * np.sin(2.0 * time + np.linspace(0.0, 6.0, 34).reshape(17, 2))


def model_of(errors: np.ndarray, mm: float = 1.0) -> WindowModel:
    points = (places() + errors) / mm
    return window_model(Keypoints2D(points), places() / mm, mm, FPS, LiftedConfig())


def lasting(std_mm: float, time_s: float) -> np.ndarray:
    """Errors that decay over a time."""
    decay = np.exp(-1.0 / (time_s * FPS))
    draws = std_mm * np.random.default_rng(1).normal(size=(FRAMES, 17, 2))
    draws[1:] *= np.sqrt(1.0 - decay**2)
    out: np.ndarray = lfilter([1.0], [1.0, -decay], draws, axis=0)
    return out


@pytest.mark.parametrize("mm", [1.0, 4.0])
def test_fresh_noise_is_measured_in_spite_of_outliers_and_of_the_bodys_motion(mm: float) -> None:
    rng = np.random.default_rng(0)
    errors = rng.normal(0.0, 10.0, (FRAMES, 17, 2))
    gross = rng.random((FRAMES, 17)) < 0.05
    errors[gross] = rng.uniform(-300.0, 300.0, (FRAMES, 17, 2))[gross]
    model = model_of(errors, mm)
    assert model.noise_mm == pytest.approx(11.0, abs=1.0)
    assert model.fresh_share > 0.9


def test_noise_that_lasts_is_told_from_fresh_noise_and_counts_for_more_than_its_steps() -> None:
    model = model_of(lasting(12.0, 0.1))
    assert model.fresh_share < 0.45
    assert 9.0 < model.noise_mm < 13.0, "its steps alone have 7 mm"


def test_noise_that_lasts_counts_for_less_than_fresh_noise_of_the_same_size() -> None:
    rng = np.random.default_rng(0)
    models = {"lasting": model_of(lasting(12.0, 0.1)), "fresh": model_of(rng.normal(0.0, 12.0, (FRAMES, 17, 2)))}
    worth = {name: model.information[..., 0].mean() * model.noise_mm**2 for name, model in models.items()}
    assert worth["fresh"] == pytest.approx(1.0)
    assert worth["lasting"] == pytest.approx(0.3, abs=0.05)
    assert model_of(np.full((FRAMES, 17, 2), 8.0)).information[0, 0, 0] == pytest.approx(LiftedConfig().noise_mm ** -2)


def test_a_lifter_that_errs_evenly_does_not_make_exact_keypoints_noisy() -> None:
    model = model_of(np.full((FRAMES, 17, 2), 8.0))
    assert model.noise_mm == LiftedConfig().noise_mm
    assert model.fresh_share < 0.05


def test_a_single_frame_has_the_least_noise() -> None:
    keypoints = Keypoints2D(places()[:1])
    assert window_model(keypoints, places()[:1] + 50.0, 1.0, FPS, LiftedConfig()).noise_mm == LiftedConfig().noise_mm


def test_seen_joints_follow_the_keypoints_and_unseen_ones_the_lifter_where_noise_is_fresh() -> None:
    joints = 1000.0 * simulate_person(np.arange(96) / FPS, "walk", 1, 1.75, BODY_17)
    true = joints[..., [1, 2, 0]] * np.array([1.0, -1.0, 1.0])
    prior = true + np.array([20.0, 0.0, 0.0])
    lifted = LiftedMotion(prior, np.full((96, 17, 2), 10.0), np.full((96, 2), 0.5))
    flat = true[..., :2] + np.random.default_rng(0).normal(0.0, 10.0, (96, 17, 2))
    flat[:, WRIST] = np.nan
    model = window_model(Keypoints2D(flat), prior[..., :2], 1.0, FPS, LiftedConfig())

    def drawn(fresh_share: float) -> np.ndarray:
        """(17,) mm by which the lifter draws the joints to its side."""
        found = solve_signs_and_adjust(replace(model, fresh_share=fresh_share), flat, lifted, None, 5, None)
        out: np.ndarray = (found.joints - true)[..., 0].mean(axis=0)
        return out

    lasting_noise, fresh_noise = drawn(0.3), drawn(1.0)
    others = np.arange(17) != WRIST
    assert fresh_noise[others].mean() < 0.5 * lasting_noise[others].mean()
    assert fresh_noise[WRIST] > 0.5 * lasting_noise[WRIST]


class Watched(Lifter):
    """The shipped lifter; keeps what it was shown."""

    def __init__(self) -> None:
        super().__init__(Lifter.load().network)
        self.shown: list[np.ndarray] = []

    def lift(self, seen: LifterInput, fps: float = FPS):  # type: ignore[no-untyped-def]
        self.shown.append(seen.keypoints)
        return super().lift(seen, fps)


def test_the_second_look_does_not_see_a_keypoint_that_is_alone_far_from_its_place() -> None:
    joints = 1000.0 * simulate_person(np.arange(96) / FPS, "walk", 1, 1.75, BODY_17)
    flat = joints[..., [1, 2]] * np.array([1.0, -1.0])
    flat[40, WRIST] += 250.0
    lifter = Watched()
    measure_size(EvenView(Keypoints2D(flat), FPS, None, None), LiftedConfig(), lifter, None)
    first, second = (np.isnan(seen[..., 0]) for seen in lifter.shown)
    assert not first.any()
    assert second[40, WRIST]
    assert second.sum() == 1


def test_a_keypoint_that_stays_far_from_its_place_is_seen() -> None:
    place = places()
    flat = place.copy()
    flat[:, WRIST] += 250.0
    flat[7, WRIST] = np.nan
    believed = without_outliers(flat, place, 2.0, LiftedConfig())
    np.testing.assert_array_equal(np.isnan(believed), np.isnan(flat))
