"""The guard: what the images alone allow, whatever filter and planner want."""

import numpy as np
import pytest
from flown_copter import ALL, Flight
from orbit_observations import GOOD, LIMITS, changed

from drocap_ros.flight.autopilot.coasting import Setpoint
from drocap_ros.flight.bridge_config import SubjectConfig
from drocap_ros.flight.orbit.speed import limit_closing
from drocap_ros.flight.subject.guard import Guard
from drocap_ros.flight.vehicle import CameraPose
from drocap_ros.keypoints import PoseObservation
from drocap_ros.simulation.pinhole import pinhole_matrix
from drocap_ros.simulation.simulated_person import simulate_person
from lab.simulation.keypoint_errors import detect_person

S = 1_000_000_000
MATRIX, SIZE = pinhole_matrix(1280, 720, 60.0), (1280, 720)
STANDING = simulate_person(np.zeros(1), "stand", 0, 1.7)[0]
LEVEL = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])  # looks west
AT = np.array([6.0, 0.0, 1.2])
STILL = Setpoint(AT, np.zeros(3), np.zeros(3), np.pi, 0.0)


def image(t_s, person=(0.0, 0.0), camera=AT, track_id=1, shift_px=0.0):
    joints = STANDING - np.append(STANDING[0, :2], 0.0) + np.append(person, 0.0)
    found = detect_person(joints[None], LEVEL[None], camera[None], MATRIX, SIZE, round(t_s * 1000))
    keypoints = found.keypoints[0].astype(np.float32) + np.float32([shift_px, 0.0])
    return PoseObservation(
        round(t_s * S) + S, track_id, SIZE, keypoints=keypoints,
        covariance=found.covariance[0].astype(np.float32), confidence=found.confidence[0].astype(np.float32),
    )  # fmt: skip


def flown(person, camera, seconds=3.0):
    """A guard that has seen both move: functions of time, m."""
    guard = Guard(SubjectConfig())
    for i in range(int(seconds * 15)):
        t = i / 15
        place = np.array([6.0 + camera(t), 0.0, 1.2])
        guard.see(image(t, (person(t), 0.0), place), MATRIX, CameraPose(LEVEL, place), locked=i > 15)
    limit = int((1.0 + seconds) * S)
    return guard, place, limit


def limited(guard, setpoint, place, velocity, now_ns, autopilot="px4", receding_m_s=np.inf):
    """The setpoint that is left; by the other estimate the subject recedes as fast as one likes."""
    sight = guard.sight(place, np.zeros(3), now_ns)
    seen = changed(
        GOOD, position=place, velocity=velocity, autopilot=autopilot, by_size=sight, approach_m_s=-receding_m_s
    )
    return limit_closing(setpoint, seen, LIMITS)


def asked(guard, place, now_ns, inward, own=0.0, autopilot="px4"):
    """Speed towards the subject that is left of the one asked for; PX4 has the general bounds, ArduPilot lower ones."""
    setpoint = STILL._replace(position=place, velocity=np.array([-inward, 0.0, 0.0]))
    sent = limited(guard, setpoint, place, np.array([-own, 0.0, 0.0]), now_ns, autopilot)
    return -float(sent.velocity[0]), sent


def test_towards_a_standing_person_the_speed_is_bounded():
    guard, place, now = flown(lambda t: 0.0, lambda t: 0.0)
    assert asked(guard, place, now, 2.5)[0] == pytest.approx(1.0, abs=0.5)
    # A position ahead is a pull towards it: velocity and pull together.
    ahead = STILL._replace(position=place - np.array([1.5, 0.0, 0.0]), velocity=np.array([-0.8, 0.5, 0.1]))
    sent = limited(guard, ahead, place, np.zeros(3), now)
    assert -sent.velocity[0] + place[0] - sent.position[0] < 1.5
    assert np.allclose(sent.velocity[1:], [0.5, 0.1])
    # What moves away or aside passes as it is.
    away = STILL._replace(velocity=np.array([1.0, 2.0, 0.0]))
    assert np.allclose(limited(guard, away, place, np.zeros(3), now).velocity, away.velocity)


def test_a_vehicle_that_closes_too_fast_is_slowed():
    guard, place, now = flown(lambda t: 0.0, lambda t: 0.0)
    _, sent = asked(guard, place, now, 1.0, own=3.0)
    assert sent.acceleration[0] == pytest.approx(2.0)


def test_following_is_no_closing_while_the_image_keeps_its_size():
    guard, place, now = flown(lambda t: -1.4 * t, lambda t: -1.4 * t)
    assert asked(guard, place, now, 2.2, own=1.4)[0] == pytest.approx(2.2, abs=0.4)
    # The vehicle follows, but the person stands: his image grows.
    guard, place, now = flown(lambda t: 0.0, lambda t: -0.8 * t)
    assert asked(guard, place, now, 2.2, own=0.8)[0] < 1.5


def test_a_person_who_stays_in_place_is_not_followed_however_his_image_shrinks():
    guard, place, now = flown(lambda t: -1.4 * t, lambda t: -1.4 * t)
    setpoint = STILL._replace(position=place, velocity=np.array([-2.2, 0.0, 0.0]))
    stays, walks = (limited(guard, setpoint, place, np.zeros(3), now, receding_m_s=speed) for speed in (0.0, 1.4))
    assert -stays.velocity[0] < 1.0
    assert -walks.velocity[0] > 1.7


def test_a_person_far_away_is_followed_only_where_he_surely_walks():
    """From 12 m the images of one who stands shrink at up to 0.4 m/s for a second."""
    near = flown(lambda t: -0.6 * t, lambda t: 0.0, 2.5)
    far = flown(lambda t: -0.6 * t, lambda t: 6.0, 2.5)
    assert asked(*near, 2.2)[0] > 1.1
    assert asked(*far, 2.2)[0] == pytest.approx(0.85, abs=0.05)
    assert asked(*flown(lambda t: -1.4 * t, lambda t: 6.0 - 1.4 * t), 2.2, own=1.4)[0] > 1.2


def test_no_speed_towards_a_person_whose_image_is_large():
    guard, place, now = flown(lambda t: 2.9, lambda t: 0.0)  # 3.1 m; 2.6 m if he is 1.43 m tall
    assert asked(guard, place, now, 1.0)[0] < 0.35
    assert 3.1 < guard.sight(place, np.zeros(3), now).farthest_m < 5.0


@pytest.mark.parametrize(
    ("spoil", "contradicts"),
    [
        (lambda last, t: PoseObservation(round(t * S) + S, 0, SIZE), False),
        (lambda last, t: image(t, track_id=2), True),
        (lambda last, t: image(t, shift_px=400.0), True),
    ],
    ids=["nobody", "another", "jumped"],
)
def test_without_a_sure_image_the_last_sure_one_grows_old(spoil, contradicts):
    guard, place, _ = flown(lambda t: 0.0, lambda t: 0.0)
    last = image(3.0)
    guard.see(last, MATRIX, CameraPose(LEVEL, place), locked=True)
    for step in range(1, 9):
        t = 3.0 + step / 15
        assert not guard.see(spoil(last, t), MATRIX, CameraPose(LEVEL, place), locked=True)
    sight = guard.sight(place, np.zeros(3), round(3.55 * S) + S)
    assert sight.age_s == pytest.approx(0.55)
    assert sight.contradicted == contradicts
    assert guard.see(image(3.6), MATRIX, CameraPose(LEVEL, place), locked=True)
    assert not guard.sight(place, np.zeros(3), round(3.65 * S) + S).contradicted


def test_a_body_that_shrinks_for_a_moment_may_not_be_followed():
    """A crouch or a swing of the range looks like a person who walks away."""
    guard, place, now = flown(lambda t: -1.4 * max(t - 2.3, 0.0), lambda t: 0.0)
    assert asked(guard, place, now, 2.2)[0] < 1.2
    guard, place, now = flown(lambda t: -1.4 * max(t - 2.3, 0.0), lambda t: -1.4 * max(t - 2.3, 0.0), 6.0)
    assert asked(guard, place, now, 2.2, own=1.4)[0] > 1.6


def test_ardupilot_that_recedes_is_not_told_to_close_up_at_once():
    standing = flown(lambda t: 0.0, lambda t: 0.0)
    allowed = asked(*standing, 2.5, own=-1.8)[0]  # PX4: its path does not overshoot
    assert allowed > 0.7
    assert asked(*standing, 2.5, own=0.6, autopilot="ardupilot")[0] == pytest.approx(allowed, abs=1e-3)
    assert asked(*standing, 2.5, own=-1.8, autopilot="ardupilot")[0] == pytest.approx(0.0, abs=1e-3)
    assert asked(*standing, 2.5, own=-0.6, autopilot="ardupilot")[0] == pytest.approx(allowed - 0.6, abs=1e-3)
    assert asked(*standing, 2.5, own=-0.3, autopilot="ardupilot")[0] == pytest.approx(0.4, abs=1e-3)  # as at rest


@pytest.mark.parametrize("wind", [0.0, 8.0, -8.0])
@pytest.mark.parametrize("receding", [0.0, 0.5, 1.0, 1.8])
def test_ardupilot_that_recedes_and_is_told_to_come_near_stays_below_the_closing_speed(receding, wind):
    """It flies away from one who stands; then every setpoint asks for 2 m/s towards him, from 1 m ahead."""
    flight, guard = Flight(wind=wind), Guard(SubjectConfig())
    body = flight.copter.body
    body.position[0], body.velocity[0] = 9.0 - 4.0 * receding, receding
    first, ahead = body.position.copy(), np.array([-1.0, 0.0, 0.0])

    def each():
        place, velocity = body.position.copy(), body.velocity.copy()
        now_ns = round(flight.t * S) + S
        camera = np.array([place[0], place[1], 1.2])
        guard.see(image(flight.t, camera=camera), MATRIX, CameraPose(LEVEL, camera), locked=True)
        speed = np.array([receding, 0.0, 0.0])
        sent = Setpoint(first + speed * flight.t, speed, np.zeros(3), np.pi, 0.0)
        if flight.t > 4.0:
            sent = limited(
                guard, Setpoint(place + ahead, 2 * ahead, 2 * ahead, np.pi, 0.0), place, velocity, now_ns, "ardupilot"
            )
        flight.send(ALL, sent.position, sent.velocity, sent.acceleration, np.pi)

    flight.fly(8.0, each)
    rows = np.array(flight.rows)
    closing = -rows[rows[:, 0] > 4.0, 4]
    assert 0.6 < closing.max() <= 1.0


def test_ardupilot_at_rest_closes_up_step_by_step():
    """Told the whole speed at once it overshoots."""
    standing = flown(lambda t: 0.0, lambda t: 0.0)
    assert asked(*standing, 2.5, autopilot="ardupilot")[0] == pytest.approx(0.4, abs=1e-3)
    assert asked(*standing, 2.5, own=0.2, autopilot="ardupilot")[0] == pytest.approx(0.6, abs=1e-3)
    walking = flown(lambda t: -1.4 * t, lambda t: 0.0, 2.5)  # who walks away is followed at once
    assert asked(*walking, 2.5, autopilot="ardupilot")[0] > 0.8


def test_less_is_left_for_closing_up_with_one_who_walks_because_he_may_stop():
    """What ArduPilot gives up is a share of the speed at which it follows; it still follows."""
    walking = flown(lambda t: -1.0 * t, lambda t: -1.0 * t)
    px4, ardupilot = (asked(*walking, 2.5, own=1.0, autopilot=name)[0] for name in ("px4", "ardupilot"))
    assert 0.15 < px4 - ardupilot <= 0.3 * 0.85 + 1e-6
    assert ardupilot > 1.2  # he walks at 1.0 m/s


@pytest.mark.parametrize("own", [-2.0, -0.5, 0.0, 0.5, 1.5])
@pytest.mark.parametrize("person", [-1.4, -0.5, 0.0, 0.5, 1.4])
def test_ardupilot_never_closes_up_faster_than_the_general_bound(person, own):
    place = flown(lambda t: person * t, lambda t: person * t)
    px4, ardupilot = (asked(*place, 2.5, own=own, autopilot=name)[0] for name in ("px4", "ardupilot"))
    assert 0.0 <= ardupilot <= px4 + 1e-9


def test_nothing_is_flown_about_a_person_whose_size_was_never_seen():
    guard, place = Guard(SubjectConfig()), np.array([6.0, 0.0, 1.2])
    assert guard.sight(place, np.zeros(3), S) is None
