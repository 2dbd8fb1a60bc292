"""Fixed points of the scene, followed through images of a known camera."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from drocap_ros.perception.background_tracks import BackgroundTracks

SIZE = (640, 360)
STEP_NS = 100_000_000
NOBODY: list[np.ndarray] = []


@pytest.fixture(scope="module")
def ground():
    """Grass and stones, several images wide."""
    rng = np.random.default_rng(1)
    picture = np.full((1000, 1600), 120, np.float32)
    for size, contrast in ((6, 10), (16, 14), (64, 14)):
        coarse = rng.normal(size=(1000 // size + 2, 1600 // size + 2)).astype(np.float32)
        picture += contrast * cv2.resize(coarse, (1600, 1000), interpolation=cv2.INTER_CUBIC)
    return np.repeat(np.clip(picture, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def camera(step):
    """(2, 3) ground -> image of a drone that flies, turns by 0.4 degrees and nears by 0.2 % each step."""
    angle, zoom = np.radians(0.4 * step), 1.002**step
    turn = zoom * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return np.column_stack([turn, np.array([320.0, 180]) - turn @ [800.0 + 5 * step, 500 + 2 * step]])


def view(ground, step, size=SIZE):
    scale = size[0] / SIZE[0]
    return cv2.warpAffine(ground, scale * camera(step), size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)


def on_ground(points, step, scale=1.0):
    """(N, 2) px -> the ground's coordinates, as ``view`` shows them."""
    matrix = scale * camera(step)
    return (points - matrix[:, 2]) @ np.linalg.inv(matrix[:, :2]).T


def followed(images, persons=NOBODY):
    tracker = BackgroundTracks()
    seen = []
    for i, image in enumerate(images):
        tracker.follow(image)
        seen.append(tracker.renew(persons, i * STEP_NS))
    return seen


@pytest.mark.parametrize("scale", [1.0, 2.5], ids=["small", "halved"])
def test_points_stay_where_they_are_in_the_scene(ground, scale):
    size = (round(SIZE[0] * scale), round(SIZE[1] * scale))
    seen = followed(view(ground, i, size) for i in range(25))
    first, last = seen[0], seen[-1]
    both, i, j = np.intersect1d(first.track, last.track, return_indices=True)
    assert len(both) > 0.4 * len(first)
    drift = scale * np.linalg.norm(on_ground(last.point[j], 24, scale) - on_ground(first.point[i], 0, scale), axis=1)
    assert np.median(drift) < 0.1 * scale
    assert np.quantile(drift, 0.9) < 0.3 * scale


def test_faint_ground_with_little_else_is_followed(ground):
    faint = cv2.GaussianBlur(ground, (0, 0), 1.5).astype(np.float32)
    faint = np.clip(np.round(120 + 0.35 * (faint - 120)), 0, 255).astype(np.uint8)
    seen = followed(view(faint, i) for i in range(10))
    first, last = seen[0], seen[-1]
    both, i, j = np.intersect1d(first.track, last.track, return_indices=True)
    assert len(first) >= 80
    assert len(both) > 0.4 * len(first)
    assert np.median(np.linalg.norm(on_ground(last.point[j], 9) - on_ground(first.point[i], 0), axis=1)) < 0.3


def test_points_are_spread_over_the_image_and_their_number_is_bounded(ground):
    seen = followed(view(ground, i) for i in range(8))
    for points in seen:
        assert 120 <= len(points) <= 160
        parts = np.histogram2d(*points.point.T, bins=3, range=[[0, SIZE[0]], [0, SIZE[1]]])[0]
        assert parts.min() >= 8
        assert len(np.unique(points.track)) == len(points)


def test_no_point_lies_on_a_person_at_the_feet_or_where_there_is_no_texture(ground):
    sky = np.linspace(200, 230, 120)[:, None, None].astype(np.uint8)
    box = np.array([300.0, 150, 360, 300])
    images = []
    for i in range(6):
        image = view(ground, i)
        image[:120] = sky
        images.append(image)
    for points in followed(images, [box]):
        x, y = points.point.T
        assert len(points) > 50
        assert not ((x > 290) & (x < 370) & (y > 140) & (y < 320)).any()
        assert not (y < 110).any()


def test_a_point_that_something_covers_ends(ground):
    images = [view(ground, i) for i in range(6)]
    for image in images[3:]:
        image[100:260, 200:440] = ground[100:260, 200:440][::-1, ::-1]
    seen = followed(images)
    x, y = seen[2].point.T
    covered = seen[2].track[(x > 220) & (x < 420) & (y > 120) & (y < 240)]
    assert len(covered) > 5
    assert np.isin(covered, seen[3].track).mean() < 0.2


def test_a_cut_ends_all_tracks_and_no_number_comes_again(ground):
    images = [view(ground, i) for i in range(3)]
    seen = followed([*images, *(np.ascontiguousarray(image[::-1, ::-1]) for image in images)])
    assert len(seen[3]) > 100
    assert not np.isin(seen[3].track, np.concatenate([points.track for points in seen[:3]])).any()


def test_a_fast_pan_is_followed(ground):
    images = [
        cv2.warpAffine(ground, np.array([[1.0, 0, -x], [0, 1, -300]]), SIZE, flags=cv2.INTER_LINEAR) for x in (200, 400)
    ]
    before, after = followed(images)
    both, i, j = np.intersect1d(before.track, after.track, return_indices=True)
    assert len(both) > 60
    np.testing.assert_allclose(np.median(after.point[j] - before.point[i], axis=0), [-200, 0], atol=0.1)


def test_equal_images_give_equal_tracks_and_a_reset_begins_anew(ground):
    images = [view(ground, i) for i in range(4)]
    for one, other in zip(followed(images), followed(images), strict=True):
        assert np.array_equal(one.track, other.track)
        assert np.array_equal(one.point, other.point)
    tracker = BackgroundTracks()
    tracker.follow(images[0])
    first = tracker.renew(NOBODY, 0)
    tracker.reset()
    assert len(tracker.follow(images[1])) == 0
    assert not np.isin(tracker.renew(NOBODY, STEP_NS).track, first.track).any()


def test_images_of_another_size_begin_anew(ground):
    image = view(ground, 0)
    small = np.ascontiguousarray(image[:180, :320])
    seen = followed([image, small])
    assert not np.isin(seen[1].track, seen[0].track).any()
    assert (seen[1].point < [320, 180]).all()


@pytest.mark.parametrize("size", [(1, 5000), (5000, 2), (3, 961), (1, 1), (30, 30)])
def test_images_of_a_few_rows_and_of_one_colour_have_no_points(size):
    assert [len(points) for points in followed([np.full((*size, 3), 90, np.uint8)] * 3)] == [0, 0, 0]
