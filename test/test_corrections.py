"""Corrections by hand: what a person says of a recording's tracks, and the motion that follows from it."""

from __future__ import annotations

import contextlib
import io
import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from drocap_ros.background import Background
from drocap_ros.cli import main
from drocap_ros.contacts import ANKLES, FEET, RestingFeet
from drocap_ros.corrections import corrected, load_corrections, parse_corrections, save_corrections, spliced
from drocap_ros.errors import InputError
from drocap_ros.evaluation.metrics import aligned_error
from drocap_ros.motion import load_motion
from drocap_ros.reconstruction.reconstruct import reconstruct
from drocap_ros.simulation.pinhole import project
from drocap_ros.simulation.simulated_person import simulate_person
from drocap_ros.skeleton import BODY_17
from drocap_ros.tracks import Tracks, save_tracks
from lab.simulation.orbit import orbit_camera

FPS, FRAMES, SIZE, FOCAL = 24.0, 150, (1280, 720), 1100.0
BEGIN, END = 60, 84  # images in which the network errs
KNEE, ANKLE = BODY_17.index("lknee"), BODY_17.index("lankle")
EDGE = {"time": 0.0, "bottom": [9, 300], "top": [9, 9]}
OTHER_LEG = {"lknee": "rknee", "lankle": "rankle", "ltoe": "rtoe"}


@cache
def scene(seed: int, roll_deg: float = 0.0) -> tuple[np.ndarray, Tracks]:
    """(F, 17, 3) m, and its tracks by a camera that stands, 4 m away, among fixed points."""
    rng, t = np.random.default_rng(seed), np.arange(FRAMES) / FPS
    joints = simulate_person(t, "mixed", seed, 1.75, BODY_17)
    middle = np.broadcast_to(joints[:, 0].mean(axis=0), (FRAMES, 3))
    rotation, position = orbit_camera(t, middle, 4.5, 1.4, 0.0, 40.0 * seed)
    c, s = np.cos(np.deg2rad(roll_deg)), np.sin(np.deg2rad(roll_deg))
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ rotation
    matrix = np.array([[FOCAL, 0, SIZE[0] / 2], [0, FOCAL, SIZE[1] / 2], [0, 0, 1]])
    xy = project(joints, rotation, position, matrix) + rng.normal(0.0, 2.0, (FRAMES, 17, 2))
    points, frame = rng.uniform((0, 0), SIZE, (60, 2)), np.repeat(np.arange(FRAMES), 60)
    track = np.tile(np.arange(60), FRAMES)
    background = Background(frame.astype(np.int32), track, points[track].astype(np.float32))
    stamp_ns = np.round(t * 1e9).astype(np.int64)
    return joints, Tracks(xy, BODY_17.joints, stamp_ns, SIZE, camera_matrix=matrix, background=background)


def at(image: int) -> float:
    return image / FPS


def wrong(kind: str, seed: int) -> tuple[Tracks, dict[str, object]]:
    """Tracks of a network that errs for a second, and the corrections of somebody who sees it."""
    tracks = scene(seed)[1]
    xy, rng = tracks.keypoints.copy(), np.random.default_rng(seed)
    height = float(np.median(np.ptp(xy[..., 1], axis=1)))
    if kind == "exchanged legs":
        for joint, other in OTHER_LEG.items():
            pair = [BODY_17.index(joint), BODY_17.index(other)]
            xy[BEGIN:END, pair] = xy[BEGIN:END, pair[::-1]]
        entry = {"sides": [{"from": at(BEGIN), "to": at(END - 1), "limbs": "legs"}]}
        return replace(tracks, keypoints=xy), entry
    right = xy[:, KNEE].copy()
    if kind == "shifted":
        xy[BEGIN:END, KNEE] += 0.13 * height * np.array([np.cos(seed), np.sin(seed)])
    else:  # on the other knee, and about
        wave = 0.1 * height * np.sin(np.arange(END - BEGIN) / 3.0)[:, None]
        xy[BEGIN:END, KNEE] = xy[BEGIN:END, BODY_17.index("rknee")] + wave
    clicks = [(image, right[image] + rng.normal(0.0, 0.004 * height, 2)) for image in (BEGIN + 3, BEGIN + 12, END - 4)]
    entries = [{"time": at(image), "joint": "lknee", "at": [float(v) for v in place]} for image, place in clicks]
    return replace(tracks, keypoints=xy), {"joints": entries}


def errors_mm(tracks: Tracks, seed: int) -> np.ndarray:
    """(F, 17) of the motion of tracks, each pose aligned."""
    found = reconstruct(tracks).joints3d[:, :17]
    return 1e3 * aligned_error(found, scene(seed)[0])


@pytest.mark.parametrize("kind", ["shifted", "on the other knee", "exchanged legs"])
@pytest.mark.parametrize("seed", [1, 2, 4])
def test_a_second_of_wrong_keypoints_is_corrected_by_three_clicks_or_one_entry(kind: str, seed: int) -> None:
    tracks, entries = wrong(kind, seed)
    before = errors_mm(tracks, seed)
    after = errors_mm(corrected(tracks, parse_corrections(entries)), seed)
    limb = np.s_[BEGIN:END, [KNEE, ANKLE]]
    right = errors_mm(scene(seed)[1], seed)[limb].mean()  # of a network that does not err
    assert after[limb].mean() - right < 0.5 * (before[limb].mean() - right)
    rest = np.r_[0 : BEGIN - 12, END + 12 : FRAMES]
    assert after[rest].mean() < before[rest].mean() + 2.0


def test_a_hidden_joint_is_not_seen_and_a_person_who_is_nobody_is_not_there() -> None:
    tracks = scene(1)[1]
    said = parse_corrections({"hidden": [{"from": at(10), "to": at(20), "joint": "rwrist"}]})
    gone = np.isnan(corrected(tracks, said).keypoints).all(axis=2)
    assert gone[10:21, BODY_17.index("rwrist")].all()
    assert gone.sum() == 11
    rows = np.arange(FRAMES) >= 100
    assert np.isnan(spliced(tracks, rows, None).keypoints[100:]).all()
    other = replace(tracks, keypoints=tracks.keypoints + 5.0)
    both = spliced(tracks, rows, other.of_frames(rows)).keypoints
    assert np.array_equal(both[100:], other.keypoints[100:])
    assert np.array_equal(both[:100], tracks.keypoints[:100])


@settings(max_examples=30, deadline=None)
@given(st.sampled_from(["legs", "arms", "all"]), st.integers(0, FRAMES - 2), st.integers(1, FRAMES - 1))
def test_sides_that_are_exchanged_twice_are_as_they_were(limbs: str, begin: int, length: int) -> None:
    tracks = scene(1)[1]
    entry = {"from": at(begin), "to": at(begin + length), "limbs": limbs}
    once = corrected(tracks, parse_corrections({"sides": [entry]}))
    assert np.array_equal(corrected(tracks, parse_corrections({"sides": [entry, entry]})).keypoints, tracks.keypoints)
    changed = (once.keypoints != tracks.keypoints).any(axis=2)
    assert not changed[:begin].any()
    assert changed.any(axis=0).sum() == {"legs": 6, "arms": 4, "all": 14}[limbs]


@pytest.mark.parametrize("rests", [True, False])
def test_a_foot_rests_where_somebody_says_so(rests: bool) -> None:
    t = np.arange(60) / FPS
    joints = np.zeros((60, 17, 3))
    joints[:, FEET[::2], 0] = 0.0 if not rests else 0.8 * t[:, None]  # the right foot stands, or slides
    looks = np.full((60, 2), 0.02 if rests else 0.98)
    said = parse_corrections({"feet": [{"from": at(20), "to": at(40), "foot": "right", "rests": rests}]})
    stated = corrected(scene(1)[1].of_frames(slice(60)), said).resting
    assert stated is not None
    feet = RestingFeet(np.ones((60, 17), bool), FPS, np.where(np.isfinite(stated), stated, looks))
    found = feet.probability(joints, 0.0, 0.1)
    assert (found[21:39, 0] == float(rests)).all()
    assert ((found[:19, 0] > 0.5) != rests).all()


def test_a_foot_that_is_said_to_rest_keeps_its_place_in_the_motion() -> None:
    tracks = scene(2)[1]
    before = reconstruct(tracks)
    ankle = before.joints3d[:, ANKLES[1]]
    speed = np.linalg.norm(np.diff(ankle, axis=0), axis=1) * FPS
    begin = int(np.convolve(speed, np.ones(10) / 10, "valid").argmax())  # where the left foot moves fastest
    said = {"feet": [{"from": at(begin), "to": at(begin + 10), "foot": "left", "rests": True}]}
    after = reconstruct(corrected(tracks, parse_corrections(said)))
    now = np.linalg.norm(np.diff(after.joints3d[:, ANKLES[1]], axis=0), axis=1) * FPS
    assert now[begin : begin + 10].mean() < 0.5 * speed[begin : begin + 10].mean()


@pytest.mark.parametrize("roll_deg", [-12.0, 9.0])
def test_what_is_vertical_levels_a_camera_that_stands_rolled(roll_deg: float) -> None:
    tracks = replace(scene(3, roll_deg)[1], camera_matrix=None, real_lens=True)
    c, s = np.cos(np.deg2rad(roll_deg)), np.sin(np.deg2rad(roll_deg))
    lower, upper = np.array([0.0, 250.0]), np.array([0.0, -250.0])
    ends = [(np.array([[c, -s], [s, c]]) @ end + (640, 360)).tolist() for end in (lower, upper)]
    said = parse_corrections({"upright": [{"time": 0.0, "bottom": ends[0], "top": ends[1]}]})

    def horizon(motion_tracks: Tracks) -> float:
        up = reconstruct(motion_tracks).camera_rotation[0][:, 2]
        return abs(float(np.degrees(np.arctan2(up[0], -up[1]))) - roll_deg)

    assert horizon(corrected(tracks, said)) < max(0.6 * horizon(tracks), 1.5)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("joints: [{time: 1, joint: knee, at: [1, 2]}]", "joint: expected one of pelvis, .*'knee'"),
        ("joints: [{time: 900, joint: lknee, at: [1, 2]}]", "time: expected one within the recording's 6.21 s"),
        ("joints: [{time: -1, joint: lknee, at: [1, 2]}]", "joints, entry 1: time: expected seconds"),
        ("joints: [{time: 1, joint: lknee, at: [.nan, 2]}]", "at: expected 2 numbers"),
        ("joints: [{time: 1, joint: lknee, at: 7}]", "at: expected 2 numbers, px of the image, found 7"),
        ("joints: [{time: 1, joint: lknee}]", "expected 'at', found none"),
        ("joints: {time: 1}", "joints: expected a list of entries, found dict"),
        ("join: []", "join: expected one of joints, hidden, .*joints"),
        ("sides: [{from: 2, to: 1, limbs: legs}]", "from 2 to 1: expected an end after the begin"),
        ("sides: [{limbs: leg}]", "limbs: expected one of legs, arms, all, found 'leg'"),
        ("feet: [{foot: left, rests: 1}]", "rests: expected true or false, found 1"),
        ("feet: [{foot: left, rest: true}]", "feet, entry 1: expected {from, to, foot, rests}"),
        ("person: [{from: 1, box: [5, 5, 1, 9]}]", "box: expected x_min, y_min, x_max, y_max px"),
        ("person: [{from: 1, box: [5, 5, 9, 9]}]", "person: expected images for whoever is in a box.*--video"),
        ("person: [{from: 99}]", "person: expected a time within the recording"),
        ("[1, 2]", "expected lists of joints, hidden"),
        ("joints: [", "expected YAML"),
    ],
)
def test_a_wrong_file_is_one_line_and_nothing_is_written(text: str, message: str, tmp_path: Path) -> None:
    save_tracks(tmp_path / "tracks.npz", scene(1)[1])
    (tmp_path / "c.yaml").write_text(text)
    said, out = io.StringIO(), tmp_path / "out"
    words = ["reconstruct", str(tmp_path / "tracks.npz"), "--corrections", str(tmp_path / "c.yaml"), "--out", str(out)]
    with contextlib.redirect_stderr(said):
        assert main(words) == 2
    (line,) = said.getvalue().splitlines()
    assert re.search(message, line), line
    assert not out.exists()


def test_the_command_takes_corrections_says_them_and_is_undone_without_them(tmp_path: Path) -> None:
    tracks, entries = wrong("exchanged legs", 1)
    save_tracks(tmp_path / "walk.npz", tracks)
    save_corrections(tmp_path / "c.yaml", entries)
    assert yaml.safe_load((tmp_path / "c.yaml").read_text()) == entries
    base = ["reconstruct", str(tmp_path / "walk.npz"), "--quiet", "--no-report", "--out"]
    assert main([*base, str(tmp_path / "raw")]) == 0
    assert main([*base, str(tmp_path / "by_hand"), "--corrections", str(tmp_path / "c.yaml")]) == 0
    again = str(tmp_path / "by_hand" / "tracks.npz")  # kept as they were
    assert main(["reconstruct", again, "--quiet", "--no-report", "--out", str(tmp_path / "undone")]) == 0
    raw, by_hand, undone = (load_motion(tmp_path / name) for name in ("raw", "by_hand", "undone"))
    assert by_hand.meta["corrections"] == entries
    assert np.array_equal(raw.joints3d, undone.joints3d)
    assert np.abs(raw.joints3d - by_hand.joints3d).max() > 0.05


def test_without_entries_there_is_no_file(tmp_path: Path) -> None:
    path = tmp_path / "corrections.yaml"
    save_corrections(path, {"feet": [{"from": 1.0, "to": 2.0, "foot": "left", "rests": False}]})
    assert load_corrections(path).feet[0][1:] == ("left", False)
    save_corrections(path, {"feet": []})
    assert not path.exists()
    with pytest.raises(InputError, match="expected a file of corrections"):
        load_corrections(path)


@pytest.mark.parametrize(
    ("by", "entry", "words"),
    [
        ("nothing", {"feet": [{"to": 2.0, "foot": "left", "rests": True}]}, "feet: the motion has no world"),
        ("nothing", {"upright": [EDGE]}, "upright: the motion has no world"),
        ("telemetry", {"upright": [EDGE]}, "upright: telemetry tells up"),
        ("points", {"upright": [EDGE]}, ""),
    ],
)
def test_what_is_said_in_vain_is_told(
    by: str, entry: dict[str, object], words: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    tracks = scene(1)[1]
    if by == "nothing":
        tracks = replace(tracks, background=None)
    if by == "telemetry":
        turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
        place = np.tile([0.0, 0.0, 2.0], (FRAMES, 1))
        tracks = replace(tracks, camera_rotation=np.tile(turn, (FRAMES, 1, 1)), camera_position=place)
    save_tracks(tmp_path / "walk.npz", tracks)
    save_corrections(tmp_path / "c.yaml", entry)
    command = ["reconstruct", str(tmp_path / "walk.npz"), "--quiet", "--no-report", "--out", str(tmp_path / "out")]
    assert main([*command, "--corrections", str(tmp_path / "c.yaml")]) == 0
    assert (words in caplog.text) if words else ("changes nothing" not in caplog.text)
