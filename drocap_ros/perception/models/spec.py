"""Specification of a model: of a known one by its content, else from a YAML beside it."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drocap_ros.errors import InputError, first_line
from drocap_ros.perception.models.fetch import KNOWN_MODELS, sha256_of
from drocap_ros.perception.models.runtime import Model, network_files, open_model
from drocap_ros.skeleton import JOINT_SETS

#: Fields of a :class:`ModelSpec` by their names, in part.
Fields = dict[str, Any]

_UNIT_RGB: Fields = {"std": (255.0, 255.0, 255.0), "letterbox": "centre"}
_IMAGENET: Fields = {"mean": (123.675, 116.28, 103.53), "std": (58.395, 57.12, 57.375)}
_RAW_BGR: Fields = {"colour": "bgr", "mean": (0.0, 0.0, 0.0), "std": (1.0, 1.0, 1.0)}
_MMDET: Fields = {"mean": (103.53, 116.28, 123.675), "std": (57.375, 57.12, 58.395), "colour": "bgr"}

#: Tasks and fields, where they differ from the defaults, of the layouts.
LAYOUTS: dict[str, tuple[str, Fields]] = {
    "movenet": ("pose", {}),
    "rtmdet-maps": ("detector", _MMDET),
    "heatmap": ("pose", _IMAGENET),
    "simcc": ("pose", _IMAGENET),
    "boxes-nms": ("detector", {}),
    "yolox-grid": ("detector", _RAW_BGR),
    "yolo": ("detector", _UNIT_RGB),
    "yolo-nms": ("detector", _UNIT_RGB),
    "yolo-pose": ("both", _UNIT_RGB),
    "yolo-pose-nms": ("both", _UNIT_RGB),
    "rtmo": ("both", _RAW_BGR),
}
#: Axis of the last output with the joints; of the others 17 of COCO.
_JOINT_AXIS = {"movenet": 2, "heatmap": 1, "simcc": 1}
_JOINTS_BY_COUNT = {17: "coco17", 133: "wholebody133", 26: "halpe26", 16: "mpii16"}
#: Known networks by the names and ranks of their outputs; their publishers export them so.
KNOWN: dict[tuple[tuple[str, int], ...], Fields] = {
    (("simcc_x", 3), ("simcc_y", 3)): {"layout": "simcc"},  # RTMPose
    (("output", 3),): {"layout": "yolox-grid"},  # YOLOX of Megvii
    (("1211", 4), ("1213", 4), ("1215", 4)): {"layout": "rtmdet-maps"},  # RTMDet-nano without NMS
    (("conv2d_441.tmp_1/Result", 4),): {"layout": "heatmap"},  # PP-TinyPose
    (("conv2d_441.tmp_1", 4),): {"layout": "heatmap"},
    (("StatefulPartitionedCall:0", 4),): {"layout": "movenet"},
    (("out0", 3),): {"layout": "yolo", "mean": (127.5,) * 3, "std": (127.5,) * 3},  # BlazePose
    (("out0", 4), ("out1", 3)): {"layout": "movenet", "skeleton": "coco21", "std": (255.0,) * 3},
    (("grid", 3),): {"layout": "yolox-grid"},  # the shipped ones
    (("columns", 3), ("rows", 3)): {"layout": "simcc"},
}
#: Outputs that RTMDet and YOLOX with NMS share: the checksum tells which.
_SHARED = (("dets", 3), ("labels", 2))


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
    sigma_scale : standard deviations of its keypoints over those of :mod:`drocap_ros.perception.pose.body_pose`
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


def read_spec(model: Model) -> ModelSpec:
    """Spec of a model: that of a known one, and what the YAML beside it states."""
    path = model.path.with_suffix(".yaml")
    given = _read_yaml(path)
    size, channels_last = _input_size(model, given)
    shapes = [value.shape for value in model(np.zeros(_input_shape(size, channels_last), np.float32))]
    fields = _known(model, shapes) | given
    if fields.get("layout") is None:
        found = ", ".join(f"{t.name} {list(shape)}" for t, shape in zip(model.outputs, shapes, strict=True))
        raise InputError(
            f"{model.path}: expected a known network or {path.name}, which says what it is, found outputs {found};"
            f" `drocap models list --write` writes one to fill in (layout: one of {', '.join(LAYOUTS)})"
        )
    if fields["layout"] not in LAYOUTS:
        raise InputError(f"{path}: layout: expected {', '.join(LAYOUTS)}; got {fields['layout']!r}; correct it")
    task, usual = LAYOUTS[fields["layout"]]
    if fields["layout"] == "boxes-nms" and not _RAW_BGR.keys() <= fields.keys():
        raise InputError(f"{path}: expected {', '.join(_RAW_BGR)}, which RTMDet and YOLOX do not share; write them")
    first = {"task": task, "input_size": size, "channels_last": channels_last}
    if task != "detector" and "skeleton" not in fields:
        first["skeleton"] = _skeleton(_JOINT_AXIS.get(fields["layout"]), shapes[-1], model.path)
    return _checked(ModelSpec(**{**first, **usual, **fields}), path)


def _input_shape(size: tuple[int, int], channels_last: bool) -> tuple[int, ...]:
    return (1, size[1], size[0], 3) if channels_last else (1, 3, size[1], size[0])


def _skeleton(axis: int | None, shape: tuple[int, ...], path: Path) -> str:
    """Joint set by the number of joints."""
    count = 17 if axis is None else shape[axis]
    if count not in _JOINTS_BY_COUNT:
        raise InputError(
            f"{path}: expected {', '.join(map(str, sorted(_JOINTS_BY_COUNT)))} joints, found {count}; name its joint"
            f" set as skeleton in {path.stem}.yaml"
        )
    return _JOINTS_BY_COUNT[count]


def _known(model: Model, shapes: list[tuple[int, ...]]) -> Fields:
    outputs = tuple((tensor.name, len(shape)) for tensor, shape in zip(model.outputs, shapes, strict=True))
    if outputs == _SHARED:
        digest = sha256_of(model.path)
        family = next((known.name for known in KNOWN_MODELS if known.sha256 == digest), "")
        return {"layout": "boxes-nms", **(_RAW_BGR if family.startswith("yolox") else _MMDET)} if family else {}
    return KNOWN.get(outputs, {})


def write_specs(folder: Path) -> list[Path]:
    """Write a YAML to fill in beside each network of a folder that is not known and has none."""
    written = []
    for file in network_files(folder):
        path = file.with_suffix(".yaml")
        if path.exists():
            continue
        model = open_model(file)
        try:
            read_spec(model)
        except InputError:
            lines = [f"# {tensor.name}: {list(tensor.shape)}" for tensor in (*model.inputs, *model.outputs)]
            lines += [f"layout:  # one of {', '.join(LAYOUTS)}", f"# skeleton: one of {', '.join(JOINT_SETS)}"]
            defaults = dataclasses.asdict(ModelSpec("", "", (192, 256))).items()
            values = ((name, list(value) if isinstance(value, tuple) else value) for name, value in defaults)
            lines += [f"# {name}: {str(value).lower()}" for name, value in values if value != ""]
            path.write_text("\n".join([*lines, ""]), encoding="utf-8")
            written.append(path)
    return written


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


def _input_size(model: Model, given: Fields) -> tuple[tuple[int, int], bool]:
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
