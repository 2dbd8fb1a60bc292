"""Whether the setpoints are followed, by the echo's content and by the motion."""

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest
from orbit_observations import GOOD, LIMITS, changed, orbiting

from drocap_ros.flight.conditions import ConditionCode
from drocap_ros.flight.orbit.following import Echoes, Following, Keeping
from drocap_ros.flight.orbit.safety import reduce
from drocap_ros.flight.orbit.states import Action, State
from drocap_ros.flight.vehicle import VehicleState

MAX_ECHO_AGE_S = 0.5


def vehicle(autopilot, speed, north=0.0):
    return VehicleState(
        stamp_ns=0, autopilot=autopilot, mode="GUIDED", armed=True, position_enu_m=np.array([0.0, north, 0.0]),
        velocity_enu_m_s=np.array([0.0, speed, 0.1]), orientation_xyzw=np.array([0, 0, 0, 1.0]),
        angular_velocity_flu_rad_s=np.zeros(3), position_ok=True, gimbal_orientation_xyzw=np.full(4, np.nan),
        link_age_s=0.0,
    )  # fmt: skip


def setpoint(x, vx):
    return SimpleNamespace(x=x, y=0.0, vx=vx, vy=0.0)


def fly(
    echo_of, seconds=6.0, autopilot="ardupilot", commanded=2.0, flown=lambda t: 2.0, trip_s=math.nan, place=None
):  # fmt: skip
    """(time, evidence) of the first step that does not follow; ``echo_of(t, x)`` is the echo, where the path is x.

    place : north (m) of the vehicle at a time; None = at the setpoint
    """
    following, sent, echoed = Following(MAX_ECHO_AGE_S, 0.2), [], None
    for i in range(1, round(seconds * 20)):
        t = i / 20
        x = commanded * t
        if i % 2 == 0 and (echo := echo_of(t - 0.1, x - 0.1 * commanded)) is not None:
            echoed = (t, echo)
        judged = None if echoed is None else (t - echoed[0], echoed[1])
        seen = vehicle(autopilot, flown(t), x - commanded / 20 if place is None else place(t))
        if evidence := following.step(t, t, Echoes(sent, judged, trip_s), seen):
            return t, evidence
        sent = [*sent[-79:], (t, setpoint(x, commanded))]
    return math.inf, ""


def followed(t, x):
    return setpoint(x, 2.0)


def dropped(t, x):
    """ArduPilot from 3 s on: integrated for half a second, then velocity zero at the place that was reached."""
    return followed(t, x) if t < 3.5 else setpoint(7.0, 0.0)


def test_an_echo_of_what_was_sent_is_followed():
    assert fly(followed) == (math.inf, "")
    assert fly(lambda t, x: setpoint(x - 0.8, 2.0)) == (math.inf, "")  # 0.4 s late


def test_a_target_that_was_not_sent_shows_dropped_setpoints_within_half_a_second_of_the_time_out():
    t, evidence = fly(dropped)
    assert 3.5 < t <= 4.0
    assert "by its time-out" in evidence


def test_px4_echoes_the_velocity_of_its_controller():
    assert fly(lambda t, x: setpoint(x, 3.1), autopilot="px4") == (math.inf, "")
    t, _ = fly(lambda t, x: setpoint(min(x, 6.0), 0.4), autopilot="px4")  # the target stays
    assert t <= 4.7


def test_on_a_quick_link_the_echo_must_be_of_a_recent_setpoint():
    def deaf(t, x):
        return setpoint(min(x, 6.0), 0.4)  # from 3 s on

    assert fly(deaf, autopilot="px4", trip_s=0.05)[0] <= 3.85
    assert fly(deaf, autopilot="px4", trip_s=0.4)[0] <= 4.4
    assert fly(lambda t, x: setpoint(x, 3.1), autopilot="px4", trip_s=0.05) == (math.inf, "")
    assert fly(lambda t, x: setpoint(x - 0.4, 2.0), autopilot="px4", trip_s=0.2) == (math.inf, "")  # 0.2 s late


def test_no_echo_at_all_counts_after_its_time_and_a_link_without_one_is_judged_by_the_motion():
    t, evidence = fly(lambda t, x: followed(t, x) if t < 3 else None)
    assert (t, evidence[:7]) == (pytest.approx(3.6, abs=0.1), "no echo")
    assert fly(lambda t, x: None) == (math.inf, "")
    t, evidence = fly(lambda t, x: None, flown=lambda t: max(0.2, min(2.0, 2.0 - 1.5 * (t - 3))))
    assert t <= 3 + 2.0 / 1.5 + 1.1
    assert "commanded" in evidence


def test_an_echo_whose_content_never_agreed_is_not_judged_but_the_motion_is():
    assert fly(lambda t, x: setpoint(math.nan, math.nan)) == (math.inf, "")
    t, evidence = fly(lambda t, x: setpoint(0.0, 0.0), flown=lambda t: 0.05)
    assert 1.0 <= t <= 1.2
    assert evidence == "it flies at 0.1 m/s where 2.0 m/s are commanded"


def test_a_slow_command_and_a_vehicle_in_wind_are_no_evidence():
    assert fly(lambda t, x: None, commanded=0.4, flown=lambda t: 0.0) == (math.inf, "")
    assert fly(lambda t, x: None, flown=lambda t: 0.9) == (math.inf, "")


def test_a_vehicle_that_stands_or_springs_back_before_a_place_does_not_follow():
    """The reference waits before a vehicle that stands: its speed falls, and the way to its place remains."""
    t, evidence = fly(lambda t, x: None, commanded=0.1, flown=lambda t: 0.1, place=lambda t: -1.5)
    assert 2.0 <= t <= 2.2
    assert evidence == "it flies at 0.1 m/s where 1.1 m/s are commanded"
    assert fly(lambda t, x: None, commanded=0.1, flown=lambda t: -1.0, place=lambda t: -1.2)[0] <= 2.2
    assert fly(lambda t, x: None, commanded=0.1, flown=lambda t: 0.3, place=lambda t: -1.5) == (math.inf, "")
    assert fly(lambda t, x: None, commanded=0.0, flown=lambda t: 0.0, place=lambda t: -0.5) == (math.inf, "")


def test_a_vehicle_that_stands_where_velocity_and_way_back_cancel_follows():
    """As after an adjustment between extremes: both autopilots add the way to the place to the velocity."""
    ahead = fly(lambda t, x: None, commanded=1.0, flown=lambda t: 0.1, place=lambda t: t + 0.9)
    assert ahead == (math.inf, "")
    assert fly(lambda t, x: None, commanded=1.0, flown=lambda t: 0.1, place=lambda t: t + 0.2)[0] <= 1.2


def test_each_orbit_is_judged_anew():
    following = Following(MAX_ECHO_AGE_S, 0.2)
    sent = [(0.05 * i, setpoint(0.1 * i, 2.0)) for i in range(60)]
    slow = vehicle("ardupilot", 0.0)
    assert following.step(3.0, 3.0, Echoes(sent, (0.1, setpoint(6.0, 2.0))), slow) == ""
    assert following.step(3.5, 0.0, Echoes(sent, (0.1, setpoint(0.0, 0.0))), slow) == ""
    assert following.step(9.0, 0.2, Echoes(sent, (0.1, setpoint(0.0, 0.0))), slow) == ""
    assert (
        following.step(9.1, 0.3, Echoes(sent, None), dataclasses.replace(slow, velocity_enu_m_s=np.full(3, np.nan)))
        == ""
    )


def test_vehicle_that_does_not_reach_its_place_on_the_orbit_slows_down_and_then_holds():
    keeping, state, codes = Keeping(LIMITS), orbiting(), []
    place = GOOD.vehicle.position
    for i in range(500):
        t = 1.0 + 0.05 * i
        blown_m = 2.5 if t >= 4.0 else 1.9  # 1.95 m is the limit
        blown = changed(GOOD, position=GOOD.vehicle.position + np.array([0.0, blown_m, 0.0]))
        away_m, away_s = keeping.watch(place, blown.vehicle.position, t)
        state, _ = reduce(state, changed(blown, away_m=away_m, away_s=away_s), t, None, LIMITS)
        codes.append((round(t, 2), state.condition.values.get("cause", state.condition).code, state.state))
        # "take over by hand" is no word for a vehicle that is on its way back.
        away = codes[-1][1] == ConditionCode.ORBIT_NOT_KEPT
        assert ("take over by hand" in str(state.condition)) == (away and state.state == State.HOLDING)
    kept = [(t, now) for t, code, now in codes if code == ConditionCode.ORBIT_NOT_KEPT]
    assert 5.0 <= kept[0][0] <= 5.1
    assert kept[0][1] == State.ORBITING
    assert 23.9 <= next(t for t, now in kept if now == State.HOLDING) <= 24.0
    carried_off = changed(blown, away_m=6.0, away_s=1.1)
    assert reduce(orbiting(), carried_off, 1.0, None, LIMITS)[0].condition.code == ConditionCode.ORBIT_NOT_KEPT
    assert reduce(orbiting(), changed(blown, away_m=5.7, away_s=1.1), 1.0, None, LIMITS)[1].action == Action.ORBIT
    assert keeping.watch(place, place, 12.0) == (0.0, 0.0)
    assert keeping.watch(None, blown.vehicle.position, 12.1)[1] == 0.0


def test_no_recorded_flight_of_a_real_autopilot_counts_as_standing(shared):
    judged = 0
    for path in sorted((shared / "flight").glob("*.npz")):
        if not path.name.startswith(("orbit", "px4_stand", "px4_walk")):
            continue
        flight = dict(np.load(path))
        following, time = Following(MAX_ECHO_AGE_S, 0.2), flight["time_s"]
        sent = np.hstack([flight["setpoint_position_m"][:, :2], flight["setpoint_velocity_m_s"][:, :2]])
        for at, (east, north, ve, vn) in zip(flight["setpoint_time_s"], sent, strict=True):
            flown, place = (
                np.array([np.interp(at - 0.1, time, flight[name][:, i]) for i in range(3)])
                for name in ("velocity_m_s", "position_m")
            )
            state = dataclasses.replace(vehicle("px4", 0.0), velocity_enu_m_s=flown, position_enu_m=place)
            command = SimpleNamespace(x=float(north), y=float(east), vx=float(vn), vy=float(ve))
            assert following.step(at, at + 1.0, Echoes([(at, command)]), state) == "", path.name
            judged += 1
    assert judged > 3000
