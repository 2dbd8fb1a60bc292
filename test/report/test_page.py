"""The report's file: one piece, valid, safe, without links."""

import dataclasses
import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest

from drocap_ros.errors import InputError
from drocap_ros.report.movement import flexion
from drocap_ros.report.page import MAX_POSES, render_report, script_json
from drocap_ros.skeleton import BODY_15

VOID = {"meta", "input", "br", "img", "link"}


class Page(HTMLParser):
    """Checks that elements close in order; collects attributes, scripts and text."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.attributes: list[tuple[str, str]] = []
        self.scripts: dict[str, str] = {}
        self.text = ""
        self.kind = ""
        self.feed(html)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.attributes += attrs
        if tag not in VOID:
            self.open.append(tag)
        self.kind = dict(attrs).get("id", "code") if tag == "script" else ""

    def handle_startendtag(self, tag, attrs):
        self.attributes += attrs

    def handle_endtag(self, tag):
        assert self.open.pop() == tag
        self.kind = ""

    def handle_data(self, data):
        if self.kind:
            self.scripts[self.kind] = self.scripts.get(self.kind, "") + data
        elif "style" not in self.open:
            self.text += data


@pytest.fixture(scope="module")
def html(person):
    return render_report(person, command="drocap report walk_motion")


def data_of(html):
    return json.loads(Page(html).scripts["motion"])


def test_the_page_is_one_file_without_requests(html):
    page = Page(html)
    names = {name for name, _ in page.attributes}
    assert not names & {"src", "href", "srcset", "action"}
    assert not re.search(r"(?i)\b(https?:|url\(|@import|fetch\(|XMLHttpRequest|WebSocket|import\()", html)
    assert ("content", "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'") in (
        page.attributes
    )


def test_the_data_equal_the_motion(html, person):
    data = data_of(html)
    shape = person.joints3d.shape
    np.testing.assert_allclose(np.reshape(data["pose"], shape) / 1000, person.joints3d, atol=0.00051)
    np.testing.assert_allclose(np.array(data["times"]) / 1000, (person.stamp_ns - person.stamp_ns[0]) * 1e-9, atol=6e-4)
    axes = np.reshape(data["camera"], (len(person.joints3d), 2, 3)) / 1000
    np.testing.assert_allclose(axes, person.camera_rotation[:, [0, 2]], atol=0.00051)
    assert data["sides"][BODY_15.index("rwrist")] == "right"
    assert data["sides"][BODY_15.index("lhip")] == "left"
    assert data["sides"][BODY_15.index("head")] == "middle"


def test_the_movement_has_a_list_per_side_with_unit_and_scale(html, person):
    by_name = {curve["name"]: curve for curve in data_of(html)["movement"]}
    assert {name: curve["unit"] for name, curve in by_name.items()} == {
        "Knee bend": "°",
        "Hip bend": "°",
        "Elbow bend": "°",
        "Pelvis speed": "m/s",
        "Wrist speed": "m/s",
        "Ankle speed": "m/s",
    }
    knee = by_name["Knee bend"]
    expected = flexion(person.joints3d, person.joints)["knee"]
    np.testing.assert_allclose(np.array(knee["values"]).T / knee["scale"], expected, atol=0.051)
    assert knee["sides"] == ["right", "left"]
    assert knee["deviation"] is None  # no covariance


def test_checks_commands_and_versions_are_on_the_page(html, person):
    text = Page(html).text
    for words in (
        "walk.mp4",
        "drocap reconstruct walk.mp4",
        "drocap report walk_motion",
        "0123456789abcdef",
        np.__version__,
        "150 iterations, stopped by: converged",
        "Scale assumed",
        "No warnings",
        "Bone lengths",
        "pose2d",
    ):
        assert words in text


def test_text_of_the_motion_is_escaped(person):
    evil = '</script><script>alert(1)</script><img src=x onerror="alert(2)">\u2028$title'
    joints = tuple(evil if name == "head" else name for name in person.joints)
    motion = dataclasses.replace(
        person,
        joints=joints,
        scale_source=evil,
        meta={**person.meta, "input": evil, "versions": {evil: evil}},
    )
    html = render_report(motion, command=evil)
    page = Page(html)
    assert "onerror" not in {name for name, _ in page.attributes}
    assert set(page.scripts) == {"motion", "code"}
    assert json.loads(page.scripts["motion"])["joints"][BODY_15.index("head")] == evil
    assert evil in page.text


def test_unusual_meta_is_rendered(person):
    odd = {"seconds": [1, 2], "versions": "all", "iterations": None, "input": 7, "method": None, "command": ["a"]}
    assert "Bone lengths" in render_report(dataclasses.replace(person, meta=odd))
    assert "Bone lengths" in render_report(dataclasses.replace(person, meta={}))


def test_unknown_joints_are_null_and_lines_are_broken(person):
    joints, error = person.joints3d.copy(), person.reprojection_px.copy()
    joints[20:25] = np.nan
    error[20:25] = np.nan
    keypoints = person.keypoints.copy()
    keypoints[20:25] = np.nan
    html = render_report(dataclasses.replace(person, joints3d=joints, reprojection_px=error, keypoints=keypoints))
    data = data_of(html)
    pose = np.array(data["pose"], dtype=object).reshape(person.joints3d.shape)
    assert (pose[20:25] == None).all()  # noqa: E711
    assert data["series"]["error"][20:25] == [None] * 5
    path = re.search(r'data-series="error".*?class="line" d="([^"]*)"', html)[1]
    assert path.count("M") == 2
    assert "NaN" not in html.split("<script")[0]


def test_a_single_frame_is_rendered(one_frame):
    assert data_of(render_report(one_frame))["times"] == [0]


def test_a_motion_without_poses_or_torso_is_refused(person):
    nothing = dataclasses.replace(person, joints3d=np.full_like(person.joints3d, np.nan))
    with pytest.raises(InputError, match="NaN in all of them"):
        render_report(nothing)
    with pytest.raises(InputError, match="missing neck"):
        render_report(dataclasses.replace(person, joints=tuple("nose" if j == "neck" else j for j in person.joints)))


@pytest.mark.parametrize("size", [0.0, 1e-300, 1e5])
def test_bodies_of_any_size_are_drawn(person, size):
    assert "Bone lengths" in render_report(dataclasses.replace(person, joints3d=size * person.joints3d))


def test_a_motion_without_keypoints_is_rendered(person):
    unknown = np.full_like(person.keypoints, np.nan)
    error = np.full_like(person.reprojection_px, np.nan)
    html = render_report(dataclasses.replace(person, keypoints=unknown, reprojection_px=error))
    assert "Many missing joints" in html


def test_an_hour_gives_a_page_of_less_than_two_megabytes(person):
    """108,000 frames: every n-th pose is shown, the plots average over all."""
    times = 1800
    many = {
        name: np.concatenate([getattr(person, name)] * times)
        for name in ("joints3d", "camera_rotation", "confidence", "keypoints", "reprojection_px")
    }
    stamps = np.arange(60 * times) * 33_333_333
    html = render_report(dataclasses.replace(person, **many, stamp_ns=stamps))
    assert len(html) < 2_000_000
    data = data_of(html)
    assert len(data["times"]) <= MAX_POSES
    assert data["frames"][1] == data["frames"][2] - data["frames"][1]


def test_script_json_keeps_every_character():
    hostile = {"a": "</script>&<!--\u2028\u2029\\u003c'\""}
    text = script_json(hostile)
    assert not re.search("[<>&\u2028\u2029]", text)
    assert json.loads(text) == hostile
    with pytest.raises(ValueError, match="JSON"):
        script_json({"x": float("nan")})
