"""PX4.  Parameters and numbers: its documentation, PositionControl.cpp, failsafe.cpp, and recorded flights."""

from __future__ import annotations

import math
from collections.abc import Callable

from drocap_ros.flight.autopilot.autopilot import (
    Airframe,
    Autopilot,
    Decay,
    Fence,
    FenceSettings,
    FlownSpeeds,
    Gains,
    Hints,
    Level,
    LossAction,
    ReportErrors,
    SettingCheck,
    Simulated,
    warn_if,
)
from drocap_ros.flight.autopilot.coasting import HeldCoasting

#: Values of GF_ACTION that guard nobody: its 4 is flight termination, above a person.
_IDLE_FENCES = {0.0: "off", 1.0: "warns only", 4.0: "stops the motors"}


def _greatest_speed(value: float, speeds: FlownSpeeds) -> Level:
    if value < speeds.orbit_m_s:
        return Level.MISSING
    return Level.WARNING if value < speeds.greatest_m_s else Level.OK


def _obeys_sticks(value: float, _: FlownSpeeds) -> Level:
    return Level.OK if not math.isnan(value) and int(value) & 2 else Level.WARNING


def _fence(setting: Callable[[str], float]) -> Fence:
    action = setting("GF_ACTION")
    problem = "GF_ACTION not reported" if math.isnan(action) else _IDLE_FENCES.get(action, "")
    return Fence(problem, setting("GF_MAX_HOR_DIST"), setting("GF_MAX_VER_DIST"))


PX4 = Autopilot(
    name="px4",
    title="PX4",
    mav_autopilot=12,
    modes={
        "ALTCTL": 2 << 16, "POSCTL": 3 << 16, "LOITER": 4 << 16 | 3 << 24, "RTL": 4 << 16 | 5 << 24,
        "LAND": 4 << 16 | 6 << 24, "OFFBOARD": 6 << 16,
    },
    submodes=True,
    control_mode="OFFBOARD",
    hold_mode="LOITER",
    handed_over_mode="LOITER",  # OFFBOARD is entered only while setpoints stream: the pilot leaves it holding
    # One setpoint younger than COM_OF_LOSS_T is enough: measured; a rejected request is repeated.  Six setpoints are
    # sent: five of them may be lost.  A longer wait is longer a place behind a vehicle that the pilot still moves.
    warm_up_s=0.3,
    answers_twice=True,
    estimator_message="ESTIMATOR_STATUS",
    estimator_bad=128 | 1024 | 2048,  # ESTIMATOR_STATUS_FLAGS: constant position, GPS glitch, accelerometer error
    rest_flags=128,  # recorded: constant position from the start to the take-off, and again after the landing
    heartbeat_on_request=False,  # once a second, whatever is requested
    integers_in_bytes=True,
    velocity_sd_m_s=0.25,  # recorded, as errors for seconds
    height_wanders=True,  # by 0.2 to 0.45 m in recorded flights
    heading_sd_deg=6.0,  # recorded: 4 to 19 at worst, within 10 to 60 s
    position_gain_per_s=0.95,  # MPC_XY_P
    timeout_setting="COM_OF_LOSS_T",
    shipped_timeout_s=1.0,
    loss_action=LossAction(
        "COM_OBL_RC_ACT",
        5,
        words={
            0: "drifts by the sticks", 1: "drifts in altitude mode", 2: "drifts in manual flight", 3: "returns",
            4: "lands", 5: "holds", 6: "ends the flight", 7: "stops the motors",
        },
        fatal={
            0: "the vehicle waits for sticks in position mode, and lands without a remote control",
            1: "the vehicle drifts in altitude mode",
            2: "the vehicle flies by its sticks alone",
            6: "flight is terminated",
            7: "the motors are stopped",
        },
        leaves={3: "flies home", 4: "lands where it is"},
        modes={3: "RTL", 4: "LAND", 5: "LOITER"},
    ),
    coasting=HeldCoasting(
        pull_per_s=0.6,  # left of MPC_XY_P: the rest makes up for friction (recorded flights lie 1 m behind)
        push_s=0.3,  # its velocity loop passes acceleration on; with more, recorded flights stop too soon
        delay_s=0.1,  # this and the next two: measured in recorded flights whose bridge was killed
        follows_s=0.5,
        braking_m_s2=1.4,
        creep_m=0.8,  # at up to 0.4 m/s for seconds: measured
        standing_m_s=0.5,
    ),
    # Its estimate wanders while the vehicle stops, and the vehicle follows it.  With less than this it falls behind
    # subjects who walk at 1.4 m/s, and loses them.
    steady_coast=0.63,
    greatest_coast=0.82,
    gives_way_s=2.4,  # fitted in the closed loop: slower by its coast
    echo_m=0.2,  # the place as it came; the velocity has the correction of the place
    echo_m_s=math.inf,
    checks=(
        SettingCheck(
            "MPC_XY_VEL_MAX",
            "at least {speeds.greatest_m_s:g} m/s (max_speed_m_s)",
            "set MPC_XY_VEL_MAX above {speeds.greatest_m_s:g} on the autopilot, or fly slower with a lower "
            "max_speed_m_s: it cuts off every setpoint's speed, and the orbit waits for the vehicle",
            _greatest_speed,
        ),
        SettingCheck(
            "COM_RCL_EXCEPT",
            "bit 2 clear",
            "clear bit 2 (4) of COM_RCL_EXCEPT on the autopilot: else the orbit goes on when the remote control is "
            "lost, and nobody takes over by it",
            warn_if(lambda v: bool(int(v) & 4)),  # flies on in OFFBOARD without the remote control
        ),
        SettingCheck(
            "NAV_RCL_ACT",
            "1 (holds), 2 (returns) or 3 (lands)",
            "set NAV_RCL_ACT to 1 on the autopilot: when the remote control is lost, 5 and 6 stop the motors, and with "
            "0 the orbit goes on",
            warn_if(lambda v: v not in (1, 2, 3)),
        ),
        SettingCheck(
            "COM_RC_OVERRIDE",
            "3 (the sticks take over in OFFBOARD)",
            "set COM_RC_OVERRIDE to 3 on the autopilot, or take over by the mode switch only",
            _obeys_sticks,
            always=True,
        ),
    ),
    fence=FenceSettings(
        "GF_MAX_HOR_DIST", "GF_MAX_VER_DIST", ("GF_ACTION",), "GF_ACTION to 2 (hold) or 3", _fence
    ),
    hints=Hints(
        port=" (MAV_n_MODE Onboard)",
        battery=" (BAT1_CAPACITY)",
        engaged="PX4 grants OFFBOARD only while setpoints arrive",
        limits="it circles a subject who stands, and does not keep up with one who walks yet",
    ),
    simulated=Simulated(
        stick_mode="POSCTL",
        settings={"COM_OF_LOSS_T": 0.5, "COM_OBL_RC_ACT": 5},
        gains=Gains(position=0.95, velocity=1.8, integral=0.4, derivative=0.2),  # as it ships
        # Its SIH simulator has a friction of 1 N s/m for its 1 kg.  With the wind's part of it nothing would fly in
        # 8 m/s, so wind pushes by the drag alone; the own motion is slowed down by the friction alone, at 1.4 m/s
        # against 8 m/s of wind by 1.4 m/s^2, where the drag would add 0.4.  No recorded flight is in wind.
        airframe=Airframe((0.1, 0.04), drag=0.016, inflow=0.0, friction=1.0),
        stop=Decay(2.5, 3.3),  # this and the next three: fitted to the recorded flights
        hold=Decay(2.5, 3.3),
        stick=Decay(3.0, 3.0),
        jerk_m_s3=9.4,
        # Recorded: the velocity errs by 0.25 m/s, the position by 0.26 m, the height by 0.42 m.
        horizontal=ReportErrors(
            ((1.4974, 0.1228), (0.3031, 1.3553)), ((-0.5004, -0.1174), (-0.3063, -0.3628)), (0.00621, 0.02123), 0.23
        ),
        vertical=ReportErrors(
            ((1.8653, 0.0661), (0.0605, 1.2604)), ((-0.8665, -0.0619), (-0.0601, -0.2735)), (0.0034, 0.02222), 0.33
        ),
        lost_modes={0: "POSCTL", 1: "ALTCTL", 3: "RTL", 4: "LAND", 5: "LOITER"},
        loss_check_s=(0.06, 0.13),  # measured
        override=("COM_RC_OVERRIDE", 2, 1),
        streams={"ATTITUDE": 0.05, "SYS_STATUS": 1.0},
        transit_s=0.07,
        clock_rate=0.994,  # recorded: slower than the bridge's by 0.6 %, by up to 3 % where the machine was busy
        critical_when_lost=True,
        flags_at_rest=128,  # constant position: 1023 on the ground, 895 or 831 in the air
    ),
)  # fmt: skip
