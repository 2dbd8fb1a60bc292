"""The live method on a recorded session, without ROS."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from bent_lenses import BENT, bent
from recorded import NAMES, record

from drocap_ros.config import DrocapConfig
from drocap_ros.errors import InputError
from drocap_ros.live_replay import reconstruct_live
from drocap_ros.reconstruction.live.core import LiveCore
from drocap_ros.recording.open_session import open_session
from drocap_ros.recording.session import BACKGROUND_TRACKS
from drocap_ros.recording.session_tracks import read_pose2d

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


@pytest.mark.parametrize("times", [1.0, 5.0])
@pytest.mark.parametrize("model", BENT)
def test_live_and_offline_take_the_distortion_of_a_lens_off_alike(tmp_path, messages, capture, model, times):
    true, matrix = capture.tracks, capture.tracks.camera_matrix
    true = dataclasses.replace(true, keypoints=true.keypoints + np.array([350.0, 100.0]))  # far from the middle
    shown = dataclasses.replace(true, keypoints=bent(true.keypoints, matrix, model, times))
    rng, entries = np.random.default_rng(0), []
    ideal = rng.uniform(100, min(true.image_size) - 100, (40, 2))
    point = bent(ideal, matrix, model, times).astype(np.float32).ravel()
    for i, stamp in enumerate(true.stamp_ns[:45].tolist()):
        header = messages.header(stamp)
        info = messages(NAMES["info"], header=header, width=true.image_size[0], height=true.image_size[1],
                        k=matrix.ravel(), distortion_model=model, d=times * np.array(BENT[model]))  # fmt: skip
        points = messages(BACKGROUND_TRACKS, header=header, track=np.arange(40), point=point)
        entries += [("/drocap/camera_info", info), ("/drocap/background", points)]
        entries += [("/drocap/pose2d", messages.pose2d(shown, i, stamp))]
    stamps = np.repeat(true.stamp_ns[:45], 3).tolist()
    record(tmp_path / "s", [(*e, at, messages.cdr(e[1])) for e, at in zip(entries, stamps, strict=True)])
    windows = []
    with open_session(tmp_path / "s") as session, pytest.MonkeyPatch.context() as patch:
        own = LiveCore.window
        patch.setattr(LiveCore, "window", lambda core: windows.append(own(core)) or windows[-1])
        _, live, _ = reconstruct_live(session, DrocapConfig())
        offline = read_pose2d(session)
    used = np.isin(offline.stamp_ns, live.stamp_ns)  # those of the camera's path
    assert used.sum() == len(live) > 20
    assert np.array_equal(live.keypoints, offline.keypoints[used], equal_nan=True)
    assert np.nanmax(np.abs(offline.keypoints - shown.keypoints[:45])) > 2.0
    assert windows
    same = np.isin(offline.background.frame, np.searchsorted(offline.stamp_ns, windows[-1].stamp_ns))
    assert np.array_equal(windows[-1].background.point, offline.background.point[same])
    if times == 1.0:
        assert np.nanmax(np.abs(offline.keypoints - true.keypoints[:45])) < 0.2
        assert np.abs(windows[-1].background.point - np.tile(ideal, (len(windows[-1].stamp_ns), 1))).max() < 0.2
