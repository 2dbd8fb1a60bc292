"""BlazePose (Bazarevsky et al., 2020) as this package's networks: its two TensorFlow Lite files with our outputs.

The detector's output becomes that of the layout ``yolo``, a box for each anchor; the pose network's that of
``movenet``, the joints of ``coco21``.  MediaPipe's graphs ``pose_detection`` and ``pose_landmark`` give the meaning of
the numbers.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from drocap_ros.perception.models.tflite import as_onnx, node

if TYPE_CHECKING:
    import onnx

#: Names of the written networks.
DETECTOR, POSE = "blazepose-detector", "blazepose-full"

#: Side of the detector's input, px, and the strides of its anchors: two anchors a cell for each entry.
_SIDE = 224
_STRIDES = (8, 16, 32, 32, 32)
#: Of a raw row of the detector: the middle of the hips, and a point on the circle about it that holds the body.
_HIPS, _CIRCLE = slice(4, 6), slice(6, 8)
#: Width of a standing person's box over its height; the network gives a circle.
_SLENDER = 0.5

#: Least score of MediaPipe's detector; trees and furniture reach it.  Scores from here to 1 become those from 0 to 1.
_LEAST = 0.5

#: BlazePose's 39 points, of which these are the joints of ``coco21``.
_COCO_21 = (0, 2, 5, 7, 8, 11, 12, 13, 14, 15, 16, 23, 24, 25, 26, 27, 28, 31, 32, 29, 30)

#: ONNX's version of the operators, and of the file: what the oldest onnxruntime of this package reads.
_OPERATORS, _FILE = 17, 8

_DETECTOR_YAML = "layout: yolo\ninput_size: [224, 224]\nmean: [127.5, 127.5, 127.5]\nstd: [127.5, 127.5, 127.5]\n"
_POSE_YAML = "layout: movenet\nskeleton: coco21\nstd: [255, 255, 255]\n"


def anchors() -> np.ndarray:
    """Centres (2254, 2) x y of the detector's anchors, px of its input: by stride, row and column."""
    centres = []
    for stride in sorted(set(_STRIDES)):
        n = _SIDE // stride
        y, x = np.mgrid[:n, :n]
        cells = (np.stack([x, y], -1).reshape(-1, 2) + 0.5) * stride
        centres.append(np.repeat(cells, 2 * _STRIDES.count(stride), axis=0))
    return np.concatenate(centres).astype(np.float32)


def write_blazepose(tflite: Path, target: Path) -> None:
    """Write one of both networks with its YAML; the stem of ``target`` says which.

    tflite : MediaPipe's ``pose_detection.tflite`` or ``pose_landmark_full.tflite`` (or lite, heavy)
    """
    import onnx
    from onnx import helper, numpy_helper

    head, yaml = (_detector_head, _DETECTOR_YAML) if target.stem == DETECTOR else (_pose_head, _POSE_YAML)
    graph, outputs = as_onnx(tflite)
    nodes, constants, shapes = head(outputs)
    graph.node.extend(nodes)
    graph.initializer.extend(numpy_helper.from_array(value, key) for key, value in constants.items())
    del graph.output[:]
    graph.output.extend(
        helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, shape) for name, shape in shapes.items()
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", _OPERATORS)], ir_version=_FILE)
    onnx.checker.check_model(model)
    target.with_suffix(".yaml").write_text(yaml, encoding="ascii")
    onnx.save(model, target)


#: Nodes, constants, shapes of the outputs.
_Head: TypeAlias = "tuple[list[onnx.NodeProto], dict[str, np.ndarray], dict[str, tuple[int, ...]]]"


def _detector_head(outputs: list[str]) -> _Head:
    """Rows (1, 5, 2254): cx cy w h px and score of a standing person."""
    rows, logits = outputs
    constants = {
        "hips": np.arange(_HIPS.start, _HIPS.stop), "circle": np.arange(_CIRCLE.start, _CIRCLE.stop),
        "anchors": anchors()[None], "size": np.array([2 * _SLENDER, 2.0], np.float32),
        "least": np.array(_LEAST, np.float32), "rest": np.array(1 - _LEAST, np.float32),
    }  # fmt: skip
    nodes = [
        node("Gather", [rows, "hips"], "from_anchor", axis=2),
        node("Gather", [rows, "circle"], "on_circle", axis=2),
        node("Add", ["from_anchor", "anchors"], "centre"),
        node("Sub", ["on_circle", "from_anchor"], "spoke"),
        node("ReduceL2", ["spoke"], "radius", axes=[2]),
        node("Mul", ["radius", "size"], "sides"),
        node("Sigmoid", [logits], "share"),
        node("Sub", ["share", "least"], "above"),
        node("Div", ["above", "rest"], "score"),
        node("Concat", ["centre", "sides", "score"], "people", axis=2),
        node("Transpose", ["people"], "out", perm=[0, 2, 1]),
    ]
    return nodes, constants, {"out": (1, 5, 2254)}


def _pose_head(outputs: list[str]) -> _Head:
    """Rows (1, 1, 21, 3): y, x as shares of the input, and the visibility, less where the network sees nobody.

    And the joints in space (1, 21, 3): m about the hips' middle, x right, y down, z away along the ray to it.
    """
    rows, person, space = outputs[0], outputs[1], outputs[4]
    constants = {
        "points": np.array([1, 1, 39, 5]), "joints": np.array(_COCO_21), "side": np.array(1 / 256, np.float32),
        "yx": np.array([1, 0]), "visibility": np.array([3]), "in_space": np.array([1, 39, 3]),
    }  # fmt: skip
    nodes = [
        node("Reshape", [rows, "points"], "all_points"),
        node("Gather", ["all_points", "joints"], "coco", axis=2),
        node("Gather", ["coco", "yx"], "yx_px", axis=3),
        node("Mul", ["yx_px", "side"], "places"),
        node("Gather", ["coco", "visibility"], "logits", axis=3),
        node("Sigmoid", ["logits"], "visible"),
        node("Mul", ["visible", person], "score"),
        node("Concat", ["places", "score"], "out", axis=3),
        node("Reshape", [space, "in_space"], "all_space"),
        node("Gather", ["all_space", "joints"], "space", axis=1),
    ]
    return nodes, constants, {"out": (1, 1, len(_COCO_21), 3), "space": (1, len(_COCO_21), 3)}
