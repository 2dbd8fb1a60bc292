"""Training: its samples are geometrically right, and a short run learns and exports a network that runs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drocap_ros.errors import DrocapError
from drocap_ros.reconstruction.lifted.lifter import SHIPPED
from drocap_ros.reconstruction.lifted.lifter_input import BONES, FEATURES, PARTS
from drocap_ros.skeleton import BODY_17, indices
from lab.training.keypoint_errors import as_drawn, detect
from lab.training.leg_lengths import refit_knees
from lab.training.lifter_samples import camera_rotation, sample_batch
from lab.training.mocap_bank import MocapBank, load_bank, straighten_legs


def bank(frames: int = 90) -> MocapBank:
    """Two sequences of a swinging stick figure."""
    rng = np.random.default_rng(0)
    body = np.zeros((17, 3))
    for joint, parent in enumerate(BODY_17.parents):
        if parent >= 0:
            body[joint] = body[parent] + rng.normal(0, 0.1, 3) + (0, 0, 0.25 if 7 <= joint < 15 else -0.25)
    phase = rng.uniform(0, 6, (1, 17, 3))
    x = body + 0.05 * np.sin(0.2 * np.arange(2 * frames)[:, None, None] + phase)
    both = np.array([frames, frames])
    speed = np.full((2 * frames, 2), 0.3, np.float32)
    rate, low = np.array([30.0, 30.0]), np.zeros(2)
    return MocapBank(x.astype(np.float32), np.array([0, frames]), both, rate, speed, np.ones(2), low)


def part(features: np.ndarray, number: int) -> np.ndarray:
    """One of the parts of the features, by its place in PARTS."""
    begin = sum(PARTS[:number])
    return features[..., begin : begin + PARTS[number]]


def test_virtual_camera_sees_the_head_above_the_feet():
    azimuth, elevation, roll = np.array([0.3, 2.0]), np.array([0.2, 0.9]), np.zeros(2)
    rotation = camera_rotation(azimuth, elevation, roll)
    np.testing.assert_allclose(rotation @ np.swapaxes(rotation, 1, 2), np.tile(np.eye(3), (2, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(rotation), 1.0)
    away = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=-1
    )
    np.testing.assert_allclose(np.einsum("nij,nj->ni", rotation, -away), np.tile([0.0, 0.0, 1.0], (2, 1)), atol=1e-12)
    # Up in the world is up in the image (y grows downwards), and the horizon is level.
    up = rotation[:, :, 2]
    assert (up[:, 1] < 0).all()
    np.testing.assert_allclose(up[:, 0], 0.0, atol=1e-12)


@pytest.mark.parametrize("frames", [2, 16, 160])
def test_samples_are_finite_repeatable_and_mostly_show_the_target(frames):
    first = sample_batch(bank(), np.random.default_rng(3), 12, frames)
    again = sample_batch(bank(), np.random.default_rng(3), 12, frames)
    assert first.features.shape == (12, frames, FEATURES)
    assert first.target.shape == (12, frames, 17, 3)
    assert np.isfinite(first.features).all()
    assert np.isfinite(first.target).all()
    assert np.array_equal(first.features, again.features)
    assert np.array_equal(first.target, again.target)
    seen = part(first.features, 1) > 0
    gap = np.linalg.norm(part(first.features, 0).reshape(12, frames, 17, 2) - first.target[..., :2], axis=-1)
    assert np.median(gap[seen]) < 0.1
    assert set(np.unique(first.still[np.isfinite(first.still)])) <= {0.0}


def test_length_and_reach_features_agree_with_the_truth():
    batch = sample_batch(bank(), np.random.default_rng(5), 300, 64)
    length, reach = part(batch.features, 2), part(batch.features, 3)
    given = (length > 0).all(axis=(1, 2))
    assert 0.3 < given.mean() < 0.9
    span = batch.target[:, :, BONES[:, 1]] - batch.target[:, :, BONES[:, 0]]
    true = np.median(np.linalg.norm(span, axis=-1), axis=1)
    np.testing.assert_allclose(np.median(length[given, 0] / true[given]), 1.0, atol=0.02)
    shown = reach[given] > 0
    # Of joints that are drawn at their places: a network draws others aside.
    drawn = np.linalg.norm(part(batch.features, 0).reshape(*span.shape[:2], 17, 2) - batch.target[..., :2], axis=-1)
    there = (np.median(drawn, axis=(1, 2)) < 0.03)[given]
    assert there.sum() >= 20
    assert np.median(np.abs(reach[given] - np.abs(span[given][..., 2]))[there][shown[there]]) < 0.15


def test_known_camera_turns_and_gravity_agree_with_the_poses():
    batch = sample_batch(bank(), np.random.default_rng(6), 80, 64)
    gravity, known = part(batch.features, 7), part(batch.features, 8)[..., 0] > 0
    given = known.all(axis=1)
    assert 0.3 < given.mean() < 0.7
    assert not gravity[~given].any()
    np.testing.assert_allclose(np.linalg.norm(gravity[given], axis=-1), 1.0, atol=1e-5)
    # Most cameras look at upright people: gravity points down the image.
    assert np.median(gravity[given][..., 1]) > 0.7
    turning = np.abs(part(batch.features, 6)[given]).max(axis=(1, 2))
    assert (turning > 0.02).mean() > 0.5


def test_given_covariances_are_those_of_the_errors():
    exact = np.zeros((400, 64, 17, 2), np.float32)
    found = detect(exact, np.random.default_rng(1))
    given = np.isfinite(found.covariance[..., 0]).all(axis=(1, 2))
    assert 0.3 < given.mean() < 0.6
    size = np.square(found.keypoints[given]).sum(axis=-1)
    expected = found.covariance[given][..., 0] + found.covariance[given][..., 2]
    use = np.isfinite(size) & (expected > 1e-4)
    # The median of a chi-squared variable of two degrees of freedom over its mean is 0.69; gross errors have none.
    assert 0.4 < np.median((size / expected)[use]) < 1.2


def test_legs_are_refitted_between_hip_and_ankle():
    x = bank().joints[None]
    x[:, :, indices(BODY_17.joints, ("rknee", "lknee"))] += np.array([0.15, 0.0, 0.0], np.float32)
    hip, knee, ankle = (x[..., indices(BODY_17.joints, ("r" + p, "l" + p)), :] for p in ("hip", "knee", "ankle"))
    shorter = refit_knees(x, np.array([0.97]))
    moved = shorter[..., indices(BODY_17.joints, ("rknee", "lknee")), :]
    still = [j for j in range(17) if BODY_17.joints[j] not in ("rknee", "lknee")]
    assert np.array_equal(shorter[:, :, still], x[:, :, still])
    reached = np.linalg.norm(ankle - hip, axis=-1) < 0.97 * (
        np.linalg.norm(knee - hip, axis=-1) + np.linalg.norm(ankle - knee, axis=-1)
    )
    assert reached.mean() > 0.5
    for end in (hip, ankle):
        ratio = np.linalg.norm(moved - end, axis=-1) / np.linalg.norm(knee - end, axis=-1)
        np.testing.assert_allclose(ratio[reached], 0.97, atol=1e-4)
    reach = np.linalg.norm(ankle - hip, axis=-1) / (
        np.linalg.norm(knee - hip, axis=-1) + np.linalg.norm(ankle - knee, axis=-1)
    )
    many = straighten_legs(np.repeat(x, 40, axis=0), np.full(40, np.quantile(reach, 0.99)), np.random.default_rng(0))
    bend = np.linalg.norm(many[..., (3, 6), :] - many[..., (1, 4), :], axis=-1) / (
        np.linalg.norm(many[..., (2, 5), :] - many[..., (1, 4), :], axis=-1)
        + np.linalg.norm(many[..., (3, 6), :] - many[..., (2, 5), :], axis=-1)
    )
    # cos(10 degrees / 2): no refitted leg's straightest posture is more bent.
    assert (np.quantile(bend, 0.99, axis=(1, 2)) > 0.996).mean() > 0.5


@pytest.mark.filterwarnings("ignore:overflow:RuntimeWarning")  # of the joints that are made so large
def test_a_training_that_diverges_keeps_the_last_good_network():
    pytest.importorskip("torch", reason="the extra 'train' is not installed")
    from lab.training.lifter import LifterTraining, train

    broken = replace(bank(), joints=bank().joints * np.float32(1e30))
    kept = []
    with pytest.raises(DrocapError, match="diverged"):
        train(
            broken, LifterTraining(steps=4, width=16, frames_per_batch=240), lambda line: None,
            lambda network, facts: kept.append(facts), checkpoint_minutes=0.0,
        )  # fmt: skip
    assert not kept


def test_low_postures_are_counted(tmp_path):
    standing = np.zeros((6, 15, 3))
    standing[:, :, 2] = [900, 900, 450, 0, 900, 450, 0, 1400, 1600, 1350, 1100, 900, 1350, 1100, 900]
    bent = standing.copy()
    bent[3:, 7:, 1], bent[3:, 7:, 2] = standing[3:, 7:, 2] - 900, 900
    crouching = standing.copy()
    crouching[..., 2] = np.where(standing[..., 2] > 450, standing[..., 2] - 400, standing[..., 2])
    crouching[:, [2, 5], 1], crouching[:, [2, 5], 2] = 400, 300
    for name, x in (("a", standing), ("b", bent), ("c", crouching)):
        np.savez(tmp_path / f"{name}.npz", X=x, fps=30.0, joints=np.array(BODY_17.joints[:15]))
    found = load_bank([tmp_path / f"{name}.npz" for name in "abc"])
    np.testing.assert_allclose(found.low, [0.0, 0.5, 1.0])


def test_a_short_training_learns_and_its_network_runs(tmp_path):
    pytest.importorskip("torch", reason="the extra 'train' is not installed")
    pytest.importorskip("onnx", reason="the extra 'train' is not installed")
    from drocap_ros.reconstruction.lifted.lifter import Lifter
    from drocap_ros.reconstruction.lifted.network import LifterInput
    from lab.training.lifter import LifterTraining, export_onnx, train
    from lab.training.lifter_network import build_network

    def error(network) -> float:
        export_onnx(network, tmp_path / "t.onnx", {"command": "test"})
        batch = sample_batch(bank(), np.random.default_rng(9), 8, 64)
        import onnxruntime

        session = onnxruntime.InferenceSession(str(tmp_path / "t.onnx"), providers=["CPUExecutionProvider"])
        joints = session.run(["joints"], {"features": batch.features})[0]
        return float(np.linalg.norm(joints - batch.target, axis=-1).mean())

    options = LifterTraining(steps=12, width=32, frames_per_batch=640)
    kept = []
    network, facts = train(bank(), options, lambda line: None, lambda n, f: kept.append(f), checkpoint_minutes=0.0)
    assert facts["steps"] == 12
    assert facts["frames_seen"] > 0
    assert kept
    assert error(network) < error(build_network(32))
    again, _ = train(bank(), options, lambda line: None, lambda n, f: None)
    assert all(np.array_equal(a, b) for a, b in zip(weights(network), weights(again), strict=True))
    lifted = Lifter.load(tmp_path / "t.onnx").lift(LifterInput(np.random.default_rng(0).normal(size=(9, 17, 2))))
    assert np.isfinite(lifted.joints).all()


def test_repeated_batches_and_processes_that_draw_leave_the_weights_to_the_seed():
    pytest.importorskip("torch", reason="the extra 'train' is not installed")
    from lab.training.lifter import LifterTraining, train

    def trained(seed: int, workers: int) -> list[np.ndarray]:
        options = LifterTraining(steps=5, width=32, frames_per_batch=320, steps_per_batch=3, workers=workers, seed=seed)
        return weights(train(bank(), options, lambda line: None, lambda n, f: None)[0])

    first = trained(1, workers=0)
    assert all(np.array_equal(a, b) for a, b in zip(first, trained(1, workers=2), strict=True))
    assert not all(np.array_equal(a, b) for a, b in zip(first, trained(2, workers=0), strict=True))


@pytest.mark.parametrize("name", ["a", "a_quick"])
def test_weights_of_eight_bits_change_the_outputs_little(tmp_path, name):
    torch = pytest.importorskip("torch", reason="the extra 'train' is not installed")
    pytest.importorskip("onnx", reason="the extra 'train' is not installed")
    import onnxruntime

    from lab.training.lifter import export_onnx
    from lab.training.lifter_network import build_network

    network = build_network(96)
    export_onnx(network, tmp_path / "a.onnx", {"command": "test"})
    count = sum(weight.numel() for weight in network.parameters())
    assert (tmp_path / f"{name}.onnx").stat().st_size < 1.3 * count
    features = sample_batch(bank(), np.random.default_rng(4), 4, 64).features
    session = onnxruntime.InferenceSession(str(tmp_path / f"{name}.onnx"), providers=["CPUExecutionProvider"])
    outputs = session.run(None, {"features": features})
    for exact, found in zip(network(torch.from_numpy(features)), outputs, strict=True):
        exact = exact.detach().numpy()
        assert np.abs(found - exact).mean() < 0.02 * np.abs(exact).mean()


def test_no_sum_of_the_shipped_integers_overflows_sixteen_bits():
    onnx = pytest.importorskip("onnx", reason="not installed")
    graph = onnx.load(SHIPPED.with_stem(f"{SHIPPED.stem}_quick")).graph
    arrays = {tensor.name: onnx.numpy_helper.to_array(tensor) for tensor in graph.initializer}
    codes = [arrays[node.input[1]].astype(int) for node in graph.node if node.op_type == "MatMulInteger"]
    assert len(codes) > 30
    # Processors of 2013 to 2019 add the products of two neighbours with values up to 255 in 16 bits.
    assert max(np.abs(c.reshape(-1, 2, c.shape[1])).sum(axis=1).max() for c in codes) * 255 < 2**15


def test_muon_steps_along_an_orthogonal_matrix():
    torch = pytest.importorskip("torch", reason="the extra 'train' is not installed")
    from lab.training.muon import muon, orthogonalised

    for shape in ((24, 72), (72, 24)):
        matrix = torch.from_numpy(np.random.default_rng(0).normal(size=shape).astype(np.float32))
        values = torch.linalg.svdvals(orthogonalised(matrix))
        assert 0.5 < float(values.min()) <= float(values.max()) < 1.3
    weight = torch.nn.Parameter(matrix.clone())
    optimiser = muon([weight], weight_decay=0.0)
    optimiser.param_groups[0]["lr"] = 0.1
    weight.grad = matrix.clone()
    optimiser.step()
    step = (matrix - weight.detach()) / (0.1 * 3**0.5)
    np.testing.assert_allclose(step.numpy(), orthogonalised(matrix).numpy(), atol=1e-5)


def weights(network) -> list[np.ndarray]:
    return [weight.detach().numpy() for weight in network.parameters()]


def test_a_bent_knee_is_drawn_up_the_shank_and_a_straight_one_on_its_line():
    at = BODY_17.index
    body = np.zeros((400, 4, 17, 3), np.float32)
    body[:, :, [at("rknee"), at("lknee")]] = (0, 0.4, 0)
    body[:, :, at("rankle")] = (0, 0.8, 0)
    body[:, :, at("lankle")] = (0, 0.4, 0.4)  # a right angle
    drawn = as_drawn(body, np.random.default_rng(0)) - body
    along = {"r": drawn[:, :, at("rknee"), 1], "l": drawn[:, :, at("lknee"), 2]}
    assert abs(along["r"].mean()) < 0.003
    assert -0.020 < along["l"].mean() < -0.008  # half of the windows, 0 to 56 mm
    np.testing.assert_allclose(drawn[:, :, [at("rknee"), at("lknee")], 0], 0, atol=1e-6)
