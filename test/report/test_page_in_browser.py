"""The report in a real browser: it draws, reacts to keys, mouse and touch, and fits a narrow screen."""

import dataclasses

import numpy as np
import pytest
from browser import Browser, chromium

from drocap_ros.cli.batch_recording import save_summary
from drocap_ros.report.motion_images import MotionImages
from drocap_ros.report.movement import flexion
from drocap_ros.report.page import render_report, save_report
from drocap_ros.report.people import save_people_report

pytestmark = pytest.mark.skipif(chromium() is None, reason="no Chromium or Chrome on this machine")


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    browser = Browser(tmp_path_factory.mktemp("profile"))
    yield browser
    browser.close()


@pytest.fixture(scope="module")
def pages(person, reported_in_camera, one_frame, tmp_path_factory):
    """A report with images, one without, one in the camera's frame, one of a single frame, one with gaps."""
    import cv2

    folder = tmp_path_factory.mktemp("pages")
    grey = cv2.imencode(".jpg", np.full((200, 150, 3), 90, np.uint8))[1].tobytes()
    low, high = np.nanmin(person.keypoints, axis=(0, 1)), np.nanmax(person.keypoints, axis=(0, 1))
    x0, y0, x1, y1 = (*(int(v) for v in low - 20), *(int(v) for v in high + 20))
    boxes = tuple((x0 - number, y0, x1 + number, y1 + 3 * number) for number in range(20))
    images = MotionImages(tuple(range(0, 60, 3)), (grey,) * 20, boxes)
    (folder / "images.html").write_text(render_report(person, images), encoding="utf-8")
    joints = person.joints3d.copy()
    joints[10:20] = np.nan
    joints[30, 3] = np.nan
    for name, motion in (
        ("plain", person),
        ("camera", reported_in_camera),
        ("single", one_frame),
        ("gaps", dataclasses.replace(person, joints3d=joints)),
    ):
        save_report(folder / f"{name}.html", motion)
    return folder


def drawn(browser, canvas):
    """Number of pixels of a canvas that are not empty."""
    return browser.run(
        f"""(() => {{ const c = document.getElementById("{canvas}");
        const d = c.getContext("2d").getImageData(0, 0, c.width, c.height).data;
        let n = 0; for (let i = 3; i < d.length; i += 4) n += d[i] > 0; return n; }})()"""
    )


def pixels_of(browser, canvas):
    return browser.run(f'document.getElementById("{canvas}").toDataURL()')


def pressed(browser):
    return browser.run('document.querySelector("[data-view][aria-pressed=true]").dataset.view')


@pytest.mark.parametrize("name", ["images", "plain", "camera", "single", "gaps"])
@pytest.mark.parametrize("width", [1280, 800, 400])
def test_the_page_draws_without_errors_network_or_overflow(browser, pages, name, width):
    browser.open(pages / f"{name}.html", width, 900)
    for canvas in ("main", "front", "profile", "image"):
        assert drawn(browser, canvas) > 300, canvas
    assert browser.errors == []
    assert all(url.startswith(("file:", "data:")) for url in browser.requests)
    assert browser.run("document.documentElement.scrollWidth") <= width
    assert browser.run("document.querySelectorAll('svg.plot').length") == 6


def test_frames_without_a_pose_are_shown_empty(browser, pages):
    browser.open(pages / "gaps.html", 1280, 900)
    browser.run("show(9)")
    browser.settle()
    full = drawn(browser, "front")
    browser.run("show(15)")
    browser.settle()
    assert drawn(browser, "front") < 0.6 * full  # the floor is left
    assert browser.errors == []


def test_keys_step_play_and_choose_views(browser, pages):
    browser.open(pages / "plain.html", 1280, 900)
    frame = lambda: browser.run("state.frame")  # noqa: E731
    assert (frame(), pressed(browser)) == (0, "novel")
    browser.key("ArrowRight")
    assert frame() == 1
    browser.key("ArrowRight", modifiers=8)
    assert frame() == 11
    browser.key("ArrowLeft")
    assert frame() == 10
    browser.key("End")
    assert frame() == 59
    assert browser.run('document.getElementById("clock").textContent').startswith("3.93 s")
    browser.key("Home")
    assert frame() == 0
    shots = set()
    for key, view in (("1", "front"), ("2", "profile"), ("4", "camera"), ("3", "novel")):
        browser.key(key)
        assert pressed(browser) == view
        shots.add(pixels_of(browser, "main"))
    assert len(shots) == 4
    browser.key(" ")
    assert browser.run("state.playing")
    browser.run("new Promise((done) => setTimeout(done, 500))")
    assert frame() > 2
    browser.key(" ")
    assert not browser.run("state.playing")
    stopped = frame()
    browser.run("new Promise((done) => setTimeout(done, 200))")
    assert frame() == stopped
    assert browser.errors == []


def test_playing_keeps_the_time_of_the_motion(browser, pages):
    browser.open(pages / "plain.html", 1280, 900)
    moved = browser.run(
        """(async () => { play(true); const begin = performance.now();
        await new Promise((done) => setTimeout(done, 1500));
        const shown = motion.times[state.frame]; play(false);
        return [(performance.now() - begin) / 1000, shown]; })()"""
    )
    assert moved[1] == pytest.approx(moved[0], abs=0.3)


def test_mouse_turns_and_wheel_zooms(browser, pages):
    browser.open(pages / "plain.html", 1280, 900)
    box = browser.run('(({x, y, width, height}) => [x, y, width, height])(byId("main").getBoundingClientRect())')
    x, y = box[0] + box[2] / 2, box[1] + box[3] / 2
    before = pixels_of(browser, "main")
    browser.key("1")
    browser.mouse("mousePressed", x, y, button="left", buttons=1, clickCount=1)
    browser.mouse("mouseMoved", x + 120, y + 30, button="left", buttons=1)
    browser.mouse("mouseReleased", x + 120, y + 30, button="left", clickCount=1)
    browser.settle()
    assert pressed(browser) == "novel"
    turned = pixels_of(browser, "main")
    assert turned != before
    browser.mouse("mouseWheel", x, y, deltaX=0, deltaY=-300)
    browser.settle()
    assert browser.run("state.zoom") > 1.2
    assert pixels_of(browser, "main") != turned
    plot = browser.run(
        """(() => { const s = document.querySelector("svg.time"); s.scrollIntoView();
        const b = s.getBoundingClientRect(); return [b.x, b.y, b.width, b.height]; })()"""
    )
    browser.mouse(
        "mousePressed", plot[0] + 0.7 * plot[2], plot[1] + plot[3] / 2, button="left", buttons=1, clickCount=1
    )
    browser.mouse("mouseReleased", plot[0] + 0.7 * plot[2], plot[1] + plot[3] / 2, button="left", clickCount=1)
    browser.settle()
    assert 33 <= browser.run("state.frame") <= 43
    assert browser.errors == []


def test_space_belongs_to_the_player_after_a_click_and_to_a_button_reached_by_keyboard(browser, pages):
    browser.open(pages / "plain.html", 1280, 1400)
    x, y = browser.run(
        """(({x, y, width, height}) => [x + width / 2, y + height / 2])(
        document.querySelector("[data-view=front]").getBoundingClientRect())"""
    )
    browser.mouse("mousePressed", x, y, button="left", buttons=1, clickCount=1)
    browser.mouse("mouseReleased", x, y, button="left", clickCount=1)
    browser.settle()
    assert pressed(browser) == "front"
    browser.key(" ")
    assert browser.run("state.playing")
    browser.key(" ")
    browser.run('document.querySelector("[data-view=profile]").focus()')
    browser.key(" ")
    assert pressed(browser) == "profile"
    assert not browser.run("state.playing")


def test_two_fingers_zoom(browser, pages):
    browser.open(pages / "plain.html", 400, 900)
    browser.run('byId("main").scrollIntoView()')
    x, y = browser.run(
        '(({x, y, width, height}) => [x + width / 2, y + height / 2])(byId("main").getBoundingClientRect())'
    )

    def touch(kind, *spread):
        points = [{"x": x + side * s, "y": y, "id": n} for s in spread for n, side in enumerate((-1, 1))]
        browser.send("Input.dispatchTouchEvent", type=kind, touchPoints=points)

    touch("touchStart", 30)
    touch("touchMove", 50)
    touch("touchMove", 70)
    touch("touchEnd")
    browser.settle()
    assert browser.run("state.zoom") > 1.5


def test_keypoints_are_drawn_on_their_own_image(browser, pages):
    browser.open(pages / "images.html", 1280, 900)
    browser.run("show(31)")
    browser.settle()
    assert browser.run("images.places[images.nearest(31)]") == 30
    with_overlay = pixels_of(browser, "image")
    browser.run('byId("overlay").click()')
    browser.settle()
    assert pixels_of(browser, "image") != with_overlay
    browser.run("show(30)")
    browser.run('byId("overlay").click()')
    browser.settle()
    assert pixels_of(browser, "image") == with_overlay


@pytest.mark.parametrize("width", [1600, 390])
def test_the_body_is_drawn_at_its_keypoints_of_the_image(browser, pages, person, width):
    browser.open(pages / "images.html", width, 900)
    browser.run(
        """window.arcs = []; const arc = CanvasRenderingContext2D.prototype.arc;
        CanvasRenderingContext2D.prototype.arc = function (x, y, ...more) {
          if (this.canvas.id === "image") arcs.push([x, y]);
          return arc.call(this, x, y, ...more); }; 0"""
    )
    for frame in (0, 31, 58):
        browser.run(f"arcs.length = 0; show({frame})")
        browser.settle()
        shown, arcs, box, size = browser.run(
            """[images.places[images.nearest(state.frame)], arcs, images.boxes[images.nearest(state.frame)],
            [byId("image").clientWidth, byId("image").clientHeight]]"""
        )
        assert abs(shown - frame) <= 1  # every third frame has an image
        low, high = np.reshape(box, (2, 2))
        scale = np.min(np.array(size) / (high - low))
        found = person.keypoints[shown][np.isfinite(person.keypoints[shown]).all(axis=1)]
        at = (np.array(arcs[-len(found) :]) - 0.5 * np.array(size)) / scale + 0.5 * (low + high)
        np.testing.assert_allclose(at, found, atol=0.1)  # px of the image


def test_charts_of_movement_follow_the_player_and_are_chosen(browser, pages):
    browser.open(pages / "plain.html", 1400, 1000)
    shown = '[...document.querySelectorAll("#charts figure:not([hidden]) b")].map((b) => b.textContent)'
    titles = [title for title in browser.run(shown) if title[0].isalpha()]
    assert titles == ["Knee bend", "Hip bend", "Elbow bend", "Pelvis speed"]
    x, y = browser.run(
        """(() => { const wrist = [...byId("choice").children].find((b) => b.textContent === "Wrist speed");
        const { x, y, width, height } = wrist.getBoundingClientRect(); return [x + width / 2, y + height / 2]; })()"""
    )
    browser.mouse("mousePressed", x, y, button="left", buttons=1, clickCount=1)
    browser.mouse("mouseReleased", x, y, button="left", clickCount=1)
    browser.settle()
    assert "Wrist speed" in browser.run(shown)
    # The cursor stands where the frame is, and its dots have the values of the data.
    cursor = 'Number(document.querySelector("#charts .cursor").getAttribute("x1"))'
    places = []
    for frame in (0, 30, 59):
        browser.run(f"show({frame})")
        browser.settle()
        places.append(browser.run(cursor))
        said = browser.run('document.querySelector("#charts output .right b").textContent')
        assert said == f"{browser.run(f'(motion.movement[0].values[0][{frame}] / 10).toFixed(0)')}°"
    assert places[1] == pytest.approx(places[0] + 30 / 59 * (places[2] - places[0]), abs=0.2)
    chart = browser.run(
        """(() => { const b = document.querySelector("#charts svg").getBoundingClientRect(); return [b.x, b.y]; })()"""
    )
    x = chart[0] + places[1]
    browser.mouse("mousePressed", x, chart[1] + 40, button="left", buttons=1, clickCount=1)
    browser.mouse("mouseReleased", x, chart[1] + 40, button="left", clickCount=1)
    browser.settle()
    assert browser.run("state.frame") in (29, 30)
    browser.run('byId("span").value = "1"; byId("span").dispatchEvent(new Event("change"))')
    browser.settle()
    width = browser.run('document.querySelector("#charts svg").clientWidth')
    assert browser.run(cursor) == pytest.approx(36 + (width - 46) / 2, abs=1.0)  # it stands, the lines move
    assert browser.errors == []


def test_charts_of_another_person_keep_the_choice_and_have_the_times_of_the_page(browser, person, tmp_path):
    """The second person came 20 images later, with other knees."""
    names = ("joints3d", "stamp_ns", "camera_rotation", "confidence", "keypoints", "reprojection_px")
    late = dataclasses.replace(person, **{name: getattr(person, name)[20:] for name in names})
    save_people_report(tmp_path / "two.html", {1: person, 2: late})
    browser.open(tmp_path / "two.html", 1400, 1000)
    browser.run('byId("choice").children[0].click()')  # not the knees
    browser.run('byId("person").value = "2"; byId("person").dispatchEvent(new Event("change"))')
    browser.run("show(40)")
    browser.settle()
    shown = '[...document.querySelectorAll("#charts figure:not([hidden]) figcaption > b")].map((b) => b.textContent)'
    assert browser.run(shown) == ["Hip bend", "Elbow bend", "Pelvis speed"]
    values = browser.run("bodies[1].movement[1].values[0]")
    assert values[:20] == [None] * 20
    expected = flexion(person.joints3d[20:], person.joints)["hip"][:, 0]
    np.testing.assert_allclose(np.array(values[20:]) / 10, expected, atol=0.051)
    said = browser.run('document.querySelector("#charts figure:not([hidden]) output .right b").textContent')
    assert said == f"{browser.run('(bodies[1].movement[1].values[0][40] / 10).toFixed(0)')}°"
    assert browser.errors == []


def test_dark_and_light_differ(browser, pages):
    grounds = []
    for dark in (False, True):
        browser.open(pages / "plain.html", 1280, 900, dark=dark)
        grounds.append(browser.run("getComputedStyle(document.body).backgroundColor"))
        assert browser.errors == []
    assert grounds[0] != grounds[1]
    assert len(browser.screenshot()) > 20_000


def done(name, doubts, error_body):
    figures = {"error_body": error_body, "seen": 1.0, "bone_spread": 0.01, "view_span_deg": 200.0, "duration_s": 9.0}
    costs = {"seconds": 3.0, "peak_memory_mb": 300.0}
    page = {"page": f"{name}/report.html", "messages": []}
    return {"input": f"/season/{name}.mp4", "status": "done", "doubts": doubts, **figures, **costs, **page}


@pytest.mark.parametrize("width", [1600, 390])
@pytest.mark.parametrize("dark", [False, True])
def test_the_table_sorts_and_fits_without_errors_or_network(tmp_path, width, dark):
    failed = {"input": "/season/broken.mp4", "status": "failed", "error": "expected a video, found text; name a video"}
    save_summary(tmp_path / "summary.html", [done("walk", [], 0.02), failed, done("run", ["Short sequence"], 0.01)], 4)
    browser = Browser(tmp_path / "profile")
    try:
        browser.open(tmp_path / "summary.html", width, 900, dark=dark)
        names = '[...document.querySelectorAll("tbody tr")].map((row) => row.cells[0].textContent)'
        assert browser.run(names) == ["broken.mp4", "run.mp4", "walk.mp4"]
        heads = browser.run('[...document.querySelectorAll("th")].map((head) => head.innerText.split("\\n"))')
        assert [head[1] for head in heads if len(head) > 1 and head[1]] == [
            "% of body",
            "% of frames",
            "% spread",
            "°",
            "s",
            "s",
            "MB",
        ]
        browser.run('document.querySelectorAll("th")[2].click()')
        first = browser.run(names)
        browser.run('document.querySelectorAll("th")[2].click()')
        assert {first[0], browser.run(names)[0]} == {"broken.mp4", "run.mp4"}  # unknown is last of one order
        assert browser.run("document.documentElement.scrollWidth") <= width
        light = sum(map(int, browser.run("getComputedStyle(document.body).backgroundColor.match(/\\d+/g)")))
        assert (light < 200) == dark
        assert browser.errors == []
        assert all(url.startswith("file:") for url in browser.requests)
    finally:
        browser.close()
