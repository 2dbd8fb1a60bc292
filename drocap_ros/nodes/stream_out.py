"""Node ``stream_out``: the newest pose to other programs, by VMC over UDP and as JSON by a WebSocket.

Subscribes ``pose3d/latest`` or, by its parameter ``stage``, ``pose3d/initial``, and ``/tf``, for the up of a camera in
``odom``; publishes no topic.  What receivers get: docs/live_out.md.
"""

from __future__ import annotations

import asyncio
import contextlib
import importlib.util
import math
import socket
import threading
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

import numpy as np
from rclpy.serialization import deserialize_message
from scipy.spatial.transform import Rotation

from drocap_ros.errors import InputError
from drocap_ros.export.avatar import AvatarPose, LiveRig, up_of_pitch, y_up_of
from drocap_ros.export.live_messages import json_text, vmc_packet
from drocap_ros.export.stream_out_config import StreamOutConfig, address_of, is_loopback
from drocap_ros.msg import Pose3D
from drocap_ros.ros.component import OK, WARN, ComponentNode
from drocap_ros.ros.conversions import MAP, ODOM, pose3d_from_ros
from drocap_ros.ros.diagnostics import Key
from drocap_ros.ros.topics import NODES, TFMessage
from drocap_ros.skeleton import joint_set

if TYPE_CHECKING:
    from aiohttp import web

#: A pose this old shows nobody.
_OLD_S = 0.5
#: A path's windows, each with its camera, come every second or two; after this time there is none any more.
_UP_S = 5.0
#: To wait for an event loop, s.
_LOOP_S = 5.0


class StreamOutNode(ComponentNode):
    """Sends each pose as it comes, and the newest one again where none comes."""

    component = "stream_out"
    config: StreamOutConfig

    def build(self) -> None:
        """Declare endpoints and open the sockets."""
        chosen = f"pose3d/{self.config.stage}"
        self.needs = (chosen,)  # type: ignore[misc]  # of this node's parameter
        for topic in NODES[self.component].subscribes:
            if topic == chosen:
                self.input(topic, self._on_pose, newest=True)
            else:  # the other stage is matched, as the graph expects
                self.input(topic, self._on_tf if topic == "/tf" else lambda _: None, raw=True)
        self._person, self._rig = (0, ""), LiveRig(())
        self._pitched = up_of_pitch(math.radians(self.config.camera_pitch_deg))
        self._up, self._up_s = self._pitched, -math.inf
        self._pose: AvatarPose | None = None
        self._stamp_ns, self._frame = 0, ""
        self._begin_s, self._came_s = self.now_s(), -math.inf
        self._vmc: socket.socket | None = None
        places = []
        if self.config.vmc:
            _expect("pythonosc", "python-osc")
            self._vmc = _datagrams(self.config.vmc)
            places.append(f"VMC to {self.config.vmc}")
        self._web: WebClients | None = None
        if self.config.websocket:
            _expect("aiohttp", "aiohttp")
            host, port = address_of(self.config.websocket, "websocket")
            self._web = WebClients(host, port)
            places.append(
                f"WebSocket on {self.config.websocket}" + ("" if is_loopback(host) else ", open to the network")
            )
        self._places = "; ".join(places) or "neither vmc nor websocket is set"
        self._again = self.create_timer(1.0 / self.config.rate_hz, self._repeat)

    def _on_tf(self, data: bytes) -> None:
        """Take the up of a camera in ``odom``; most messages are other frames, so few are read."""
        if ODOM.encode() not in data:
            return
        for transform in deserialize_message(data, TFMessage).transforms:
            if transform.header.frame_id == ODOM:
                q = transform.transform.rotation
                self._up = Rotation.from_quat([q.x, q.y, q.z, q.w]).inv().apply([0.0, 0.0, 1.0])
                self._up_s = self.now_s()

    def _leveled_by(self) -> tuple[np.ndarray, str]:
        """Up in the camera's frame, and by what it is known."""
        if self.now_s() - self._up_s < _UP_S:
            return self._up, f"the camera in {ODOM}"
        return self._pitched, f"camera_pitch_deg {self.config.camera_pitch_deg:g}"

    def _on_pose(self, message: Pose3D) -> None:
        pose = pose3d_from_ros(message)
        frame = message.header.frame_id
        if message.track_id and (message.track_id, message.skeleton) != self._person:
            self._person, self._rig = (message.track_id, message.skeleton), LiveRig(joint_set(message.skeleton).joints)
        self._pose = None
        if message.track_id:
            in_world = frame in (MAP, ODOM)
            up, known_by = (None, "") if in_world else self._leveled_by()
            upright = y_up_of(pose.joints3d, up)
            self._pose = self._rig.pose(upright, pose.confidence, pose.stamp_ns, on_floor=not in_world)
            level = "" if in_world else f", leveled by {known_by}; on the floor, without a place"
            self.details[Key.FRAME] = frame + level
        self._stamp_ns, self._frame, self._came_s = pose.stamp_ns, frame, self.now_s()
        self._again.reset()
        self._send()
        self.count(Key.POSES)
        self.produced(pose.stamp_ns)
        seen = "" if self._pose is not None else "; nobody is seen"
        self.report(OK if self._pose is not None else WARN, self._places + seen)

    def _repeat(self) -> None:
        if self.now_s() - self._came_s > _OLD_S:
            self._pose = None
        self._send()

    def _send(self) -> None:
        if self._vmc is not None:
            try:
                self._vmc.send(vmc_packet(self._pose, self.now_s() - self._begin_s))
                self.count(Key.PACKETS)
            except OSError as error:  # nobody listens yet, or the network is away
                self.count(Key.PACKETS_REFUSED)
                self.details[Key.LAST_REFUSED] = f"{self.config.vmc}: {error.strerror}"
        if self._web is not None:
            self._web.show(json_text(self._pose, self._stamp_ns, self._frame))

    def close(self) -> None:
        """Close the sockets."""
        if self._vmc is not None:
            self._vmc.close()
        if self._web is not None:
            self._web.close()


class WebClients:
    """WebSocket clients, served by an event loop in a thread; each gets the newest text when it has taken the last."""

    def __init__(self, host: str, port: int) -> None:
        self._text, self._changed = "", asyncio.Event()
        self._private = is_loopback(host)
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="websocket", daemon=True)
        self._thread.start()
        try:
            self._runner = asyncio.run_coroutine_threadsafe(self._serve(host, port), self._loop).result(_LOOP_S)
        except OSError as error:
            self._end_loop()
            raise InputError(
                f"websocket: expected a free address, found {host}:{port} refused ({error.strerror}); choose another"
            ) from None

    async def _serve(self, host: str, port: int) -> web.AppRunner:
        from aiohttp import web

        application = web.Application()
        application.router.add_get("/", self._talk)
        runner = web.AppRunner(application, handle_signals=False, shutdown_timeout=0.5)
        await runner.setup()
        await web.TCPSite(runner, host, port).start()
        return runner

    async def _talk(self, request: web.Request) -> web.WebSocketResponse:
        from aiohttp import web

        origin = urlsplit(request.headers.get("Origin", "")).hostname
        if self._private and origin and not is_loopback(origin):  # a foreign page in a browser of this computer
            raise web.HTTPForbidden
        client = web.WebSocketResponse(heartbeat=10.0)
        await client.prepare(request)
        listening = asyncio.ensure_future(_until_it_goes(client))
        with contextlib.suppress(ConnectionError):
            while not listening.done() and not client.closed:
                changed = self._changed
                await asyncio.wait({listening, asyncio.ensure_future(changed.wait())}, return_when="FIRST_COMPLETED")
                await client.send_str(self._text)
        listening.cancel()
        return client

    def show(self, text: str) -> None:
        """Give a text to every client that is ready for it."""

        def change() -> None:
            self._text = text
            self._changed.set()
            self._changed = asyncio.Event()

        self._loop.call_soon_threadsafe(change)

    def close(self) -> None:
        """Say good-bye and end the thread."""
        asyncio.run_coroutine_threadsafe(self._runner.cleanup(), self._loop).result(_LOOP_S)
        self._end_loop()

    def _end_loop(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(_LOOP_S)
        self._loop.close()


async def _until_it_goes(client: web.WebSocketResponse) -> None:
    """Take what a client says, which nobody has asked for."""
    async for _ in client:
        pass


def _expect(module: str, package: str) -> None:
    if importlib.util.find_spec(module) is None:
        raise InputError(f"stream_out: expected {package}, found none; run: pip install 'drocap_ros[app]'")


def _datagrams(address: str) -> socket.socket:
    """UDP socket that sends to HOST:PORT and never waits."""
    host, port = address_of(address, "vmc")
    try:
        family, kind, _, _, place = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        out = socket.socket(family, kind)
        out.setblocking(False)
        out.connect(place)
    except OSError as error:
        raise InputError(
            f"vmc: expected an address that exists, found {address} ({error.strerror}); correct it"
        ) from None
    return out
