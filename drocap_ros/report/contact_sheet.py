"""Some recorded images with their keypoints, side by side in one image."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.perception.overlay import draw
from drocap_ros.recording.image_messages import read_images
from drocap_ros.recording.pose_messages import read_observations
from drocap_ros.recording.session import COMPRESSED_IMAGE, IMAGE, POSE2D, Session

_COLUMNS, _ROWS = 4, 3
_WIDTH_PX = 640


def save_contact_sheet(path: Path, session: Session) -> None:
    """Twelve images spread over the time in which a subject was seen, read left to right.

    Raises
    ------
    InputError
        When the session holds no image with a subject, or the file cannot be written.
    """
    import cv2

    seen = {o.stamp_ns: o for o in read_observations(session, session.choose_topic(POSE2D).name) if o.has_subject}
    session.choose_topic(IMAGE, COMPRESSED_IMAGE)
    stamps = sorted(seen)
    count = min(_COLUMNS * _ROWS, len(stamps))
    wanted = {stamps[i] for i in np.linspace(0, len(stamps) - 1, count).round().astype(int)} if stamps else set()
    tiles = []
    for frame in read_images(session):
        # The recorder may lack an image: the next one with a subject takes its place.
        due = [stamp for stamp in wanted if stamp <= frame.stamp_ns]
        if due and frame.stamp_ns in seen:
            wanted.difference_update(due)
            height = round(frame.image.shape[0] * _WIDTH_PX / frame.image.shape[1])
            drawn = draw(frame.image, seen[frame.stamp_ns])
            tiles.append(cv2.resize(drawn, (_WIDTH_PX, height), interpolation=cv2.INTER_AREA))
        if not wanted:
            break
    if not tiles:
        raise InputError(f"{session.path}: expected images with a subject, found none; check pose2d")
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % _COLUMNS)
    rows = [np.hstack(tiles[i : i + _COLUMNS]) for i in range(0, len(tiles), _COLUMNS)]
    if not cv2.imwrite(str(path), np.vstack(rows), [cv2.IMWRITE_JPEG_QUALITY, 88]):
        raise InputError(f"{path}: expected a writable file; check the folder and the disk space")
