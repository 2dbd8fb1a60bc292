"""Node ``flight_simulator``: a simulated drone with a camera and the person before it, in real time.

Takes the place of vehicle, autopilot, pilot and ``image_ingest``: speaks MAVLink on ``vehicle_url``, publishes
``image/compressed`` and ``camera_info`` of the pictures that are rendered from the vehicle's real pose.  Stamps are
the instants of exposure.  At its end it writes the truth to ``truth_file``.
"""

from __future__ import annotations

import sys
import threading
import time
from pathlib import Path
from typing import Any

from drocap_ros.flight.mavlink.transport import open_transport
from drocap_ros.perception.calibration import CameraModel
from drocap_ros.ros.component import OK, WARN, ComponentNode
from drocap_ros.ros.conversions import camera_info_to_ros, header_at
from drocap_ros.ros.image_transport import PictureOutput
from drocap_ros.ros.spin import node_main
from drocap_ros.simulation.flight_simulator.truth import save_flight_truth
from drocap_ros.simulation.flight_simulator.world import Exposure, FlightWorld
from drocap_ros.simulation.render.renderer import Renderer

FRAME_ID = "camera_optical"
_STEP_S = 0.005


class FlightSimulatorNode(ComponentNode):
    """One thread flies and exposes, another renders: a slow picture never holds up the vehicle."""

    component = "flight_simulator"

    def __init__(self, config: Any = None, **node_kwargs: Any) -> None:
        super().__init__(config, **node_kwargs)
        self._pictures = PictureOutput(self, self.config.jpeg_quality)
        self._infos = self.output("camera_info")
        self._world = FlightWorld(self.config, open_transport(self.config.vehicle_url))
        width, height = self.config.image_width, self.config.image_height
        self._camera = CameraModel(width, height, self._world.camera_matrix)
        self._renderer = Renderer(self._world.camera_matrix, width, height, self.config.seed)
        self._waiting: Exposure | None = None
        self._exposed = threading.Condition()
        self._stop = threading.Event()
        self._failure: BaseException | None = None
        self._threads = [
            threading.Thread(target=self._guarded, args=(body,), name=name, daemon=True)
            for name, body in (("flight", self._fly), ("camera", self._render))
        ]
        self.create_timer(0.5, self._on_timer)

    def on_start(self) -> None:
        """The pilot takes off."""
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """End the flight and write what was really there."""
        self._end()
        for thread in self._threads:
            if thread.is_alive():
                thread.join(timeout=5.0)
        self._pictures.close()
        self._world.close()
        if self.config.truth_file and self.counters["exposures"]:
            save_flight_truth(Path(self.config.truth_file), self._world.truth())

    def _end(self) -> None:
        self._stop.set()
        with self._exposed:
            self._exposed.notify_all()

    def _guarded(self, body: Any) -> None:
        try:
            body()
        except BaseException as error:  # raised again where the node spins
            self._failure = error
            self._end()

    def _fly(self) -> None:
        """Step the world as time passes; expose at the camera's rate."""
        begin, period, due = time.monotonic(), 1.0 / self.config.rate_hz, 0.0
        while not self._stop.wait(_STEP_S):
            now = time.monotonic()
            self._world.step(now - begin)
            if now - begin < due:
                continue
            due += period * max(1, int((now - begin - due) / period) + 1)
            passed_ns = int((time.monotonic() - now) * 1e9)
            self._expose(self.get_clock().now().nanoseconds - passed_ns)

    def _expose(self, stamp_ns: int) -> None:
        exposure = self._world.expose(stamp_ns)
        self.count("exposures")
        with self._exposed:
            if self._waiting is not None:
                self.count("pictures not rendered in time")
            self._waiting = exposure
            self._exposed.notify()

    def _render(self) -> None:
        """Turn exposures into pictures; of several that wait, the newest."""
        while not self._stop.is_set():
            with self._exposed:
                while self._waiting is None and not self._stop.is_set():
                    self._exposed.wait()
                exposure, self._waiting = self._waiting, None
            if exposure is None:
                return
            picture = self._renderer.picture(exposure.joints3d, exposure.rotation, exposure.position)
            header = header_at(exposure.stamp_ns, FRAME_ID)
            self._pictures.publish(header, picture)
            self._infos.publish(camera_info_to_ros(header, self._camera))
            self.count("images")
            self.produced(exposure.stamp_ns)

    def _on_timer(self) -> None:
        if self._failure is not None:
            raise self._failure
        copter = self._world.copter
        self.details["mode"] = copter.mode
        if copter.crashed:
            self.report(WARN, f"the vehicle has crashed: {copter.crashed}")
        elif self.started:
            self.report(OK, f"pilot: {self._world.pilot.doing}")


def main() -> int:
    """Run the node as a process."""
    # Rendering is many short steps in Python: without this each telemetry message waits its 5 ms for the turn.
    sys.setswitchinterval(0.0005)
    return node_main(FlightSimulatorNode)


if __name__ == "__main__":
    raise SystemExit(main())
