"""Subtitles that a drone writes beside its video, without an option that names them."""

from __future__ import annotations

import numpy as np
import pytest
from rendered_person import rendered_images
from telemetry_logs import dji_subtitle, srt_text

from drocap_ros.cli import main
from drocap_ros.motion import load_motion

cv2 = pytest.importorskip("cv2")


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    path = tmp_path_factory.mktemp("clip") / "DJI_0001.MP4"
    writer = cv2.VideoWriter(str(path.with_suffix(".mp4")), cv2.VideoWriter.fourcc(*"mp4v"), 30.0, (1280, 720))
    for image in rendered_images(6):
        writer.write(image)
    writer.release()
    path.with_suffix(".mp4").rename(path)
    return path


def subtitles(text=None):
    t = np.arange(6) / 30
    lines = [text or dji_subtitle(i, (47.0, 8.0, 503.0), (0.0, -0.3, 0.01 * i)) for i in range(len(t))]
    return srt_text(t, lines)


@pytest.mark.parametrize("suffix", [".SRT", ".srt"])
def test_they_are_found_and_said_in_a_line(tmp_path, video, suffix, capsys, caplog):
    beside, out = video.with_suffix(suffix), tmp_path / "out"
    words = ["reconstruct", str(video), "--models", "simulation", "--no-report", "--out", str(out)]
    try:
        beside.write_text(subtitles())
        assert main(words) == 0
        assert f"{beside}: DJI subtitles, found beside the video (--telemetry none leaves it out)" in caplog.text
        assert load_motion(out).meta["telemetry"]["file"] == beside.name
        assert main(["info", str(video)]) == 0
        assert f"beside the video: {beside.name}" in capsys.readouterr().out
        assert main([*words, "--telemetry", "none"]) == 0
        assert "telemetry" not in load_motion(out).meta
    finally:
        beside.unlink()


def test_subtitles_of_spoken_words_leave_the_video_as_it_is(tmp_path, video, caplog):
    beside = video.with_suffix(".srt")
    words = ["reconstruct", str(video), "--models", "simulation", "--no-report", "--out", str(tmp_path)]
    try:
        beside.write_text(subtitles("- Where are you going?"))
        assert main(words) == 0
    finally:
        beside.unlink()
    assert caplog.text.count("the video is used without it") == 1
    assert "telemetry" not in load_motion(tmp_path).meta
