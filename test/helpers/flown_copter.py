"""A simulated ArduPilot without estimation errors that flies the setpoints it is sent."""

import math

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.flight.vehicle import enu_to_ned
from drocap_ros.simulation.vehicle.copter import SimulatedCopter
from drocap_ros.simulation.vehicle.copter_reports import CopterSetup
from drocap_ros.simulation.vehicle.loopback import Channel, LoopbackTransport

RADIUS, SPEED, RAMP_S, HEIGHT = 6.0, 2.0, 3.0, 2.5
ALL = 0  # no part of a setpoint is ignored


class Flight:
    """A copter without estimation errors, and its setpoints."""

    def __init__(self, wind=0.0, centre_speed=0.0, timeout_s=3.0):
        self.t, self.centre_speed = 0.0, centre_speed
        channels = [Channel(lambda: self.t) for _ in range(2)]
        self.up, self.down = channels
        self.copter = SimulatedCopter(
            LoopbackTransport(*channels),
            np.array([RADIUS, 0.0, HEIGHT]),
            math.pi,
            CopterSetup(
                mode="GUIDED", estimate_error=0.0, attitude_error_deg=0.0, wind=(wind, 0.0, 0.0), timeout_s=timeout_s
            ),
        )
        self.mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=191)
        self.rows = []

    def centre(self):
        return np.array([self.centre_speed * self.t, 0.0, 0.0])

    def send(self, mask, position=(0, 0, 0), velocity=(0, 0, 0), acceleration=(0, 0, 0), yaw=math.pi / 2, yaw_rate=0.0):
        vectors = [
            float(v) for vector in (position, velocity, acceleration) for v in enu_to_ned(np.array(vector, float))
        ]
        self.up.write(
            self.mav.set_position_target_local_ned_encode(
                0, 1, 1, 1, mask, *vectors, math.remainder(math.pi / 2 - yaw, 2 * math.pi), -yaw_rate
            ).pack(self.mav)
        )  # fmt: skip

    def orbit(self, mask, yaw_from):
        """Send the setpoint of the circle; ``yaw_from`` the reference, or the vehicle's position."""
        omega = SPEED / RADIUS * min(self.t / RAMP_S, 1.0)
        phase = SPEED / RADIUS * (self.t**2 / (2 * RAMP_S) if self.t < RAMP_S else self.t - RAMP_S / 2)
        outward, along = (
            np.array([math.cos(phase), math.sin(phase), 0]),
            np.array([-math.sin(phase), math.cos(phase), 0]),
        )
        sight = -outward if yaw_from == "reference" else self.centre() - self.copter.body.position
        self.send(
            mask, self.centre() + RADIUS * outward + np.array([0, 0, HEIGHT]),
            RADIUS * omega * along + np.array([self.centre_speed, 0, 0]), -(omega**2) * RADIUS * outward,
            math.atan2(sight[1], sight[0]), omega,
        )  # fmt: skip

    def fly(self, until_s, each):
        while self.t < until_s - 1e-9:
            self.t = round(self.t + 0.01, 6)
            if round(self.t * 100) % 5 == 0:
                each()
            self.copter.fly(self.t)
            self.down.read()
            body, sight = self.copter.body, self.centre() - self.copter.body.position
            yaw_error = math.remainder(body.yaw - math.atan2(sight[1], sight[0]), 2 * math.pi)
            self.rows.append((self.t, *body.position, *body.velocity, float(np.hypot(*sight[:2])), yaw_error))
