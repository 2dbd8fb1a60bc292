"""The report's checks, on motions with known faults."""

import dataclasses

import numpy as np
import pytest

from drocap_ros.motion import upright_joints
from drocap_ros.report.checks import MotionCheck, Severity, run_checks
from drocap_ros.report.statistics import motion_statistics, smooth
from drocap_ros.simulation.simulated_person import simulate_person
from drocap_ros.skeleton import BODY_15
from lab.simulation.capture import simulate_capture
from lab.simulation.orbit import look_at


def results(motion):
    return run_checks(motion, motion_statistics(motion))


def checks(motion, level=None):
    return [r.check for r in results(motion) if level in (None, r.severity)]


def result_of(motion, check):
    (result,) = (r for r in results(motion) if r.check is check)
    return result


def test_a_good_motion_has_no_warning(person):
    assert checks(person, Severity.WARNING) == []
    assert MotionCheck.ASSUMED_SCALE in checks(person)


@pytest.mark.parametrize(
    ("camera", "words"),
    [
        ({"kind": "few_points", "words": "too few fixed points: no texture, blur or water"}, "too few fixed points"),
        ({"kind": "moves", "words": "a camera that moves", "up_std_deg": 1.0}, None),  # of another version
    ],
)
def test_a_camera_of_the_picture_is_told_without_any_calibration(person, camera, words):
    told = dataclasses.replace(person, meta={"camera": camera})
    if words is None:
        assert MotionCheck.CALIBRATION not in checks(told)
    else:
        assert words in result_of(told, MotionCheck.CALIBRATION).text


def test_the_view_span_is_that_of_the_orbit(person):
    m = motion_statistics(person)
    look = -person.camera_rotation[:, 2]
    orbit = np.degrees(np.abs(np.diff(np.unwrap(np.arctan2(look[:, 1], look[:, 0]))))).sum()
    turned = np.degrees(np.ptp(m.heading_rad))
    # The body turns as well: the view differs from the orbit by at most that.
    assert m.view_span_deg == pytest.approx(orbit, abs=turned + 8.0)
    assert m.rate_hz == pytest.approx(15.0)


def test_view_and_heading_of_a_body_that_faces_north(person):
    """A standing body that faces north, the camera east of it: seen from its right."""
    body = np.zeros((5, 15, 3))
    at = {"neck": (0, 0, 0.6), "lhip": (-0.1, 0, 0), "rhip": (0.1, 0, 0), "lshoulder": (-0.2, 0, 0.5),
          "rshoulder": (0.2, 0, 0.5), "head": (0, 0, 0.7)}  # fmt: skip
    for name, place in at.items():
        body[:, BODY_15.index(name)] = place
    towards_west = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
    parts = {n: getattr(person, n)[:5] for n in ("stamp_ns", "confidence", "keypoints", "reprojection_px")}
    motion = dataclasses.replace(person, joints3d=body, camera_rotation=np.tile(towards_west, (5, 1, 1)), **parts)
    m = motion_statistics(motion)
    np.testing.assert_allclose(np.degrees(m.heading_rad), 90.0, atol=1e-6)
    np.testing.assert_allclose(m.view_deg, -90.0, atol=1e-6)


def test_a_wrong_pitch_of_the_mount_is_a_body_that_leans_with_the_camera(person):
    """The camera's pitch is reported 20 degrees too high, as by a wrong sign: body and camera turn by as much."""
    capture = simulate_capture(16.0, 15.0, seed=3)
    shape = capture.joints3d_world.shape[:2]
    motion = dataclasses.replace(
        person, joints3d=capture.joints3d_world, stamp_ns=capture.tracks.stamp_ns, confidence=np.ones(shape),
        camera_rotation=capture.camera_rotation, keypoints=capture.tracks.keypoints, reprojection_px=np.ones(shape),
    )  # fmt: skip
    assert abs(motion_statistics(motion).lean_deg) < 4.0
    assert MotionCheck.LEANING not in checks(motion)
    half = np.deg2rad(20.0)
    pitched = np.array([[1.0, 0, 0], [0, np.cos(half), np.sin(half)], [0, -np.sin(half), np.cos(half)]])
    reported = pitched.T @ motion.camera_rotation
    seen = (motion.joints3d - motion.joints3d[:, :1]) @ np.swapaxes(motion.camera_rotation, 1, 2)
    wrong = dataclasses.replace(motion, joints3d=seen @ reported, camera_rotation=reported)
    assert abs(motion_statistics(wrong).lean_deg) == pytest.approx(20.0, abs=4.0)
    result = result_of(wrong, MotionCheck.LEANING)
    assert result.severity is Severity.WARNING
    assert "negative = down" in result.text
    still = dataclasses.replace(wrong, camera_rotation=np.tile(reported[:1], (len(reported), 1, 1)))
    assert np.isnan(motion_statistics(still).lean_deg)


def test_a_still_camera_and_a_still_body_are_low_camera_motion(person):
    still = dataclasses.replace(
        person,
        joints3d=np.repeat(person.joints3d[:1], len(person.joints3d), axis=0),
        camera_rotation=np.repeat(person.camera_rotation[:1], len(person.joints3d), axis=0),
    )
    assert MotionCheck.LOW_CAMERA_MOTION in checks(still, Severity.WARNING)
    assert motion_statistics(still).view_span_deg == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize(("elevation", "level"), [(30.0, None), (52.0, Severity.NOTE), (69.0, Severity.WARNING)])
@pytest.mark.parametrize("frame", ["world", "camera"])
def test_steep_view_is_named_with_its_elevation(person, frame, elevation, level):
    """A camera that orbits a standing body at an elevation."""
    frames = len(person.joints3d)
    bearing = np.linspace(0, np.pi, frames)
    tilt = np.deg2rad(elevation)
    away = np.stack([np.cos(tilt) * np.cos(bearing), np.cos(tilt) * np.sin(bearing), np.full(frames, np.sin(tilt))], 1)
    rotation = look_at(away, np.zeros((frames, 3)))
    body = np.repeat(simulate_person(np.array([1.0]), "stand"), frames, axis=0)
    body = body - body[:, :1]
    if frame == "camera":
        body, rotation = np.einsum("fij,fpj->fpi", rotation, body), np.tile(np.eye(3), (frames, 1, 1))
    motion = dataclasses.replace(
        person, joints3d=body, camera_rotation=rotation, frame=frame, camera_position=None, covariance=None
    )
    assert motion_statistics(motion).elevation_deg == pytest.approx(elevation, abs=6.0)
    found = [r for r in results(motion) if r.check is MotionCheck.STEEP_VIEW]
    assert [r.severity for r in found] == ([] if level is None else [level])
    assert level is None or f"{motion_statistics(motion).elevation_deg:.0f}° above" in found[0].text


@pytest.mark.parametrize(
    ("rate_hz", "level"), [(24, None), (15, Severity.NOTE), (10, Severity.WARNING), (5, Severity.WARNING)]
)
def test_low_image_rate_is_named(person, rate_hz, level):
    stamps = np.arange(len(person.stamp_ns), dtype=np.int64) * round(1e9 / rate_hz)
    found = [r for r in results(dataclasses.replace(person, stamp_ns=stamps)) if r.check is MotionCheck.LOW_RATE]
    assert [r.severity for r in found] == ([] if level is None else [level])
    assert level is None or f"{rate_hz:.1f} images per second" in found[0].text


@pytest.mark.parametrize("gap_s", [0.5, 4.0, 6.0, 60.0, 3600.0])
@pytest.mark.parametrize("at", [1, 10, -1])
def test_gap_in_time_makes_a_motion_doubtful(person, gap_s, at):
    stamps = np.arange(len(person.stamp_ns), dtype=np.int64) * 40_000_000
    stamps[at:] += round(gap_s * 1e9)
    found = results(dataclasses.replace(person, stamp_ns=stamps))
    named = [r for r in found if r.check is MotionCheck.GAP]
    assert bool(named) == (gap_s > 5.0)
    assert not named or f"No image for {gap_s:.0f} s" in named[0].text


def test_interpolated_poses_before_the_person_comes_count_in_no_statistic(reported_in_camera):
    """Two thirds of the frames repeat the first pose, with its knees bent backward and a longer shank."""
    person, first = reported_in_camera, 2 * len(reported_in_camera.joints3d)
    repeated = person.joints3d[:1].copy()
    repeated[:, [BODY_15.index("lankle"), BODY_15.index("rankle")]] += (0.0, -0.2, 0.5)

    def late(before, after):
        return np.concatenate([np.repeat(before, first, axis=0), after])

    motion = dataclasses.replace(
        person,
        joints3d=late(repeated, person.joints3d),
        stamp_ns=np.arange(first // 2 * 3) * (person.stamp_ns[1] - person.stamp_ns[0]),
        camera_rotation=late(person.camera_rotation[:1], person.camera_rotation),
        confidence=late(0.0 * person.confidence[:1], person.confidence),
        keypoints=late(np.full((1, 15, 2), np.nan), person.keypoints),
        reprojection_px=late(np.full((1, 15), np.nan), person.reprojection_px),
    )
    whole, s = motion_statistics(person), motion_statistics(motion)
    assert (s.knees_forward, s.bent_knees) == (whole.knees_forward, whole.bent_knees)
    np.testing.assert_allclose(s.bone_spread, whole.bone_spread)
    assert s.view_speed_dps == pytest.approx(whole.view_speed_dps, rel=0.3)  # smoothed over 0.5 s
    assert s.elevation_deg == pytest.approx(whole.elevation_deg, abs=1e-6)
    assert np.isnan(s.view_deg[:first]).all()
    assert np.isfinite(s.view_deg[first:]).all()


def test_a_body_that_turns_is_enough_camera_motion(reported_in_camera):
    """Only the motion of the camera relative to the body counts: the camera's frame shows the same."""
    assert MotionCheck.LOW_CAMERA_MOTION not in checks(reported_in_camera)
    assert MotionCheck.NO_VERTICAL in checks(reported_in_camera, Severity.NOTE)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_body_mirrored_in_depth_is_a_warning(person, seed):
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
    assert MotionCheck.MIRRORED not in checks(motion)
    mirrored = dataclasses.replace(motion, joints3d=joints * np.array([1.0, 1.0, -1.0]))
    assert MotionCheck.MIRRORED in checks(mirrored, Severity.WARNING)


def test_missing_joints_are_named_with_their_share(person):
    keypoints = person.keypoints.copy()
    keypoints[::2, BODY_15.index("lwrist")] = np.nan
    text = result_of(dataclasses.replace(person, keypoints=keypoints), MotionCheck.MISSING_JOINTS).text
    share = np.isnan(keypoints[:, BODY_15.index("lwrist")]).any(axis=1).mean()
    assert f"lwrist {share:.0%}" in text


def test_a_few_outliers_are_no_high_error(person):
    size = motion_statistics(person).body_px
    few = np.zeros_like(person.reprojection_px)
    few[::20] = 0.5 * size
    assert checks(dataclasses.replace(person, reprojection_px=few), Severity.WARNING) == []
    assert MotionCheck.OUTLIERS in checks(dataclasses.replace(person, reprojection_px=few))
    many = few.copy()
    many[::5] = 0.5 * size
    assert MotionCheck.OUTLIERS in checks(dataclasses.replace(person, reprojection_px=many), Severity.WARNING)
    all_over = np.full_like(few, 0.03 * size)
    assert MotionCheck.HIGH_ERROR in checks(dataclasses.replace(person, reprojection_px=all_over), Severity.WARNING)


def test_short_sequences_are_warned_of_and_stretching_bones_noted(person, one_frame):
    assert MotionCheck.SHORT in checks(one_frame, Severity.WARNING)
    stretched = person.joints3d.copy()
    knee, ankle = BODY_15.index("rknee"), BODY_15.index("rankle")
    stretched[::2, ankle] = stretched[::2, knee] + 1.5 * (stretched[::2, ankle] - stretched[::2, knee])
    result = result_of(dataclasses.replace(person, joints3d=stretched), MotionCheck.BONE_LENGTHS)
    assert result.values["bone"] == "rknee - rankle"
    assert result.values["worst"] == pytest.approx(0.2, abs=0.005)  # half of the frames 1, half 1.5: 0.25 / 1.25
    assert "rknee - rankle varies by 20%" in result.text


def test_frames_without_a_pose_are_counted(person):
    joints = person.joints3d.copy()
    joints[5:9] = np.nan
    result = result_of(dataclasses.replace(person, joints3d=joints), MotionCheck.MISSING_POSES)
    assert result.values == {"missing": 4, "frames": 60}
    assert result.text.startswith("4 of 60 frames")


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


def test_a_standing_person_who_is_carried_along_has_sliding_feet(person):
    seconds = (person.stamp_ns - person.stamp_ns[0]) * 1e-9
    for m_s in (0.0, 0.8):
        joints = person.joints3d[:1] + seconds[:, None, None] * np.array([m_s, 0.0, 0.0])
        assert (MotionCheck.SLIDING_FEET in checks(dataclasses.replace(person, joints3d=joints))) == (m_s > 0)
