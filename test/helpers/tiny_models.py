"""ONNX models of each supported layout with constant outputs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper


def write_model(
    path: Path,
    input_shape: tuple[int, ...],
    outputs: dict[str, np.ndarray],
    element_type: int = TensorProto.FLOAT,
    layout: str = "",
) -> Path:
    """A model with one image input whose outputs are ``outputs`` plus zero times the image's mean, and its YAML."""
    if layout:
        path.with_suffix(".yaml").write_text(f"layout: {layout}\n")
    nodes, initializers, infos = [], [], []
    nodes.append(helper.make_node("Cast", ["image"], ["as_float"], to=TensorProto.FLOAT))
    nodes.append(helper.make_node("ReduceMean", ["as_float"], ["mean"], keepdims=0))
    initializers.append(numpy_helper.from_array(np.float32(0.0), "zero"))
    nodes.append(helper.make_node("Mul", ["mean", "zero"], ["nothing"]))
    for name, value in outputs.items():
        initializers.append(numpy_helper.from_array(np.ascontiguousarray(value), f"{name}_fixed"))
        if value.dtype == np.float32:
            nodes.append(helper.make_node("Add", [f"{name}_fixed", "nothing"], [name]))
        else:
            nodes.append(helper.make_node("Identity", [f"{name}_fixed"], [name]))
        infos.append(helper.make_tensor_value_info(name, helper.np_dtype_to_tensor_dtype(value.dtype), value.shape))
    graph = helper.make_graph(
        nodes, "tiny", [helper.make_tensor_value_info("image", element_type, input_shape)], infos, initializers
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    onnx.checker.check_model(model)
    onnx.save(model, str(path))
    return path


def heatmaps(
    joints: int, rows: int, columns: int, at: np.ndarray, height: float = 0.9, sigma: float = 2.0
) -> np.ndarray:
    """(1, joints, rows, columns) float32 Gaussians at ``at`` (joints, 2) cells."""
    y, x = np.mgrid[:rows, :columns]
    squared = (x[None] - at[:, 0, None, None]) ** 2 + (y[None] - at[:, 1, None, None]) ** 2
    return (height * np.exp(-squared / (2 * sigma**2)))[None].astype(np.float32)
