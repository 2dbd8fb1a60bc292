import numpy as np
import pytest

from drocap_ros.errors import InputError
from drocap_ros.simulation.simulated_person import ACTIONS, action_weights, simulate_person, two_bone
from drocap_ros.skeleton import BODY_15

T = np.arange(0, 22, 1 / 60)


@pytest.mark.parametrize("action", ACTIONS)
def test_bone_lengths_are_constant_and_motion_is_smooth(action):
    joints = simulate_person(T, action, seed=4, stature_m=1.8)
    parent, child = BODY_15.bones.T
    lengths = np.linalg.norm(joints[:, child] - joints[:, parent], axis=2)
    assert np.ptp(lengths, axis=0).max() < 1e-9
    speed = np.linalg.norm(np.diff(joints, axis=0), axis=2) * 60
    assert speed.max() < 8.0  # m/s, no jump
    assert joints[..., 2].min() > 0.0
    assert joints[:, BODY_15.index("head"), 2].max() < 1.85


def test_left_hip_is_left_of_the_walking_direction():
    joints = simulate_person(T, "walk", seed=1)
    step = joints[2:, 0, :2] - joints[:-2, 0, :2]
    walking = np.linalg.norm(step, axis=1) * 30 > 0.5
    across = (joints[:, BODY_15.index("lhip")] - joints[:, BODY_15.index("rhip")])[1:-1, :2]
    side = step[:, 0] * across[:, 1] - step[:, 1] * across[:, 0]
    assert walking.mean() > 0.8
    assert (side[walking] > 0).all()


def test_walk_is_long_and_turns():
    pelvis = simulate_person(T, "walk", seed=2)[:, 0]
    path = np.linalg.norm(np.diff(pelvis[:, :2], axis=0), axis=1).sum()
    assert 15 < path < 30
    assert np.linalg.norm(pelvis[-1, :2] - pelvis[0, :2]) < 0.9 * path


def test_stance_foot_does_not_slide():
    joints = simulate_person(T, "walk", seed=3)
    ankle = joints[:, BODY_15.index("rankle")]
    low = ankle[:, 2] < ankle[:, 2].min() + 0.005
    speed = np.linalg.norm(np.diff(ankle[:, :2], axis=0), axis=1) * 60
    assert np.median(speed[low[1:] & low[:-1]]) < 0.1


def test_actions_have_their_characteristic_motion():
    def reach(action, joint, root):
        j = simulate_person(T, action, seed=5)
        return j[:, BODY_15.index(joint)] - j[:, BODY_15.index(root)]

    assert np.ptp(reach("squats", "pelvis", "lankle")[:, 2]) > 0.25
    assert reach("kicking", "lankle", "pelvis")[:, 2].max() > -0.1
    arm = np.linalg.norm(reach("boxing", "rwrist", "rshoulder"), axis=1)
    assert np.ptp(arm) > 0.2
    assert np.ptp(np.linalg.norm(reach("stand", "rwrist", "rshoulder"), axis=1)) < 0.01


def test_pose_does_not_depend_on_other_instants():
    whole = simulate_person(T, "mixed", seed=6)
    assert np.allclose(simulate_person(T[100:101], "mixed", seed=6), whole[100:101], atol=1e-12)
    assert np.array_equal(whole, simulate_person(T, "mixed", seed=6))
    assert not np.allclose(whole, simulate_person(T, "mixed", seed=7))


def test_mixed_weights_are_continuous_and_reach_every_action():
    weight = action_weights(T, "mixed")
    assert (weight.max(axis=0) > 0.999).all()
    assert np.abs(np.diff(weight, axis=0)).max() < 0.06


def test_two_bone_limb_reaches_goals_in_reach_with_constant_lengths():
    rng = np.random.default_rng(0)
    start, goal, pole = rng.normal(size=(3, 200, 3))
    middle, end = two_bone(start, goal, pole, 0.7, 0.5)
    assert np.allclose(np.linalg.norm(middle - start, axis=1), 0.7)
    assert np.allclose(np.linalg.norm(end - middle, axis=1), 0.5)
    distance = np.linalg.norm(goal - start, axis=1)
    inside = (distance < 1.19) & (distance > 0.37)
    assert np.allclose(end[inside], goal[inside])
    assert (np.sum((middle - start) * pole, axis=1) - np.sum((end - start) * pole, axis=1) * 0.7 / 1.2 > -0.71).all()


@pytest.mark.parametrize("t", [np.array([-1.0]), np.array([np.nan]), np.zeros((2, 2)), np.array([1e9])])
def test_times_out_of_range_are_refused(t):
    with pytest.raises(InputError, match="seconds"):
        simulate_person(t)


def test_unknown_action_is_refused():
    with pytest.raises(InputError, match="expected one of mixed"):
        simulate_person(T, "dance")


def test_empty_times_give_empty_poses():
    assert simulate_person(np.array([])).shape == (0, 15, 3)
