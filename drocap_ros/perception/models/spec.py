"""Specification of a model: inferred from its inputs and outputs, or read from a YAML beside it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from drocap_ros.errors import InputError, first_line
from drocap_ros.perception.models.runtime import OnnxModel
from drocap_ros.skeleton import JOINT_SETS

#: Shapes of a network's outputs.
Shapes = list[tuple[int, ...]]

#: Fields of a :class:`ModelSpec` by their names, in part.
Fields = dict[str, Any]

#: Joint sets by their number of joints.
JOINTS_BY_COUNT = {17: "coco17", 133: "wholebody133", 26: "halpe26", 16: "mpii16"}


def _is_movenet(shapes: Shapes, _: tuple[int, int]) -> bool:
    return len(shapes) == 1 and len(shapes[0]) == 4 and shapes[0][:2] == (1, 1) and shapes[0][3] == 3


def _is_rtmdet_maps(shapes: Shapes, size: tuple[int, int]) -> bool:
    grids = [grid for shape in shapes if len(shape) == 4 and (grid := map_grid(shape, size))]
    strides = {stride for stride, _, _ in grids}
    if len(grids) < len(shapes) or len(strides) < 3:
        return False
    whole = len(grids) == len(strides) and all(channels >= 5 for _, channels, _ in grids)
    return whole or len(grids) == 2 * len(strides)


def _is_heatmap(shapes: Shapes, size: tuple[int, int]) -> bool:
    if any(len(shape) != 4 for shape in shapes):
        return False
    like_the_image = all(rows >= 16 and rows * size[0] == columns * size[1] for _, _, rows, columns in shapes)
    return like_the_image and len({joints for _, joints, _, _ in shapes}) == 1


def _is_simcc(shapes: Shapes, size: tuple[int, int]) -> bool:
    if [len(shape) for shape in shapes] != [3, 3]:
        return False
    x, y = shapes
    return x[:2] == y[:2] and x[2] % size[0] == 0 and y[2] % size[1] == 0


def _is_boxes_nms(shapes: Shapes, size: tuple[int, int]) -> bool:
    if shapes[0][-1] != 5 or len(shapes[0]) not in (2, 3):
        return False
    return shapes[1:] == [shapes[0][:-1]] or (len(shapes) == 1 and shapes[0][-2] not in _anchors(size))


def _is_yolox_grid(shapes: Shapes, size: tuple[int, int]) -> bool:
    if len(shapes) != 1 or len(shapes[0]) not in (2, 3):
        return False
    rows, columns = shapes[0][-2:]
    # 57 = box, objectness, class and 17 joints of YOLO-pose, hardly 52 classes.
    return rows in _anchors(size) and columns not in {*_anchors(size), 57}


@dataclass(frozen=True)
class _Layout:
    """Meaning of a network's outputs.

    task : "detector", "pose" or "both"
    fits : whether outputs of these shapes have it, for an input size; None = it has to be named in a YAML
    fields : of the specification, where they differ from its defaults
    joints : axis of the last output with the joints; None = 17 of COCO, or a detector
    """

    task: str
    fits: Callable[[Shapes, tuple[int, int]], bool] | None = None
    fields: Fields = field(default_factory=dict)
    joints: int | None = None


_RAW_BGR: Fields = {"colour": "bgr"}
_UNIT_RGB: Fields = {"std": (255.0, 255.0, 255.0), "letterbox": "centre"}
_IMAGENET: Fields = {"mean": (123.675, 116.28, 103.53), "std": (58.395, 57.12, 57.375)}
_MMDET: Fields = {"mean": (103.53, 116.28, 123.675), "std": (57.375, 57.12, 58.395), "colour": "bgr"}

#: The first one that fits is inferred.  Those of other families than the registry's are named in a YAML.
LAYOUTS = {
    "movenet": _Layout("pose", _is_movenet, joints=2),
    "rtmdet-maps": _Layout("detector", _is_rtmdet_maps, _MMDET),
    "heatmap": _Layout("pose", _is_heatmap, _IMAGENET, joints=1),
    "simcc": _Layout("pose", _is_simcc, _IMAGENET, joints=1),
    "boxes-nms": _Layout("detector", _is_boxes_nms),
    "yolox-grid": _Layout("detector", _is_yolox_grid, _RAW_BGR),
    "yolo": _Layout("detector", fields=_UNIT_RGB),
    "yolo-nms": _Layout("detector", fields=_UNIT_RGB),
    "yolo-pose": _Layout("both", fields=_UNIT_RGB),
    "yolo-pose-nms": _Layout("both", fields=_UNIT_RGB),
    "rtmo": _Layout("both", fields=_RAW_BGR),
}


@dataclass(frozen=True)
class ModelSpec:
    """Everything an adapter needs; ``MODEL.yaml`` beside ``MODEL.onnx`` may set each field.

    layout : meaning of the outputs, a key of ``LAYOUTS``
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
    sigma_scale : standard deviations of its keypoints over those of :mod:`drocap_ros.perception.pose.uncertainty`
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
    """Spec of a model from one trial run and the YAML beside it."""
    path = model.path.with_suffix(".yaml")
    given = _read_yaml(path)
    size, channels_last = _input_size(model, given)
    outputs = model(np.zeros((1, size[1], size[0], 3) if channels_last else (1, 3, size[1], size[0]), np.float32))
    shapes: Shapes = [output.shape for output in outputs]
    name = given.get("layout") or guess_layout(shapes, size)
    if name is None:
        found = ", ".join(f"{t.name} {list(shape)}" for t, shape in zip(model.outputs, shapes, strict=True))
        raise InputError(
            f"{model.path}: expected the outputs of a known detector or 2D pose model, found {found}; write its layout"
            f" (layout: one of {', '.join(LAYOUTS)}) into {path.name}"
        )
    if name not in LAYOUTS:
        raise InputError(f"{path}: layout: expected {', '.join(LAYOUTS)}; got {name!r}; correct it")
    fields = {"layout": name, "input_size": size, "channels_last": channels_last, "task": LAYOUTS[name].task}
    fields |= LAYOUTS[name].fields | (_family(model.path.stem, given) if name == "boxes-nms" else {})
    if LAYOUTS[name].task != "detector" and "skeleton" not in given:
        fields["skeleton"] = _skeleton(LAYOUTS[name], shapes[-1], model.path.stem)
    return _checked(ModelSpec(**{**fields, **given}), path)


def guess_layout(shapes: Shapes, size: tuple[int, int]) -> str | None:
    """The first layout that fits outputs of these shapes, for an input size (width, height) px; None = none does."""
    return next((name for name, layout in LAYOUTS.items() if layout.fits and layout.fits(shapes, size)), None)


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


def grid_centres(input_size: tuple[int, int], strides: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Corners (A, 2) px of all cells, by stride and row, and their strides (A,)."""
    corners, all_strides = [], []
    for stride in strides:
        columns, rows = input_size[0] // stride, input_size[1] // stride
        y, x = np.mgrid[:rows, :columns]
        corners.append(np.stack([x, y], -1).reshape(-1, 2) * stride)
        all_strides.append(np.full(rows * columns, stride))
    return np.concatenate(corners).astype(np.float32), np.concatenate(all_strides).astype(np.float32)


def _anchors(size: tuple[int, int]) -> set[int]:
    """Possible numbers of a grid's anchors: strides 8, 16, 32 and optionally 64."""
    cells = [(size[0] // stride) * (size[1] // stride) for stride in (8, 16, 32, 64)]
    return {sum(cells[:3]), sum(cells)}


def _input_size(model: OnnxModel, given: Fields) -> tuple[tuple[int, int], bool]:
    """(width, height) px of the input, and whether its channels are last."""
    shape = model.inputs[0].shape
    if len(shape) != 4:
        raise InputError(f"{model.path}: expected an image input (N,3,H,W) or (N,H,W,3), got {list(shape)}")
    channels_last = bool(given.get("channels_last", shape[3] == 3 and shape[1] != 3))
    height, width = shape[1:3] if channels_last else shape[2:]
    width, height = given.get("input_size", (width, height))
    if not all(isinstance(side, int) and side > 0 for side in (width, height)):  # dynamic: the usual ones
        width, height = (640, 640) if any(part in model.path.stem.lower() for part in ("det", "yolo")) else (192, 256)
    return (width, height), channels_last


def _family(stem: str, given: Fields) -> Fields:
    """Input of RTMDet or YOLOX with NMS: their outputs are equal, only the name distinguishes them."""
    for part, fields in (("yolox", _RAW_BGR), ("rtmdet", _MMDET)):
        if part in stem.lower():
            return fields
    if {"mean", "std", "colour"} <= set(given):
        return {}
    raise InputError(
        f"{stem}.onnx: expected rtmdet or yolox in the name, since their outputs (boxes, labels) are alike; rename it"
        f" or write colour, mean and std into {stem}.yaml"
    )


def _skeleton(layout: _Layout, shape: tuple[int, ...], stem: str) -> str:
    """Joint set by the number of joints."""
    count = 17 if layout.joints is None else shape[layout.joints]
    if count not in JOINTS_BY_COUNT:
        raise InputError(
            f"{stem}.onnx: expected {', '.join(map(str, sorted(JOINTS_BY_COUNT)))} joints, found {count}; name its"
            f" joint set as skeleton in {stem}.yaml"
        )
    return JOINTS_BY_COUNT[count]


def _read_yaml(path: Path) -> Fields:
    if not path.is_file():
        return {}
    import yaml

    try:
        values = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError, OSError) as error:
        raise InputError(f"{path}: expected YAML; {first_line(error)}; correct it") from None
    known = [f.name for f in dataclasses.fields(ModelSpec)]
    found: Fields = values if isinstance(values, dict) else {type(values).__name__: None}
    if wrong := sorted(str(name) for name in found if name not in known):
        raise InputError(f"{path}: expected a mapping with {', '.join(known)}; found {', '.join(wrong)}; correct it")
    return _with_numbers(found, path)


def _with_numbers(fields: Fields, path: Path) -> Fields:
    """The fields with tuples of numbers where these are due."""
    lists = {"mean": float, "std": float, "input_size": int}
    try:
        return {name: tuple(map(lists[name], value)) if name in lists else value for name, value in fields.items()}
    except (TypeError, ValueError):
        raise InputError(f"{path}: {', '.join(lists)}: expected lists of numbers; correct them") from None


def _checked(spec: ModelSpec, path: Path) -> ModelSpec:
    """The spec, if all of its values can be."""
    size_fine = len(spec.input_size) == 2 and all(8 <= v <= 8192 for v in spec.input_size)
    problems = [
        (spec.task in ("detector", "pose", "both"), "task", "detector, pose, both"),
        (size_fine, "input_size", "[width, height] px"),
        (spec.colour in ("rgb", "bgr"), "colour", "rgb, bgr"),
        (spec.letterbox in ("corner", "centre"), "letterbox", "corner, centre"),
        (len(spec.mean) == 3 and np.isfinite(spec.mean).all(), "mean", "three numbers"),
        (len(spec.std) == 3 and all(v > 0 for v in spec.std), "std", "three positive numbers"),
        (spec.task == "detector" or spec.skeleton in JOINT_SETS, "skeleton", ", ".join(JOINT_SETS)),
        (_within(spec.box_padding, 1, 3), "box_padding", "1 to 3"),
        (_within(spec.sigma_scale, 0.1, 10), "sigma_scale", "0.1 to 10"),
    ]
    for fine, name, expected in problems:
        if not fine:
            raise InputError(f"{path}: {name}: expected {expected}; got {getattr(spec, name)!r}; correct it")
    return spec


def _within(value: object, least: float, most: float) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and least <= value <= most
