"""What the pages show of a graph, and which page commands it."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.flight.bridge_config import OPERATOR_PERIOD_S, MavlinkBridgeConfig
from drocap_ros.flight.conditions import ConditionCode
from drocap_ros.flight.orbit.states import State
from drocap_ros.station.desk import Desk, check_values, sentence
from drocap_ros.station.drawing import bearing_deg, bearing_svg, body_points, keypoints_svg, plan_svg

if TYPE_CHECKING:
    from drocap_ros.flight.preflight.findings import Finding
    from drocap_ros.recording.session import Message
    from drocap_ros.ros.graph import Graph

#: A page that has not answered for this long commands no more: three signs that are missed.
SILENT_S = 3 * OPERATOR_PERIOD_S
#: The bridge repeats its status five times a second; older than this it says nothing of now.
OLD_S = 1.5
#: Longest wait for an answer, as of `drocap orbit`.
ANSWER_S = 10.0
#: Pictures that are kept for the keypoints of one of them: half a second at 30 Hz.
_PICTURES = 16
#: Between two looks at the preflight's checks.
_CHECK_S = 2.0
_TOPICS = {"picture": "image/compressed", "keypoints": "pose2d", "pose": "pose3d/latest", "vehicle": "vehicle/state"}
_COLOURS = {
    State.IDLE: "grey", State.READY: "primary", State.ORBITING: "positive", State.HOLDING: "warning",
    State.TAKEN_OVER: "secondary", State.FAULT: "negative",
}  # fmt: skip


class Views(NamedTuple):
    """Functions of other commands that a page shows: `drocap preflight`'s checks, `drocap top`'s table."""

    findings: Callable[[], Sequence[Finding]]
    nodes: Callable[[], list[dict[str, str]]]
    recording: Callable[[], bool | None]


class Look(NamedTuple):
    """One look at a graph.

    state, colour, words : of `orbit/status`; what it says while it is old or has never come
    facts : words by name; ages : s by topic
    picture : number of the picture that the overlay belongs to
    body : (N, 3) m in `map`, None = not there
    vehicle, turn : place (3,) m, NaN = unknown, and rotation (3, 3) or None
    """

    state: str
    colour: str
    words: str
    facts: Mapping[str, str]
    ages: Mapping[str, float]
    picture: int
    overlay: str
    plan: str
    body: np.ndarray | None
    vehicle: np.ndarray
    turn: np.ndarray | None


class Station:
    """Newest messages, and the one page that commands; a thread runs the graph's callbacks.

    Nothing is kept per page: a page asks for what is newest when it is ready for it.

    findings : of the preflight
    holder : key of the page that commands; None = none has
    failure : error of the thread
    """

    def __init__(self, graph: Graph, config: MavlinkBridgeConfig, views: Views) -> None:
        from drocap_ros.ros.graph import Managed, Newest

        self.config, self.views = config, views
        self.findings: Sequence[Finding] = ()
        self.holder: str | None = None
        self.failure: BaseException | None = None
        self._alive_s = -math.inf
        self._graph = graph
        self._desk = Desk(graph, self._take_status)
        self._status_s = -math.inf
        self._state = -1
        self._fence: np.ndarray | None = None
        self._recorder = Managed(graph.node, "session_recorder")
        keep = {"picture": _PICTURES}
        self._newest = {name: Newest(graph.node, topic, keep.get(name, 1)) for name, topic in _TOPICS.items()}
        self._asked: tuple[str, float, Any] | None = None
        self._refusal = ""
        self._picture = (0, b"")
        self._looked: tuple[float, Look] | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="graph", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                self._graph.spin_for(_CHECK_S, self._stop)
                self._check()
        except BaseException as error:  # noqa: BLE001 -- shown where the station ends
            self.failure = error

    def _check(self) -> None:
        try:
            self.findings = self.views.findings() if self._desk.statuses else ()
        except Exception:
            # A table must not end the operator's console.
            logging.getLogger(__name__).exception("preflight")

    def close(self) -> None:
        """End the thread."""
        self._stop.set()
        self._thread.join()

    def _take_status(self, status: Message) -> None:
        """Note when an orbit begins: the fence lies about the subject's place at that moment."""
        if status.state == State.ORBITING and self._state not in (-1, State.ORBITING):
            place = status.subject_position_m
            self._fence = np.array([place.x, place.y])
        elif status.state in (State.IDLE, State.READY):
            self._fence = None
        self._state, self._status_s = status.state, time.monotonic()

    # -- who commands ----------------------------------------------------------------------------------

    def enter(self, page: str) -> None:
        """A page opens: it commands if no living one does."""
        if self.holder is None or time.monotonic() - self._alive_s > SILENT_S:
            self.take_over(page)

    def take_over(self, page: str) -> None:
        """A page takes the command from the one that has it."""
        self.holder, self._alive_s = page, time.monotonic()

    def leave(self, page: str) -> None:
        """A page closes: nobody commands until one takes over."""
        if page == self.holder:
            self.holder = None

    def alive(self, page: str) -> None:
        """A page has answered: if it commands, its operator is present for the bridge."""
        if page == self.holder:
            self._alive_s = time.monotonic()
            if self._desk.is_reachable():
                self._desk.present()

    def order(self, page: str, action: str, values: Mapping[str, float | None]) -> None:
        """Send what `drocap orbit` would send; a stop of any page, else of the one that commands."""
        try:
            if action != "stop" and page != self.holder:
                raise InputError(f"{action}: another page commands; take over first")
            check_values(action, values)
            if not self._desk.is_reachable():
                raise InputError(f"{action}: no mavlink_bridge serves orbit/command in {self._graph.namespace}")
        except InputError as error:
            self._asked, self._refusal = None, str(error)
            return
        self._asked, self._refusal = (action, time.monotonic(), self._desk.order(action, values)), ""

    def record(self, page: str) -> None:
        """Let the graph's recorder pause, or work again."""
        if page == self.holder and self._recorder.set_active(not self.views.recording()) is None:
            self._asked, self._refusal = None, "record: no session_recorder runs in the graph"

    def answer(self) -> str:
        """The answer to the last command, in words."""
        if self._asked is None:
            return self._refusal
        action, asked_s, future = self._asked
        if not future.done():
            waited_s = time.monotonic() - asked_s
            late = waited_s > ANSWER_S
            return f"{action}: no answer for {waited_s:.0f} s; the state shows whether it was executed" if late else ""
        response = future.result()
        return f"{action}: {response.words}" if response.accepted else f"{action} refused: {response.words}"

    # -- what is shown ---------------------------------------------------------------------------------

    def picture(self) -> tuple[bytes, str]:
        """The picture of the last look, as its publisher compressed it, and its media type."""
        if not self._picture[1]:
            return b"", "image/jpeg"
        message = self._newest["picture"].read(self._picture[1])
        return bytes(message.data), "image/png" if "png" in message.format else "image/jpeg"

    def look(self) -> Look:
        """What there is now; pages that ask at about the same time get the same."""
        now_s = time.monotonic()
        if self._looked is None or now_s - self._looked[0] > 0.1:
            self._looked = (now_s, self._look(now_s))
        return self._looked[1]

    def _look(self, now_s: float) -> Look:
        status = self._desk.statuses[-1] if self._desk.statuses else None
        silent_s = now_s - self._status_s
        state, colour, words = _state_of(status, silent_s)
        vehicle_state = self._newest["vehicle"].message()
        place, heading, turn = _place_of(vehicle_state)
        subject, radius_m, speed = np.array([math.nan] * 3), math.nan, math.nan
        if status is not None:
            at = status.subject_position_m
            subject, radius_m, speed = np.array([at.x, at.y, at.z]), status.radius_m, status.angular_speed_deg_s
        bearing = bearing_deg(subject, place)
        facts = _facts_of(vehicle_state, status, bearing)
        ages = {"status": silent_s} | {name: newest.age_s() for name, newest in self._newest.items()}
        overlay = self._choose_picture(bearing, speed)
        plan = plan_svg(subject, place, heading, self._fence, (self.config.fence_radius_m, radius_m))
        return Look(state, colour, words, facts, ages, self._picture[0], overlay, plan, self._body(), place, turn)

    def _choose_picture(self, bearing: float, speed: float) -> str:
        """Take the picture of the newest keypoints, else the newest; returns what is drawn over it."""
        from drocap_ros.ros.conversions import pose2d_from_ros, stamp_from_ros

        message, pictures = self._newest["keypoints"].message(), self._newest["picture"].stamped()
        if not pictures:
            return ""
        stamp_ns = 0 if message is None else stamp_from_ros(message.header.stamp)
        # The keypoints may be those of a picture that is no more, or not here yet.
        shown_ns = stamp_ns if stamp_ns in pictures else max(pictures)
        self._picture = (shown_ns, pictures[shown_ns])
        if shown_ns != stamp_ns:
            return ""
        try:
            observation = pose2d_from_ros(message)
        except InputError:  # the nodes say so
            return ""
        drawn = keypoints_svg(observation) if observation.has_subject else ""
        return drawn + bearing_svg(observation.image_size, bearing, speed)

    def _body(self) -> np.ndarray | None:
        from drocap_ros.ros.conversions import MAP, pose3d_from_ros
        from drocap_ros.skeleton import joint_set

        message = self._newest["pose"].message()
        if message is None or message.header.frame_id != MAP or not message.track_id:
            return None
        try:
            return body_points(pose3d_from_ros(message).joints3d, joint_set(message.skeleton))
        except InputError:
            return None


def _state_of(status: Message | None, silent_s: float) -> tuple[str, str, str]:
    if status is None:
        return "silent", "negative", "no word from mavlink_bridge yet; does a graph run in this domain and namespace?"
    name = next((code.name for code in ConditionCode if code == status.condition), "")
    words = f"{sentence(status)} [{name} {status.condition}]"
    if silent_s > OLD_S:
        return "silent", "negative", f"no word from mavlink_bridge for {silent_s:.0f} s; before: {words}"
    state = State(status.state)
    return state.name.lower().replace("_", " "), _COLOURS[state], words


def _place_of(vehicle: Message | None) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Place (3,) m, direction of the nose (2,), rotation (3, 3) of the body; NaN and None where unknown."""
    from scipy.spatial.transform import Rotation

    nothing = np.full(3, np.nan)
    if vehicle is None:
        return nothing, nothing[:2], None
    q = vehicle.orientation
    if not np.isfinite([q.x, q.y, q.z, q.w]).all():
        return np.array(vehicle.position_enu_m), nothing[:2], None
    turn = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    return np.array(vehicle.position_enu_m), turn[:2, 0], turn


def _facts_of(vehicle: Message | None, status: Message | None, bearing: float) -> dict[str, str]:
    facts = {"bearing": f"{bearing:03.0f}°" if math.isfinite(bearing) else "unknown"}
    if status is not None and math.isfinite(status.radius_m):
        off = "" if math.isnan(status.radius_error_m) else f", {status.radius_error_m:+.1f} m off"
        facts |= {
            "distance": f"{status.radius_m:.1f} m, {status.height_m:.1f} m high{off}",
            "orbit": f"{status.angular_speed_deg_s:+.0f} deg/s, yaw {status.yaw_error_deg:+.1f} deg",
        }
    if vehicle is not None:
        share, volts = vehicle.battery_fraction, vehicle.battery_voltage_v
        facts |= {
            "vehicle": f"{vehicle.mode or 'mode unknown'}, {'armed' if vehicle.armed else 'disarmed'}",
            "battery": ("unknown" if math.isnan(share) else f"{share:.0%}")
            + ("" if math.isnan(volts) else f", {volts:.1f} V"),
            "link": f"{vehicle.link_age_s:.1f} s since the autopilot's last message",
            "position": f"{'usable' if vehicle.position_ok else 'not usable'}, {vehicle.satellites} satellites",
        }
    return facts
