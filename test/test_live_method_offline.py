"""The live method on a recorded session, without ROS."""

from __future__ import annotations

import numpy as np
import pytest
from recorded import record

from drocap_ros.config import DrocapConfig
from drocap_ros.errors import InputError
from drocap_ros.live_replay import reconstruct_live
from drocap_ros.recording.open_session import open_session

SEVENTEEN = {"keypoints": 34, "covariance": 51, "confidence": 17}


def write(folder, messages, tracks, changed):
    """Record 24 poses of tracks; those after the tenth have the changed fields."""
    entries = []
    for i, stamp in enumerate(tracks.stamp_ns[:24].tolist()):
        message = messages.pose2d(tracks, i, stamp)
        for name, value in changed.items() if i >= 10 else ():
            setattr(message, name, value)
        entries.append(("/drocap/pose2d", message, stamp, messages.cdr(message)))
    record(folder, entries)


def test_motion_is_of_one_person(tmp_path, messages, capture):
    write(tmp_path / "s", messages, capture.tracks, {"track_id": 2})
    with open_session(tmp_path / "s") as session:
        motion, tracks, _ = reconstruct_live(session, DrocapConfig())
        assert any("poses of 2 persons" in warning for warning in session.warnings)
    assert np.array_equal(tracks.stamp_ns, capture.tracks.stamp_ns[10:24])
    assert len(motion.joints3d) == len(tracks)


@pytest.mark.parametrize(
    "changed",
    [
        {"image_width": 333},
        {"skeleton": "body17", **{name: np.full(n, 0.5, np.float32) for name, n in SEVENTEEN.items()}},
    ],
    ids=["size", "joints"],
)
def test_another_image_size_or_joint_set_is_an_input_error(tmp_path, messages, capture, changed):
    write(tmp_path / "s", messages, capture.tracks, changed)
    with open_session(tmp_path / "s") as session, pytest.raises(InputError, match="throughout"):
        reconstruct_live(session, DrocapConfig())
