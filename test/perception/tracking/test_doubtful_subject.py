"""Tracker and poses: what has no believable joints is not followed on, and someone in view may be the subject."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from test_subject_tracking import BLUE, RED, SIZE, STEP, Scene, offset

from drocap_ros.perception.pose.body_pose import shadow_share, without_shadow
from drocap_ros.perception.tracking.other_poses import due_bystanders
from drocap_ros.perception.tracking.person import PoseBelief
from drocap_ros.perception.tracking.pose_estimator_config import PoseEstimatorConfig
from drocap_ros.perception.tracking.search import SubjectSearch

SECOND = 1_000_000_000


def box_of(x: float, y: float, height: float) -> np.ndarray:
    return np.array([x - 0.2 * height, y - height / 2, x + 0.2 * height, y + height / 2])


def drawn(persons) -> np.ndarray:
    image = np.full((SIZE[1], SIZE[0], 3), 128, np.uint8)
    for x, y, height, (shirt, trousers) in persons:
        x0, y0, x1, y1 = box_of(x, y, height).astype(int)
        image[y0:y1, x0:x1] = trousers
        image[y0 : int(y), x0:x1] = shirt
    return image


def judged(scene: Scene, confidence: float, subject) -> None:
    scene.tracker.judge(confidence, subject.box, (scene.index - 1) * STEP)


def test_given_box_obeys_on_loss_next():
    scene = Scene(subject="box", subject_box="270,100,330,260", on_loss="next")
    for t in range(60):
        scene.show([(300 + 8 * t, 180, 160, RED)])
    after = [scene.show([(40 + 4 * t, 180, 160, BLUE)]) for t in range(12)]
    assert after[-1].track_id == 2
    assert offset(after[-1], 84) < 10


def test_given_box_obeys_on_loss_wait():
    scene = Scene(subject="box", subject_box="270,100,330,260", on_loss="wait")
    for t in range(60):
        scene.show([(300 + 8 * t, 180, 160, RED)])
    assert {scene.show([(40 + 3 * t, 180, 160, BLUE)]) for t in range(150)} == {None}


def test_drone_box_obeys_on_loss_next_and_without_any_box_nobody_is_chosen():
    scene = Scene(subject="roi", on_loss="next")
    assert {scene.show([(300, 180, 160, RED)]) for _ in range(20)} == {None}
    first = scene.show([(300, 180, 160, RED)], roi=box_of(300, 180, 160))
    assert first.track_id == 1
    after = [scene.show([(60, 200, 150, BLUE)]) for _ in range(200)]
    assert after[-1].track_id == 2


def test_subject_that_slid_to_a_shadow_goes_back_to_the_person_in_view():
    scene = Scene()
    person = (300, 180, 160, RED)
    for _ in range(20):
        judged(scene, 0.9, scene.show([person]))
    # The detector sees nothing but the shadow beside the person for some images, then both.
    shadow = box_of(360, 190, 150)
    for _ in range(8):
        subject = scene.show([person], detections=[(shadow, 0.6)])
        judged(scene, 0.3, subject)
    both = [(shadow, 0.6), (box_of(300, 180, 160), 0.7)]
    subject = scene.show([person], detections=both)
    judged(scene, 0.9, subject)
    for _ in range(10):
        subject = scene.show([person], detections=both)
        judged(scene, 0.9, subject)
        assert offset(subject, 300) < 20
        assert subject.track_id == 1
        assert not subject.hidden


def test_bystander_is_judged_once_under_load_shedding_and_is_not_the_subject():
    scene, persons, poses = Scene(), [(300, 180, 160, RED), (400, 180, 160, RED)], 0
    for _ in range(40):
        judged(scene, 0.9, scene.show(persons))
        stamp = (scene.index - 1) * STEP
        for bystander in due_bystanders(scene.tracker, stamp, shedding=True)[:1]:
            poses += 1
            scene.tracker.judge_bystander(bystander, 0.9, stamp)
    assert poses == 1
    assert len(scene.tracker.subject.others) == 1


def test_doubted_subject_is_searched_over_the_whole_picture_after_a_second():
    scene = Scene()
    search, seen = SubjectSearch(None, scene.tracker, PoseEstimatorConfig()), []
    for confidence in [0.9] * 20 + [0.2] * 60:
        seen.append(search.windows((1920, 1080), scene.index * STEP, single=False, close=False))
        judged(scene, confidence, scene.show([(300, 180, 160, RED)]))
    del seen[:20]
    assert all(len(windows) <= 2 for windows in seen)  # bounded in every image
    early, late = seen[:25], seen[35:60]
    assert sum(len(windows) > 1 for windows in early) <= 2  # the usual interval
    assert all(len(windows) == 2 for windows in late)
    others = {window for windows in late for window in windows[1:]}
    assert None in others
    assert len(others) > 4  # tiles as well


def test_refuted_subject_is_lost_and_its_person_in_view_is_the_same():
    scene = Scene()
    person = (200, 180, 160, RED)
    for _ in range(20):
        judged(scene, 0.9, scene.show([person]))
    tree = box_of(330, 180, 170)
    states = []
    for _ in range(120):  # the track slid onto a tree, the person stays undetected
        subject = scene.show([person], detections=[(tree, 0.6)])
        states.append(subject)
        if subject is not None:
            judged(scene, 0.15, subject)
    assert states[-1] is None
    back = [scene.show([person], detections=[(tree, 0.6), (box_of(200, 180, 160), 0.7)]) for _ in range(10)]
    assert back[-1] is not None
    assert back[-1].track_id == 1
    assert offset(back[-1], 200) < 15


def test_track_is_questioned_after_a_second_and_refuted_after_more():
    belief = PoseBelief(np.array([0.0, 0, 10, 20]), 0)
    box = box_of(100, 100, 80)
    assert belief.believed
    for i in range(10):
        belief.judge(0.9, box, i * SECOND // 10)
    assert belief.believed
    states = []
    for i in range(10, 50):
        belief.judge(0.2, box + 50, i * SECOND // 10)
        states.append((belief.believed, belief.questioned, belief.refuted))
    assert states[5] == (False, False, False)
    assert states[12] == (False, True, False)
    assert states[30] == (False, True, True)
    assert belief.plausible_ns is None
    np.testing.assert_array_equal(belief.box, box)  # the last certain place stays
    belief.judge(0.8, box + 50, 5 * SECOND)
    assert belief.believed
    assert belief.plausible_ns == 5 * SECOND


def test_persons_seen_badly_from_the_start_are_believed_at_their_usual_confidence():
    belief = PoseBelief(np.array([0.0, 0, 10, 20]), 0)
    for i in range(100):
        belief.judge(0.55, box_of(100, 100, 40), i * SECOND // 10)
    assert belief.believed
    assert not belief.questioned


@pytest.mark.parametrize("ground", [(60, 115, 85), (112, 112, 115), (205, 205, 200)])
def test_shadow_is_the_ground_but_darker(ground):
    rng = np.random.default_rng(0)
    image = np.clip(np.array(ground) + rng.normal(0, 6, (200, 300, 3)), 0, 255)
    box = np.array([120.0, 40, 160, 160])
    image[50:150, 128:152] *= 0.48
    shadow = image.astype(np.uint8)
    person = shadow.copy()
    person[50:100, 128:152] = (40, 40, 200)
    person[100:150, 128:152] = (90, 40, 30)
    assert shadow_share(shadow, box) > 0.8
    assert shadow_share(person, box) < 0.2
    assert without_shadow(0.6, shadow, box) < 0.5 < without_shadow(0.6, person, box)


def test_empty_ground_and_cut_boxes_are_no_shadow():
    image = np.full((100, 100, 3), 120, np.uint8)
    assert shadow_share(image, np.array([20.0, 20, 60, 90])) == 0.0
    assert shadow_share(image, np.array([95.0, 95, 140, 180])) == 0.0
    assert shadow_share(image, np.array([0.0, 0, 100, 100])) == 0.0


def search(scene: Scene, confidence: dict[int, float]) -> bool:
    """Judge the person that is due in the last image; whether its pose re-identifies the subject in that image.

    confidence : of the poses, by the rounded centre's x
    """
    stamp = (scene.index - 1) * STEP
    for person in due_bystanders(scene.tracker, stamp)[:1]:
        x = round(float(person.box[[0, 2]].mean()))
        scene.tracker.judge_bystander(person, confidence[x], stamp)
    return scene.tracker.current(stamp) is not None


def lost_subject() -> Scene:
    scene = Scene()
    for _ in range(20):
        judged(scene, 0.9, scene.show([(300, 180, 160, RED)]))
    for _ in range(60):
        scene.show([])
    return scene


def test_subject_that_comes_out_of_cover_is_found_in_the_image_of_its_first_certain_pose():
    scene = lost_subject()
    leaves = (340, 280, 160, ((40, 90, 60), (40, 90, 60)))  # over the legs: the appearance alone is not enough
    found = []
    for pose in (0.55, 0.55, 0.6, 0.65, 0.8):  # more joints are free in every image; the first one starts the track
        detections = [(box_of(340, 180, 160), 0.8)]
        assert scene.show([(340, 180, 160, RED), leaves], detections=detections) is None
        found.append(search(scene, {340: pose}))
    assert found == [False, False, False, False, True]


def test_person_before_leaves_that_were_found_to_be_none_starts_a_track():
    scene = lost_subject()
    leaves = box_of(330, 180, 240)
    for _ in range(20):
        scene.show([], detections=[(leaves, 0.5)])
        search(scene, {330: 0.1})
    person = (335, 190, 150, RED)
    for _ in range(4):
        subject = scene.show([person], detections=[(leaves, 0.5), (box_of(335, 190, 150), 0.6)])
        if subject is not None or search(scene, {330: 0.1, 335: 0.9}):
            break
    else:
        pytest.fail("the person was not found")
    assert scene.tracker.persons
    assert offset(scene.tracker.predict((scene.index - 1) * STEP) or scene.show([person]), 335) < 15


def test_person_who_comes_into_view_in_blurred_images_is_found_by_its_appearance():
    scene = lost_subject()
    found = []
    for t in range(8):  # the pan takes the joints from the pose, the colours stay
        subject = scene.show([(300 + t, 180, 160, RED)])
        stamp = (scene.index - 1) * STEP
        for person in due_bystanders(scene.tracker, stamp)[: subject is None]:
            scene.tracker.judge_bystander(person, 0.32, stamp, blurred=True)
        found.append(scene.tracker.current(stamp) is not None)
    assert found[-1]
    assert scene.show([(308, 180, 160, RED)]).track_id == 1


def test_weak_pose_in_a_blurred_image_says_nothing_and_a_certain_one_counts():
    belief = PoseBelief(np.array([0.0, 0, 10, 20]), 0)
    box = box_of(100, 100, 80)
    belief.judge(0.3, box, SECOND, blurred=True)
    assert belief.judged_ns == SECOND
    assert belief.plausible_ns == 0
    assert np.isnan(belief.last)
    belief.judge(0.8, box, 2 * SECOND, blurred=True)
    assert (belief.value, belief.believed_ns) == (0.8, 2 * SECOND)
    sharp = PoseBelief(np.array([0.0, 0, 10, 20]), 0)
    sharp.judge(0.3, box, SECOND)
    assert sharp.plausible_ns is None


def seen_together(colours) -> Scene:
    """Subject and someone else are in view, then both go out of view, the other one a second later."""
    scene = Scene()
    for _ in range(30):
        judged(scene, 0.9, scene.show([(300, 180, 160, RED), (500, 180, 160, colours)]))
        stamp = (scene.index - 1) * STEP
        for other in due_bystanders(scene.tracker, stamp)[:1]:
            scene.tracker.judge_bystander(other, 0.9, stamp)
    for _ in range(60):
        scene.show([(500, 180, 160, colours)])
    for _ in range(18):
        scene.show([])
    return scene


def test_subject_that_comes_out_where_someone_else_went_in_is_found():
    scene = seen_together(BLUE)
    shown = [scene.show([(490 + 2 * t, 180, 160, RED)]) for t in range(8)]
    assert shown[-1] is not None
    assert shown[-1].track_id == 1
    assert offset(shown[-1], 504) < 15


def test_someone_else_who_comes_out_again_is_not_the_subject():
    scene = seen_together(BLUE)
    assert {scene.show([(490 + 2 * t, 180, 160, BLUE)]) for t in range(8)} == {None}


@pytest.mark.parametrize("on_loss", ["wait", "next"])
@pytest.mark.parametrize("seed", range(12))
def test_clutter_that_was_taken_for_a_person_does_not_keep_the_person_away(seed, on_loss):
    """Its first poses are believable by chance; the person comes into view before, with or after it."""
    rng = np.random.default_rng(seed)
    scene, came, chance, height = Scene(on_loss=on_loss), rng.integers(0, 30), rng.integers(1, 4), rng.uniform(80, 160)
    clutter, there, taken = (450, 180, 1.3 * height), (200, 180, height, RED), []
    for i in range(60 + came):
        persons = [there] if i >= came else []
        boxes = [(box_of(*clutter), rng.uniform(0.35, 0.6))] if i >= 10 else []
        boxes += [(box_of(*there[:3]) + rng.normal(0, 1, 4), rng.uniform(0.36, 0.7)) for _ in persons]
        subject, stamp = scene.show(persons, detections=boxes), scene.index * STEP - STEP
        poses = {
            450.0: rng.uniform(0.51, 0.65) if i < 10 + chance else rng.uniform(0.1, 0.45),
            200.0: rng.normal(0.8, 0.06),
        }
        if subject is not None and subject.score > 0:
            judged(scene, poses[450.0 if offset(subject, 450) < 50 else 200.0], subject)
        for other in due_bystanders(scene.tracker, stamp)[:2]:
            scene.tracker.judge_bystander(other, poses[450.0 if other.box[0] > 300 else 200.0], stamp)
        taken.append(subject is not None and offset(subject, 200) < 20)
    assert all(taken[-20:])
    assert all(later or not before for before, later in pairwise(taken))  # never left again


@pytest.mark.parametrize("other", ["shadow", "person"])
@pytest.mark.parametrize("seed", range(10))
def test_somebody_whose_shadow_was_chosen_is_chosen_instead_and_nobody_who_stands_beside(seed, other):
    """Poses on a shadow are nearly as believable as the person's, at first."""
    rng = np.random.default_rng(seed)
    scene, height, side = Scene(), rng.uniform(60, 140), rng.choice([-1, 1])
    x = 300 + side * 0.3 * height
    chosen, beside = (300, 180, 1.12 * height, BLUE), (x, 180, height, RED)
    ids = []
    for i in range(90):
        boxes = [(box_of(*who[:3]) + rng.normal(0, 1, 4), rng.uniform(0.4, 0.7)) for who in (chosen, beside)]
        subject, stamp = scene.show([chosen, beside], detections=boxes), scene.index * STEP - STEP
        poses = [rng.normal(0.82 if other == "person" or i < 3 else 0.66, 0.06), rng.normal(0.83, 0.06)]

        def nearest(box):
            return int(abs(box[[0, 2]].mean() - x) < abs(box[[0, 2]].mean() - 300))

        if subject is not None:
            judged(scene, poses[nearest(subject.box)], subject)
            ids.append(nearest(subject.box))
        for bystander in due_bystanders(scene.tracker, stamp)[:2]:
            scene.tracker.judge_bystander(bystander, poses[nearest(bystander.box)], stamp)
    if other == "shadow":
        assert set(ids[60:]) == {1}
    assert sum(a != b for a, b in pairwise(ids)) <= (other == "shadow")
