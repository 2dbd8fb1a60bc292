"""Patches are found again where they are, however the view of them has changed."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from drocap_ros.perception.background_tracks import patches_at

POINTS = np.array([[60.0, 50], [100, 70], [140, 50], [80, 110], [120, 100]], np.float32)


@pytest.fixture(scope="module")
def picture():
    rng = np.random.default_rng(5)
    coarse = rng.normal(128, 60, (40, 50)).clip(0, 255).astype(np.float32)
    return cv2.resize(coarse, (200, 160), interpolation=cv2.INTER_CUBIC).clip(0, 255).astype(np.uint8)


def test_the_place_is_found_from_half_a_px_beside(picture):
    patches = patches_at(picture, POINTS)
    place, alike = patches.align(picture, POINTS + np.float32([0.4, -0.3]))
    assert np.linalg.norm(place - POINTS, axis=1).max() < 0.05
    assert alike.min() > 0.95


@pytest.mark.parametrize("exposure", [1.0, 0.6])
def test_a_view_that_turns_nears_and_tilts_is_followed(picture, exposure):
    patches, place = patches_at(picture, POINTS), POINTS
    for step in range(1, 16):
        angle, zoom = np.radians(1.0 * step), 1.01**step
        turn = zoom * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        turn = turn @ np.diag([1.0, 0.99**step])
        matrix = np.column_stack([turn, np.array([100.0, 80]) - turn @ [100.0, 80] + [0.3 * step, 0.2 * step]])
        view = (exposure * cv2.warpAffine(picture, matrix, (200, 160), borderMode=cv2.BORDER_REFLECT)).astype(np.uint8)
        place, alike = patches.align(view, place)
    expected = POINTS @ matrix[:, :2].T + matrix[:, 2]
    error = np.linalg.norm(place - expected, axis=1)
    assert np.median(error) < 0.07
    assert error.max() < 0.2
    assert alike.min() > 0.95


def test_what_covers_a_patch_is_not_alike(picture):
    patches = patches_at(picture, POINTS)
    _, alike = patches.align(np.ascontiguousarray(picture[::-1, ::-1]), POINTS)
    assert alike.max() < 0.6


def test_patches_of_one_grey_value_stay(picture):
    flat = np.full_like(picture, 90)
    place, alike = patches_at(flat, POINTS).align(flat, POINTS)
    np.testing.assert_allclose(place, POINTS, atol=1e-3)
    assert (alike < 0.6).all()


def test_a_part_of_the_patches_joined_to_more_or_exchanged(picture):
    patches = patches_at(picture, POINTS)
    some = patches[np.array([True, False, True, False, False])] + patches_at(picture, POINTS[3:4])
    assert len(some) == 3
    points = POINTS[[0, 2, 3]]
    assert some.align(picture, points)[1].min() > 0.99
    some.replace(np.array([False, True, False]), patches_at(picture, POINTS[4:]))
    assert some.align(picture, POINTS[[0, 4, 3]])[1].min() > 0.99


def test_no_patches_are_no_error(picture):
    place, alike = patches_at(picture, POINTS[:0]).align(picture, POINTS[:0])
    assert place.shape == (0, 2)
    assert alike.shape == (0,)
