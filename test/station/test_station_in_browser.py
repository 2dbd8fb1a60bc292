"""A flight by the page alone: a real browser, the real bridge, a copter in real time."""

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest
from browser import Browser, chromium
from flying import flying

from drocap_ros.flight.conditions import ConditionCode
from drocap_ros.flight.orbit.states import Command
from drocap_ros.msg import OrbitStatus

pytestmark = pytest.mark.skipif(chromium() is None, reason="no Chromium or Chrome on this machine")
pytest.importorskip("nicegui", reason="no NiceGUI: pip install 'drocap_ros[app]'")

ROOT = Path(__file__).resolve().parents[2]
#: The bridge misses its operator after this time.
SILENT_S = 2.0
#: Loose: this machine may run other tests at the same time.
LIMITS = {
    "commands_enabled": True, "mode_change_allowed": True, "max_state_age_s": 0.5, "watchdog_s": 0.5,
    "max_round_trip_s": 2.0, "max_echo_age_s": 2.0, "max_subject_age_s": 1.0,
}  # fmt: skip


class Page(Browser):
    """The station's page in a browser of its own."""

    def __init__(self, profile, address, **options):
        super().__init__(profile)  # without WebGL, which would take the processors that the flight needs
        self.open(address, 1200, 900, **options)

    def text(self, name):
        return self.run(f"(e => e?.checkVisibility() ? e.innerText : '')(document.querySelector('.{name}'))")

    def button(self, name):
        """Expression of a button by its words."""
        return f"[...document.querySelectorAll('button')].find(b => b.innerText.toLowerCase().includes('{name}'))"

    def press(self, name, key="Enter"):
        """Press a button by the keyboard alone."""
        self.run(f"{self.button(name)}.focus()")
        for kind in ("rawKeyDown", "char", "keyUp"):
            text = {"text": "\r" if key == "Enter" else " "} if kind == "char" else {}
            code = {"Enter": 13, "Space": 32}[key]
            self.send("Input.dispatchKeyEvent", type=kind, key=key, code=key, windowsVirtualKeyCode=code, **text)

    def type(self, field, text):
        self.run(f"(e => {{ e.focus(); e.select(); }})(document.querySelector('input[aria-label={field}]'))")
        self.send("Input.insertText", text=text)

    def is_enabled(self, name):
        return self.run(f"!{self.button(name)}.disabled")


class Served:
    """The command in a process of its own, beside a flight."""

    def __init__(self, graph, drone, got, folder):
        self.graph, self.drone, self.got, self.folder = graph, drone, got, folder
        with socket.socket() as sock:
            sock.bind(("127.0.0.1", 0))
            port = sock.getsockname()[1]
        config = folder / "station.yaml"
        config.write_text(f"mavlink_bridge:\n  commands_enabled: true\n  operator_timeout_s: {SILENT_S}\n")
        words = ["station", "--config", str(config), "--port", str(port), "--no-browser"]
        place = ["--domain-id", str(graph.domain_id), "--namespace", graph.namespace]
        env = {**os.environ, "PYTHONPATH": str(ROOT)}
        self.process = subprocess.Popen(
            [sys.executable, "-m", "drocap_ros.cli", *words, *place], env=env, stdout=subprocess.PIPE, text=True
        )
        self.address = f"http://127.0.0.1:{port}/"
        assert self.process.stdout.readline().startswith(f"open {self.address}")
        self._pages = []
        self.wait(self._answers, 30, "the server")

    def _answers(self):
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", int(self.address[17:-1])), 1):
            return True
        return False

    def page(self, **options):
        page = Page(self.folder / f"profile_{len(self._pages)}_{time.monotonic_ns()}", self.address, **options)
        self._pages.append(page)
        self.wait(lambda: page.text("state"), 30, "a page that shows something")
        return page

    def close(self, page):
        self._pages.remove(page)
        page.close()

    def wait(self, condition, timeout_s, what):
        self.graph.wait_until(condition, timeout_s, what)

    def state(self, *states):
        self.wait(lambda: self.got and self.got[-1].state in states, 30, f"state {states}")

    def orbits(self, page):
        """Fly from whatever state to an orbit, by the page."""
        if self.got[-1].state != OrbitStatus.ORBITING:
            self.wait(lambda: page.is_enabled("engage"), 10, "a page that commands")
            for _ in range(8):  # this machine may be late for the bridge's checks now and then
                page.press("engage")
                if self.graph.wait(lambda: self.got[-1].state == OrbitStatus.ORBITING, 5):
                    return
            pytest.fail(f"no orbit: {self.got[-1].reason}; {page.text('answer')}")

    def end(self):
        for page in list(self._pages):
            self.close(page)
        self.process.send_signal(signal.SIGINT)
        return self.process.wait(20)


@pytest.fixture
def served(tmp_path):
    with flying(pictures=True, processes=True, operator_timeout_s=SILENT_S, **LIMITS) as (graph, drone, got):
        served = Served(graph, drone, got, tmp_path)
        try:
            yield served
        finally:
            if served.process.poll() is None:
                assert served.end() == 0


def test_an_orbit_is_started_adjusted_and_stopped_by_the_keyboard_alone(served):
    page = served.page()
    served.state(OrbitStatus.READY)  # which needs an operator: the page's signs
    page.type("radius", "2")
    page.press("start")
    served.wait(lambda: "refused: radius_m: expected at least" in page.text("answer"), 10, "the bridge's refusal")
    page.type("radius", "")
    page.type("speed", "500")
    page.press("start")
    served.wait(lambda: "speed: expected" in page.text("answer"), 10, "the desk's refusal")
    page.type("speed", "15")
    page.press("start")
    served.wait(lambda: page.text("answer"), 10, "an answer")
    served.orbits(page)
    served.wait(lambda: page.text("state") == "orbiting", 10, "its state on the page")
    page.type("speed", "10")
    page.press("adjust")
    served.wait(lambda: served.got[-1].command == Command.ADJUST and served.got[-1].command_accepted, 10, "adjusted")
    assert page.not_by_keyboard() == []
    # Space on a button that has the focus is no press of it.
    page.press("start", "Space")
    served.wait(lambda: served.got[-1].command == Command.STOP and served.got[-1].command_accepted, 10, "a stop")
    served.state(OrbitStatus.HOLDING)
    served.wait(lambda: page.text("state") == "holding", 10, "the hold on the page")
    assert page.errors == []


def test_a_closed_page_is_no_operator_and_a_frozen_one_neither(served):
    page = served.page()
    for end in ("closed", "frozen"):
        served.state(OrbitStatus.READY, OrbitStatus.HOLDING, OrbitStatus.TAKEN_OVER)
        served.orbits(page)
        served.graph.spin_for(2.0)
        begin = time.monotonic()
        if end == "closed":
            served.close(page)
        else:
            page.run("setTimeout(() => alert('its script stands still, and its connection lives'), 0) && 0")
        served.state(OrbitStatus.HOLDING)
        assert time.monotonic() - begin < SILENT_S + 2.5
        assert served.got[-1].condition == ConditionCode.OPERATOR_SILENT, served.got[-1].reason
        if end == "closed":
            page = served.page()


def test_a_second_page_shows_until_it_takes_over_which_the_first_one_sees(served):
    first = served.page()
    served.wait(lambda: first.is_enabled("start"), 10, "command")
    second = served.page()
    served.wait(lambda: not second.is_enabled("start"), 10, "a viewer")
    assert "Another page commands" in second.text("viewer")
    assert first.text("viewer") == ""
    second.press("take over")
    served.wait(lambda: second.is_enabled("start") and not first.is_enabled("start"), 10, "the change")
    assert "Another page commands" in first.text("viewer")
    served.state(OrbitStatus.READY)
    served.orbits(second)
    first.press("stop")  # a viewer's too
    served.state(OrbitStatus.HOLDING)


@pytest.mark.parametrize(("width", "dark"), [(390, False), (1600, True)])
def test_page_fits_its_window_and_shows_picture_plan_and_preflight(served, width, dark):
    page = served.page(dark=dark)
    page.open(served.address, width, 900, dark=dark)
    served.wait(lambda: page.run("document.querySelector('main img')?.naturalWidth") == 1280, 20, "a picture")
    served.wait(lambda: page.run("document.querySelectorAll('main svg circle').length") > 10, 20, "keypoints")
    served.wait(lambda: "permission to fly" in page.run("document.body.innerText"), 20, "the preflight")
    assert page.run("document.documentElement.scrollWidth") <= width
    assert all(url.startswith((served.address, "data:", "blob:")) for url in page.requests)  # there may be no internet
    # The stop stays in view, however far one scrolls.
    page.run("scrollTo(0, document.body.scrollHeight)")
    page.settle()
    top = page.run(f"{page.button('stop')}.getBoundingClientRect().top")
    assert 0 <= top < 200
    assert page.run("document.body.classList.contains('body--dark')") == dark


def test_station_takes_little_of_a_processor_and_no_memory_that_grows(served):
    served.page()
    process = psutil.Process(served.process.pid)
    served.graph.spin_for(6.0)
    before, memory = process.cpu_times(), process.memory_info().rss
    served.graph.spin_for(12.0)
    after = process.cpu_times()
    share = (after.user + after.system - before.user - before.system) / 12.0
    assert share < 0.15
    assert process.memory_info().rss - memory < 8e6
