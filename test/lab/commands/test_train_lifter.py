"""python -m lab train-lifter."""

from __future__ import annotations

import argparse
from pathlib import Path

import pytest
from walking import write_mocap

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
