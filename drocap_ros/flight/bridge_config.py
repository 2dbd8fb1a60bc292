"""Parameters of the MAVLink bridge."""

from __future__ import annotations

from dataclasses import dataclass

from drocap_ros.errors import ParameterError
from drocap_ros.flight.orbit_config import OrbitConfig
from drocap_ros.flight.safety_config import SafetyConfig, height_condition
from drocap_ros.flight.subject_config import SubjectConfig
from drocap_ros.parameters import param

FENCE_ROOM_M = 1.0  # of an orbit from the fence: its braking distance at 1.6 m/s


@dataclass(frozen=True)
class MavlinkBridgeConfig(SubjectConfig, OrbitConfig, SafetyConfig):
    """The link to the autopilot, its telemetry, the orbit, and the conditions for motion."""

    url: str = param(
        "udpin:127.0.0.1:14540",
        "udpin:HOST:PORT (listen), udpout:HOST:PORT, udp:HOST:PORT (as udpin), tcp:HOST:PORT, serial:DEVICE[:BAUD]",
    )
    system_id: int = param(
        1,
        "own MAVLink system, that of the carrying vehicle.  Never 255: it is the ground station's, and an "
        "autopilot that receives it does not notice the loss of the real one",
        minimum=1,
        maximum=254,
    )
    component_id: int = param(191, "own MAVLink component; 191 = onboard computer", minimum=2, maximum=250)
    target_system_id: int = param(0, "vehicle to read; 0 = the first autopilot", minimum=0, maximum=254)
    signing_key_file: str = param(
        "", "file with the 64 hexadecimal digits of the key by which packets are signed, both ways; empty = unsigned"
    )
    heartbeat_hz: float = param(1.0, "rate of our heartbeat", "Hz", 0.2, 10)
    attitude_hz: float = param(50.0, "wanted rate of attitude", "Hz", 1, 200)
    position_hz: float = param(30.0, "wanted rate of local position", "Hz", 1, 100)
    gimbal_hz: float = param(20.0, "wanted rate of the gimbal's attitude; 0 = not requested", "Hz", 0, 100)
    status_hz: float = param(5.0, "wanted rate of GPS, battery, estimator and landed state", "Hz", 0.2, 20)
    time_sync_hz: float = param(
        10.0, "rate of time synchronization; its answers show that the link works in both directions", "Hz", 0.1, 20
    )
    rate_window_s: float = param(3.0, "time over which the real rates are measured", "s", 1, 30)
    rate_shortfall: float = param(
        0.5, "share of the wanted rate below which a message is requested again", minimum=0, maximum=1
    )
    request_retry_s: float = param(2.0, "time between requests for the same message", "s", 0.2, 60)
    link_timeout_s: float = param(3.0, "silence after which the link counts as lost", "s", 0.5, 60)
    control_hz: float = param(20.0, "rate of setpoints", "Hz", 5, 50)
    watchdog_s: float = param(
        0.2, "time without a step of the control loop after which the watchdog holds the vehicle", "s", 0.1, 2
    )
    max_control_timeout_s: float = param(
        0.5, "longest time-out without setpoints: a longer or unknown one forbids motion; 0 = not checked", "s", 0, 10
    )
    gimbal_control: bool = param(False, "whether the mount's pitch follows the subject")

    def __post_init__(self) -> None:
        super().__post_init__()
        if (refusal := height_condition(self, self.height_m)) is not None:
            raise ParameterError(str(refusal))
        if self.radius_m + FENCE_ROOM_M > self.fence_radius_m:
            raise ParameterError(
                f"fence_radius_m: expected at least radius_m and 1 m, {self.radius_m + FENCE_ROOM_M:g}, "
                f"got {self.fence_radius_m:g}; widen the fence or come closer"
            )
        # One period of the loop is no hang: with less, every step would count as one.
        if self.watchdog_s < (periods_s := 2.0 / self.control_hz):
            raise ParameterError(
                f"watchdog_s: expected at least two periods of control_hz, {periods_s:.2g} s, got {self.watchdog_s:g}; "
                "raise it or control_hz"
            )
        # The age of the last answer grows by a period before the next one: with less it would hold the vehicle.
        if self.commands_enabled and self.time_sync_hz < (least_hz := 2.0 / self.max_round_trip_s):
            raise ParameterError(
                f"time_sync_hz: expected at least two answers within max_round_trip_s, {least_hz:.3g} Hz, to fly, "
                f"got {self.time_sync_hz:g}; raise one of the two"
            )
        for name, least in (("attitude_hz", 5.0), ("position_hz", 5.0), ("status_hz", 2.0)):
            if self.commands_enabled and getattr(self, name) < least:
                raise ParameterError(
                    f"{name}: expected at least {least:g} Hz to fly by it, got {getattr(self, name):g}; raise it or "
                    "set commands_enabled to false"
                )
