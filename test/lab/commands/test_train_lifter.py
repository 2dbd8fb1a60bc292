"""python -m lab train-lifter."""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from walking import write_mocap

from drocap_ros.errors import InputError
from drocap_ros.reconstruction.lifted.lifter import Lifter
from lab.commands import train_lifter

SMALL = ("--width", "16", "--frames-per-batch", "240", "--workers", "1")


def command(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    train_lifter.add_parser(parser.add_subparsers())
    return parser.parse_args(["train-lifter", *words])


@pytest.fixture
def mocap(tmp_path: Path) -> Path:
    pytest.importorskip("torch", reason="the extra 'train' is not installed")
    pytest.importorskip("onnx", reason="the extra 'train' is not installed")
    folder = tmp_path / "mocap"
    folder.mkdir()
    write_mocap(folder, "one_1")
    return folder


def test_a_network_is_trained_and_states_its_origin(mocap: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = mocap.parent / "l.onnx"
    words = (str(mocap), "--out", str(out), "--include", "one_*", "--steps", "2", "--seed", "3", *SMALL)
    args = command(*words)
    assert args.run(args) == 0
    assert "2 steps" in capsys.readouterr().out
    origin = Lifter.load(out).origin
    assert (origin["files"], origin["origin"], origin["licence"]) == ("1", "synthetic", "made here")
    assert "--include 'one_*' --steps 2 --width 16 --frames-per-batch 240" in origin["command"]
    first = out.read_bytes()
    quiet = command(*words, "--quiet")
    assert quiet.run(quiet) == 0
    assert capsys.readouterr() == ("", "")
    assert out.read_bytes() == first


@pytest.mark.parametrize(
    ("words", "match"),
    [
        (("--out", "x.npz"), "--out"),
        (("--out", "folder.onnx"), "found a folder"),
        (("--threads", "0"), "--threads"),
        (("--frames-per-batch", "64"), "--frames-per-batch: expected 240"),
        (("--include", "/abs*"), "found none"),
        (("--include", "**/one"), "found none"),
    ],
)
def test_an_unusable_option_is_refused_before_the_training(
    mocap: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], match: str
) -> None:
    monkeypatch.chdir(mocap.parent)
    (mocap.parent / "folder.onnx").mkdir()
    args = command(str(mocap), "--out", "l.onnx", "--steps", "100000", *words)
    with pytest.raises(InputError, match=match):
        args.run(args)
    assert not (mocap.parent / "l.onnx").exists()


def test_a_terminated_group_leaves_the_file_that_was_there(mocap: Path) -> None:
    out = mocap.parent / "l.onnx"
    out.write_bytes(b"before")
    words = [sys.executable, "-m", "lab", "train-lifter", str(mocap), "--out", str(out), "--minutes", "9"]
    root = str(Path(__file__).parents[3])
    training = subprocess.Popen(
        [*words, *SMALL], stderr=subprocess.PIPE, text=True, start_new_session=True,
        env={**os.environ, "PYTHONPATH": root},
    )  # fmt: skip
    assert training.stderr is not None
    assert "step" in training.stderr.readline()
    os.killpg(training.pid, signal.SIGTERM)
    begin = time.monotonic()
    rest = training.communicate(timeout=60)[1]
    assert training.returncode == 130, rest
    assert "Error" not in rest
    assert time.monotonic() - begin < 30
    assert out.read_bytes() == b"before"
    assert [path.name for path in mocap.parent.iterdir() if path.name.startswith(".")] == []
