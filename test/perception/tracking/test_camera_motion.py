"""Motion of the image by the camera's own, and persons who follow it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from drocap_ros.perception.background_tracks import BackgroundTracks
from drocap_ros.perception.tracking.camera_motion import CameraMotion, moved_box, sweeps
from drocap_ros.perception.tracking.person import BoxFilter
from drocap_ros.perception.tracking.pose_estimator_config import PoseEstimatorConfig
from drocap_ros.perception.tracking.subject import SubjectTracker

SIZE = (640, 360)
STEP_NS = 50_000_000
PERSON = np.array([[280.0, 120.0, 340.0, 270.0]])


@pytest.fixture(scope="module")
def ground():
    """Grass and stones, several images wide."""
    rng = np.random.default_rng(0)
    picture = np.full((1400, 2400), 120, np.float32)
    for size, contrast in ((8, 12), (24, 12), (96, 14)):
        coarse = rng.normal(size=(1400 // size + 2, 2400 // size + 2)).astype(np.float32)
        picture += contrast * cv2.resize(coarse, (2400, 1400), interpolation=cv2.INTER_CUBIC)
    return np.repeat(np.clip(picture, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def view(ground, matrix, blur=0):
    """Image of a camera whose pixels are (2, 3) ``matrix`` times those of the ground."""
    image = cv2.warpAffine(ground, matrix, SIZE, borderMode=cv2.BORDER_REFLECT)
    return cv2.blur(image, (blur, 1)) if blur else image


def camera(x=-700.0, y=-500.0, degrees=0.0, zoom=1.0):
    turn = zoom * np.array([[np.cos(a := np.radians(degrees)), -np.sin(a)], [np.sin(a), np.cos(a)]])
    return np.column_stack([turn, [x, y]])


class Motion:
    """The camera's motion over images, from the points that are followed in them."""

    def __init__(self):
        self.points, self.camera, self.images = BackgroundTracks(), CameraMotion(), 0

    def update(self, image, persons):
        last = self.points.points
        found = self.camera.update(last, self.points.follow(image), image.shape[1::-1])
        self.points.renew(persons, self.images * STEP_NS)
        self.images += 1
        return found


def apart(found, first, second):
    """Largest error (px) of a motion between two cameras, in the corners of the image."""
    corners = np.array([[0, 0], [SIZE[0], 0], [0, SIZE[1]], SIZE], float)
    on_ground = (corners - first[:, 2]) @ np.linalg.inv(first[:, :2]).T
    expected = on_ground @ second[:, :2].T + second[:, 2]
    return np.linalg.norm(corners @ found[:, :2].T + found[:, 2] - expected, axis=1).max()


@pytest.mark.parametrize(
    ("change", "blur"),
    [
        ({"x": -664.0, "y": -492.0}, 0),
        ({"x": -630.0, "y": -510.0}, 25),
        ({"x": -705.0, "degrees": 2.0, "zoom": 1.02}, 0),
    ],
    ids=["pan", "fast pan, blurred", "turn and zoom"],
)
def test_the_motion_of_the_ground_is_found(ground, change, blur):
    motion = Motion()
    first, second = camera(), camera(**change)
    assert motion.update(view(ground, first, blur), PERSON) is None
    found = motion.update(view(ground, second, blur), PERSON)
    assert found is not None
    assert apart(found, first, second) < 2.0


def test_a_person_who_fills_half_the_image_is_not_the_ground(ground):
    motion = Motion()
    box = np.array([[160.0, 0.0, 520.0, 360.0]])
    cameras = camera(), camera(x=-715.0)
    for i in range(2):
        image = view(ground, cameras[i])
        image[:, 160:520] = ground[300:660, 900 + 20 * i : 1260 + 20 * i]
        found = motion.update(image, box)
    assert found is not None
    assert apart(found, *cameras) < 2.0


def test_small_motions_add_up(ground):
    motion = Motion()
    found = [motion.update(view(ground, camera(x=-700.0 - 2 * i)), PERSON) for i in range(10)]
    steps = [(i, matrix) for i, matrix in enumerate(found) if matrix is not None]
    assert [i for i, _ in steps] == [4, 8]
    for _, matrix in steps:
        assert apart(matrix, camera(), camera(x=-708.0)) < 1.0


def test_after_a_reset_small_motions_add_up_anew(ground):
    motion = Motion()
    found = []
    for i in range(8):
        if i == 3:
            motion.camera.reset()
        found.append(motion.update(view(ground, camera(x=-700.0 - 2 * i)), PERSON))
    assert [i for i, matrix in enumerate(found) if matrix is not None] == [6]


def test_what_does_not_show_the_motion_gives_none(ground):
    motion = Motion()
    grey = np.full((SIZE[1], SIZE[0], 3), 128, np.uint8)
    assert [motion.update(grey, PERSON) for _ in range(2)] == [None, None]
    assert motion.update(view(ground, camera()), PERSON) is None  # a cut
    assert motion.update(view(ground, camera(x=-1500.0)), PERSON) is None  # nothing in common
    assert motion.update(view(ground, camera())[:180, :320].copy(), PERSON) is None  # another size


def test_a_filter_follows_the_image():
    matrix = camera(30.0, -10.0, 3.0, 1.1)
    found = BoxFilter(PERSON[0], 0)
    found.move_camera(matrix)
    np.testing.assert_allclose(found.box(), moved_box(matrix, PERSON[0]), atol=1e-9)
    found.predict(STEP_NS)
    np.testing.assert_allclose(found.box(), moved_box(matrix, PERSON[0]), atol=1e-9)


@pytest.mark.parametrize("known", [True, False])
def test_a_shaken_camera_keeps_its_subject_by_the_known_motion_alone(known):
    tracker = SubjectTracker(PoseEstimatorConfig(on_loss="wait"))
    rng, last, followed = np.random.default_rng(3), 0.0, []
    for i in range(40):
        shake = rng.uniform(-150, 150) if i >= 10 else 0.0
        x = 320 + shake
        image = np.full((SIZE[1], SIZE[0], 3), 128, np.uint8)
        image[100:240, int(x - 25) : int(x + 25)] = (40, 40, 200)
        if known:
            tracker.move_camera(camera(shake - last, 0.0))
        last = shake
        subject = tracker.update(image, i * STEP_NS, np.array([[x - 25, 100, x + 25, 240]]), np.array([0.8]))
        followed.append(subject is not None and subject.score > 0 and abs(subject.box[[0, 2]].mean() - x) < 5)
    assert all(followed) == known


@pytest.mark.parametrize(("way", "blurred"), [((0.0, 0.0), False), ((30.0, 15.0), False), ((30.0, -30.0), True)])
def test_way_of_a_quarter_of_the_person_blurs_it(way, blurred):
    matrix = np.column_stack([np.eye(2), way])
    assert sweeps(matrix, PERSON[0]) == blurred  # 150 px long
    assert not sweeps(None, PERSON[0])


@pytest.mark.parametrize("size", [(1, 5000), (5000, 2), (3, 961), (1, 1)])
def test_image_of_a_few_rows_has_no_motion(size):
    motion = Motion()
    for _ in range(2):
        assert motion.update(np.zeros((*size, 3), np.uint8), PERSON) is None
