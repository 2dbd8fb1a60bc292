"""Postures of the lifter's training: bones keep their lengths, the angles do what their names say, bodies stand."""

from __future__ import annotations

import numpy as np
import pytest

from drocap_ros.skeleton import BODY_17
from lab.training.postures import ANGLES, KINDS, balance, bend, draw_postures, tilt

_J = {name: i for i, name in enumerate(BODY_17.joints)}


def standing(windows: int = 1, frames: int = 1) -> np.ndarray:
    """(B, T, 17, 3) bones of a person who stands straight and looks along y, with legs of 0.9 m."""
    bone = np.zeros((17, 3), np.float32)
    for side, sign in (("r", 1.0), ("l", -1.0)):
        bone[_J[side + "hip"]] = (0.1 * sign, 0.0, 0.0)
        bone[_J[side + "shoulder"]] = (0.18 * sign, 0.0, -0.05)
        for limb in ("knee", "ankle"):
            bone[_J[side + limb]] = (0.0, 0.0, -0.45)
        for limb in ("elbow", "wrist"):
            bone[_J[side + limb]] = (0.0, 0.0, -0.3)
        bone[_J[side + "toe"]] = (0.0, 0.2, -0.05)
    bone[_J["neck"]] = (0.0, 0.0, 0.5)
    bone[_J["head"]] = (0.0, 0.0, 0.2)
    return np.tile(bone, (windows, frames, 1, 1))


def placed(bone: np.ndarray) -> np.ndarray:
    """Joints (B, T, 17, 3) of bones, the pelvis at the origin."""
    body = np.zeros_like(bone)
    for joint, parent in enumerate(BODY_17.parents):
        if parent >= 0:
            body[:, :, joint] = body[:, :, parent] + bone[:, :, joint]
    return body


def posture(**angle: float) -> np.ndarray:
    """(1, 1, 24) angles, zero but the named ones."""
    return np.array([[[angle.get(name, 0.0) for name in ANGLES]]], np.float32)


@pytest.mark.parametrize(
    ("angle", "joint", "direction"),
    [
        ({"rhip": 1.57}, "rknee", (0, 1, 0)),
        ({"rhip_out": 1.57}, "rknee", (1, 0, 0)),
        ({"lhip_out": 1.57}, "lknee", (-1, 0, 0)),
        ({"rknee": 1.57}, "rankle", (0, -1, 0)),
        ({"lhip": 1.57, "lknee": 1.57}, "lankle", (0, 0, -1)),
        ({"rhip": 1.57, "rhip_turn": 1.57}, "rknee", (1, 0, 0)),
        ({"lhip": 1.57, "lhip_turn": 1.57, "lknee": 1.57}, "lankle", (0, 0, -1)),
        ({"lshoulder": 1.57}, "lelbow", (0, 1, 0)),
        ({"rarm_turn": -1.57, "relbow": 1.57}, "rwrist", (-1, 0, 0)),
        ({"relbow": 1.57}, "rwrist", (0, 1, 0)),
        ({"lshoulder_out": 1.57}, "lwrist", (-1, 0, 0)),
        ({"bend": 1.57}, "neck", (0, 1, 0)),
        ({"bend": 1.57}, "rwrist", (0, 0, 0)),
        ({"lean": 1.57}, "neck", (1, 0, 0)),
        ({"neck": 1.57}, "head", (0, 1, 0)),
    ],
)
def test_each_angle_turns_its_bone_as_its_name_says(angle, joint, direction):
    bone = bend(standing(), posture(**angle))
    np.testing.assert_allclose(np.linalg.norm(bone, axis=-1), np.linalg.norm(standing(), axis=-1), atol=1e-6)
    if any(direction):
        np.testing.assert_allclose(bone[0, 0, _J[joint]] / np.linalg.norm(bone[0, 0, _J[joint]]), direction, atol=2e-3)
    else:
        # Arms go with the trunk: they hang from the shoulders of a body that is bent as a whole.
        np.testing.assert_allclose(bone[0, 0, _J[joint]], (0.0, -0.3, 0.0), atol=2e-3)


def test_a_body_is_tilted_about_its_hips_and_its_front():
    body = placed(standing())
    np.testing.assert_allclose(tilt(body, posture(pitch=-1.57))[0, 0, _J["neck"]], (0, 0.5, 0), atol=2e-3)
    np.testing.assert_allclose(tilt(body, posture(roll=1.57))[0, 0, _J["neck"]], (0.5, 0, 0), atol=2e-3)


def test_drawn_postures_are_smooth_repeatable_and_of_every_height():
    angles = draw_postures(np.random.default_rng(1), 300, 240)
    assert angles.shape == (300, 240, len(ANGLES))
    assert np.array_equal(angles, draw_postures(np.random.default_rng(1), 300, 240))
    assert np.isfinite(angles).all()
    # 1.5 rad in 12 frames, twice as fast in the middle.
    assert np.abs(np.diff(angles, axis=1)).max() < 0.6
    body = balance(tilt(placed(bend(standing(300, 240), angles)), angles))
    height = -np.nanmin(body[..., 2], axis=-1)
    assert (np.ptp(height, axis=1) > 0.3).mean() > 0.5
    for low, high in ((0.0, 0.3), (0.3, 0.6), (0.6, 1.0)):
        assert ((height > low) & (height < high)).mean() > 0.1
    assert {kind.level for kind in KINDS} == {0, 1, 2, 3}


def test_a_person_who_would_fall_is_turned_until_the_feet_carry():
    leaning = tilt(placed(standing(1, 40)), np.repeat(posture(pitch=0.3), 40, axis=1))
    upright = balance(leaning)
    feet = upright[0, 20, [_J["rankle"], _J["lankle"], _J["rtoe"], _J["ltoe"]], 1]
    assert leaning[0, 20, _J["neck"], 1] < leaning[0, 20, _J["rankle"], 1] - 0.3
    assert feet.min() - 0.15 < upright[0, 20, _J["neck"], 1] < feet.max() + 0.15
    np.testing.assert_allclose(
        np.linalg.norm(np.diff(upright[0, 0, :4], axis=0), axis=-1),
        np.linalg.norm(np.diff(leaning[0, 0, :4], axis=0), axis=-1),
        atol=1e-5,
    )


def test_a_person_who_sits_leaning_back_stays_on_the_seat():
    arms = {"rshoulder": 1.2, "lshoulder": 1.2}
    sitting = posture(pitch=0.4, bend=0.1, rhip=1.3, lhip=1.3, rknee=0.1, lknee=0.1, **arms)
    body = tilt(placed(bend(standing(1, 40), np.repeat(sitting, 40, axis=1))), np.repeat(sitting, 40, axis=1))
    held = balance(body)[0, 20]
    assert held[_J["pelvis"], 2] - np.nanmin(held[:, 2]) < 0.12
    assert held[_J["neck"], 2] > held[_J["pelvis"], 2] + 0.4


def test_a_person_who_lies_stays_lying():
    lying = tilt(placed(standing(1, 40)), np.repeat(posture(pitch=1.57), 40, axis=1))
    assert np.ptp(balance(lying)[0, 20, :15, 2]) < 0.35
