"""ArduPilot Copter.  Parameters and numbers: its documentation, ArduCopter/mode_guided.cpp, AC_PosControl.cpp."""

from __future__ import annotations

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
    ReportErrors,
    SettingCheck,
    Simulated,
    warn_if,
)
from drocap_ros.flight.autopilot.coasting import ContinuedCoasting

_GOES_ON = "on the autopilot: else the orbit goes on when the remote control is lost, and nobody takes over by it"
_SLOW_STOP = "on the autopilot, as shipped since 4.1: with less each stop is longer, that after the bridge's death too"


def _guided_options(value: float, _: FlownSpeeds) -> Level:
    bits = int(value)  # 4 and 5: it drifts off its setpoints and its hold; 7: it turns into the wind
    return Level.MISSING if bits & (16 | 32) else Level.WARNING if bits & 128 else Level.OK


def _fence(setting: Callable[[str], float]) -> Fence:
    enabled, kinds = setting("FENCE_ENABLE"), setting("FENCE_TYPE")
    if enabled != 1:
        return Fence("off" if enabled == 0 else "FENCE_ENABLE not reported", float("nan"), float("nan"))
    radius, height = setting("FENCE_RADIUS"), setting("FENCE_ALT_MAX")
    if kinds == kinds:  # bits of FENCE_TYPE: 1 height, 2 circle
        radius = radius if int(kinds) & 2 else 0.0
        height = height if int(kinds) & 1 else 0.0
    return Fence("reports only" if setting("FENCE_ACTION") == 0 else "", radius, height)


ARDUPILOT = Autopilot(
    name="ardupilot",
    title="ArduPilot Copter",
    mav_autopilot=3,
    modes={
        "STABILIZE": 0, "ALT_HOLD": 2, "GUIDED": 4, "LOITER": 5, "RTL": 6, "LAND": 9, "POSHOLD": 16, "BRAKE": 17,
    },
    control_mode="GUIDED",
    # LOITER flies on unless a stick is centred.  The vehicle is at rest when BRAKE is requested.
    hold_mode="BRAKE",
    handed_over_mode="GUIDED",  # it waits there for setpoints
    estimator_message="EKF_STATUS_REPORT",
    estimator_bad=128 | 1024 | 32768,  # EKF_STATUS_FLAGS: constant position, uninitialized, GPS glitch
    velocity_sd_m_s=0.02,  # recorded
    position_gain_per_s=1.0,  # PSC_POSXY_P
    continues_setpoints=True,
    needs_mode_to_stop=False,  # the time-out has ended the motion, and BRAKE would take longer
    starts_from_ground=False,  # in GUIDED it waits for a take-off
    timeout_setting="GUID_TIMEOUT",
    shipped_timeout_s=3.0,
    coasting=ContinuedCoasting(
        acceleration_m_s2=2.5,  # WP_ACC as shipped
        jerk_m_s3=5.0,  # PSC_JERK_NE as shipped
        excess=1.1,  # lag and wind; recorded flights whose bridge was killed
        standing_m_s=0.2,
    ),
    # Gusts, turns and the way add to a steady flight.  Of 204 deaths of the bridge 98 % moved by 2.5 m at most; with a
    # greatest share of 0.935 94 % did.
    steady_coast=0.75,
    greatest_coast=0.9,
    gives_way_s=1.2,  # fitted in the closed loop: the vehicle leans before it flies away
    echo_m=0.5,  # its target is the setpoint, integrated
    echo_m_s=0.75,
    mount_type_setting="MNT1_TYPE",
    servo_mount=1,
    checks=(
        SettingCheck(
            "GUID_OPTIONS",
            "bits 4, 5 and 7 clear",
            "clear bits 4 (16), 5 (32) and 7 (128) of GUID_OPTIONS on the autopilot: with 4 or 5 it drifts off its "
            "setpoints and its hold, with 7 it may turn the camera into the wind",
            _guided_options,
        ),
        # Speed limits of waypoints (WPNAV_SPEED) are missing: setpoints with a velocity pass them by.
        # By its name and unit up to 4.6, and from 4.7 on; 0 stands for the default.
        SettingCheck(
            "WPNAV_ACCEL", "at least 250 cm/s^2", f"set WPNAV_ACCEL to 250 {_SLOW_STOP}", warn_if(lambda v: 0 < v < 250)
        ),
        SettingCheck("WP_ACC", "at least 2.5 m/s^2", f"set WP_ACC to 2.5 {_SLOW_STOP}", warn_if(lambda v: 0 < v < 2.5)),
        SettingCheck(
            "FS_THR_ENABLE", "not 0", f"set FS_THR_ENABLE to 1 (returns) {_GOES_ON}", warn_if(lambda v: v == 0)
        ),
        SettingCheck(
            "FS_OPTIONS",
            "bit 2 clear",
            f"clear bit 2 (4) of FS_OPTIONS {_GOES_ON}",
            warn_if(lambda v: bool(int(v) & 4)),  # flies on in GUIDED without the remote control
        ),
    ),
    fence=FenceSettings(
        "FENCE_RADIUS",
        "FENCE_ALT_MAX",
        ("FENCE_ENABLE", "FENCE_TYPE", "FENCE_ACTION"),
        "FENCE_ENABLE to 1, FENCE_TYPE to 3 (height and circle), FENCE_ACTION to 4 (brake)",
        _fence,
    ),
    hints=Hints(
        port=" (SERIALn_BAUD 921)",
        mount=" (MNT1_TYPE)",
        battery=" (BATT_MONITOR 4 and BATT_CAPACITY)",
        by_hand="switch to GUIDED by hand",
    ),
    simulated=Simulated(
        stick_mode="LOITER",
        settings={"GUID_TIMEOUT": 0.5},
        gains=Gains(position=1.0, velocity=2.0, integral=1.0, derivative=0.25),  # PSC_NE_POS_P, PSC_NE_VEL_P, _I, _D
        # This and the decays: fitted to the recorded flights.
        airframe=Airframe((0.093, 0.048), drag=0.0275, inflow=0.25, friction=0.0),
        stop=Decay(0.667, 7.5),  # BRAKE: its jerk limit over its deceleration
        hold=Decay(1.28, 2.92),
        stick=Decay(3.0, 2.5),
        jerk_m_s3=5.0,  # PSC_JERK_NE
        # Recorded: the velocity errs by 0.02 m/s, the position by 0.03 m, the height by 0.01 m.
        horizontal=ReportErrors(
            ((0.5555, 0.4084), (0.0207, 1.1008)), ((0.4078, -0.3403), (-0.0429, -0.0961)), (0.00606, 0.00239), 0.13
        ),
        vertical=ReportErrors(
            ((0.8172, -0.2234), (-0.0111, 1.0314)), ((0.0989, 0.3548), (0.0017, -0.0215)), (0.00217, 0.00028), 0.05
        ),
        transit_s=0.002,
    ),
)  # fmt: skip
