"""Node ``flight_simulator``: a simulated drone with a camera, and a person.

Replaces vehicle, autopilot, pilot and ``image_ingest``: sends and receives MAVLink on ``vehicle_url``, publishes
``image/compressed`` and ``camera_info`` of images rendered from the vehicle's true pose.  Stamps are the instants of
exposure.  At its end it writes the truth to ``truth_file``.

In real time, images come as fast as this machine renders them.  In simulated time (``use_sim_time``) each image is
published ``latency_s`` after its exposure, and the vehicle moves with the clock alone.
"""

from __future__ import annotations

import sys
import threading
import time
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from drocap_ros.flight.mavlink.transport import open_transport
from drocap_ros.geometry.lens import CameraModel
from drocap_ros.ros.component import OK, WARN
from drocap_ros.ros.conversions import camera_info_to_ros, compressed_image_to_ros, header_at
from drocap_ros.ros.diagnostics import PILOT_FLIES, PILOT_HANDS_OFF, Key
from drocap_ros.ros.lifecycle import ManagedComponent
from drocap_ros.ros.lockstep import STEP_S
from drocap_ros.ros.own_process import LooksAhead, OwnProcess
from drocap_ros.simulation.flight_simulator.simulator_config import FlightSimulatorConfig
from drocap_ros.simulation.flight_simulator.truth import save_flight_truth
from drocap_ros.simulation.flight_simulator.world import Exposure, FlightWorld
from drocap_ros.simulation.render.renderer import Renderer

FRAME_ID = "camera_optical"
#: Pause between steps of the vehicle in real time, below the period of its fastest telemetry (20 ms).
_STEP_S = 0.005


class FlightSimulatorNode(ManagedComponent):
    """One thread flies and exposes, another renders: a slow image never delays the vehicle.

    In simulated time a timer flies and exposes, and waits for the rendering, which has a process of its own.
    """

    component = "flight_simulator"
    config: FlightSimulatorConfig

    def build(self) -> None:
        """Declare endpoints and state."""
        self._images = self.output("image/compressed")
        self._infos = self.output("camera_info")
        self._world = FlightWorld(self.config, self.transport or open_transport(self.config.vehicle_url))
        width, height = self.config.image_width, self.config.image_height
        self._camera = CameraModel(width, height, self._world.camera_matrix)
        jpeg = Renderer(self._world.camera_matrix, width, height, self.config.seed).jpeg
        self._jpeg = OwnProcess(jpeg) if self.simulated else jpeg
        self._waiting: Exposure | None = None
        self._exposed = threading.Condition()
        self._stop = threading.Event()
        self._threads = [self.thread(self._fly, "flight"), self.thread(self._render, "camera")]
        self._camera_thread = ThreadPoolExecutor(1, "camera")  # in simulated time
        self._pending: deque[tuple[int, Future[bytes]]] = deque()  # stamps of exposures with their pictures
        self._begin_ns = 0
        self.create_timer(0.5, self._on_timer)

    def begin(self) -> None:
        """Let the pilot take off; a flight under way has continued meanwhile."""
        if self.simulated:
            if not self._begin_ns:
                self._begin_ns = self.now_ns()
                self.create_timer(STEP_S, self._step)
            return
        # Rendering is many short steps in Python: without this each telemetry message waits its 5 ms for the turn.
        sys.setswitchinterval(0.0005)
        for thread in self._threads:
            if thread.ident is None:
                thread.start()

    def close(self) -> None:
        """End the flight and write the truth."""
        self._end()
        for thread in self._threads:
            if thread.is_alive():
                thread.join(timeout=5.0)
        self._camera_thread.shutdown(cancel_futures=True)
        if isinstance(self._jpeg, OwnProcess):
            self._jpeg.close()
        self._world.close()
        if self.config.truth_file and self.counters[Key.EXPOSURES]:
            save_flight_truth(Path(self.config.truth_file), self._world.truth())

    def _end(self) -> None:
        self._stop.set()
        with self._exposed:
            self._exposed.notify_all()

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

    def _step(self) -> None:
        """Fly to the simulated time, expose on the way, publish what is due."""
        now_ns, latency_ns = self.now_ns(), round(self.config.latency_s * 1e9)
        while (stamp_ns := self._begin_ns + round(self.counters[Key.EXPOSURES] / self.config.rate_hz * 1e9)) < now_ns:
            self._world.step((stamp_ns - self._begin_ns) * 1e-9)
            picture = self._camera_thread.submit(self._picture, self._world.expose(stamp_ns))
            self._pending.append((stamp_ns, picture))
            for node in self.beside.values():
                if isinstance(node, LooksAhead):
                    node.expect(stamp_ns, picture)
            self.count(Key.EXPOSURES)
        self._world.step((now_ns - self._begin_ns) * 1e-9)
        while self._pending and self._pending[0][0] + latency_ns <= now_ns:
            stamp_ns, picture = self._pending.popleft()
            self._publish(stamp_ns, picture.result())

    def _expose(self, stamp_ns: int) -> None:
        exposure = self._world.expose(stamp_ns)
        self.count(Key.EXPOSURES)
        with self._exposed:
            if self._waiting is not None:
                self.count(Key.IMAGES_UNRENDERED)
            self._waiting = exposure
            self._exposed.notify()

    def _render(self) -> None:
        """Render exposures; of several that wait, the newest."""
        while not self._stop.is_set():
            with self._exposed:
                while self._waiting is None and not self._stop.is_set():
                    self._exposed.wait()
                exposure, self._waiting = self._waiting, None
            if exposure is None:
                return
            if not self.active:
                continue
            self._publish(exposure.stamp_ns, self._picture(exposure))

    def _picture(self, exposure: Exposure) -> bytes:
        return self._jpeg(self.config.jpeg_quality, exposure.joints3d, exposure.rotation, exposure.position)

    def _publish(self, stamp_ns: int, jpeg: bytes) -> None:
        if self.active:
            header = header_at(stamp_ns, FRAME_ID)
            self._images.publish(compressed_image_to_ros(header, jpeg))
            self._infos.publish(camera_info_to_ros(header, self._camera))
            self.count(Key.IMAGES)
            self.produced(stamp_ns)

    def _on_timer(self) -> None:
        copter, pilot = self._world.copter, self._world.pilot
        self.details[Key.VEHICLE_MODE] = copter.mode
        self.details[Key.PILOT] = PILOT_HANDS_OFF if pilot.handed_over else PILOT_FLIES
        if copter.crashed:
            self.report(WARN, f"the vehicle has crashed: {copter.crashed}")
        elif self.active:
            self.report(OK, f"pilot: {pilot.phase.value}")
