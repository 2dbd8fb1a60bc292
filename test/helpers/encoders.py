"""FFmpeg for tests: the real program where there is one, else a stand-in that takes its words and encodes MPEG-4."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from drocap_ros.report.video_file import find_ffmpeg

_STAND_IN = """#!{python}
import sys
import cv2
import numpy as np
words = sys.argv
width, height = map(int, words[words.index("-s") + 1].split("x"))
rate = float(words[words.index("-r") + 1])
video = cv2.VideoWriter(words[-1], cv2.VideoWriter.fourcc(*"mp4v"), rate, (width, height))
while len(image := sys.stdin.buffer.read(3 * width * height)) == 3 * width * height:
    video.write(np.frombuffer(image, np.uint8).reshape(height, width, 3))
video.release()
sys.exit(len(image) > 0)
"""


def with_ffmpeg(folder: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Put an FFmpeg where the product finds it; returns the four letters of the codec that its files have."""
    if find_ffmpeg():
        return "h264"
    folder.mkdir()
    program = folder / "ffmpeg"
    program.write_text(_STAND_IN.format(python=sys.executable))
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{folder}:/usr/bin:/bin")
    return "FMP4"


def without_ffmpeg(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hide every FFmpeg."""
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    monkeypatch.setenv("PATH", "")
