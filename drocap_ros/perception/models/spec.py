"""Specification of a model: inferred from its inputs and outputs, or read from a YAML beside it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.perception.models.runtime import OnnxModel

DETECTOR_LAYOUTS = ("rtmdet-maps", "yolox-grid", "boxes-nms", "yolo-nms", "yolo", "yolo-pose", "yolo-pose-nms", "rtmo")
POSE_LAYOUTS = ("heatmap", "simcc", "movenet", "yolo-pose", "yolo-pose-nms", "rtmo")

_LAYOUTS = tuple(dict.fromkeys(DETECTOR_LAYOUTS + POSE_LAYOUTS))

_RAW_BGR: dict[str, Any] = {"colour": "bgr"}
_UNIT_RGB: dict[str, Any] = {"std": (255.0, 255.0, 255.0), "letterbox": "centre"}
_IMAGENET: dict[str, Any] = {"mean": (123.675, 116.28, 103.53), "std": (58.395, 57.12, 57.375)}
_MMDET: dict[str, Any] = {"mean": (103.53, 116.28, 123.675), "std": (57.375, 57.12, 58.395), "colour": "bgr"}
#: Input of each layout that does not take plain RGB.
_INPUTS = {
    "rtmdet-maps": _MMDET, "yolox-grid": _RAW_BGR, "rtmo": _RAW_BGR, "heatmap": _IMAGENET, "simcc": _IMAGENET,
    "yolo": _UNIT_RGB, "yolo-nms": _UNIT_RGB, "yolo-pose": _UNIT_RGB, "yolo-pose-nms": _UNIT_RGB,
}  # fmt: skip

#: Joint sets by their number of joints.
JOINTS_BY_COUNT = {17: "coco17", 133: "wholebody133", 26: "halpe26", 16: "mpii16"}


@dataclass(frozen=True)
class ModelSpec:
    """Everything an adapter needs; ``MODEL.yaml`` beside ``MODEL.onnx`` may set each field.

    layout : meaning of the outputs, one of DETECTOR_LAYOUTS or POSE_LAYOUTS
    task : "detector", "pose" or "both"
    input_size : (width, height) px
    channels_last : NHWC input
    colour : "rgb" or "bgr"; mean, std : per channel of that order, in 0-255 units
    letterbox : place of the image in a detector's input: "corner" or "centre"
    skeleton : joint set of the keypoints ("" for a detector)
    person_class : class index of a person
    decoded : for "yolox-grid": whether the outputs are px
    udp : for "heatmap": trained with unit-length coordinates (MMPose's UDPHeatmap; its ViTPose and later HRNets)
    box_padding : side of the pose crop over that of the box
    sigma_scale : standard deviations of its keypoints over those of :mod:`drocap_ros.perception.uncertainty`
    """

    layout: str
    task: str
    input_size: tuple[int, int]
    channels_last: bool = False
    colour: str = "rgb"
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    std: tuple[float, float, float] = (1.0, 1.0, 1.0)
    letterbox: str = "corner"
    skeleton: str = ""
    person_class: int = 0
    decoded: bool = False
    udp: bool = False
    box_padding: float = 1.25
    sigma_scale: float = 1.0


def read_spec(model: OnnxModel) -> ModelSpec:
    """Spec of a model from one trial run and the YAML beside it.

    Raises
    ------
    InputError
        When the outputs fit no known layout, or the YAML is invalid.
    """
    overrides = _read_yaml(model.path.with_suffix(".yaml"))
    size, channels_last = _input_size(model, overrides)
    shape = (1, size[1], size[0], 3) if channels_last else (1, 3, size[1], size[0])
    outputs = model(np.full(shape, 0, np.float32))
    fields: dict[str, Any] = {"input_size": size, "channels_last": channels_last}
    layout = overrides.get("layout") or guess_layout([o.shape for o in outputs], size)
    if layout is None:
        found = ", ".join(f"{t.name} {list(o.shape)}" for t, o in zip(model.outputs, outputs, strict=True))
        raise InputError(
            f"{model.path}: expected the outputs of a known detector or 2D pose model, found {found}; write its layout"
            f" (one of {', '.join(_LAYOUTS)}) into {model.path.stem}.yaml"
        )
    fields.update(_defaults(layout, outputs, model.path.stem.lower(), size, overrides))
    fields.update(overrides)
    return _checked(ModelSpec(**fields), model.path)


def guess_layout(shapes: list[tuple[int, ...]], input_size: tuple[int, int]) -> str | None:
    """Layout from the shapes of the outputs, or None."""
    width, height = input_size
    if all(len(s) == 4 for s in shapes):
        if len(shapes) == 1 and shapes[0][:2] == (1, 1) and shapes[0][3] == 3:
            return "movenet"
        grids = [map_grid(s, input_size) for s in shapes]
        strides = {g[0] for g in grids if g}
        if all(grids) and len(strides) == len(shapes) >= 3 and all(g and g[1] >= 5 for g in grids):
            return "rtmdet-maps"
        if all(grids) and len(shapes) == 2 * len(strides) and len(strides) >= 3:
            return "rtmdet-maps"
        if len({s[1] for s in shapes}) == 1 and all(s[2] * width == s[3] * height and s[2] >= 16 for s in shapes):
            return "heatmap"
        return None
    if len(shapes) == 2:
        first, second = shapes
        if len(first) == 3 and first[-1] == 5:
            if len(second) == 4 and second[-1] == 3:
                return "rtmo"
            if second == first[:-1]:
                return "boxes-nms"
        if (
            len(first) == len(second) == 3
            and first[:2] == second[:2]
            and first[2] % width == 0
            and second[2] % height == 0
        ):
            return "simcc"
        return None
    if len(shapes) != 1 or len(shapes[0]) not in (2, 3):
        return None
    rows, columns = shapes[0][-2:]
    anchors = _anchors(input_size)
    if rows in anchors and columns not in anchors:
        return "yolo-pose" if _holds_keypoints(columns, 6) else "yolox-grid"
    if columns in anchors:
        return "yolo-pose" if _holds_keypoints(rows, 5) or _holds_keypoints(rows, 6) else "yolo"
    if columns in (5, 6):
        return "boxes-nms" if columns == 5 else "yolo-nms"
    return "yolo-pose-nms" if columns > 6 and (columns - 6) % 3 == 0 else None


def _holds_keypoints(channels: int, first: int) -> bool:
    """Whether an anchor's row holds ``first`` numbers, then x, y, score of a known number of joints."""
    if channels in (84, 85):  # box and 80 classes of COCO; 26 joints would also fit
        return False
    return (channels - first) % 3 == 0 and (channels - first) // 3 in JOINTS_BY_COUNT


def map_grid(shape: tuple[int, ...], input_size: tuple[int, int]) -> tuple[int, int, bool] | None:
    """(stride, channels, channels last) of a detection map (1, ., ., .); None when it fits no stride."""
    width, height = input_size
    for stride in (8, 16, 32, 64):
        cells = (height // stride, width // stride)
        if shape[1:3] == cells:
            return stride, shape[3], True
        if shape[2:] == cells:
            return stride, shape[1], False
    return None


def _anchors(input_size: tuple[int, int]) -> set[int]:
    """Possible numbers of anchors: strides 8, 16, 32 and optionally 64, one or three anchors per cell."""
    cells = [(input_size[0] // s) * (input_size[1] // s) for s in (8, 16, 32, 64)]
    return {sum(cells[:3]), sum(cells), 3 * sum(cells[:3]), 3 * sum(cells)}


def _input_size(model: OnnxModel, overrides: Mapping[str, Any]) -> tuple[tuple[int, int], bool]:
    info = model.inputs[0]
    if len(info.shape) != 4:
        raise InputError(f"{model.path}: expected an image input (N,3,H,W) or (N,H,W,3), got {list(info.shape)}")
    channels_last = bool(overrides.get("channels_last", info.shape[3] == 3 and info.shape[1] != 3))
    height, width = info.shape[1:3] if channels_last else info.shape[2:]
    if "input_size" in overrides:
        width, height = overrides["input_size"]
    if not all(isinstance(side, int) and side > 0 for side in (width, height)):  # dynamic
        many = len(model.outputs) == 2 or (len(model.outputs[0].shape) == 4)
        width, height = (192, 256) if many and "det" not in model.path.stem.lower() else (640, 640)
    return (int(width), int(height)), channels_last


def _defaults(
    layout: str, outputs: list[np.ndarray], stem: str, size: tuple[int, int], overrides: Mapping[str, Any]
) -> dict[str, Any]:
    detects, poses = layout in DETECTOR_LAYOUTS, layout in POSE_LAYOUTS
    task = "both" if detects and poses else "pose" if poses else "detector"
    fields: dict[str, Any] = {"layout": layout, "task": task}
    if detects or poses:
        fields |= _INPUTS.get(layout, {})
    if layout == "yolox-grid":
        fields["decoded"] = is_decoded_grid(outputs[0], size)
    elif layout == "boxes-nms":
        # RTMDet and YOLOX with NMS have equal outputs but different inputs; only the name distinguishes them.
        if "yolox" in stem:
            fields |= _RAW_BGR
        elif "rtmdet" in stem:
            fields |= _MMDET
        elif not {"mean", "std", "colour"} <= set(overrides):
            raise InputError(
                f"{stem}.onnx: expected rtmdet or yolox in the name, since their outputs (boxes, labels) are alike;"
                f" rename it or write colour, mean and std into {stem}.yaml"
            )
    if task != "detector":
        fields["skeleton"] = _skeleton(layout, outputs, stem, overrides)
    return fields


def _skeleton(layout: str, outputs: list[np.ndarray], stem: str, overrides: Mapping[str, Any]) -> str:
    if "skeleton" in overrides:
        return str(overrides["skeleton"])
    last = outputs[-1].shape
    if layout in ("movenet", "rtmo"):
        count = last[2]
    elif layout == "yolo-pose":
        channels = min(last[-2:])
        count = (channels - 5) // 3 if (channels - 5) % 3 == 0 else (channels - 6) // 3
    elif layout == "yolo-pose-nms":
        count = (last[-1] - 6) // 3
    else:
        count = last[1]
    if count == 17 and ("h36m" in stem or "human36m" in stem):
        return "h36m17"
    if count not in JOINTS_BY_COUNT:
        raise InputError(
            f"{stem}.onnx: expected {', '.join(map(str, sorted(JOINTS_BY_COUNT)))} joints, found {count}; name its"
            f" joint set as skeleton in {stem}.yaml"
        )
    return JOINTS_BY_COUNT[count]


def is_decoded_grid(output: np.ndarray, input_size: tuple[int, int]) -> bool:
    """Whether a YOLOX output is in px: its centres then lie near their own cells.

    output : (1, A, 5 + classes)
    """
    centres, strides = grid_centres(input_size, (8, 16, 32))
    if output.shape[-2] != len(centres):
        return False
    distance = np.linalg.norm(output.reshape(output.shape[-2:])[:, :2] - centres, axis=1)
    return bool(np.median(distance / strides) < 4.0)


def grid_centres(input_size: tuple[int, int], strides: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Corners (A, 2) px of all cells, by stride and row, and their strides (A,)."""
    corners, all_strides = [], []
    for stride in strides:
        columns, rows = input_size[0] // stride, input_size[1] // stride
        y, x = np.mgrid[:rows, :columns]
        corners.append(np.stack([x, y], -1).reshape(-1, 2) * stride)
        all_strides.append(np.full(rows * columns, stride))
    return np.concatenate(corners).astype(np.float32), np.concatenate(all_strides).astype(np.float32)


def _read_yaml(path: Path) -> dict[str, Any]:
    if not path.is_file():
        return {}
    import yaml

    try:
        values = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError, OSError) as error:
        raise InputError(f"{path}: expected YAML; {str(error).splitlines()[0]}; correct it") from None
    known = [f.name for f in dataclasses.fields(ModelSpec)]
    if not isinstance(values, dict) or set(values) - set(known):
        wrong = sorted(map(str, set(values) - set(known))) if isinstance(values, dict) else [type(values).__name__]
        raise InputError(f"{path}: expected a mapping with {', '.join(known)}; found {', '.join(wrong)}; correct it")
    try:
        for name in ("mean", "std"):
            if name in values:
                values[name] = tuple(float(v) for v in values[name])
        if "input_size" in values:
            values["input_size"] = tuple(int(v) for v in values["input_size"])
    except (TypeError, ValueError):
        raise InputError(f"{path}: mean, std, input_size: expected lists of numbers; correct them") from None
    return values


def _checked(spec: ModelSpec, path: Path) -> ModelSpec:
    from drocap_ros.skeleton import JOINT_SETS

    size_fine = len(spec.input_size) == 2 and all(8 <= v <= 8192 for v in spec.input_size)
    problems = [
        (spec.layout in _LAYOUTS, "layout", ", ".join(_LAYOUTS), spec.layout),
        (spec.task in ("detector", "pose", "both"), "task", "detector, pose, both", spec.task),
        (size_fine, "input_size", "[width, height] px", spec.input_size),
        (spec.colour in ("rgb", "bgr"), "colour", "rgb, bgr", spec.colour),
        (spec.letterbox in ("corner", "centre"), "letterbox", "corner, centre", spec.letterbox),
        (len(spec.mean) == 3 and np.isfinite(spec.mean).all(), "mean", "three numbers", spec.mean),
        (len(spec.std) == 3 and all(v > 0 for v in spec.std), "std", "three positive numbers", spec.std),
        (spec.task == "detector" or spec.skeleton in JOINT_SETS, "skeleton", ", ".join(JOINT_SETS), spec.skeleton),
        (_within(spec.box_padding, 1, 3), "box_padding", "1 to 3", spec.box_padding),
        (_within(spec.sigma_scale, 0.1, 10), "sigma_scale", "0.1 to 10", spec.sigma_scale),
    ]
    for fine, name, expected, found in problems:
        if not fine:
            raise InputError(f"{path.with_suffix('.yaml')}: {name}: expected {expected}; got {found!r}; correct it")
    return spec


def _within(value: Any, least: float, most: float) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and least <= value <= most
