"""The mount's pitch follows the subject, and a vehicle without a mount is not asked twice."""

import math

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.flight.orbit.states import Command, State
from lab.flights.orbit_loop import LoopSettings, OrbitLoop, with_config

PITCH = mavlink.MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW


class Watched(OrbitLoop):
    """Notes every command to the mount and its answer."""

    def __init__(self, settings):
        super().__init__(settings)
        self.asked, answer = [], self.copter._answer

        def watch(message, t_s):
            if message.get_type() == "COMMAND_LONG" and message.command == PITCH:
                self.asked.append((t_s, message))
            answer(message, t_s)

        self.copter._answer = watch


def flown(autopilot, mount, **values):
    settings = LoopSettings(autopilot=autopilot, seconds=40, seed=2, mount="gimbal" if mount else "fixed")
    loop = Watched(with_config(settings, **values))
    loop.start()
    return loop


@pytest.mark.parametrize("autopilot", ["ardupilot"])
def test_mount_pitch_follows_height_and_radius(autopilot):
    loop = flown(autopilot, True, gimbal_control=True)
    loop.copter.mount.command(-9.0)
    loop.run(12.0)
    assert loop.controller.safety.state == State.ORBITING
    assert len(loop.asked) > 3
    loop.command(Command.ADJUST, height_m=4.5, radius_m=5.0)
    loop.run(22.0)
    assert loop.controller.safety.state == State.ORBITING, loop.reasons[-2:]
    _, last = loop.asked[-1]
    assert math.isfinite(last.param1)
    assert last.param2 == 0.0  # along the nose: the yaw is the vehicle's
    assert math.isnan(last.param3)  # at the mount's own rate
    assert math.isnan(last.param4)
    drop = loop.copter.body.position[2] - loop.pelvis()[2]
    wanted = -math.degrees(math.atan2(drop, loop.rows[-1].distance_m))
    assert wanted < -25
    assert abs(math.degrees(loop.copter.mount.pitch) - wanted) < 3.0
    assert loop.asked[-1][0] - loop.asked[0][0] > 10  # it goes on being asked
    assert np.diff([t for t, _ in loop.asked]).min() > 0.35


@pytest.mark.parametrize("autopilot", ["px4"])
def test_refused_mount_is_requested_once(autopilot):
    loop = flown(autopilot, False, gimbal_control=True)
    loop.run(16.0)
    assert len(loop.asked) == 1  # refused with MAV_RESULT_FAILED, as measured
    loop.copter.set_mode("POSCTL" if autopilot == "px4" else "LOITER", "pilot")
    loop.run(18.0)
    loop.command(Command.STOP)
    loop.run(19.0)
    loop.command(Command.ENGAGE)
    loop.run(25.0)
    assert any(t > 19 and state == "ORBITING" for t, state, _ in loop.reasons)
    assert len(loop.asked) == 1


def test_mount_is_not_commanded_without_permission():
    loop = flown("ardupilot", True)
    loop.run(9.0)
    assert loop.controller.safety.state == State.ORBITING
    assert loop.asked == []
