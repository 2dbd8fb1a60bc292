"""python -m lab learn-dictionary."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits
from walking import write_mocap

from drocap_ros.reconstruction.paper.dictionary import Dictionary, load_dictionary
from lab.commands import learn_dictionary
from lab.training import dictionary


def command(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    learn_dictionary.add_parser(parser.add_subparsers())
    return parser.parse_args(["learn-dictionary", *words])


def test_a_dictionary_is_learned_and_its_quality_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_mocap(tmp_path, "one_1")
    write_mocap(tmp_path, "two_1", X=np.full((5, 15, 3), np.nan, np.float32))
    out = tmp_path / "d.npz"
    args = command(str(tmp_path), "--out", str(out), "--include", "one_*", "--atoms", "16", "--every", "1")
    assert args.run(args) == 0
    printed = capsys.readouterr().out
    assert "reconstruction error" in printed
    assert "active atoms" in printed
    metadata = load_dictionary(out).metadata
    assert (metadata["files"], metadata["licence"], metadata["origin"]) == (1, ["made here"], ["synthetic"])


def test_learning_uses_one_thread_whatever_the_environment_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    used: set[int] = set()

    def spied(*args: Any, **options: Any) -> Dictionary:
        used.update(library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas")
        return learn(*args, **options)

    learn = dictionary.learn
    monkeypatch.setattr(dictionary, "learn", spied)
    write_mocap(tmp_path, "one_1")
    args = command(str(tmp_path), "--out", str(tmp_path / "d.npz"), "--include", "one_*", "--atoms", "16", "--quiet")
    with threadpool_limits(2):
        assert args.run(args) == 0
    assert used == {1}
    assert capsys.readouterr().out == ""
