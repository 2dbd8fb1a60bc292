"""The order of keypoints: stated by names, found by the body, or refused; inputs that are no body are never good."""

import numpy as np
import pytest
from orders_of_points import SIZE, in_order, views, wrong_inputs

from drocap_ros.cli import main
from drocap_ros.errors import InputError
from drocap_ros.reconstruction.reconstruct import reconstruct
from drocap_ros.recording.keypoints.body_check import is_no_body, limbs_of
from drocap_ros.recording.keypoints.files import Stated, read_keypoints
from drocap_ros.recording.keypoints.orders import ORDERS, joint_name
from drocap_ros.report.checks import MotionCheck, quality_sentence, run_checks
from drocap_ros.report.statistics import motion_statistics

ACTIONS = ("walk", "boxing", "kicking", "squats", "mixed")


@pytest.mark.parametrize("order", [name for name in ORDERS if name not in ("wholebody133", "halpe136")])
@pytest.mark.parametrize("seed", range(3))
def test_every_order_is_found_by_its_body(tmp_path, order, seed, caplog):
    rng = np.random.default_rng(seed)
    points = in_order(views(ACTIONS[seed], seed, height_m=1.5 + 2 * seed, start_deg=100 * seed)[2], order, rng)
    np.save(tmp_path / "k.npy", points)
    found = read_keypoints(tmp_path / "k.npy", Stated(30.0, SIZE))
    wanted, got = limbs_of(ORDERS[order]), limbs_of(found.joints)
    assert all(got[joint] == at for joint, at in wanted.items() if joint != "face")
    assert "points without names: taken in the order" in caplog.text


WRONG = list(wrong_inputs())


def test_there_are_sixty_wrong_inputs():
    assert len(WRONG) >= 60


@pytest.mark.parametrize(("name", "arrays"), WRONG, ids=[name for name, _ in WRONG])
def test_what_is_no_body_is_refused_or_doubted(tmp_path, name, arrays):
    np.savez(tmp_path / "k.npz", **arrays)
    size = SIZE if "without a size" not in name else None
    try:
        tracks = read_keypoints(tmp_path / "k.npz", Stated(30.0, size))
    except InputError:
        return
    motion = reconstruct(tracks)
    assert "quality: doubtful" in quality_sentence(run_checks(motion, motion_statistics(motion)))


@pytest.mark.parametrize("action", ACTIONS)
@pytest.mark.parametrize("seed", range(4))
def test_a_body_is_not_doubted(action, seed):
    rng = np.random.default_rng(seed)
    points = in_order(views(action, seed, height_m=1 + 1.3 * seed, start_deg=70 * seed)[2], "coco17", rng, 2.0)
    points[rng.random(points.shape[:2]) < 0.2] = np.nan
    assert not is_no_body(points, ORDERS["coco17"], strict=True)


@pytest.mark.parametrize("order", ["coco17", "mediapipe33", "openpose25", "halpe26"])
@pytest.mark.parametrize("side", ["right", "left", "below", "above"])
@pytest.mark.parametrize("share", [0.35, 0.5, 0.7])
def test_who_is_cut_off_at_one_side_of_the_picture_is_taken(tmp_path, order, side, share):
    """Networks go on beyond the edge: before a webcam two thirds of the points lie below the picture."""
    points = in_order(views("walk", 1)[2], order, np.random.default_rng(0))
    low, high = np.min(points, axis=(0, 1)), np.max(points, axis=(0, 1))
    axis, last = (0 if side in ("right", "left") else 1), side in ("right", "below")
    scale = SIZE[1] / (share if axis else 1.25) / (high - low)[1]
    place = np.array(SIZE) / 2 - scale * (low + high) / 2
    edge = share * (high - low)[axis] * scale  # of the body in the picture
    place[axis] = SIZE[axis] - edge - scale * low[axis] if last else edge - scale * high[axis]
    np.savez(tmp_path / "k.npz", keypoints=scale * points + place, joints=ORDERS[order])
    found = read_keypoints(tmp_path / "k.npz", Stated(30.0, SIZE))
    assert np.isfinite(found.keypoints).all(axis=2).mean() > 0.1


@pytest.mark.parametrize("height_m", [1.5, 5.0, 9.0, 20.0])
@pytest.mark.parametrize("action", ACTIONS)
def test_joints_that_our_networks_name_are_not_doubted_from_any_height(tmp_path, action, height_m):
    points = in_order(views(action, 1, height_m=height_m)[2], "coco17", np.random.default_rng(1), 2.0)
    np.savez(tmp_path / "k.npz", keypoints=points, joints=ORDERS["coco17"])
    motion = reconstruct(read_keypoints(tmp_path / "k.npz", Stated(30.0, SIZE)))
    motion.meta["pose2d"] = "estimated"
    assert MotionCheck.NO_BODY not in {found.check for found in run_checks(motion, motion_statistics(motion))}


def test_an_order_that_a_user_states_replaces_names_and_the_search(tmp_path, capsys):
    points = in_order(views()[2], "h36m17", np.random.default_rng(0))
    np.savez(tmp_path / "k.npz", keypoints=points, joints=ORDERS["coco17"])
    assert read_keypoints(tmp_path / "k.npz", Stated(30.0, SIZE, "h36m")).joints == ORDERS["h36m17"]
    arrays = {"joints": ORDERS["coco17"], "stamp_ns": np.arange(len(points)) * 10**8, "image_size": SIZE}
    np.savez(tmp_path / "own.npz", keypoints=points, **arrays)
    assert read_keypoints(tmp_path / "own.npz", Stated(order="h36m17")).joints == ORDERS["h36m17"]
    assert main(["reconstruct", str(tmp_path / "k.npz"), "--order", "openpose25"]) == 2
    assert "expected an order of 17 points (coco17, h36m17" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("key", "names"),
    [
        ("keypoint_names", list),
        ("joint_names", list),
        ("keypoint_id2name", lambda names: {str(i): name for i, name in enumerate(names)}),
        ("keypoint_name2id", lambda names: {name: i for i, name in enumerate(names)}),
    ],
)
def test_names_beside_the_points_win(tmp_path, key, names):
    import json

    human36m = ["root", *(f"{side}_{part}" for side in ("right", "left") for part in ("hip", "knee", "foot")), "spine",
                "thorax", "neck_base", "head"]  # fmt: skip
    human36m += [f"{side}_{part}" for side in ("left", "right") for part in ("shoulder", "elbow", "wrist")]
    points = in_order(views()[2], "h36m17", np.random.default_rng(0)).tolist()
    frames = [{"frame_id": i, "instances": [{"keypoints": person}]} for i, person in enumerate(points)]
    (tmp_path / "k.json").write_text(json.dumps({"meta_info": {key: names(human36m)}, "instance_info": frames}))
    assert read_keypoints(tmp_path / "k.json").joints == ORDERS["h36m17"]


def test_spellings_of_a_joint():
    for name in ("RHip", "hip_R", "Hip.right", "rightHip", "right-hip", "r_hip"):
        assert joint_name(name) == "right_hip"
    assert joint_name("left_foot_index") == "left_big_toe"


@pytest.mark.parametrize("seen", ["upper body", "without ankles", "left side half", "one frame"])
@pytest.mark.parametrize("seed", range(3))
def test_a_part_of_a_body_is_not_doubted(seen, seed):
    rng = np.random.default_rng(seed)
    points = in_order(views(ACTIONS[seed], seed, start_deg=80 * seed)[2], "coco17", rng, 2.0)
    if seen == "one frame":
        points = points[40:41]
    elif seen == "left side half":
        points[::2, 1::2] = np.nan
    else:
        points[:, 11 if seen == "upper body" else 15 :] = np.nan
    assert not is_no_body(points, ORDERS["coco17"], strict=True)
