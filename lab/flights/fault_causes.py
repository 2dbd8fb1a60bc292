"""Mechanisms outside the bridge that end a flight with a fault: their bounds and the evidence of each.

Stops scale with the speed from what was measured on ArduPilot Copter at 2 m/s.
"""

from __future__ import annotations

from drocap_ros.flight.autopilot import autopilot_of
from drocap_ros.flight.orbit.states import State
from lab.flights.fault_flight import FAULT_S, MOTION_S, Bounds, Cause, Flight
from lab.flights.orbit_loop import LoopSettings

FRAME_S = 0.17  # period of the images and their latency: the earliest sign of a fault of perception
HEARTBEAT_S = 0.21  # mode and status arrive at 5 Hz
HEARTBEAT_PX4_S = 1.05  # PX4 sends its heartbeat once a second, whatever is requested
LINK_S = 0.05  # to the next setpoint or telemetry message
ECHO_S = 0.65  # the simulated autopilot repeats its echo for 0.5 s at 10 Hz
DELAY_S = 1.0  # of a delayed link
TAKEN_S = 0.8  # from the fault to the pilot's mode during a hold
_DRIFT_M = 0.3  # of the position estimate during the stop: 0.4 m with a time constant of 20 s
_LOSS_CHECK_S = 0.14  # after COM_OF_LOSS_T; measured on PX4: 0.06 to 0.13 s
_MAX_ACCELERATION = 4.5  # of the simulated vehicle, m/s^2
#: Measured stops from 2 m/s, m: a position setpoint, LOITER (assumed for PX4's hold mode too), BRAKE.
_POSITION_STOP_M, _LOITER_STOP_M, _BRAKE_STOP_M = 1.5, 2.0, 3.4


def _scaled(stop_m: float, speed: float) -> float:
    """Stop from another speed than 2 m/s: between linear (lag) and quadratic (deceleration)."""
    return stop_m * max(speed / 2, (speed / 2) ** 2)


def _timeout_bounds(settings: LoopSettings, speed: float) -> Bounds:
    """The last setpoint acts for the time-out; then ArduPilot holds its position, PX4 changes to its hold mode."""
    holds = not autopilot_of(settings.autopilot).needs_mode_to_stop
    flown_s = settings.timeout_s + (0.02 if holds else _LOSS_CHECK_S)
    stop_m = _POSITION_STOP_M if holds else _LOITER_STOP_M
    return Bounds(max(flown_s, MOTION_S), speed * flown_s + _scaled(stop_m, speed) + _DRIFT_M)


def _nothing_arrived(flight: Flight) -> bool:
    """No setpoint was accepted between the fault and the end of the motion."""
    during = [
        count for t, count in zip(flight.times, flight.accepted, strict=True)
        if FAULT_S + 0.06 <= t <= flight.motion_until_s
    ]  # fmt: skip
    return len(during) > 0 and during[0] == during[-1]


def _delay_bounds(settings: LoopSettings, speed: float) -> Bounds:
    """The time-out acts during the delay; then everything arrives that was sent before the delay was detected.

    The age of telemetry reveals the delay; missing answers reveal one of the uplink alone.
    """
    config = settings.config
    detected_s = config.max_round_trip_s + 1.0 / config.time_sync_hz + 1.0 / config.control_hz
    return Bounds(DELAY_S + detected_s, _timeout_bounds(settings, speed).excursion_m + speed * detected_s)


def _in_transit(flight: Flight) -> bool:
    """The bridge ended the orbit on detection; only packets already in transit moved the vehicle later."""
    detected = flight.orbit_until_s - FAULT_S <= MOTION_S + 0.2
    return detected and flight.motion_until_s - flight.orbit_until_s <= DELAY_S + 0.1


def _loss_bounds(settings: LoopSettings, speed: float) -> Bounds:
    """Most packets are lost, the hold among them; the last one that arrived acts for the time-out."""
    detected_s = settings.config.max_state_age_s + 2.0 / settings.config.control_hz
    timeout = _timeout_bounds(settings, speed)
    return Bounds(detected_s + timeout.motion_s, timeout.excursion_m + speed * detected_s)


def _orbit_ended(flight: Flight) -> bool:
    """The bridge ended the orbit within the bound of the protocol."""
    return flight.orbit_until_s - FAULT_S <= MOTION_S


def _jump_bounds(settings: LoopSettings, speed: float) -> Bounds:
    """Until the jump is reported and the hold arrives, the autopilot accelerates towards the old setpoint."""
    pulled_s = 0.15
    speed += _MAX_ACCELERATION * pulled_s
    return Bounds(MOTION_S, speed * pulled_s + _scaled(_POSITION_STOP_M, speed) + _DRIFT_M)


def _mode_bounds(settings: LoopSettings, speed: float) -> Bounds:
    """The autopilot ignores the bridge; the mode stops the vehicle, at the latest like the slowest one measured."""
    return Bounds(MOTION_S, _scaled(_BRAKE_STOP_M, speed) + _DRIFT_M)


def _takeover_bounds(settings: LoopSettings, speed: float) -> Bounds:
    """The hold has begun; the pilot's mode brakes the remaining speed, at most all of it."""
    return Bounds(MOTION_S, speed * (TAKEN_S - FRAME_S) + _scaled(_LOITER_STOP_M, speed) + _DRIFT_M)


def _taken_over(flight: Flight) -> bool:
    """Pilot or failsafe chose the last mode, and the bridge ended the orbit in time and stayed silent."""
    by = flight.loop.copter.mode_log[-1][2]
    silent = flight.loop.controller.safety.state == State.TAKEN_OVER
    return silent and (by == "pilot" or by.startswith("failsafe")) and _orbit_ended(flight)


TIMEOUT = Cause("time-out of the autopilot: no packet of the bridge arrives", _timeout_bounds, _nothing_arrived)
DELAYED = Cause("setpoints in transit in the delayed link still arrive", _delay_bounds, _in_transit)
LOSSY = Cause("time-out of the autopilot: the hold was lost", _loss_bounds, _orbit_ended)
JUMPED = Cause("the autopilot flies to the setpoint from before its jump until the hold", _jump_bounds, _orbit_ended)
MODE = Cause("the mode chosen by pilot or failsafe brakes", _mode_bounds, _taken_over)
PILOT = Cause("the pilot's mode ends the hold and brakes", _takeover_bounds, _taken_over)
