"""``drocap batch``: kills, resuming, failures, and the same arrays as ``reconstruct``."""

import fcntl
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from argparse import Namespace
from pathlib import Path

import numpy as np
import psutil
import pytest

from drocap_ros.cli import main
from drocap_ros.cli.batch import read_inputs
from drocap_ros.cli.batch_recording import Task, content_digest, fingerprint, run_on_this_machine, stat_digest
from drocap_ros.motion import load_motion
from drocap_ros.reconstruction.reconstruct import reconstruct
from drocap_ros.tracks import load_tracks, save_tracks
from lab.simulation.capture import simulate_capture

ROOT = Path(__file__).resolve().parents[2]
GOOD = 4


@pytest.fixture(scope="module")
def season(tmp_path_factory):
    folder = tmp_path_factory.mktemp("season")
    for seed in range(GOOD):
        save_tracks(folder / f"walk {seed}.npz", simulate_capture(1.0, 24.0, seed=seed).tracks)
    (folder / "broken.npz").write_bytes(b"no archive")
    return folder


def batch(*words):
    command = [sys.executable, "-m", "drocap_ros.cli", "batch", *map(str, words)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)


def log_lines(out):
    log = out / "batch.jsonl"
    return [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []


def wait_for_lines(out, count, runs):
    until = time.monotonic() + 600
    while len(log_lines(out)) < count:
        assert runs()
        assert time.monotonic() < until
        time.sleep(0.02)


def done_times(out):
    return {path.parent.name: path.stat().st_mtime_ns for path in out.glob("[!.]*/record.json")}


def assert_arrays_of_reconstruct(out, records):
    for record in records[:2]:
        ours, theirs = load_motion(out / record["folder"] / "motion.npz"), reconstruct(load_tracks(record["input"]))
        for name in ("joints3d", "camera_rotation", "confidence", "keypoints", "reprojection_px", "stamp_ns"):
            np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))


def assert_all_recorded(out):
    """One line per recording; each good one is done, the broken one is reported."""
    records = log_lines(out)
    done = [record for record in records if record["status"] == "done"]
    (failure,) = (record for record in records if record["status"] == "failed")
    assert sorted(Path(record["input"]).name for record in done) == [f"walk {seed}.npz" for seed in range(GOOD)]
    assert Path(failure["input"]).name == "broken.npz"
    assert "expected a readable .npz archive" in failure["error"]
    assert "\n" not in failure["error"]
    assert {record["folder"] for record in done} == set(done_times(out))
    return done


def test_killed_batch_goes_on_and_repeats_nothing(season, tmp_path, capsys):
    out = tmp_path / "out"
    first = batch(season, "--out", out, "--jobs", 2)
    wait_for_lines(out, 2, lambda: first.poll() is None)
    processes = psutil.Process(first.pid).children(recursive=True)
    first.kill()
    first.wait()
    _, alive = psutil.wait_procs(processes, timeout=300)
    assert not alive
    before, logged = done_times(out), sum(record["status"] == "done" for record in log_lines(out))
    assert 0 < len(before) < GOOD
    assert all((out / name / "motion.npz").exists() for name in before)
    (out / ".walk-0123456789abcdef.x1y2z3").mkdir()  # as a killed process leaves it

    second = batch(season, "--out", out, "--jobs", 2)
    printed, errors = second.communicate(timeout=900)
    assert second.returncode == 1, errors
    # A recording that was complete when the batch died, but not in its log, is found by its worker.
    earlier = int(re.search(r"5 recordings: 4 done, (\d) of them earlier, 1 failed", printed)[1])
    assert logged <= earlier == len(before)
    assert errors.count("\n") == 1
    done = assert_all_recorded(out)
    assert before.items() <= done_times(out).items()
    assert_arrays_of_reconstruct(out, done)
    assert {path.name for path in out.glob(".*")} == {".lock"}
    for record in done:
        assert record["seen"] == 1.0
        assert record["seconds"] > 0
        assert 20 < record["peak_memory_mb"] < 4000

    page = (out / "summary.html").read_text()
    for title in ("error<i>% of body</i>", "view<i>°</i>", "length<i>s</i>", "memory<i>MB</i>"):
        assert title in page
    rows = re.findall(r'<tr class="(\w+)">', page)
    assert rows == ["failed"] + ["done"] * GOOD
    links = re.findall(r'href="([^"]+)"', page)
    assert len(links) == GOOD
    assert all((out / link).is_file() for link in links)

    finished = done_times(out)
    copy = tmp_path / "walk 0.npz"
    copy.write_bytes((season / "walk 0.npz").read_bytes())
    capsys.readouterr()
    assert main(["batch", str(copy), "--out", str(out)]) == 0, "known by its content"
    assert "1 recording: 1 done, 1 of them earlier, 0 failed" in capsys.readouterr().out
    (record,) = log_lines(out)
    assert record["input"] == str(copy)
    assert done_times(out) == finished


def test_telemetry_none_is_no_file(tmp_path):
    clip, listed, out = tmp_path / "clip.mp4", tmp_path / "list.txt", tmp_path / "out"
    clip.write_text("no video")
    listed.write_text(f"'{clip}' --telemetry none\n")
    for words in ([clip, "--telemetry", "none"], [listed]):
        process = batch(*words, "--out", out, "--models", "simulation")
        _, errors = process.communicate(timeout=600)
        assert process.returncode == 1, errors
        (record,) = log_lines(out)
        assert "expected a video" in record["error"]


class Crash:
    """Ends the process that receives it."""

    def __reduce__(self):
        return os._exit, (11,)


def test_crash_is_a_failure_of_its_own_recording(tmp_path):
    def task(name, **arguments):
        return Task(Namespace(input=tmp_path / name, **arguments), tmp_path, "", "another version", {}, name)

    records = list(run_on_this_machine([task("a", x=Crash()), task("b"), task("c", x=Crash())], jobs=2))
    errors = {Path(record["input"]).name: record["error"] for record in records}
    assert errors["a"] == errors["c"]
    assert "process ended" in errors["a"]
    assert "expected drocap_ros another version" in errors["b"]


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["none.npz"], "expected a list, folder, pattern or recording"),
        (["empty"], "expected a list, folder, pattern or recording"),
        (["list.txt"], r"list.txt:2: .*unrecognized arguments: --wrong"),
        (["a.npz", "--jobs", "0"], "--jobs: expected at least 1"),
        (["a.npz", "--dictionary", "none.npz"], "--dictionary none.npz: no such file"),
        (["a.npz", "--cluster", "nonsense"], "--cluster"),
        (["a.npz", "--out", "busy"], "another batch is running"),
    ],
)
def test_unusable_arguments_give_one_line_and_status_2(words, expected, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for folder in ("empty", "busy"):
        Path(folder).mkdir()
    Path("a.npz").touch()
    Path("list.txt").write_text("a.npz\nb.npz --wrong\n")
    with Path("busy/.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert main(["batch", "--out", "out", *words]) == 2
    assert re.fullmatch(f"drocap: .*{expected}.*\n", capsys.readouterr().err)


def test_cluster_with_a_killed_worker_gives_the_same_arrays(season, tmp_path, monkeypatch):
    distributed = pytest.importorskip("distributed", reason="dask.distributed is not installed (extra [cluster])")
    out = tmp_path / "out"
    monkeypatch.setenv("PYTHONPATH", str(ROOT), prepend=os.pathsep)  # for the workers
    with distributed.LocalCluster(2, threads_per_worker=1, dashboard_address=None) as cluster:
        words = ["batch", str(season), "--out", str(out), "--cluster", cluster.scheduler_address]
        status, answers = [], [AssertionError]  # of the library to a greeting with further messages behind it

        def client(*args, **kwargs):
            if answers:
                raise answers.pop()
            return connected(*args, **kwargs)

        connected = distributed.Client
        monkeypatch.setattr(distributed, "Client", client)
        run = threading.Thread(target=lambda: status.append(main(words)))
        run.start()
        wait_for_lines(out, 1, run.is_alive)
        os.kill(cluster.workers[0].pid, signal.SIGKILL)
        run.join(200)
    assert status == [1]
    assert_arrays_of_reconstruct(out, assert_all_recorded(out))


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in (
        "season/a.npz", "season/DJI_1.MP4", "season/photo.jpg", "season/DJI_1.SRT", "season/.hidden.mp4",
        "season/flight/metadata.yaml", "season/flight/flight_0.mcap", "season/loose/one.mcap", "season/loose/two.mcap",
        "season/images/1.png", "season/images/2.png", "season/done/motion.npz", "season/done/tracks.npz",
        "season/done/report.html", "season/empty/notes.md", "with space.npz", "season/@eaDir/a.mp4/SYNO_THUMB.jpg",
        "season/__MACOSX/b.mp4",
    ):  # fmt: skip
        path = Path(name)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(name)
    return tmp_path


def names(*words):
    return [str(arguments.input) for arguments in read_inputs(words, Namespace(method="ba"))]


def test_folder_gives_its_recordings_at_any_depth_and_no_results(folder):
    assert names("season") == [
        "season/DJI_1.MP4", "season/a.npz", "season/flight", "season/images", "season/loose/one.mcap",
        "season/loose/two.mcap",
    ]  # fmt: skip


def test_pattern_takes_files_and_folders(folder):
    assert names("season/*.MP4", "season/**/t*.mcap", "season/fl*") == [
        "season/DJI_1.MP4", "season/loose/two.mcap", "season/flight",
    ]  # fmt: skip


def test_line_of_a_list_has_options_of_its_own(folder):
    Path("list.txt").write_text(
        "# comment\n\nwith space.npz\n'season/DJI_1.MP4' --telemetry season/DJI_1.SRT --method paper\nmissing.mp4\n"
    )
    first, second, third = read_inputs(["list.txt"], Namespace(method="initial", telemetry=None))
    assert (first.input, first.method, first.telemetry) == (Path("with space.npz"), "initial", None)
    assert (second.input, second.method) == (Path("season/DJI_1.MP4"), "paper")
    assert second.telemetry == Path("season/DJI_1.SRT")
    assert (third.input, third.method) == (Path("missing.mp4"), "initial")


def key(of_path, version="1", **values):
    return fingerprint(Namespace(**{"input": Path("season/a.npz"), "method": "ba", **values}), version, of_path)


@pytest.mark.parametrize("of_path", [content_digest, stat_digest])
def test_key_depends_on_input_options_and_version(folder, of_path):
    changes = ({}, {"method": "paper"}, {"version": "2"}, {"input": Path("season/images")})
    keys = [key(of_path, **change) for change in changes]
    assert keys == [key(of_path, **change) for change in changes]
    assert len(set(keys)) == len(changes)
    before = key(of_path, input=Path("season/images"))
    Path("season/images/2.png").rename("season/images/3.png")
    assert key(of_path, input=Path("season/images")) != before


def test_key_of_a_copy_is_the_same(folder):
    Path("copy.npz").write_bytes(Path("season/a.npz").read_bytes())
    assert key(content_digest, input=Path("copy.npz")) == key(content_digest)
