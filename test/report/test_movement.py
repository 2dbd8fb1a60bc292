"""Joint angles and speeds of the report, against known motions."""

import dataclasses

import numpy as np
import pytest

from drocap_ros.geometry.rotations import exp_so3
from drocap_ros.report.movement import flexion, flexion_words, movement
from drocap_ros.report.statistics import motion_statistics
from drocap_ros.skeleton import BODY_15


def curves(motion, frames=None):
    frames = np.arange(len(motion.stamp_ns)) if frames is None else frames
    return {curve.name: curve for curve in movement(motion, motion_statistics(motion), frames)}


def test_a_moving_person_has_its_speeds_in_every_joint(person):
    still = np.tile(person.joints3d[:1], (60, 1, 1))
    seconds = (person.stamp_ns - person.stamp_ns[0]) * 1e-9
    moving = still + seconds[:, None, None] * np.array([0.6, -0.8, 0.0])
    found = curves(dataclasses.replace(person, joints3d=moving))
    assert [name for name in found if name.endswith("speed")] == ["Pelvis speed", "Wrist speed", "Ankle speed"]
    for name in ("Pelvis speed", "Wrist speed", "Ankle speed"):
        np.testing.assert_allclose(found[name].values, 1.0, atol=1e-9)
        assert found[name].unit == "m/s"
        assert found[name].words == "Through the world, mean over 0.1 s."  # the frames beside each, at 15 Hz
    some = curves(dataclasses.replace(person, joints3d=moving), np.array([0, 59]))
    assert some["Wrist speed"].values.shape == (2, 2)


def test_without_a_path_the_turning_of_the_camera_moves_no_hand(reported_in_camera):
    """The body stands as in its first frame while the camera goes round it."""
    turns = exp_so3(np.linspace(0.0, 3.0, 60)[:, None] * np.array([0.0, 1.0, 0.0]))
    joints = np.einsum("fij,pj->fpi", turns, reported_in_camera.joints3d[0])
    found = curves(dataclasses.replace(reported_in_camera, joints3d=joints))
    assert "Pelvis speed" not in found
    middle = slice(8, -8)  # the heading is a mean over half a second, shorter at the ends
    assert np.abs(found["Wrist speed"].values[middle]).max() < 0.02
    assert "whose path is not known" in found["Wrist speed"].words


def test_the_hip_bends_forwards_and_less_than_nothing_backwards(person):
    joints = person.joints3d.copy()
    names = BODY_15.joints
    axis = joints[:, names.index("lhip")] - joints[:, names.index("rhip")]
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    at = curves(person)["Hip bend"].values[:, 0]
    for turn in (-0.3, 0.5):
        moved = joints.copy()
        hip = joints[:, names.index("rhip")]
        for name in ("rknee", "rankle"):
            place = joints[:, names.index(name)] - hip
            moved[:, names.index(name)] = hip + np.einsum("fij,fj->fi", exp_so3(-turn * axis), place)
        found = curves(dataclasses.replace(person, joints3d=moved))["Hip bend"].values[:, 0]
        np.testing.assert_allclose(found - at, np.degrees(turn), atol=1e-6)


@pytest.mark.parametrize("about", ["pelvis", "origin"])
def test_deviations_are_those_of_disturbed_joints_and_what_all_share_turns_no_limb(person, about):
    random = np.random.default_rng(4)
    std = random.uniform(0.005, 0.02, person.joints3d.shape)
    std[:, BODY_15.index("pelvis")] = 0.0
    covariance = np.zeros((*std.shape[:2], 6))
    covariance[..., [0, 3, 5]] = np.square(std) + (0.04 if about == "origin" else 0.0)  # a place off by 0.2 m
    motion = dataclasses.replace(person, covariance=covariance, meta={**person.meta, "covariance_about": about})
    found = curves(motion)
    many = np.stack(
        [
            np.stack([disturbed[joint].values for joint in ("Knee bend", "Elbow bend")])
            for disturbed in (
                curves(dataclasses.replace(person, joints3d=person.joints3d + std * random.standard_normal(std.shape)))
                for _ in range(100)
            )
        ]
    )
    spread = many.std(axis=0)
    for joint, expected in zip(("Knee bend", "Elbow bend"), spread, strict=True):
        ratio = found[joint].deviation / expected
        assert 0.9 < np.median(ratio) < 1.1, joint


def test_frames_without_the_person_are_unknown(person):
    keypoints = person.keypoints.copy()
    keypoints[20:25] = np.nan
    for curve in curves(dataclasses.replace(person, keypoints=keypoints)).values():
        assert np.isnan(curve.values[20:25]).all()
        assert np.isfinite(np.delete(curve.values, slice(20, 25), axis=0)).all()


def standing(frames: int = 3) -> np.ndarray:
    """(F, 15, 3) m, straight limbs, arms hanging."""
    place = {
        "pelvis": (0, 0, 0.9), "neck": (0, 0, 1.5), "head": (0, 0, 1.6),
        "rhip": (0, -0.1, 0.9), "rknee": (0, -0.1, 0.5), "rankle": (0, -0.1, 0.1),
        "lhip": (0, 0.1, 0.9), "lknee": (0, 0.1, 0.5), "lankle": (0, 0.1, 0.1),
        "rshoulder": (0, -0.2, 1.4), "relbow": (0, -0.2, 1.1), "rwrist": (0, -0.2, 0.8),
        "lshoulder": (0, 0.2, 1.4), "lelbow": (0, 0.2, 1.1), "lwrist": (0, 0.2, 0.8),
    }  # fmt: skip
    return np.tile(np.array([place[name] for name in BODY_15.joints]), (frames, 1, 1))


def test_straight_limbs_have_no_flexion_and_bent_ones_their_angle():
    joints = standing()
    assert all(np.allclose(angle, 0.0, atol=1e-6) for angle in flexion(joints, BODY_15.joints).values())
    joints[:, BODY_15.index("rankle")] = (-0.4, -0.1, 0.5)
    joints[:, BODY_15.index("lwrist")] = (0.3 * np.sin(0.5), 0.2, 1.1 - 0.3 * np.cos(0.5))
    bent = flexion(joints, BODY_15.joints)
    np.testing.assert_allclose(bent["knee"], np.tile([90.0, 0.0], (3, 1)), atol=1e-6)
    np.testing.assert_allclose(bent["elbow"], np.tile([0.0, np.degrees(0.5)], (3, 1)), atol=1e-6)
    assert flexion_words(joints, BODY_15.joints) == "knees 90 and 0, hips 0 and 0, elbows 0 and 29 degrees"


def test_unknown_joints_and_skeletons_have_no_words():
    joints = standing()
    joints[1] = np.nan
    assert flexion_words(joints, BODY_15.joints).startswith("knees 0 and 0")
    assert flexion_words(np.full((3, 15, 3), np.nan), BODY_15.joints) == ""
    assert flexion_words(joints[:, :3], BODY_15.joints[:3]) == ""
