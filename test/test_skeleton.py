"""Joint sets: trees, sides, mirror images."""

from __future__ import annotations

import numpy as np
import pytest

from drocap_ros.errors import InputError
from drocap_ros.skeleton import (
    BODY_15,
    BODY_19,
    COCO_17,
    JOINT_SETS,
    LIMB_JOINTS,
    SHOULDERS_OUTWARDS,
    TABLES,
    joint_map,
    joint_set,
)


@pytest.mark.parametrize("name", sorted(JOINT_SETS))
def test_joint_sets_are_trees_with_sides(name):
    s = joint_set(name)
    assert len(s.joints) == len(s.parents) == len(set(s.joints))
    for start in range(len(s)):
        joint, steps = start, 0
        while s.parents[joint] >= 0:
            joint, steps = s.parents[joint], steps + 1
            assert steps <= len(s), f"{s.joints[start]} hangs in a circle"
    assert (s.mirror[s.mirror] == np.arange(len(s))).all()
    assert (s.mirror != np.arange(len(s))).sum() >= 12


def test_mirror_is_an_involution_that_exchanges_the_sides():
    for joints in JOINT_SETS.values():
        np.testing.assert_array_equal(joints.mirror[joints.mirror], np.arange(len(joints)))
    assert BODY_15.joints[BODY_15.mirror[BODY_15.index("rwrist")]] == "lwrist"
    assert COCO_17.joints[COCO_17.mirror[COCO_17.index("left_ear")]] == "right_ear"
    assert BODY_15.mirror[BODY_15.index("neck")] == BODY_15.index("neck")


@pytest.mark.parametrize("name", sorted(TABLES))
def test_weights_sum_to_one_and_sides_are_kept(name):
    table, source = joint_map(name), joint_set(name)
    np.testing.assert_allclose(table.weights.sum(axis=1), 1.0)
    np.testing.assert_allclose(table.lines.sum(axis=1), 0.0, atol=1e-12)
    for row, joint in enumerate(BODY_15.joints):
        used = {source.joints[i] for i in np.nonzero(table.weights[row])[0]}
        if joint in LIMB_JOINTS:
            side = {"l": ("l", "left_"), "r": ("r", "right_")}[joint[0]]
            assert len(used) == 1
            name_there = used.pop()
            assert name_there in (side[0] + joint[1:], side[1] + joint[1:])


@pytest.mark.parametrize("name", ["coco17", "halpe26", "wholebody133", "mpii16", "h36m17"])
def test_every_set_maps_an_upright_person_to_the_same_joints(name):
    """Places in mm of one person standing before the camera, y down, in each set's own joints."""
    places = {
        "hip": (90, 0), "knee": (95, 420), "ankle": (100, 830), "shoulder": (170, -480), "elbow": (220, -190),
        "wrist": (230, 60), "ear": (75, -670), "eye": (30, -690),
        "toe": (120, 880), "big_toe": (120, 880), "heel": (95, 900),
    }  # fmt: skip
    middle = {
        "nose": (0, -660), "pelvis": (0, 0), "hip": (0, 0), "neck": (0, -615), "upper_neck": (0, -615),
        "head": (0, -712), "head_top": (0, -790), "thorax": (0, -500), "spine": (0, -250),
    }  # fmt: skip

    def place(joint: str) -> tuple[float, float]:
        for side, sign in (("left_", 1), ("right_", -1), ("l", 1), ("r", -1)):
            if joint.startswith(side) and joint[len(side) :] in places:
                x, y = places[joint[len(side) :]]
                return sign * x, y
        return middle.get(joint, (0.0, 0.0))

    s = joint_set(name)
    xy = np.array([place(j) for j in s.joints], float)
    if name in ("coco17", "halpe26", "wholebody133"):  # their annotators draw shoulders inside the joints' centres
        xy[[s.index("left_shoulder"), s.index("right_shoulder")], 0] /= SHOULDERS_OUTWARDS
    table = joint_map(name)
    out, covariance, confidence = table.apply(xy, np.ones((len(s), 3)), np.ones(len(s)), 1700.0)
    assert table.joints is (BODY_19 if name in ("halpe26", "wholebody133") else BODY_15)
    expected = np.array([place(j) for j in table.joints.joints], float)
    np.testing.assert_allclose(out, expected, atol=12)
    assert (covariance[:, 0] > 0).all()
    assert (confidence > 0.8).all()


def test_a_joint_without_one_of_its_parts_is_unknown():
    s = joint_set("coco17")
    xy, covariance, confidence = np.ones((17, 2)), np.ones((17, 3)), np.full(17, 0.9)
    xy[s.index("left_ear")] = np.nan
    out, out_covariance, out_confidence = joint_map("coco17").apply(xy, covariance, confidence, 100.0)
    lost = [BODY_15.index("neck"), BODY_15.index("head")]
    assert np.isnan(out[lost]).all()
    assert np.isnan(out_covariance[lost]).all()
    assert (out_confidence[lost] == 0).all()
    assert np.isfinite(np.delete(out, lost, 0)).all()


def test_drawn_shoulders_move_apart_about_their_middle_with_a_variance_along_their_line():
    s, table = joint_set("coco17"), joint_map("coco17")
    drawn, own = [s.index("left_shoulder"), s.index("right_shoulder")], [9, 12]
    xy, covariance = np.ones((17, 2)), np.tile([4.0, 0.0, 4.0], (17, 1))
    xy[drawn] = (80.0, 10.0), (20.0, 10.0)
    out, out_covariance, _ = table.apply(xy, covariance, np.ones(17), 100.0)
    assert [BODY_15.joints[i] for i in own] == ["lshoulder", "rshoulder"]
    np.testing.assert_allclose(out[own].mean(axis=0), xy[drawn].mean(axis=0))
    np.testing.assert_allclose(out[own[0]] - out[own[1]], SHOULDERS_OUTWARDS * (xy[drawn[0]] - xy[drawn[1]]))
    assert (out_covariance[own, 0] > out_covariance[own, 2] + 1.0).all()
    xy[drawn[1]] = np.nan
    alone, _, confidence = table.apply(xy, covariance, np.ones(17), 100.0)
    np.testing.assert_array_equal(alone[own[0]], xy[drawn[0]])
    assert confidence[own[0]] == 1.0


def test_shoulders_of_networks_that_learned_joint_centres_stay():
    for name in ("body15", "body17", "body19", "h36m17"):
        assert not joint_map(name).outwards.any()


def test_extrapolated_joints_have_more_variance_and_less_confidence():
    rng = np.random.default_rng(0)
    table = joint_map("coco17")
    true = rng.uniform(0, 100, (17, 2))
    noisy = true + rng.normal(0, 2.0, (4000, 17, 2))
    outs = np.array([table.apply(x, np.tile([4.0, 0, 4.0], (17, 1)), np.full(17, 0.9), 100.0)[0] for x in noisy])
    _, covariance, confidence = table.apply(true, np.tile([4.0, 0, 4.0], (17, 1)), np.full(17, 0.9), 100.0)
    sampled = outs.var(axis=0)
    limbs = [BODY_15.index(j) for j in (*LIMB_JOINTS, "pelvis") if "shoulder" not in j]
    np.testing.assert_allclose(covariance[limbs][:, [0, 2]], sampled[limbs], rtol=0.15)
    head = BODY_15.index("head")
    assert covariance[head, 0] > sampled[head, 0]  # the lean of the head comes on top
    assert confidence[head] < confidence[limbs].min()


def test_an_unknown_set_is_refused():
    with pytest.raises(InputError, match="spider8"):
        joint_map("spider8")
