"""Gaps of pictures and telemetry in flight: the orbit slows down and goes on, or holds and starts again."""

import dataclasses
from collections import deque
from functools import lru_cache

import numpy as np
import pytest
from branched import branched

from drocap_ros.flight.conditions import ConditionCode
from drocap_ros.flight.orbit.states import Action, Command, State
from lab.flights.fault_injections import freeze
from lab.flights.orbit_loop import LoopSettings, OrbitLoop, with_config

FAULT_S = 12.0


def orbit(autopilot, **config):
    settings = LoopSettings(autopilot=autopilot, seed=4, seconds=40)
    loop = OrbitLoop(with_config(settings, body_height_m=1.75, size_error=0.04, attitude_hz=50.0, **config))
    loop.start()
    loop.run(FAULT_S)
    assert loop.controller.safety.state == State.ORBITING
    return loop


begun = lru_cache(orbit)


@pytest.fixture
def loop(autopilot):
    """An orbit that has begun, flown once of each autopilot."""
    return begun(autopilot)


def blind(loop, seconds):
    """No picture arrives for a while."""
    loop.perceive = lambda seen: None
    loop.run(loop.t + seconds)
    loop.perceive = lambda seen: seen


def silence(loop, seconds):
    """Telemetry of a while arrives in one burst afterwards."""
    read, loop.down.read = loop.down.read, lambda: b""
    loop.run(loop.t + seconds)
    loop.down.read = read


@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
@pytest.mark.parametrize(("gap", "seconds"), [(blind, 0.5), (silence, 0.3)])
@branched
def test_orbit_goes_on_after_a_gap(loop, gap, seconds):
    paces = []
    for _ in range(3):
        gap(loop, seconds)
        loop.run(loop.t + 1.5, lambda loop: paces.append(loop.controller.safety.pace.value))
    assert all(row.action == Action.ORBIT for row in loop.rows if row.t_s > FAULT_S), loop.reasons
    assert ConditionCode.DEGRADED in [reason.code for t, _, reason in loop.reasons if t > FAULT_S]
    assert min(paces) < 0.5
    assert paces[-1] == 1.0
    assert np.linalg.norm(loop.copter.body.velocity) > 1.0


@pytest.mark.parametrize(("hangs_s", "ends"), [(0.26, False), (0.31, False), (0.6, True)])
@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
@branched
def test_a_loop_that_stood_still_slows_the_orbit_down_as_data_of_that_age_do(loop, hangs_s, ends):
    for _ in range(3):
        loop.hung = True
        loop.run(loop.t + hangs_s)
        loop.hung = False
        loop.run(loop.t + 1.0)
    states = {row.state for row in loop.rows if row.t_s > FAULT_S}
    assert states == ({State.ORBITING, State.HOLDING} if ends else {State.ORBITING})
    causes = [reason.values.get("cause", reason).code for t, _, reason in loop.reasons if t > FAULT_S]
    assert causes[0] == ConditionCode.CONTROL_LOOP_STALLED


def nothing(loop):
    loop.perceive = lambda seen: None


def nobody(loop):
    loop.perceive = lambda seen: dataclasses.replace(seen, track_id=0)


def jump(loop):
    loop.future_joints()[:, :, 0] += 3.0


@pytest.mark.parametrize(
    ("autopilot", "fault"),
    [("ardupilot", nothing), ("ardupilot", freeze), ("ardupilot", jump), ("px4", nobody), ("px4", jump)],
)
@branched
def test_commanded_motion_ends_in_time_after_a_fault_of_perception(loop, fault):
    position = loop.copter.body.position.copy()
    fault(loop)
    sent = []
    loop.run(FAULT_S + 4.0, lambda loop: sent.append(loop.link.sent_setpoints()[-1]))
    moving = [t for t, setpoint in sent if np.hypot(setpoint.vx, setpoint.vy) > 0.05]
    assert max(moving) - FAULT_S <= 0.35
    if fault is not jump:  # the picture before it may be as old as this step
        assert loop.copter.motion_until_s - FAULT_S <= 0.35
    assert max(np.linalg.norm(row.position[:2] - position[:2]) for row in loop.rows if row.t_s > FAULT_S) <= 2.5
    stands = [(setpoint.x, setpoint.y) for t, setpoint in sent if t - FAULT_S > 0.35]
    assert np.ptp(stands, axis=0).max() < 0.5  # one place, but for the wander of the reported position
    assert loop.controller.safety.state == State.HOLDING


@pytest.mark.parametrize("autopilot", ["ardupilot"])
@branched
def test_hold_that_dead_perception_began_stays(loop):
    blind(loop, 4.0)
    assert loop.controller.safety.state == State.HOLDING
    loop.run(loop.t + 4.0)
    ended = next(i for i, row in enumerate(loop.rows) if row.t_s > FAULT_S and row.action != Action.ORBIT)
    assert all(row.action != Action.ORBIT for row in loop.rows[ended:])  # off by default


@pytest.mark.parametrize("autopilot", ["ardupilot"])
@branched
def test_start_is_enough_when_the_pilot_gives_control_back_after_a_hold(loop):
    blind(loop, 6.0)
    assert loop.copter.mode == "BRAKE"
    loop.copter.set_mode("GUIDED", "pilot")
    back_s = loop.t
    loop.run(back_s + 2.0)
    assert loop.controller.safety.state == State.READY
    assert all(row.action == Action.NOTHING for row in loop.rows if row.t_s > back_s)
    loop.command(Command.START)
    loop.run(loop.t + 3.0)
    assert loop.controller.safety.state == State.ORBITING, loop.reasons[-3:]


@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
def test_positions_that_are_late_by_their_stamps_start_no_orbit(autopilot):
    loop = OrbitLoop(LoopSettings(autopilot=autopilot, seed=4, seconds=20))
    report, late = loop.copter._telemetry, deque()

    def telemetry(number, t, pose):
        message = report(number, t, pose)
        if message is None or message.get_type() != "LOCAL_POSITION_NED":
            return message
        late.append((t, message))
        return late.popleft()[1] if late[0][0] <= t - 0.8 else None

    loop.copter._telemetry = telemetry
    loop.start()
    loop.run(10.0)
    assert all(row.action == Action.NOTHING for row in loop.rows)
    assert loop.status.condition.code == ConditionCode.POSITION_FROZEN


@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
def test_a_fixed_wing_is_not_commanded(autopilot):
    loop = OrbitLoop(LoopSettings(autopilot=autopilot, seed=4, seconds=10))
    heartbeat = loop.copter._heartbeat

    def of_a_plane():
        message = heartbeat()
        message.type = 1
        return message

    loop.copter._heartbeat = of_a_plane
    loop.start()
    loop.run(9.0)
    assert all(row.action == Action.NOTHING for row in loop.rows)
    assert loop.status.condition.code == ConditionCode.AUTOPILOT_UNSUPPORTED
    assert f"{autopilot}, vehicle type 1" in loop.status.reason


@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
def test_an_orbit_on_a_busy_machine_ends_by_no_short_stand_of_our_own(autopilot):
    """Process and loop stand still as at a load of 40: 0.1 s a second, every twentieth of them for 0.3 s and more.

    Old data that waited to be read, and the echo of the guardian's hold, ended an orbit too."""
    for seed in range(3):
        loop = OrbitLoop(LoopSettings(autopilot=autopilot, seed=seed, seconds=61, load=40.0, latency_s=0.06))
        stands, before = [], [0.0]

        def step(loop, stands=stands, before=before):
            if not (loop.hung or loop.stopped):
                stands.append(loop.t - before[0])
                before[0] = loop.t

        loop.start()
        loop.run(60.0, step)
        assert max(stands) > 0.3
        ends = [(t, reason.code) for t, state, reason in loop.reasons if t > 4.5 and state == "HOLDING"]
        ended_s = min((t for t, _ in ends), default=60.0)
        longest = max(s for s, at in zip(stands, np.cumsum(stands), strict=True) if at < ended_s + 0.1)
        assert not ends or (ends[0][1] == ConditionCode.CONTROL_LOOP_STALLED and longest > 0.5), (ends, longest)
