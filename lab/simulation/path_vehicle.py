"""A simulated vehicle that follows a given path without error, in real time.

``python -m lab.simulation.path_vehicle --url URL`` runs it as a process of its own.
"""

from __future__ import annotations

import argparse
import math
import threading
import time
from collections.abc import Callable

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.flight.autopilot import AUTOPILOTS
from drocap_ros.flight.mavlink.transport import Transport, open_transport
from drocap_ros.flight.vehicle import LANDED_ON_GROUND, OPTICAL_FROM_FLU
from drocap_ros.geometry.rotations import quaternion_from_matrix, slerp
from drocap_ros.simulation.vehicle.mavlink_vehicle import SimulatedVehicle, VehiclePose
from lab.simulation.orbit import orbit_camera


class SampledPath:
    """Path through sampled camera poses: the camera is at the vehicle's position, the nose follows its bearing.

    t_s : (F,) increasing
    rotation : (F, 3, 3) world ENU -> camera optical
    position : (F, 3) m ENU
    """

    def __init__(self, t_s: np.ndarray, rotation: np.ndarray, position: np.ndarray) -> None:
        self._t = np.asarray(t_s, dtype=float)
        self._position = position
        self._velocity = np.gradient(position, self._t, axis=0) if len(self._t) > 1 else np.zeros_like(position)
        self._camera = quaternion_from_matrix(np.swapaxes(rotation, 1, 2) @ OPTICAL_FROM_FLU)
        forward = rotation[:, 2]
        self._yaw = np.unwrap(np.arctan2(forward[:, 1], forward[:, 0]))

    def at(self, t_s: float) -> VehiclePose:
        """Pose at an instant."""
        t = self._t
        inside = float(np.clip(t_s, t[0], t[-1]))
        i = int(np.clip(np.searchsorted(t, inside, side="right") - 1, 0, max(len(t) - 2, 0)))
        j = min(i + 1, len(t) - 1)
        part = (inside - t[i]) / (t[j] - t[i]) if j > i else 0.0
        moving = 1.0 if t[0] <= t_s <= t[-1] else 0.0
        yaw = (1 - part) * self._yaw[i] + part * self._yaw[j]
        yaw_rate = (self._yaw[j] - self._yaw[i]) / (t[j] - t[i]) if j > i else 0.0
        return VehiclePose(
            (1 - part) * self._position[i] + part * self._position[j],
            moving * ((1 - part) * self._velocity[i] + part * self._velocity[j]),
            np.array([0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)]),
            np.array([0.0, 0.0, moving * yaw_rate]),
            slerp(self._camera[i], self._camera[j], part),
        )


def orbit_path(seconds: float, radius_m: float = 6.0, height_m: float = 2.5, speed_deg_s: float = 25.0) -> SampledPath:
    """Orbit about a point 0.9 m above the origin."""
    t = np.arange(0.0, seconds + 0.02, 0.02)
    centre = np.broadcast_to(np.array([0.0, 0.0, 0.9]), (len(t), 3))
    rotation, position = orbit_camera(t, centre, radius_m, height_m, speed_deg_s)
    return SampledPath(t, rotation, position)


class PathVehicle(SimulatedVehicle):
    """A vehicle on a path, which it flies in a thread, or in its caller's.

    link : a transport, or a URL of :func:`drocap_ros.flight.mavlink.transport.open_transport`
    max_rate_hz : highest delivered rate, whatever was requested and acknowledged (a slow link)
    signing_key : 32 bytes; it then signs its packets and drops unsigned ones
    The other parameters are those of :class:`SimulatedVehicle`.
    """

    def __init__(
        self,
        link: str | Transport,
        path: SampledPath,
        autopilot: str = "ardupilot",
        *,
        gimbal: bool = True,
        max_rate_hz: float = 400.0,
        boot_s: float = 30.0,
        signing_key: bytes | None = None,
    ) -> None:
        transport = open_transport(link) if isinstance(link, str) else link
        super().__init__(transport, autopilot, gimbal=gimbal, boot_s=boot_s)
        self.path, self.max_rate_hz = path, max_rate_hz
        if signing_key is not None:
            self.use_key(signing_key, time.time_ns())
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def at(self, t_s: float) -> VehiclePose:
        """Pose on the path."""
        return self.path.at(t_s)

    def __enter__(self) -> PathVehicle:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def start(self, clock_s: Callable[[], float] = time.monotonic) -> None:
        """Fly in a thread, in real time; path time 0 is now."""
        self._thread = threading.Thread(target=self.run, args=(clock_s,), name="simulated-vehicle", daemon=True)
        self._thread.start()

    def run(self, clock_s: Callable[[], float] = time.monotonic, seconds: float = math.inf) -> None:
        """Fly in real time until :meth:`close`, or for some seconds."""
        start = clock_s()
        while not self._stop.is_set() and clock_s() - start < seconds:
            data = self._transport.read(0.004)
            # The time is taken after it: an answer to TIMESYNC must not be stamped before the question came.
            self.step(clock_s() - start, data)

    def close(self) -> None:
        """Stop and close the port."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(2.0)
        super().close()


def _setting(text: str) -> tuple[str, float]:
    """Name and value of NAME=VALUE; a value without a decimal point is an int."""
    name, _, value = text.partition("=")
    try:
        return name, int(value) if value.lstrip("-").isdigit() else float(value)
    except ValueError:
        raise InputError(f"--set: expected NAME=VALUE, got {text!r}") from None


def main(arguments: list[str] | None = None) -> None:
    """Run an orbit as a process."""
    parser = argparse.ArgumentParser(prog="path_vehicle", description=__doc__)
    parser.add_argument("--url", default="udpout:127.0.0.1:14540", help="address of the companion computer")
    parser.add_argument("--autopilot", choices=tuple(AUTOPILOTS), default="ardupilot")
    parser.add_argument("--seconds", type=float, default=3600.0, help="length of the flight, s")
    parser.add_argument("--radius", type=float, default=6.0, help="of the orbit, m")
    parser.add_argument("--height", type=float, default=2.5, help="above the ground, m")
    parser.add_argument("--speed", type=float, default=25.0, help="deg/s, counter-clockwise from above")
    parser.add_argument("--max-rate", type=float, default=400.0, help="highest delivered rate of a message, Hz")
    parser.add_argument(
        "--set", nargs="*", default=[], metavar="NAME=VALUE", help="parameters of the autopilot, e.g. GUID_TIMEOUT=3"
    )
    parser.add_argument("--on-ground", action="store_true", help="it reports that it stands there, not armed")
    args = parser.parse_args(arguments)
    path = orbit_path(args.seconds, args.radius, args.height, args.speed)
    try:
        settings = dict(map(_setting, args.set))
        with PathVehicle(args.url, path, args.autopilot, max_rate_hz=args.max_rate) as vehicle:
            vehicle.settings.update(settings)
            if args.on_ground:
                vehicle.armed, vehicle.landed_state = False, LANDED_ON_GROUND
            vehicle.run(seconds=args.seconds)
    except InputError as error:
        parser.exit(2, f"{error}\n")
    except KeyboardInterrupt:
        pass


if __name__ == "__main__":
    main()
