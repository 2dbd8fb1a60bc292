"""Who commands, what is drawn, and who may open the page: without a browser."""

import asyncio
import time
from types import SimpleNamespace

import numpy as np
import pytest

from drocap_ros.app.serving import Door, listen
from drocap_ros.bringup import bringup, free_domain, watch
from drocap_ros.cli import main
from drocap_ros.cli.graph.top import dashboard_of
from drocap_ros.config import DrocapConfig
from drocap_ros.errors import InputError
from drocap_ros.flight.bridge_config import MavlinkBridgeConfig
from drocap_ros.keypoints import PoseObservation
from drocap_ros.ros.graph import Newest
from drocap_ros.ros.topics import TOPICS
from drocap_ros.skeleton import BODY_15
from drocap_ros.station.desk import check_values
from drocap_ros.station.drawing import bearing_deg, bearing_svg, body_points, keypoints_svg, plan_svg
from drocap_ros.station.station import SILENT_S, Station, Views


class OneAnswer:
    """A desk that notes what is sent, and whose bridge accepts it."""

    def __init__(self):
        self.sent, self.signs, self.statuses = [], 0, []

    def is_reachable(self):
        return True

    def order(self, action, values):
        self.sent.append((action, dict(values)))
        response = SimpleNamespace(accepted=True, words="done")
        return SimpleNamespace(done=lambda: True, result=lambda: response)

    def present(self):
        self.signs += 1


@pytest.fixture
def station():
    with free_domain() as domain_id, watch("/drocap", domain_id, lean=True) as graph:
        station = Station(graph, MavlinkBridgeConfig(), Views(list, list, lambda: None))
        station._desk = OneAnswer()
        yield station
        station.close()


def test_the_first_page_commands_and_the_second_takes_over_by_a_click(station):
    station.enter("a")
    station.enter("b")
    assert station.holder == "a"
    station.order("b", "start", {})
    assert not station._desk.sent
    assert "another page commands" in station.answer()
    station.take_over("b")
    station.order("a", "engage", {})
    station.order("b", "start", {"speed": 12.0})
    assert station._desk.sent == [("start", {"speed": 12.0})]
    assert station.answer() == "start: done"


def test_every_page_may_stop(station):
    station.enter("a")
    station.enter("b")
    station.order("b", "stop", {})
    assert station._desk.sent == [("stop", {})]


def test_signs_of_the_commanding_page_alone_make_an_operator(station):
    station.enter("a")
    station.enter("b")
    for page in ("b", "", "unknown"):
        station.alive(page)
    assert station._desk.signs == 0
    station.alive("a")
    assert station._desk.signs == 1
    station.leave("b")
    assert station.holder == "a"
    station.leave("a")
    station.alive("a")
    assert station._desk.signs == 1
    assert station.holder is None


def test_a_page_that_opens_after_the_last_sign_of_another_commands(station):
    station.enter("a")
    station._alive_s = time.monotonic() - SILENT_S - 0.1
    station.enter("b")
    assert station.holder == "b"


@pytest.mark.parametrize(
    ("action", "values", "words"),
    [
        ("adjust", {}, "expected radius, height or speed"),
        ("adjust", {"speed": 500.0}, "speed: expected"),
        ("start", {"radius": float("nan")}, "radius: expected a finite number"),
        ("stop", {"radius": 5.0}, "stop takes no values"),
    ],
)
def test_what_drocap_orbit_refuses_the_page_refuses(station, action, values, words):
    with pytest.raises(InputError, match=words):
        check_values(action, values)
    station.enter("a")
    station.order("a", action, values)
    assert not station._desk.sent
    assert words in station.answer()


def test_without_a_bridge_the_page_says_so_and_shows_nothing_old(station):
    assert station.look().state == "silent"
    assert station.look().ages["picture"] == float("inf")
    assert station.picture()[0] == b""


def test_newest_messages_are_kept_and_no_more():
    with free_domain() as domain_id, watch("/drocap", domain_id, lean=True) as graph:
        entry = TOPICS["image/compressed"]
        newest = Newest(graph.node, "image/compressed", 4)
        publisher = graph.node.create_publisher(entry.message, "image/compressed", entry.offered)
        graph.wait_until(publisher.get_subscription_count, 10, "a match")
        assert newest.message() is None
        for second in range(1, 21):
            message = entry.message(format="jpeg", data=bytes(1000))
            message.header.stamp.sec = second
            publisher.publish(message)
            graph.spin_for(0.02)
        graph.wait_until(lambda: 20 * 10**9 in newest.stamped(), 10, "the last one")
        assert len(newest.stamped()) == 4
        assert newest.message().header.stamp.sec == 20
        assert newest.age_s() < 5.0


def test_plan_has_north_up_and_a_dashed_fence_before_the_orbit():
    subject, vehicle = np.array([1.0, 2.0, 0.0]), np.array([6.0, 2.0, 3.0])
    before = plan_svg(subject, vehicle, np.array([-1.0, 0.0]), None, (40.0, 5.0))
    assert "stroke-dasharray" in before
    assert "translate(5.00 0.00) rotate(-90)" in before  # east of the subject, its nose to the west
    during = plan_svg(subject, np.array([1.0, 10.0, 3.0]), np.array([0.0, 1.0]), np.array([1.0, 2.0]), (40.0, 5.0))
    assert "stroke-dasharray" not in during
    assert "translate(0.00 -8.00) rotate(0)" in during
    nothing = plan_svg(np.full(3, np.nan), np.full(3, np.nan), np.full(2, np.nan), None, (40.0, np.nan))
    assert "nan" not in nothing


def test_bearing_is_a_compass_bearing_from_the_subject():
    assert bearing_deg(np.zeros(3), np.array([0.0, 5.0, 2.0])) == pytest.approx(0.0)
    assert bearing_deg(np.zeros(3), np.array([5.0, 0.0, 2.0])) == pytest.approx(90.0)
    assert "270" in bearing_svg((1280, 720), 270.0, 10.0)
    assert bearing_svg((1280, 720), float("nan"), 0.0) == ""


def test_keypoints_that_are_not_seen_are_not_drawn():
    at = np.full((15, 2), np.nan, np.float32)
    at[[0, 1]] = [[10, 20], [30, 40]]
    covariance, confidence = np.zeros((15, 3), np.float32), np.ones(15, np.float32)
    seen = PoseObservation(0, 1, (640, 480), keypoints=at, covariance=covariance, confidence=confidence)
    svg = keypoints_svg(seen)
    assert svg.count("<circle") == 2
    assert svg.count("<line") == 1
    assert "nan" not in svg


def test_body_is_points_along_its_known_bones():
    joints = np.zeros((15, 3))
    joints[:, 2] = np.arange(15)
    joints[3] = np.nan
    points = body_points(joints, BODY_15)
    assert np.isfinite(points).all()
    assert len(points) == 8 * (len(BODY_15.bones) - 1)


def ask(door, path="/", query="", host="127.0.0.1:8090", cookie="", kind="http"):
    """Status of a request at a door, and the headers of its answer."""
    pytest.importorskip("starlette", reason="no NiceGUI: pip install 'drocap_ros[app]'")
    sent = []
    headers = [(b"host", host.encode()), (b"cookie", cookie.encode())]
    scope = {"type": kind, "path": path, "query_string": query.encode(), "headers": headers, "scheme": "http",
             "method": "GET", "server": ("127.0.0.1", 8090), "extensions": {"websocket.http.response": {}}}  # fmt: skip

    async def take(message):
        sent.append(message)

    asyncio.run(door(scope, None, take))
    return sent[0].get("status"), dict(sent[0].get("headers", []))


async def inside(scope, receive, send):
    await send({"type": "http.response.start", "status": 200})


def test_on_the_loopback_another_hosts_name_is_refused():
    door = Door(inside, "", 8090)
    assert ask(door)[0] == 200
    assert ask(door, host="localhost:8090")[0] == ask(door, host="[::1]:8090")[0] == 200
    assert ask(door, host="127.evil.example:8090")[0] == 403
    for kind in ("http", "websocket"):
        assert ask(door, host="evil.example:8090", kind=kind)[0] == 403


def test_off_the_loopback_the_token_is_demanded_and_kept_in_a_cookie():
    door = Door(inside, "secret", 8090)
    for kind in ("http", "websocket"):
        assert ask(door, kind=kind)[0] == 403
        assert ask(door, kind=kind, cookie="station_8090=wrong")[0] == 403
    assert ask(door, query="token=wrong")[0] == 403
    status, headers = ask(door, query="token=secret")
    assert status == 303
    assert b"station_8090=secret" in headers[b"set-cookie"]
    assert ask(door, cookie="station_8090=secret")[0] == 200
    assert ask(door, cookie="station_8090=secret", kind="websocket")[0] == 200


def test_a_taken_port_and_a_missing_package_are_one_line(tmp_path, capsys, monkeypatch):
    config = tmp_path / "c.yaml"
    config.write_text("mavlink_bridge:\n  url: udpin:127.0.0.1:14550\n")
    with listen("127.0.0.1", 0) as sock, pytest.raises(InputError, match="free address"):
        listen("127.0.0.1", sock.getsockname()[1])
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert main(["station", "--config", str(config)]) == 2
    error = capsys.readouterr().err
    assert error == "drocap: station: expected nicegui, found none; run: pip install 'drocap_ros[app]'\n"


def test_record_pauses_the_graphs_recorder_and_lets_it_work_again(tmp_path):
    config = DrocapConfig().replace("session_recorder", session_dir=str(tmp_path / "session"))
    with (
        bringup(config, ["session_recorder"]) as running,
        watch("/drocap", running.domain_id, lean=True) as graph,
        dashboard_of(graph, show=False) as (dashboard, _),
    ):
        recording = lambda: dashboard.is_active("drocap/session_recorder")  # noqa: E731
        station = Station(graph, MavlinkBridgeConfig(), Views(list, list, recording))
        station.enter("a")
        running.wait_until(lambda: recording() is True, 20, "its recording")
        station.record("b")  # a viewer
        running.spin_for(1.5)
        for expected in (False, True):
            assert recording() is not expected
            station.record("a")
            running.wait_until(lambda wanted=expected: recording() is wanted, 20, f"recording {expected}")
        station.close()
