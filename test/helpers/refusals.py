"""A command that refuses its input: one line, status 2, nothing written."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from drocap_ros.cli import main


def refused(arguments: list[Any], folder: Path, capsys: pytest.CaptureFixture[str], words: str) -> None:
    before = sorted(folder.iterdir())
    assert main([str(a) for a in arguments]) == 2
    error = capsys.readouterr().err
    assert len(error.strip().splitlines()) == 1
    assert words in error
    assert sorted(folder.iterdir()) == before
