from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_models import TensorProto, heatmaps, write_model

from drocap_ros.errors import InputError
from drocap_ros.perception.load_models import load_pose_model
from drocap_ros.perception.models.network_input import crop_around, cut
from drocap_ros.perception.pose.pose_model import decode_heatmaps, decode_simcc
from drocap_ros.perception.tracking.pose_estimator_config import PoseEstimatorConfig

IMAGE = np.zeros((400, 300, 3), np.uint8)
#: Aspect ratio of the networks' input, so that the crop is 1.25 times the box.
BOX = np.array([60.0, 80.0, 210.0, 280.0])


def load(folder, **config):
    return load_pose_model(folder, PoseEstimatorConfig(**config))


def in_image(crop_px: np.ndarray, size: tuple[int, int] = (192, 256)) -> np.ndarray:
    return crop_around(BOX, size, 1.25).to_image(crop_px)


@settings(max_examples=80, deadline=None)
@given(st.floats(2, 45), st.floats(2, 61), st.floats(0.05, 1.0), st.floats(1.2, 3.0))
def test_heatmap_peak_has_subcell_precision(x, y, height, sigma):
    peaks = decode_heatmaps(heatmaps(1, 64, 48, np.array([[x, y]]), height, sigma)[0], (192, 256))
    np.testing.assert_allclose(peaks.xy[0], [4 * x, 4 * y], atol=0.12)
    assert peaks.score[0] == pytest.approx(height, rel=0.25)


def test_spread_follows_width_and_direction():
    y, x = np.mgrid[:64, :48]
    sharp = heatmaps(1, 64, 48, np.array([[20.0, 30.0]]))[0]
    wide = np.exp(-((x - 20) ** 2 / (2 * 4.0**2) + (y - 30) ** 2 / (2 * 2.0**2)))[None].astype(np.float32)
    tilted = np.exp(-((x - 20 - (y - 30)) ** 2 / 8 + (x - 20 + y - 30) ** 2 / 80))[None].astype(np.float32)
    assert decode_heatmaps(sharp, (192, 256)).spread.max() < 2.0
    xx, xy, yy = decode_heatmaps(wide, (192, 256)).spread[0]
    assert xx > 50
    assert yy < 2.0
    assert abs(xy) < 1.0
    assert decode_heatmaps(tilted, (192, 256)).spread[0, 1] > 5


def test_second_peak_is_the_highest_other_one():
    two = heatmaps(1, 64, 48, np.array([[12.0, 20.0]]), 0.8)[0] + heatmaps(1, 64, 48, np.array([[36.0, 50.0]]), 0.5)[0]
    peaks = decode_heatmaps(two, (192, 256))
    np.testing.assert_allclose(peaks.xy[0], [48, 80], atol=0.5)
    np.testing.assert_allclose([peaks.score[0], peaks.second[0]], [0.8, 0.5], atol=0.01)
    assert decode_heatmaps(heatmaps(1, 64, 48, np.array([[12.0, 20.0]]))[0], (192, 256)).second[0] == 0


def test_udp_cells_span_the_outer_pixels():
    peaks = decode_heatmaps(heatmaps(1, 64, 48, np.array([[47.0, 63.0]]))[0], (192, 256), udp=True)
    np.testing.assert_allclose(peaks.xy[0], [191, 255], atol=4.5)
    middle = decode_heatmaps(heatmaps(1, 64, 48, np.array([[23.5, 31.5]]))[0], (192, 256), udp=True)
    np.testing.assert_allclose(middle.xy[0], [95.5, 127.5], atol=0.1)


def test_empty_heatmap_has_score_zero():
    peaks = decode_heatmaps(np.zeros((3, 64, 48), np.float32), (192, 256))
    assert (peaks.score == 0).all()
    assert np.isfinite(peaks.xy).all()
    assert np.isfinite(peaks.spread).all()


@settings(max_examples=40, deadline=None)
@given(st.floats(10, 180), st.floats(10, 245))
def test_simcc_peak_has_subbin_precision(x, y):
    bins_x, bins_y = np.arange(384) / 2, np.arange(512) / 2
    rx = 0.9 * np.exp(-((bins_x - x) ** 2) / (2 * 4.9**2))
    ry = 0.8 * np.exp(-((bins_y - y) ** 2) / (2 * 5.66**2))
    peaks = decode_simcc(rx[None].astype(np.float32), ry[None].astype(np.float32), (192, 256))
    np.testing.assert_allclose(peaks.xy[0], [x, y], atol=0.05)
    assert peaks.score[0] == pytest.approx(0.8, abs=0.02)
    assert peaks.spread[0].max() < 3.0


def heatmap_outputs(joints: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
    cells = np.column_stack([np.linspace(8, 40, joints), np.linspace(10, 54, joints)])
    return {"heatmaps": heatmaps(joints, 64, 48, cells)}, 4 * cells


@pytest.mark.parametrize(
    ("joints", "skeleton"), [(17, "coco17"), (16, "mpii16"), (26, "halpe26"), (133, "wholebody133")]
)
def test_heatmap_model_of_each_joint_set(tmp_path, joints, skeleton):
    outputs, expected = heatmap_outputs(joints)
    write_model(tmp_path / "a.onnx", (1, 3, 256, 192), outputs, layout="heatmap")
    model = load(tmp_path)
    assert (model.spec.layout, model.joints.name) == ("heatmap", skeleton)
    np.testing.assert_allclose(model.estimate(IMAGE, BOX).xy, in_image(expected), atol=0.1)


def test_last_of_stacked_heatmaps_is_used(tmp_path):
    cells = np.full((16, 2), 30.0)
    outputs = {"first": heatmaps(16, 64, 64, cells - 10), "second": heatmaps(16, 64, 64, cells)}
    write_model(tmp_path / "hourglass.onnx", (1, 3, 256, 256), outputs, layout="heatmap")
    model = load(tmp_path)
    expected = in_image(np.full((16, 2), 120.0), (256, 256))
    np.testing.assert_allclose(model.estimate(IMAGE, BOX).xy, expected, atol=0.1)


def test_other_joint_set_of_17_comes_from_the_yaml(tmp_path):
    outputs, _ = heatmap_outputs(17)
    write_model(tmp_path / "b.onnx", (1, 3, 256, 192), outputs)
    (tmp_path / "b.yaml").write_text("layout: heatmap\nskeleton: h36m17\nudp: true\nsigma_scale: 0.8\n")
    model = load(tmp_path, pose_model="b")
    assert (model.joints.name, model.spec.udp, model.spec.sigma_scale) == ("h36m17", True, 0.8)


def test_simcc_model(tmp_path):
    x = np.zeros((1, 17, 384), np.float32)
    y = np.zeros((1, 17, 512), np.float32)
    for j in range(17):
        x[0, j] = 0.9 * np.exp(-((np.arange(384) / 2 - (20 + 8 * j)) ** 2) / (2 * 4.9**2))
        y[0, j] = 0.9 * np.exp(-((np.arange(512) / 2 - (30 + 10 * j)) ** 2) / (2 * 5.66**2))
    write_model(tmp_path / "rtmpose.onnx", (1, 3, 256, 192), {"simcc_x": x, "simcc_y": y})
    model = load(tmp_path)
    assert (model.spec.layout, model.spec.colour) == ("simcc", "rgb")
    expected = np.column_stack([20 + 8 * np.arange(17), 30 + 10 * np.arange(17)])
    np.testing.assert_allclose(model.estimate(IMAGE, BOX).xy, in_image(expected), atol=0.1)


def test_movenet_model_takes_uint8_channels_last(tmp_path):
    rows = np.full((1, 1, 17, 3), 0.5, np.float32)
    rows[..., 0] = 0.25  # y comes first
    write_model(tmp_path / "a.onnx", (1, 192, 192, 3), {"out": rows}, TensorProto.UINT8, "movenet")
    model = load(tmp_path)
    assert (model.spec.layout, model.spec.channels_last) == ("movenet", True)
    expected = in_image(np.tile([96.0, 48.0], (17, 1)), (192, 192))
    np.testing.assert_allclose(model.estimate(IMAGE, BOX).xy, expected, atol=0.01)


def test_one_stage_model_gives_the_person_in_the_box(tmp_path):
    inside = np.array([30.0, 30.0, 160.0, 220.0])
    rows = np.zeros((1, 20, 57), np.float32)
    rows[0, 0] = [0, 0, 20, 20, 0.99, 0, *np.tile([5, 5, 0.9], 17)]  # another person
    rows[0, 1] = [*inside, 0.6, 0, *np.tile([100, 120, 0.8], 17)]
    write_model(tmp_path / "yolo11-pose.onnx", (1, 3, 256, 192), {"out": rows})
    (tmp_path / "yolo11-pose.yaml").write_text("layout: yolo-pose-nms\n")
    keypoints = load(tmp_path).estimate(IMAGE, BOX)
    np.testing.assert_allclose(keypoints.xy, in_image(np.tile([100.0, 120.0], (17, 1))), atol=0.01)
    np.testing.assert_allclose(keypoints.score, 0.8, atol=1e-6)


@settings(max_examples=60, deadline=None)
@given(st.floats(-50, 350), st.floats(-50, 450), st.floats(3, 400), st.floats(3, 500))
def test_crop_holds_the_box_and_is_invertible(x, y, width, height):
    box = np.array([x, y, x + width, y + height])
    crop = crop_around(box, (192, 256), 1.25)
    edges = (box.reshape(2, 2) - 0.5 - crop.origin) * crop.scale + np.array(crop.size) / 2
    assert (edges > -1e-3).all()
    assert (edges < np.array(crop.size) + 1e-3).all()
    # A pixel's middle stands at a whole number, half a pixel from its edges.
    np.testing.assert_allclose(crop.to_image(edges - 0.5) + 0.5, box.reshape(2, 2), atol=0.05)


@pytest.mark.parametrize("scale", [0.15, 0.3, 0.7, 2.0])
def test_crop_samples_the_image_at_its_mapping(scale):
    """A bright disc of the image appears at the mapped position."""
    height, width = int(200 / scale) + 40, int(150 / scale) + 40
    y, x = np.mgrid[:height, :width]
    centre, radius = np.array([0.6 * width, 0.4 * height]), 12 / scale
    disc = ((x - centre[0]) ** 2 + (y - centre[1]) ** 2 < radius**2).astype(np.uint8) * 255
    crop = crop_around(np.array([20, 20, width - 20, height - 20], float), (192, 256), 1.25)
    seen = cut(np.repeat(disc[..., None], 3, 2), crop)[..., 0].astype(float)
    cy, cx = np.mgrid[:256, :192]
    middle = np.array([(seen * cx).sum(), (seen * cy).sum()]) / seen.sum()
    np.testing.assert_allclose(crop.to_image(middle), centre, atol=0.35 / crop.scale)


def test_unknown_outputs_are_refused_with_the_layouts(tmp_path):
    write_model(tmp_path / "odd.onnx", (1, 3, 256, 192), {"embedding": np.zeros((1, 512), np.float32)})
    with pytest.raises(InputError, match=r"odd\.yaml, which .* embedding \[1, 512\]; .*\(layout: one of "):
        load(tmp_path, pose_model="odd")


def test_nan_outputs_are_refused(tmp_path):
    outputs, _ = heatmap_outputs(17)
    outputs["heatmaps"][0, 3, 4, 5] = np.nan
    write_model(tmp_path / "a.onnx", (1, 3, 256, 192), outputs, layout="heatmap")
    with pytest.raises(InputError, match="expected finite numbers, got NaN or infinity"):
        load(tmp_path, pose_model="a")


def test_invalid_model_file_is_refused(tmp_path):
    (tmp_path / "a.onnx").write_bytes(b"not a model at all")
    with pytest.raises(InputError, match=r"a\.onnx: expected an ONNX model") as caught:
        load(tmp_path, pose_model="a")
    assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match="expected a 2D pose model"):
        load(tmp_path)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("layout: magic", "layout: expected"),
        ("colour: cmyk", "colour: expected rgb, bgr"),
        ("nonsense: 1", "expected a mapping with"),
        ("std: [1, 0, 1]", "std: expected three positive"),
        ("skeleton: spider8", "skeleton: expected"),
        ("mean: much", "expected lists of numbers"),
        ("{", "expected YAML"),
        ("sigma_scale: 0", "sigma_scale: expected 0.1 to 10; got 0"),
        ("sigma_scale: .nan", "sigma_scale: expected 0.1 to 10"),
        ("sigma_scale: true", "sigma_scale: expected 0.1 to 10; got True"),
        ("sigma_scale: small", "sigma_scale: expected 0.1 to 10; got 'small'"),
        ("box_padding: [1]", "box_padding: expected 1 to 3"),
    ],
)
def test_invalid_yaml_is_refused(tmp_path, text, complaint):
    outputs, _ = heatmap_outputs(17)
    write_model(tmp_path / "a.onnx", (1, 3, 256, 192), outputs)
    (tmp_path / "a.yaml").write_text(text if ":" not in text or "layout" in text else f"layout: heatmap\n{text}")
    with pytest.raises(InputError, match=complaint):
        load(tmp_path, pose_model="a")


def test_folder_without_a_pose_model_is_refused_with_advice(tmp_path):
    with pytest.raises(
        InputError, match=r"expected a 2D pose model \(\.onnx\), found no \.onnx file.*drocap models fetch"
    ):
        load(tmp_path)
    with pytest.raises(InputError, match="found no such folder"):
        load(tmp_path / "nowhere")
