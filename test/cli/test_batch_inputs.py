"""Inputs and keys of ``drocap batch``."""

from argparse import Namespace
from pathlib import Path

import pytest

from drocap_ros.cli.batch import read_inputs
from drocap_ros.cli.batch_recording import content_digest, fingerprint, stat_digest


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in (
        "season/a.npz", "season/DJI_1.MP4", "season/photo.jpg", "season/DJI_1.SRT", "season/.hidden.mp4",
        "season/flight/metadata.yaml", "season/flight/flight_0.mcap", "season/loose/one.mcap", "season/loose/two.mcap",
        "season/images/1.png", "season/images/2.png", "season/done/motion.npz", "season/done/tracks.npz",
        "season/done/report.html", "season/empty/notes.md", "with space.npz",
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
