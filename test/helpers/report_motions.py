"""Motions made from others."""

from __future__ import annotations

import dataclasses

from drocap_ros.motion import Motion


def first_frames(motion: Motion, count: int) -> Motion:
    """The first frames of a motion."""
    names = ("joints3d", "stamp_ns", "camera_rotation", "confidence", "keypoints", "reprojection_px")
    return dataclasses.replace(motion, **{name: getattr(motion, name)[:count] for name in names})
