"""Recordings for `batch.py`: simulated tracks, videos of a rendered person, and broken files."""

from __future__ import annotations

import dataclasses
import random
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from figures import ROOT

sys.path[:0] = [str(ROOT), str(ROOT / "test" / "helpers")]


def make_season(folder: Path, count: int, seconds: float) -> tuple[int, int]:
    """Tracks, half of them without telemetry; each tenth a video; each twentieth broken.  (good, broken)"""
    from drocap_ros.tracks import save_tracks
    from lab.simulation.capture import simulate_capture

    folder.mkdir()
    broken = count // 20
    videos = (count - broken) // 10
    for i in range(count - broken - videos):
        tracks = simulate_capture(seconds, 24.0, seed=i).tracks
        if i % 2:
            tracks = dataclasses.replace(tracks, camera_rotation=None, camera_position=None, camera_matrix=None)
        save_tracks(folder / f"walk_{i:03}.npz", tracks)
    make_videos(folder, videos)
    make_broken(folder, broken)
    return count - broken, broken


def make_videos(folder: Path, count: int) -> None:
    """Videos of 1.5 s of a rendered person, cut at different moments from one."""
    from rendered_person import rendered_images

    images = [cv2.resize(image, (640, 360)) for image in rendered_images(36 + count, 24.0)]
    for i in range(count):
        writer = cv2.VideoWriter(str(folder / f"clip_{i:03}.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 24.0, (640, 360))
        for image in images[i : i + 36]:
            writer.write(image)
        writer.release()


def make_broken(folder: Path, count: int) -> None:
    """Recordings that cannot be used, ten kinds in turn."""
    tracks = next(folder.glob("walk_*.npz")).read_bytes()
    clip = next(folder.glob("clip_*.mp4"), None)
    with np.load(folder / "walk_000.npz") as archive:
        arrays = dict(archive)
    kinds: list[tuple[str, Any]] = [
        ("empty.npz", b""),
        ("noise.npz", random.Random(0).randbytes(5000)),
        ("cut.npz", tracks[: len(tracks) // 2]),
        ("no_stamps.npz", {"stamp_ns": None}),
        ("infinite.npz", {"keypoints": np.full_like(arrays["keypoints"], np.inf)}),
        ("nobody.npz", {"keypoints": np.full_like(arrays["keypoints"], np.nan)}),
        ("backwards.npz", {"stamp_ns": arrays["stamp_ns"][::-1]}),
        ("text.mp4", b"no video"),
        ("cut.mp4", clip.read_bytes()[:4000] if clip else b""),
        ("black.mp4", None),
    ]
    for i in range(count):
        name, content = kinds[i % len(kinds)]
        path = folder / f"broken_{i:03}_{name}"
        if isinstance(content, bytes):
            path.write_bytes(content)
        elif content is not None:
            np.savez(path, **{k: v for k, v in {**arrays, **content}.items() if v is not None})
        else:
            writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 24.0, (640, 360))
            for _ in range(24):
                writer.write(np.zeros((360, 640, 3), np.uint8))
            writer.release()
