"""``drocap app`` in a real browser: a clip is dropped, a person chosen, mistakes corrected, the motion exported."""

from __future__ import annotations

import dataclasses
import os
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import yaml
from browser import Browser, chromium
from people_scenes import PeopleScene, camera_of, people_of, write_video

from drocap_ros.motion import load_motion
from drocap_ros.tracks import load_tracks, save_tracks

pytest.importorskip("nicegui")
pytest.importorskip("onnxruntime")
pytestmark = [
    pytest.mark.skipif(chromium() is None, reason="Chromium is not installed"),
    pytest.mark.timeout(600),
]

SCENE = PeopleScene("walk", 1, duration_s=2.4, rate_hz=12.5, distance_m=7.0, orbit=False)
#: Slow machines load the page and solve in much more time than that of a person who waits.
PATIENCE_S = 120.0


def wait(what: Callable[[], object], words: str) -> None:
    end = time.monotonic() + PATIENCE_S
    while not what():
        assert time.monotonic() < end, f"expected {words} within {PATIENCE_S:g} s"
        time.sleep(0.2)


class Hand:
    """What a person does at the page, counted."""

    def __init__(self, browser: Browser) -> None:
        self.browser, self.clicks = browser, 0

    def place(self, selector: str) -> tuple[float, float, float, float]:
        """x, y, width, height of an element in the window, scrolled into view."""
        found = (
            f"(() => {{ const e = {selector}; if (!e) return null; e.scrollIntoView({{block: 'center'}});"
            " const r = e.getBoundingClientRect(); return [r.x, r.y, r.width, r.height]; })()"
        )
        wait(lambda: (box := self.browser.run(found)) and box[2] > 0, selector)
        before: list[float] = []
        while (box := self.browser.run(found)) != before:  # scrolling, and what the page adds on a busy machine, end
            before = box
            time.sleep(0.3)
        x, y, width, height = box
        return x, y, width, height

    def drag(self, selector: str, begin: tuple[float, float], end: tuple[float, float]) -> None:
        """From one place of an element to another, shares of its size; the same place twice is a click."""
        x, y, width, height = self.place(selector)
        points = [(x + u * width, y + v * height) for u, v in (begin, end)]
        self.browser.mouse("mouseMoved", *points[0])
        self.browser.mouse("mousePressed", *points[0], button="left", buttons=1, clickCount=1)
        if points[0] != points[1]:
            for share in (0.3, 0.7, 1.0):
                way = [a + share * (b - a) for a, b in zip(*points, strict=True)]
                self.browser.mouse("mouseMoved", *way, button="left", buttons=1)
        self.browser.mouse("mouseReleased", *points[1], button="left", buttons=0, clickCount=1)
        self.clicks += 1
        time.sleep(0.5)

    def click(self, selector: str, at: tuple[float, float] = (0.5, 0.5)) -> None:
        self.drag(selector, at, at)

    def drop(self, *files: Path) -> None:
        """Files upon the page."""
        wait(lambda: self.browser.run("!!document.querySelector('input[type=file]')"), "the place for files")
        document = self.browser.send("DOM.getDocument")["root"]["nodeId"]
        node = self.browser.send("DOM.querySelector", nodeId=document, selector="input[type=file]")["nodeId"]
        self.browser.send("DOM.setFileInputFiles", nodeId=node, files=[str(file) for file in files])

    def press(self, label: str) -> None:
        """Click a button or tab by its words."""
        self.click(
            "[...document.querySelectorAll('button, .q-tab')].find("
            f"e => e.textContent.trim().toLowerCase().endsWith({label.lower()!r}) && e.offsetParent)"
        )


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, str]]:
    """The folder of a running app, and its address."""
    folder = tmp_path_factory.mktemp("desk")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    words = ["app", str(folder), "--port", str(port), "--no-browser", "--models", "simulation"]
    # Within a test NiceGUI would wait for a port of its own test fixtures.
    outside = {name: value for name, value in os.environ.items() if name != "PYTEST_CURRENT_TEST"}
    process = subprocess.Popen([sys.executable, "-m", "drocap_ros.cli", *words], env=outside)

    def answers() -> bool:
        try:
            return urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=5).status == 200
        except OSError:
            assert process.poll() is None, "the app has ended"
            return False

    wait(answers, "a page")
    yield folder, f"http://127.0.0.1:{port}/"
    process.terminate()
    assert process.wait(timeout=30) in (0, 130)


@pytest.fixture(scope="module")
def hand(desk: tuple[Path, str], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Hand]:
    browser = Browser(tmp_path_factory.mktemp("profile"))
    browser.open(desk[1], 1400, 1000)
    yield Hand(browser)
    assert not browser.errors
    browser.close()


def idle(hand: Hand) -> bool:
    return bool(hand.browser.run("!document.querySelector('.q-linear-progress')"))


def corrections_of(folder: Path) -> str:
    return (folder / "corrections.yaml").read_text()


def solve(hand: Hand, motion: Path) -> None:
    before = motion.stat().st_mtime_ns
    hand.press("Solve again")
    wait(lambda: motion.stat().st_mtime_ns != before and idle(hand), "another solution")


@pytest.fixture(scope="module")
def folder(desk: tuple[Path, str], hand: Hand, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A video is dropped, its second person clicked and reconstructed; the folder of the motion."""
    video = tmp_path_factory.mktemp("clip") / "three.avi"
    write_video(video, SCENE)
    browser = hand.browser
    hand.drop(video)
    wait(lambda: (desk[0] / "three.avi").exists(), "the clip in the folder")
    time.sleep(1.0)
    hand.press("Find persons")
    hand.click("document.querySelector('[data-person=\"2\"]')")
    hand.press("Reconstruct")
    out = desk[0] / "three_motion"
    wait(lambda: (out / "motion.npz").exists() and idle(hand), "a motion")
    assert load_motion(out).meta["person"] == 2
    card = "document.querySelector('[data-motion=three_motion]').textContent"
    wait(lambda: "quality: " in browser.run(card), "the quality of the motion")
    assert hand.clicks == 3
    told = "[...document.querySelectorAll('.q-notification')].map(e => e.getBoundingClientRect().right)"
    work = "document.querySelector('.desk .main').getBoundingClientRect().left"
    assert all(right <= browser.run(work) for right in browser.run(told))  # a message covers no control of the work
    hand.press("Correct")
    picture = "document.querySelector('[data-part=picture] img')"
    wait(lambda: browser.run(f"{picture} && {picture}.naturalWidth > 0"), "the picture")
    return out


@pytest.fixture(autouse=True)
def _no_corrections(request: pytest.FixtureRequest, hand: Hand) -> Iterator[None]:
    hand.clicks = 0
    yield
    while hand.browser.run("document.querySelectorAll('[aria-label^=remove]').length"):
        hand.click("document.querySelector('[aria-label^=remove]')")


def test_a_knee_that_is_dragged_moves_the_knee_of_the_motion(folder: Path, hand: Hand) -> None:
    before = load_motion(folder)
    circle = "document.querySelector('[data-joint=lknee]')"
    width = hand.place(circle)[2]
    hand.drag(circle, (0.5, 0.5), (0.5 + 25.0 / width, 0.5))
    solve(hand, folder / "motion.npz")
    after, tracks = load_motion(folder), load_tracks(folder / "tracks.npz")
    (entry,) = yaml.safe_load((folder / "corrections.yaml").read_text())["joints"]
    assert entry["joint"] == "lknee"
    knee = tracks.joints.index("lknee")
    moved = np.array(entry["at"]) - tracks.keypoints[0, knee]
    assert moved[0] > 3.0
    assert abs(moved[1]) < 2.0
    ours = before.joints.index("lknee")
    assert after.reprojection_px[0, ours] < 0.5 * moved[0]
    change = np.linalg.norm(after.joints3d - before.joints3d, axis=2)
    assert change[0, ours] > 2.0 * np.median(change[-5:])
    assert hand.clicks <= 8


def test_legs_that_are_exchanged_for_a_second_are_put_right(folder: Path, hand: Hand) -> None:
    tracks = load_tracks(folder / "tracks.npz")
    legs = [tracks.joints.index(name) for name in ("lknee", "lankle", "rknee", "rankle")]
    wrong = tracks.keypoints.copy()
    wrong[8:20, legs] = wrong[8:20, [*legs[2:], *legs[:2]]]
    save_tracks(folder / "tracks.npz", dataclasses.replace(tracks, keypoints=wrong))
    try:
        bar = "document.querySelector('[data-part=timeline]')"
        hand.drag(bar, (8 / 29, 0.15), (19 / 29, 0.15))
        hand.press("Exchange legs")
        solve(hand, folder / "motion.npz")
    finally:
        save_tracks(folder / "tracks.npz", tracks)
    assert hand.clicks <= 8
    (entry,) = yaml.safe_load((folder / "corrections.yaml").read_text())["sides"]
    assert (entry["from"], entry["to"]) == pytest.approx((8 / 12.5, 19 / 12.5), abs=0.01)
    np.testing.assert_array_equal(load_motion(folder).keypoints[:, :15], tracks.keypoints[:, :15])


def test_a_wrong_contact_is_clicked_away(folder: Path, hand: Hand) -> None:
    hand.drag("document.querySelector('[data-part=timeline]')", (0.3, 0.5), (0.6, 0.5))
    solve(hand, folder / "motion.npz")
    (entry,) = yaml.safe_load((folder / "corrections.yaml").read_text())["feet"]
    assert (entry["foot"], entry["rests"]) == ("left", True)
    hand.click("document.querySelector('[data-part=timeline]')", (0.45, 0.5))  # what is said is not said
    solve(hand, folder / "motion.npz")
    assert not (folder / "corrections.yaml").exists()
    assert hand.clicks <= 8


def test_another_person_is_meant_from_here_on(folder: Path, hand: Hand) -> None:
    truth = [0.5 * camera_of(SCENE).pixels(joints) for joints in people_of(SCENE)]
    mine = load_tracks(folder / "tracks.npz").keypoints[:, :15]
    off = [float(np.nanmedian(np.linalg.norm(mine - person, axis=2))) for person in truth]
    other = truth[int(np.argmax(off))]
    hand.click("document.querySelector('[data-part=timeline]')", (10 / 29, 0.15))
    hand.press("Another person")
    low, high = other[10].min(axis=0) - 6, other[10].max(axis=0) + 6
    size = np.array([640.0, 360.0])
    hand.drag("document.querySelector('[data-part=picture]')", tuple(low / size), tuple(high / size))
    solve(hand, folder / "motion.npz")
    assert hand.clicks <= 8
    now = load_motion(folder).keypoints[:, :15]
    np.testing.assert_array_equal(now[:10], mine[:10])
    assert np.nanmedian(np.linalg.norm(now[10:] - other[10:], axis=2)) < 6.0


def test_up_is_set_by_two_clicks_on_something_that_leans_in_the_picture(folder: Path, hand: Hand) -> None:
    def roll_deg() -> float:
        up = load_motion(folder).camera_rotation[0][:, 2]
        return float(np.degrees(np.arctan2(up[0], -up[1])))

    before = roll_deg()
    hand.press("Vertical")
    picture, size = "document.querySelector('[data-part=picture]')", np.array([640.0, 360.0])
    lean = np.deg2rad(before + 8.0)
    for along in (-120.0, 120.0):  # px from the middle of the picture
        at = size / 2 + along * np.array([np.sin(lean), -np.cos(lean)])
        hand.click(picture, tuple(at / size))
    solve(hand, folder / "motion.npz")
    assert hand.clicks <= 8
    ((lower, upper),) = [(e["bottom"], e["top"]) for e in yaml.safe_load(corrections_of(folder))["upright"]]
    assert lower[1] > upper[1]
    assert 3.0 < roll_deg() - before < 10.0


def test_corrections_are_kept_by_each_action_for_every_page_and_taken_back(
    desk: tuple[Path, str], folder: Path, hand: Hand, tmp_path: Path
) -> None:
    other = Hand(Browser(tmp_path / "profile"))
    other.browser.open(desk[1], 1400, 1000)
    other.press("Correct")
    try:
        hand.press("Exchange legs")
        other.press("Exchange arms")
        assert [e["limbs"] for e in yaml.safe_load(corrections_of(folder))["sides"]] == ["legs", "arms"]
        assert "does not follow the corrections yet" in hand.browser.run("document.body.innerText")
        other.press("Undo")
        assert [e["limbs"] for e in yaml.safe_load(corrections_of(folder))["sides"]] == ["legs"]
        (folder / "corrections.yaml").write_text("sides: [{limbs: leg}]")
        other.press("Exchange all")
        assert "expected one of legs, arms, all" in other.browser.run("document.body.innerText")
        other.browser.open(desk[1], 1400, 1000)
        other.press("Correct")
        other.press("Delete the corrections")
        wait(lambda: not (folder / "corrections.yaml").exists(), "no corrections")
    finally:
        other.browser.close()
    hand.press("Undo")


def test_a_page_that_is_opened_during_a_job_shows_it(
    desk: tuple[Path, str], folder: Path, hand: Hand, tmp_path: Path
) -> None:
    before, gone = (folder / "motion.npz").stat().st_mtime_ns, Browser(tmp_path / "profile")
    gone.open(desk[1], 1400, 1000)
    first = Hand(gone)
    first.press("Correct")
    first.press("Solve again")
    gone.close()
    hand.browser.open(desk[1], 1400, 1000)
    wait(lambda: (folder / "motion.npz").stat().st_mtime_ns != before, "another solution")
    wait(lambda: idle(hand), "the end of its progress")
    hand.press("Correct")


def test_what_is_no_video_is_refused_and_a_name_that_is_taken_gets_a_number(
    desk: tuple[Path, str], folder: Path, hand: Hand, tmp_path: Path
) -> None:
    (tmp_path / "leer ä b.mp4").touch()
    (tmp_path / "three.avi").write_bytes((desk[0] / "three.avi").read_bytes())
    hand.drop(tmp_path / "leer ä b.mp4", tmp_path / "three.avi")
    words = "leer ä b.mp4: expected a video or a flight log, found neither"
    wait(lambda: words in hand.browser.run("document.body.innerText"), "a refusal")
    wait(lambda: (desk[0] / "three_2.avi").exists(), "a copy")
    assert not (desk[0] / "leer ä b.mp4").exists()
    (desk[0] / "three_2.avi").unlink()


def test_the_keyboard_alone_reaches_every_control(folder: Path, hand: Hand) -> None:
    hand.press("Exchange legs")
    assert hand.browser.not_by_keyboard() == []
    hand.click("document.querySelector('[data-part=timeline]')", (0.001, 0.15))  # the first image
    hand.click("document.querySelector('[data-joint=lknee]')")
    for key in ("ArrowRight", "[", "ArrowRight", "]", "d", "l"):
        hand.browser.key(key)
    said = yaml.safe_load(corrections_of(folder))
    assert said["feet"] == [{"from": 0.08, "to": 0.16, "foot": "left", "rests": True}]
    (entry,) = said["joints"]
    assert entry["time"] == 0.16
    hand.browser.key("ArrowLeft")
    hand.browser.key("ArrowLeft")


def test_a_motion_is_exported_and_read_back(folder: Path, hand: Hand, tmp_path: Path) -> None:
    hand.browser.send("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
    hand.press("Export")
    time.sleep(0.5)
    hand.click("[...document.querySelectorAll('button.bg-primary')].find(e => e.textContent.trim() === 'Export')")
    wait(lambda: list(tmp_path.glob("*.bvh")), "a file")
    text = (tmp_path / "three_motion.bvh").read_text()
    assert text.startswith("HIERARCHY")
    assert "MOTION" in text
    hand.press("Correct")


@pytest.mark.parametrize(("width", "dark"), [(1400, True), (390, False)])
def test_the_page_fits_wide_narrow_and_dark(
    desk: tuple[Path, str], folder: Path, hand: Hand, width: int, dark: bool
) -> None:
    hand.browser.open(desk[1], width, 900, dark=dark)
    wait(lambda: hand.browser.run("!!document.querySelector('.desk')"), "the page")
    assert hand.browser.run("document.documentElement.scrollWidth") <= width
    assert hand.browser.run("document.body.classList.contains('body--dark')") == dark
