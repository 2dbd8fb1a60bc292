"""``--all`` and ``--subject 1,3``: everybody in a video, through the command line."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
from people_scenes import PeopleScene, camera_of, of_another, people_of, write_video

from drocap_ros.cli import main
from drocap_ros.corrections import load_corrections, save_corrections
from drocap_ros.motion import load_motion
from drocap_ros.tracks import load_tracks

pytest.importorskip("onnxruntime")

SCENE = PeopleScene("walk", 1, duration_s=2.4, rate_hz=12.5, distance_m=7.0, orbit=False)


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three who walk before a still camera."""
    path = tmp_path_factory.mktemp("people") / "three.avi"
    write_video(path, SCENE)
    return path


@pytest.fixture(scope="module")
def out(video: Path) -> Path:
    folder = video.parent / "out"
    assert main(["reconstruct", str(video), "--all", "--models", "simulation", "--out", str(folder), "--quiet"]) == 0
    return folder


def test_persons_are_corrected_one_by_one_and_solved_again_together(
    video: Path, out: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    base = ["reconstruct", str(out), "--all", "--video", str(video), "--quiet", "--out"]
    assert main([*base, str(tmp_path / "again")]) == 0  # without networks
    before, again = ({n: load_motion(f / f"person_{n}") for n in (1, 2, 3)} for f in (out, tmp_path / "again"))
    for number, motion in before.items():
        np.testing.assert_array_equal(again[number].joints3d, motion.joints3d)
        assert again[number].meta["input"] == video.name
    assert (tmp_path / "again" / "report.html").exists()
    lead = before[1].meta["camera_found_with"]
    other, third = (number for number in before if number != lead)
    said = {"sides": [{"from": 0.5, "to": 1.5, "limbs": "legs"}]}
    save_corrections(tmp_path / "again" / f"person_{other}" / "corrections.yaml", said)
    whole = [*base, str(tmp_path / "again"), "--corrections", str(tmp_path / "again")]
    assert main(whole) == 0
    now = {n: load_motion(tmp_path / "again" / f"person_{n}") for n in (1, 2, 3)}
    assert now[other].meta["corrections"] == said
    assert np.abs(now[other].joints3d - before[other].joints3d).max() > 0.02
    for number in (lead, third):
        np.testing.assert_array_equal(now[number].joints3d, before[number].joints3d)
        assert "corrections" not in now[number].meta
    file = tmp_path / "again" / f"person_{other}" / "corrections.yaml"
    assert load_corrections(file).values == said  # kept with its motion
    # A line in the picture is vertical for all, whoever's page it was marked on; here it leans by 10 degrees.
    lower, upper = [320.0, 300.0], [320.0 + 200.0 * math.tan(math.radians(10.0)), 100.0]
    save_corrections(file, {"upright": [{"time": 0.4, "bottom": lower, "top": upper}]})
    assert main(whole) == 0
    tilts = []
    for motion in (before[third], load_motion(tmp_path / "again" / f"person_{third}")):
        up = motion.camera_rotation[0][:, 2]
        tilts.append(float(np.degrees(np.arctan2(up[0], -up[1]))))
    assert 3.0 < tilts[1] - tilts[0] < 12.0
    save_corrections(file, {"person": [{}]})
    for words, expected in (
        (whole, f"person {other}: expected some images that show it"),
        ([*base, str(tmp_path / "no"), "--corrections", str(file)], "expected a folder of person_N/corrections.yaml"),
        (["reconstruct", str(out), "--out", str(tmp_path / "no")], "add --all"),
        (["reconstruct", str(out), "--subject", "1,7", "--out", str(tmp_path / "no")], "expected one of 1, 2, 3"),
    ):
        assert main(words) == 2
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert expected in line, line
    assert not (tmp_path / "no").exists()


def test_everybody_has_a_motion_in_one_world(out: Path) -> None:
    motions = {n: load_motion(out / f"person_{n}" / "motion.npz") for n in (1, 2, 3)}
    lead = motions[motions[1].meta["camera_found_with"]]
    places = dict(zip(lead.stamp_ns.tolist(), lead.camera_position, strict=True))
    for number, motion in motions.items():
        assert motion.frame == "world"
        assert motion.meta["person"] == number
        assert motion.meta["people"] == [1, 2, 3]
        for ns, place in zip(motion.stamp_ns.tolist(), motion.camera_position, strict=True):
            np.testing.assert_array_equal(place, places[ns])
    common = sorted(set.intersection(*(set(motion.stamp_ns.tolist()) for motion in motions.values())))
    pelvis = [motion.joints3d[np.searchsorted(motion.stamp_ns, common), 0] for motion in motions.values()]
    frames = np.searchsorted(lead.stamp_ns, common)
    true = [joints[frames, 0] for joints in people_of(SCENE)]
    # A still camera's up is that of bodies, to 5 degrees: test/reconstruction/test_people.py has exact ones.
    np.testing.assert_allclose(distances(pelvis), distances(true), rtol=0.5)


def distances(places: list[np.ndarray]) -> list[float]:
    """m, medians of the distances between three paths (F, 3), sorted."""
    pairs = ((0, 1), (0, 2), (1, 2))
    return sorted(float(np.median(np.linalg.norm(places[a] - places[b], axis=1))) for a, b in pairs)


def test_joints_of_one_never_go_to_another(out: Path) -> None:
    truth = [0.5 * camera_of(SCENE).pixels(joints) for joints in people_of(SCENE)]
    owners = set()
    for number in (1, 2, 3):
        keypoints = load_tracks(out / f"person_{number}" / "tracks.npz").keypoints[:, :15]
        off = [float(np.nanmedian(np.linalg.norm(keypoints - person, axis=2))) for person in truth]
        who = int(np.argmin(off))
        owners.add(who)
        assert off[who] < 6.0
        assert of_another(keypoints, truth, who).any(axis=1).mean() < 0.05
    assert len(owners) == 3


def test_report_holds_everybody(out: Path) -> None:
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "3D motion of 3 persons" in page
    assert '"people":[{"name":"1"' in page
    said = re.findall(r'<li class="(\w+)"><b>([^<]*) \(person ([^<]*)\)</b>', page)
    assert any(persons == "1, 2, 3" for _, _, persons in said)
    assert len({(kind, title) for kind, title, _ in said}) == len(said)  # each once, with its persons


def test_exports_and_a_further_report_are_of_everybody(out: Path, tmp_path: Path) -> None:
    assert main(["export", str(out), "--to", "bvh", "--quiet"]) == 0
    assert all((out / f"person_{n}" / "motion.bvh").stat().st_size > 1000 for n in (1, 2, 3))
    assert main(["export", str(out), "--to", "bvh", "--out", str(tmp_path / "one.bvh")]) == 2
    assert main(["report", str(out), "--out", str(tmp_path / "again.html"), "--quiet"]) == 0
    assert "3D motion of 3 persons" in (tmp_path / "again.html").read_text(encoding="utf-8")


def test_two_of_three_are_the_same_persons(video: Path, out: Path, tmp_path: Path) -> None:
    words = ["track", str(video), "--subject", "1,3", "--models", "simulation", "--out", str(tmp_path), "--quiet"]
    assert main(words) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["person_1", "person_3"]
    for name in ("person_1", "person_3"):
        now, before = (load_tracks(folder / name / "tracks.npz") for folder in (tmp_path, out))
        np.testing.assert_array_equal(now.keypoints, before.keypoints)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--subject", "1,7"], "--subject 7: expected one of 1, 2, 3"),
        (["--subject", "2,2"], "expected different numbers"),
        (["--all", "--subject", "2"], "--all: expected no --subject"),
        (["--all", "--end", "0.5"], "expected a person seen for 1 s"),
        (["--all", "--method", "live"], "--method live"),
    ],
)
def test_what_cannot_be_done_is_one_line(
    video: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], expected: str
) -> None:
    command = ["reconstruct", str(video), "--models", "simulation", "--out", str(tmp_path / "out"), *words]
    assert main(command) == 2
    assert expected in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
