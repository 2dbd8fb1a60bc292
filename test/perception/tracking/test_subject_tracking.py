"""Subject tracker on drawn persons with simulated detections."""

from __future__ import annotations

import numpy as np
import pytest

from drocap_ros.errors import ParameterError
from drocap_ros.perception.detection.detector import Detections
from drocap_ros.perception.tracking.association import assign, could_be
from drocap_ros.perception.tracking.other_poses import due_bystanders
from drocap_ros.perception.tracking.person import Person
from drocap_ros.perception.tracking.pose_estimator_config import PoseEstimatorConfig
from drocap_ros.perception.tracking.search import WIDE, SubjectSearch, tiles, uncut, window_around
from drocap_ros.perception.tracking.subject import SubjectTracker

SIZE = (640, 360)
RED, BLUE, GREEN = ((40, 40, 200), (30, 30, 90)), ((200, 60, 30), (20, 20, 20)), ((60, 180, 60), (200, 200, 200))
STEP = 33_333_333


class Scene:
    """Persons as coloured rectangles (shirt, trousers); later ones stand before earlier ones."""

    def __init__(self, **config) -> None:
        self.tracker = SubjectTracker(PoseEstimatorConfig(**config))
        self.rng = np.random.default_rng(0)
        self.index = 0

    def show(self, persons, unseen=(), scores=None, roi=None, detections=None):
        """Persons: (x centre, y centre, height, colours); returns the subject.

        detections : instead of the persons' boxes, (box, score) each
        """
        image = np.full((SIZE[1], SIZE[0], 3), 128, np.uint8)
        boxes = []
        for x, y, height, (shirt, trousers) in persons:
            width = 0.4 * height
            x0, x1, y0, y1 = (int(v) for v in (x - width / 2, x + width / 2, y - height / 2, y + height / 2))
            image[max(y0, 0) : max(y1, 0), max(x0, 0) : max(x1, 0)] = trousers
            image[max(y0, 0) : max(int(y), 0), max(x0, 0) : max(x1, 0)] = shirt
            boxes.append([x - width / 2, y - height / 2, x + width / 2, y + height / 2])
        image += self.rng.integers(0, 15, image.shape, np.uint8)  # of a camera: as much as a deviation of 4
        boxes = np.clip(np.array(boxes, float).reshape(-1, 4), 0, [*SIZE, *SIZE])
        seen = [i for i in range(len(persons)) if i not in unseen and boxes[i, 2] - boxes[i, 0] > 8]
        boxes = boxes[seen] + self.rng.normal(0, 1.0, (len(seen), 4))
        score = np.array([(scores or {}).get(i, 0.8) for i in seen])
        if detections is not None:
            boxes, score = (
                np.array([box for box, _ in detections], float).reshape(-1, 4),
                np.array([s for _, s in detections]),
            )
        stamp = self.index * STEP
        self.index += 1
        return self.tracker.update(image, stamp, boxes, score, roi)


def offset(subject, x: float, y: float = 180) -> float:
    return float(np.hypot((subject.box[0] + subject.box[2]) / 2 - x, (subject.box[1] + subject.box[3]) / 2 - y))


@pytest.mark.parametrize("front", [True, False], ids=["subject in front", "subject behind"])
@pytest.mark.parametrize("speed", [4.0, 9.0])
def test_subject_is_kept_through_a_crossing(front, speed):
    scene = Scene()
    ids = set()
    for t in range(int(440 / speed)):
        x, other = 100 + speed * t, 540 - speed * t
        subject_person, passer_by = (x, 180, 170, RED), (other, 180, 150, BLUE)
        hidden = abs(x - other) < 45
        if front:  # the detector sees the one in front only
            subject = scene.show([passer_by, subject_person], unseen=(0,) if hidden else ())
        else:
            subject = scene.show([subject_person, passer_by], unseen=(0,) if hidden else ())
        assert subject is not None
        ids.add(subject.track_id)
        if subject.score > 0:
            assert offset(subject, x) < 30, t
    assert ids == {1}
    assert subject.score > 0


def test_half_hidden_subject_takes_its_own_detection_when_the_cover_goes_away():
    # Boxes of real persons at 20 Hz: someone in front left only the subject's head free, and goes on to the left.
    whole, head = np.array([709.0, 342, 749, 463]), np.array([703.0, 343, 743, 390])
    subject, front = Person(head, 0.4, 0, None), Person(np.array([698.0, 355, 746, 471]), 0.7, 0, None)
    for person, box in ((subject, whole), (front, front.box)):
        person.pose.judge(0.9, box, 0)
    front.update(front.box, 0.7, 50_000_000)
    boxes = np.array([[720.0, 344, 749, 465], [691, 353, 740, 472]])
    for person in (subject, front):
        person.filter.predict(100_000_000)
    pairs = assign([subject, front], Detections(boxes, np.array([0.6, 0.7]), appearances=[None, None]))
    assert sorted(pairs) == [(0, 0), (1, 1)]


def test_detection_near_the_subject_is_not_a_person_from_far_away():
    # He somersaults; nobody has looked at her for 0.9 s.
    subject, other = (Person(np.array(box), 0.8, 0, None) for box in ([848.0, 214, 1051, 361], [345.0, 516, 606, 945]))
    for person in (subject, other):
        person.filter.predict(867_000_000)
    found = Detections(np.array([[898.0, 182, 1177, 481]]), np.array([0.54]), appearances=[None])
    assert assign([subject, other], found) == [(0, 0)]


def test_subject_that_fell_while_unseen_is_in_the_window_of_the_search():
    size, tracker = (1768, 994), SubjectTracker(PoseEstimatorConfig())
    search = SubjectSearch(None, tracker, PoseEstimatorConfig())
    image = np.full((size[1], size[0], 3), 128, np.uint8)
    none = np.empty((0, 4))

    def update(index, boxes):
        tracker.update(image, index * STEP, boxes, np.full(len(boxes), 0.8))
        for box in boxes:
            tracker.judge(0.9, box, index * STEP)

    def window(index, boxes):
        stamp_ns = index * STEP
        return search.sought_window(tracker.followed(stamp_ns), Detections(boxes, np.ones(len(boxes))), size, stamp_ns)

    # A man of 330 px; then he jumps, and is curled up in the last image that shows him.
    for t in range(20):
        update(t, np.array([[860.0, 100, 980, 430]]))
    curled = np.array([[840.0, 165, 1030, 335]])
    update(20, curled)
    update(21, none)
    assert window(22, curled) is None  # the window near him shows him
    update(22, none)
    x0, y0, x1, y1 = window(23, none)
    # He stretches, and falls by his own length.
    assert max(x0 - 880, y0 - 180) < 0 < min(x1 - 1000, y1 - 580)
    update(23, np.array([[880.0, 250, 1000, 570]]))
    assert window(24, none) is None


def test_second_box_of_the_subject_is_no_person_who_hides_it():
    scene = Scene()
    person = (340, 205, 250, RED)
    for _ in range(30):
        scene.show([person], detections=[((310, 75, 369, 335), 0.9)])
    # A detector in doubt about the extent, as the one for rendered images was.
    scene.show([person], detections=[((298, 61, 394, 344), 0.6), ((274, 74, 373, 354), 0.5)])
    for _ in range(3):
        scene.show([person], detections=[((303, 115, 370, 345), 0.8), ((280, 73, 375, 340), 0.6)])
    for _ in range(15):
        subject = scene.show([person], detections=[((304, 76, 378, 341), 0.9)])
        assert subject.score > 0
        assert not subject.hidden
    assert subject.track_id == 1


def test_person_seen_once_a_second_takes_no_further_box_at_the_place_of_the_subject():
    # Boxes of a man on a roof, whose window the detector searches, and of a woman who walks below.
    scene = Scene()
    man, man_and_roof = ((250, 27, 289, 159), 0.7), ((250, 27, 306, 190), 0.4)
    walk = {1: (504, 181, 560, 333), 2: (497, 181, 553, 333), 30: (380, 180, 420, 332), 60: (252, 180, 339, 333)}
    walk[90] = (136, 177, 216, 334)
    for t in range(91):
        further = [(walk[t], 0.8)] if t in walk else [man_and_roof] if 70 <= t < 75 else []
        scene.show([], detections=[man, *further])
        if t == 2:
            woman = next(p for p in scene.tracker.persons if p.box[0] > 400)
    assert woman in scene.tracker.persons
    assert woman.box.tolist() == list(walk[90])


def test_second_box_with_the_joints_of_the_subject_takes_nothing_from_it():
    # Boxes as in an orbit of rendered images in which the subject was lost for good.
    scene = Scene()

    def show(*boxes):
        subject = scene.show([(340, 180, 280, RED)], detections=boxes)
        stamp = (scene.index - 1) * STEP
        scene.tracker.judge(0.99, subject.box, stamp)
        for bystander in due_bystanders(scene.tracker, stamp)[:1]:
            scene.tracker.judge_bystander(bystander, 0.98, stamp, True)
        return subject

    for _ in range(20):
        show(((284, 40, 396, 320), 0.9))
    for t in range(16):
        first = (284 - 2 * min(t, 4), 30, 384 - 2 * min(t, 4), 320)
        show((first, 0.6), ((334, 90, 404, 315) if t < 2 else (330, 60, 394, 318), 0.8))
    for _ in range(40):
        subject = show(((330, 60, 394, 318), 0.9))
        assert subject is not None
        assert not subject.hidden
    assert subject.score == 0.9


def test_person_who_comes_out_from_behind_the_subject_is_someone_else():
    scene = Scene()
    for t in range(60):
        persons = [(300 + 3 * t, 180, 185, BLUE), (300, 180, 185, RED)]
        subject = scene.show(persons, unseen=(0,) if t < 10 else ())
        stamp = (scene.index - 1) * STEP
        scene.tracker.judge(0.99, subject.box, stamp)
        for bystander in due_bystanders(scene.tracker, stamp)[:1]:
            # Behind the subject the network finds the subject's joints.
            scene.tracker.judge_bystander(bystander, 0.9, stamp, 3 * t < 50)
    states = [scene.show([(300, 180, 185, RED), (474 - 6 * t, 180, 190, BLUE)], unseen=(0,)) for t in range(28)]
    assert states[-1].track_id == 1
    assert states[-1].hidden


def test_subject_behind_another_person_is_hidden():
    scene = Scene()
    for t in range(44):
        scene.show([(300, 180, 185, RED), (80 + 4 * t, 180, 180, BLUE)])
    states = [scene.show([(300, 180, 185, RED), (80 + 4 * t, 180, 180, BLUE)], unseen=(0,)) for t in range(44, 62)]
    assert [(s.track_id, s.score) for s in states] == [(1, 0.0)] * 18
    assert all(s.hidden for s in states[6:])  # from an overlap of a quarter on


def test_missing_detections_are_predicted():
    scene = Scene()
    for t in range(60):
        subject = scene.show([(100 + 5 * t, 180, 160, RED)], unseen=(0,) if t % 10 in (6, 7, 8) and t > 10 else ())
        assert subject is not None
        assert subject.track_id == 1
        assert offset(subject, 100 + 5 * t) < 25


def test_lost_subject_is_not_replaced_by_another_person():
    scene = Scene()
    for _ in range(20):
        scene.show([(150, 180, 160, RED), (500, 180, 150, BLUE)])
    after = [scene.show([(150 + 2 * t, 180, 160, BLUE)]) for t in range(120)]  # the other stands where the subject was
    assert after[-1] is None
    assert all(s is None or s.score == 0.0 for s in after)


def test_lost_subject_of_the_same_appearance_is_reidentified():
    scene = Scene()
    for _ in range(20):
        scene.show([(300, 180, 160, RED)])
    for _ in range(60):
        scene.show([])
    newcomers = [scene.show([(330, 180, 165, GREEN)]) for _ in range(10)]
    assert newcomers[-1] is None
    for _ in range(80):
        scene.show([])
    back = [scene.show([(340, 180, 160, RED)]) for _ in range(10)]
    assert back[-1] is not None
    assert back[-1].track_id == 1


def test_next_person_after_the_subject_left_has_a_new_track_id():
    scene = Scene(on_loss="next")
    for t in range(60):
        scene.show([(300 + 8 * t, 180, 160, RED)])
    assert scene.show([]) is None
    newcomers = [scene.show([(40 + 6 * t, 180, 160, RED)]) for t in range(10)]
    assert newcomers[-1].track_id == 2


@pytest.mark.parametrize(("shown", "waited"), [(10, False), (100, True)], ids=["a moment", "seconds"])
def test_a_subject_is_waited_for_as_long_as_it_was_followed_at_most(shown, waited):
    """Half a second, or more than it takes to give up; another one stands by: first it is seen, then it is chosen."""
    scene, bystander = Scene(on_loss="next"), (150, 180, 140, BLUE)
    for _ in range(shown):
        scene.show([(400, 180, 160, RED), bystander])
    after = [scene.show([bystander]) for _ in range(60)]
    assert (after[-1] is None) == waited


def leaves(colours, back):
    """The subject in red walks out at the right, another one stands; someone in ``colours`` comes ``back`` at x."""
    scene = Scene(on_loss="next")
    bystander = (200, 180, 140, BLUE)
    for t in range(50):
        scene.show([(300 + 8 * t, 180, 160, RED), bystander])
    away = [scene.show([bystander]) for _ in range(30)]
    assert away[-1].track_id == 2
    subjects = [scene.show([(back - 4 * t, 180, 160, colours), bystander]) for t in range(30)]
    last = back - 4 * 29
    return subjects[-1], last


def test_subject_that_comes_back_where_it_left_has_its_track_id_again():
    subject, x = leaves(RED, 640)
    assert subject.track_id == 1
    assert offset(subject, x) < 15


@pytest.mark.parametrize(("colours", "x"), [(GREEN, 640), (RED, 130)], ids=["another look", "another place"])
def test_someone_else_who_comes_is_not_the_subject_that_left(colours, x):
    subject, _ = leaves(colours, x)
    assert subject.track_id == 2


def test_person_who_began_out_of_reach_is_not_the_lost_subject():
    lost = Person(np.array([600.0, 100, 640, 200]), 0.8, 0, None)
    near, far = (Person(np.array([x, 100.0, x + 40, 200]), 0.8, 10 * STEP, None) for x in (500.0, 300.0))
    assert could_be(lost, near)
    assert not could_be(lost, far)
    for person in (lost, far):  # the camera turns: places follow, and the person that walks in does not
        person.move_camera(np.array([[1.0, 0, -50], [0, 1, 0]]))
    far.update(near.box, 0.8, 11 * STEP)
    assert not could_be(lost, far)


def test_on_loss_wait_follows_nobody_until_a_roi_chooses():
    scene = Scene(on_loss="wait")
    for t in range(60):
        scene.show([(300 + 8 * t, 180, 160, RED)])
    for t in range(60):
        assert scene.show([(40 + 3 * t, 180, 160, BLUE)]) is None
    subject = scene.show([(223, 180, 160, BLUE)], roi=np.array([200.0, 100, 270, 260]))
    assert subject.track_id == 2
    assert offset(subject, 223) < 10


def test_configured_rule_chooses_the_subject():
    persons = [(150, 180, 200, RED), (330, 180, 120, BLUE)]
    assert offset(Scene(subject="largest").show(persons), 150) < 10
    assert offset(Scene(subject="centre").show(persons), 330) < 10
    boxed = Scene(subject="box", subject_box="300,120,360,240")
    assert offset(boxed.show(persons), 330) < 10


def test_roi_chooses_the_subject_and_replaces_missing_detections():
    scene = Scene(subject="roi")
    persons = [(150, 180, 200, RED), (330, 180, 120, BLUE)]
    assert scene.show(persons) is None  # nobody chosen yet
    roi = np.array([300.0, 115, 360, 245])
    assert offset(scene.show(persons, roi=roi), 330) < 10
    for _ in range(40):  # the detector is blind, the drone is not
        subject = scene.show(persons, unseen=(0, 1), roi=roi)
        assert subject is not None
    assert offset(subject, 330) < 10
    moved = scene.show(persons, roi=np.array([110.0, 80, 190, 280]))
    assert (moved.track_id, offset(moved, 150) < 10) == (2, True)


def test_low_score_clutter_does_not_become_the_subject():
    scene = Scene()
    for _ in range(20):
        scene.show([(300, 180, 160, RED)])
    after = [scene.show([(320, 200, 140, GREEN)], scores={0: 0.22}) for _ in range(60)]
    assert after[-1] is None


def test_person_entering_the_image_gets_one_track_id():
    scene = Scene(on_loss="next")
    shown = [scene.show([(320, 360 + 80 - 12 * t, 200, RED)]) for t in range(20)]
    assert {s.track_id for s in shown if s is not None} == {1}
    assert sum(s is not None for s in shown) >= 15


def test_two_runs_are_equal_bit_for_bit():
    runs = []
    for _ in range(2):
        scene = Scene()
        boxes = [scene.show([(100 + 5 * t, 180, 160, RED), (500 - 5 * t, 180, 150, BLUE)]).box for t in range(60)]
        runs.append(np.array(boxes))
    assert (runs[0] == runs[1]).all()


@pytest.mark.parametrize("text", ["", "1,2,3", "10,10,5,20", "a,b,c,d", "0,0,nan,5"])
def test_invalid_subject_box_is_refused(text):
    with pytest.raises(ParameterError, match="subject_box: expected x_min"):
        SubjectTracker(PoseEstimatorConfig(subject="box", subject_box=text))


def test_windows_lie_in_the_image_and_tiles_cover_it():
    size = (1920, 1080)
    for box in ([0, 0, 50, 120], [1880, 1000, 1920, 1080], [900, 500, 950, 620]):
        x0, y0, x1, y1 = window_around(np.array(box, float), size, WIDE)
        assert 0 <= x0 < x1 <= 1920
        assert 0 <= y0 < y1 <= 1080
        assert x0 <= box[0]
        assert x1 >= box[2]
    covered = np.zeros((1080, 1920), bool)
    for x0, y0, x1, y1 in tiles(size):
        covered[y0:y1, x0:x1] = True
    assert covered.all()
    assert tiles((960, 540)) == []
    cut = uncut(np.array([[100.0, 100, 200, 200], [300, 110, 400, 220]]), (100, 0, 500, 400), size)
    assert cut.tolist() == [False, True]


@pytest.mark.parametrize("scale", [0.7, 1.0, 1.6, 2.4])
@pytest.mark.parametrize("seed", range(4))
def test_box_that_is_drawn_loosely_names_the_person_in_it(scale, seed):
    rng = np.random.default_rng(seed)
    persons = [(200, 180, 120, RED), (430, 180, 120, BLUE)]
    centre = np.array([430, 180]) + rng.uniform(-1, 1, 2) * np.array([24, 60]) * max(scale - 1.0, 0.1)
    half = scale * rng.uniform(0.9, 1.1, 2) * np.array([24, 60])
    scene = Scene(subject="box", subject_box=",".join(f"{v:.1f}" for v in (*(centre - half), *(centre + half))))
    first = scene.show(persons)
    assert first.score > 0  # the detection, not the box that was drawn
    assert offset(first, 430) < 5


@pytest.mark.parametrize("x", [380, 400, 412])
def test_box_of_somebody_who_is_not_detected_names_nobody_beside(x):
    scene = Scene(subject="box", subject_box=f"{x - 24},120,{x + 24},240")
    first = scene.show([(x, 180, 120, RED), (x + 36, 180, 120, BLUE)], unseen=(0,))
    assert first.score == 0
    assert offset(first, x) < 5
