"""drocap learn-dictionary."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pytest
from walking import write_mocap

from drocap_ros.cli.models import learn_dictionary
from drocap_ros.errors import InputError
from drocap_ros.reconstruction.paper.dictionary import (
    load_dictionary,
)


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
