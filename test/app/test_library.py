"""What the app shows of a folder, and the commands that it runs, without a browser."""

from __future__ import annotations

import asyncio
import dataclasses
import shutil
import socket
from pathlib import Path

import numpy as np
import pytest
from walking import make_walk

from drocap_ros.app.jobs import Job
from drocap_ros.app.library import Entry, clips, motions
from drocap_ros.app.skeleton_svg import skeleton_svg
from drocap_ros.app.timeline import WIDTH, TimeAxis, bars_svg
from drocap_ros.cli import main
from drocap_ros.corrections import save_corrections
from drocap_ros.motion import load_motion
from drocap_ros.tracks import save_tracks


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a motion that was made with a stature."""
    folder = tmp_path_factory.mktemp("desk")
    save_tracks(folder / "walk.npz", make_walk(60).tracks())
    out = str(folder / "walk_motion")
    assert main(["reconstruct", str(folder / "walk.npz"), "--out", out, "--height=1.9", "--quiet", "--no-report"]) == 0
    (folder / "walk_motion" / "tracks.npz").unlink(missing_ok=True)
    shutil.copy(folder / "walk.npz", folder / "walk_motion" / "tracks.npz")
    return folder


def test_the_library_has_motions_of_one_and_of_several_and_says_what_is_damaged(made: Path, tmp_path: Path) -> None:
    for name in ("one", "all/person_1", "all/person_2", "damaged"):
        shutil.copytree(made / "walk_motion", tmp_path / name)
    (tmp_path / "damaged" / "motion.npz").write_bytes(b"PK")
    (tmp_path / "empty").mkdir()
    found = {entry.name: entry.quality for entry in motions(tmp_path)}
    assert sorted(found) == ["all/person_1", "all/person_2", "damaged", "one"]
    assert "expected a readable .npz archive" in found["damaged"]
    assert not clips(tmp_path)
    entry = Entry(tmp_path / "one" / "motion.npz", "one")
    assert entry.thumbnail is None
    assert entry.video is None
    assert entry.quality.startswith("quality: ")


def test_it_is_solved_again_from_its_tracks_with_its_options_and_corrections(made: Path, tmp_path: Path) -> None:
    shutil.copytree(made / "walk_motion", tmp_path / "one")
    entry = Entry(tmp_path / "one" / "motion.npz", "one")
    before = load_motion(tmp_path / "one")
    assert "--corrections" not in entry.words(None)
    said = {"sides": [{"from": 0.5, "to": 1.0, "limbs": "legs"}]}
    save_corrections(entry.corrections_file, said)
    assert entry.corrections() == said
    words = entry.words(tmp_path)
    assert "--height=1.9" in words
    assert words[words.index("--models") + 1] == str(tmp_path)
    job = Job([*words, "--no-report"])
    assert asyncio.run(job.run()) == 0
    after = entry.motion
    assert after.meta["corrections"] == said
    assert after.meta["assumed_height_m"] == before.meta["assumed_height_m"] == 1.9
    meant = entry.corrected(said).keypoints
    assert np.array_equal(after.keypoints[:, :15], meant, equal_nan=True)
    assert not np.array_equal(meant, entry.tracks.keypoints, equal_nan=True)


def test_persons_and_cameras_are_solved_again_together(made: Path, tmp_path: Path) -> None:
    for name in ("all/person_1", "all/person_10", "two", ".two.abc"):
        shutil.copytree(made / "walk_motion", tmp_path / name)
    shutil.copy(tmp_path / "two" / "motion.npz", tmp_path / "two" / "camera_2.npz")
    shutil.copy(tmp_path / "two" / "tracks.npz", tmp_path / "two" / "camera_2_tracks.npz")
    found = {entry.name: entry for entry in motions(tmp_path)}
    assert sorted(found) == ["all/person_1", "all/person_10", "two", "two/camera_2"]
    second, person = found["two/camera_2"], found["all/person_10"]
    assert second.corrections_file == tmp_path / "two" / "camera_2_corrections.yaml"
    assert second.words(None)[:4] == [
        "reconstruct", str(tmp_path / "two/tracks.npz"), str(tmp_path / "two/camera_2_tracks.npz"), "--together"
    ]  # fmt: skip
    assert person.words(None)[:3] == ["reconstruct", str(tmp_path / "all"), "--all"]
    for entry in (second, person):
        assert "--corrections" not in entry.words(None)
        save_corrections(entry.corrections_file, {"sides": [{"limbs": "legs"}]})
    for name in ("two", "all/person_1"):
        words = found[name].words(None)
        assert words[words.index("--corrections") + 1] == str(found[name].folder)


def test_a_job_tells_its_progress_and_the_one_line_of_a_refusal(made: Path, tmp_path: Path) -> None:
    seen: list[float] = []

    async def watch(job: Job) -> int:
        task = asyncio.create_task(job.run())
        while not task.done():
            seen.append(job.share)
            await asyncio.sleep(0.02)
        return await task

    job = Job(["reconstruct", str(made / "walk.npz"), "--out", str(tmp_path / "out")])
    assert asyncio.run(watch(job)) == 0
    assert job.share == 1.0
    assert sorted(seen) == seen
    assert any("median reprojection error" in line for line in job.lines)
    refused = Job(["reconstruct", str(tmp_path / "nothing.mp4")])
    assert asyncio.run(refused.run()) == 2
    assert [line[:8] for line in refused.lines] == ["drocap: "]


def test_a_job_that_is_cancelled_leaves_nothing(tmp_path: Path) -> None:
    tracks = make_walk(60).tracks()
    long = dataclasses.replace(
        tracks,
        keypoints=np.tile(tracks.keypoints, (60, 1, 1)),
        stamp_ns=np.round(np.arange(3600) * 1e9 / 24).astype(np.int64),
    )
    save_tracks(tmp_path / "long.npz", long)
    job = Job(["reconstruct", str(tmp_path / "long.npz"), "--out", str(tmp_path / "out")])

    async def begin_and_cancel() -> int:
        task = asyncio.create_task(job.run())
        while job.share <= 0.0 and not task.done():
            await asyncio.sleep(0.01)
        job.cancel()
        return await task

    assert asyncio.run(begin_and_cancel()) == 130
    assert not (tmp_path / "out" / "motion.npz").exists()


def test_the_command_says_what_is_missing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["app", str(tmp_path / "nowhere")]) == 2
    assert "expected a folder for clips and motions, found none" in capsys.readouterr().err
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        assert main(["app", str(tmp_path), "--no-browser", "--port", str(taken.getsockname()[1])]) == 2
    assert "expected a free address" in capsys.readouterr().err
    assert main(["app", str(tmp_path), "--no-browser", "--port", "70000"]) == 2


def test_the_timeline_draws_what_a_file_by_hand_may_leave_out() -> None:
    axis = TimeAxis(np.arange(101) / 25.0)
    said = {
        "feet": [{"foot": "left", "rests": False}, {"foot": "right", "rests": True, "from": 2.0}],
        "person": [{"from": 1.0}],
        "joints": [{"time": 4.0, "joint": "lknee", "at": [1.0, 2.0]}],
    }
    assert [axis.span(entry) for entry in said["feet"]] == [(0, 100), (50, 100)]
    assert axis.at(axis.x(37)) == 37
    assert axis.at(-50.0) == 0
    assert axis.at(2 * WIDTH) == 100
    drawn = bars_svg(axis, 10, (20, 30), [[(5, 40)], []], said)
    assert drawn.count("#e80") == 2
    assert drawn.count("#c33") == drawn.count("#2a2") == 1


def test_a_name_of_a_file_is_no_markup_of_the_page() -> None:
    at = np.array([[1.0, 2.0], [np.nan, 3.0], [4.0, 5.0]])
    drawn = skeleton_svg(('"><script>', "lknee", "rknee"), [(0, 2), (0, 1)], at, 3.0, {2: "white"})
    assert "<script>" not in drawn
    assert drawn.count("<circle") == 2
    assert drawn.count("<line") == 1
