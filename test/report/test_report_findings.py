"""The report's remarks, on motions of which we know what is wrong with them."""

import dataclasses

import numpy as np
import pytest

from drocap_ros.motion import upright_joints
from drocap_ros.report.checks import findings
from drocap_ros.report.statistics import measure, smooth
from drocap_ros.simulation.capture import simulate_capture
from drocap_ros.skeleton import BODY_15


def titles(motion, level=None):
    found = findings(motion, measure(motion))
    return [f.title for f in found if level in (None, f.level)]


def test_a_good_motion_has_no_warning(person):
    assert titles(person, "warning") == []
    assert "Scale assumed" in titles(person)


def test_the_speed_of_the_orbit_is_measured(person):
    m = measure(person)
    look = -person.camera_rotation[:, 2]
    orbit = np.degrees(np.abs(np.diff(np.unwrap(np.arctan2(look[:, 1], look[:, 0]))))).sum()
    turned = np.degrees(np.ptp(m.heading_rad))
    # The body turns as well: what it sees of the camera differs from the orbit by at most that.
    assert m.view_span_deg == pytest.approx(orbit, abs=turned + 8.0)
    assert m.rate_hz == pytest.approx(15.0)


def test_view_and_heading_are_those_of_a_body_that_looks_north(person):
    """A standing body that faces north, the camera east of it: seen from its right."""
    body = np.zeros((5, 15, 3))
    at = {"neck": (0, 0, 0.6), "lhip": (-0.1, 0, 0), "rhip": (0.1, 0, 0), "lshoulder": (-0.2, 0, 0.5),
          "rshoulder": (0.2, 0, 0.5), "head": (0, 0, 0.7)}  # fmt: skip
    for name, place in at.items():
        body[:, BODY_15.index(name)] = place
    towards_west = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
    parts = {n: getattr(person, n)[:5] for n in ("stamp_ns", "confidence", "keypoints", "reprojection_px")}
    motion = dataclasses.replace(person, joints3d=body, camera_rotation=np.tile(towards_west, (5, 1, 1)), **parts)
    m = measure(motion)
    np.testing.assert_allclose(np.degrees(m.heading_rad), 90.0, atol=1e-6)
    np.testing.assert_allclose(m.view_deg, -90.0, atol=1e-6)


def test_a_still_camera_before_a_still_body_is_reported(person):
    still = dataclasses.replace(
        person,
        joints3d=np.repeat(person.joints3d[:1], len(person.joints3d), axis=0),
        camera_rotation=np.repeat(person.camera_rotation[:1], len(person.joints3d), axis=0),
    )
    assert "Low camera motion" in titles(still, "warning")
    assert measure(still).view_span_deg == pytest.approx(0.0, abs=1e-6)


def test_a_body_that_turns_before_a_still_camera_is_motion_enough(reported_in_camera):
    """What counts is the motion of the camera relative to the body: the camera's frame shows the same."""
    assert "Low camera motion" not in titles(reported_in_camera)
    assert "Vertical and path not known" in titles(reported_in_camera, "note")


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_body_mirrored_in_depth_is_noticed(person, seed):
    capture = simulate_capture(8.0, 15.0, seed=seed)
    joints = np.einsum("fij,fpj->fpi", capture.camera_rotation, capture.joints3d_world - capture.joints3d_world[:, :1])
    frames = len(joints)
    motion = dataclasses.replace(
        person,
        joints3d=joints,
        frame="camera",
        stamp_ns=capture.tracks.stamp_ns,
        camera_rotation=np.tile(np.eye(3), (frames, 1, 1)),
        confidence=np.ones((frames, 15)),
        keypoints=capture.tracks.keypoints,
        reprojection_px=np.zeros((frames, 15)),
    )
    assert "Possibly mirrored in depth" not in titles(motion)
    mirrored = dataclasses.replace(motion, joints3d=joints * np.array([1.0, 1.0, -1.0]))
    assert "Possibly mirrored in depth" in titles(mirrored, "warning")


def test_missing_joints_are_named_with_their_share(person):
    keypoints = person.keypoints.copy()
    keypoints[::2, BODY_15.index("lwrist")] = np.nan
    found = findings(motion := dataclasses.replace(person, keypoints=keypoints), measure(motion))
    (text,) = (f.text for f in found if f.title == "Many missing joints")
    share = np.isnan(keypoints[:, BODY_15.index("lwrist")]).any(axis=1).mean()
    assert f"lwrist {share:.0%}" in text


def test_high_error_is_told_from_a_few_outliers(person):
    size = measure(person).body_px
    few = np.zeros_like(person.reprojection_px)
    few[::20] = 0.5 * size
    assert titles(dataclasses.replace(person, reprojection_px=few), "warning") == []
    assert "Outlying keypoints" in titles(dataclasses.replace(person, reprojection_px=few))
    many = few.copy()
    many[::5] = 0.5 * size
    assert "Outlying keypoints" in titles(dataclasses.replace(person, reprojection_px=many), "warning")
    all_over = np.full_like(few, 0.03 * size)
    assert "High reprojection error" in titles(dataclasses.replace(person, reprojection_px=all_over), "warning")


def test_short_sequences_and_stretching_bones_are_reported(person, one_frame):
    assert "Short sequence" in titles(one_frame, "warning")
    stretched = person.joints3d.copy()
    knee, ankle = BODY_15.index("rknee"), BODY_15.index("rankle")
    stretched[::2, ankle] = stretched[::2, knee] + 1.5 * (stretched[::2, ankle] - stretched[::2, knee])
    found = findings(motion := dataclasses.replace(person, joints3d=stretched), measure(motion))
    (text,) = (f.text for f in found if f.title == "Bones change their length")
    assert "rknee - rankle" in text
    assert "20%" in text  # half of the frames 1, half 1.5: 0.25 / 1.25


def test_frames_without_a_pose_are_counted(person):
    joints = person.joints3d.copy()
    joints[5:9] = np.nan
    found = findings(motion := dataclasses.replace(person, joints3d=joints), measure(motion))
    assert any(f.text.startswith("4 of 60 frames") for f in found)


def test_upright_joints_of_the_cameras_frame_stand(reported_in_camera):
    upright = upright_joints(reported_in_camera)
    assert (upright[:, BODY_15.index("head"), 2] > upright[:, BODY_15.index("lankle"), 2]).all()
    back = upright[..., [0, 2, 1]] * np.array([1.0, -1.0, 1.0])
    np.testing.assert_array_equal(back, reported_in_camera.joints3d)


def test_smoothing_keeps_constants_and_means():
    times = np.arange(40) / 20.0
    np.testing.assert_allclose(smooth(np.full((40, 2), 3.0), times), 3.0)
    ramp = smooth(times, times)
    np.testing.assert_allclose(ramp[5:-5], times[5:-5])
