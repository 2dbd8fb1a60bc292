"""python -m lab learn-dictionary."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits
from walking import write_mocap

from drocap_ros.errors import InputError
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


@pytest.mark.parametrize(
    ("words", "match"),
    [
        (("nowhere", "--out", "d.npz"), "expected a folder of MoCap"),
        ((".", "--out", "d.npz", "--include", "none_*"), "found none"),
        ((".", "--out", "d.npz"), "expected finite millimetres"),
        ((".", "--out", "nowhere/d.npz"), "--out: expected a .npz"),
        ((".", "--out", "d.npz", "--atoms", "1"), "--atoms: expected 8 to 4096"),
        ((".", "--out", "d.npz", "--sparsity", "nan"), "--sparsity: expected more than 0"),
        ((".", "--out", "d.npz", "--include", "one_*", "--atoms", "4000"), "at least as many as atoms"),
    ],
)
def test_unusable_input_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], match: str
) -> None:
    monkeypatch.chdir(tmp_path)
    write_mocap(tmp_path, "one_1", frames=10)
    write_mocap(tmp_path, "two_1", X=np.full((5, 15, 3), np.nan, np.float32))
    args = command(*words)
    with pytest.raises(InputError, match=match):
        args.run(args)
    assert not list(tmp_path.glob("d.npz"))


def test_a_failure_keeps_the_old_dictionary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fill_disk(path: Path, _: object) -> None:
        path.write_bytes(b"half")
        raise OSError("no space left on device")

    write_mocap(tmp_path, "one_1")
    out = tmp_path / "d.npz"
    out.write_bytes(b"old")
    monkeypatch.setattr("lab.training.dictionary.save_dictionary", fill_disk)
    args = command(str(tmp_path), "--out", str(out), "--include", "one_*", "--atoms", "16", "--quiet")
    with pytest.raises(OSError, match="no space"):
        args.run(args)
    assert out.read_bytes() == b"old"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["d.npz", "one_1.npz"]


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
