"""The optional extra ``train``: PyTorch, its threads, and ONNX files."""

from __future__ import annotations

import copy
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from drocap_ros.errors import DrocapError, InputError

if TYPE_CHECKING:
    import torch


def pytorch() -> Any:
    """PyTorch.

    Raises
    ------
    DrocapError
        When PyTorch is not installed.
    """
    try:
        import torch
    except ImportError:
        raise DrocapError("training needs PyTorch, which is not installed; pip install 'drocap_ros[train]'") from None
    return torch


def _has_bfloat16() -> bool:
    """Whether the processor has bfloat16; others emulate it, many times slower than single precision."""
    return bool(pytorch().cpu.get_capabilities().get("avx512_bf16", False))


def mixed_precision() -> Any:
    """Context of bfloat16 where the processor has it."""
    torch = pytorch()
    return torch.autocast("cpu", dtype=torch.bfloat16, enabled=_has_bfloat16())


def reduced(tensor: torch.Tensor) -> torch.Tensor:
    """The tensor in bfloat16 where the processor has it."""
    return tensor.bfloat16() if _has_bfloat16() else tensor


def set_threads(count: int) -> None:
    """Threads of PyTorch and OpenCV."""
    import cv2

    pytorch().set_num_threads(count)
    cv2.setNumThreads(count)


def write_onnx(
    network: torch.nn.Module,
    example: torch.Tensor,
    path: Path,
    inputs: list[str],
    outputs: list[str],
    axes: dict[str, dict[int, str]],
    facts: dict[str, str],
) -> None:
    """Write a network as ONNX with weights in half precision (computed in single) and ``facts`` as metadata.

    ``axes`` names the variable dimensions per input and output.
    """
    torch = pytorch()
    try:
        import onnx
        from onnx import TensorProto, helper, numpy_helper
    except ImportError:
        raise DrocapError("export needs the package onnx, which is not installed; pip install onnx") from None
    if path.suffix != ".onnx":
        raise InputError(f"--out: expected a file name ending in .onnx, got {path.name!r}")
    network = copy.deepcopy(network).eval().float()
    path.parent.mkdir(parents=True, exist_ok=True)
    with warnings.catch_warnings():
        # The exporter warns of its deprecation and of unfolded slices.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network,
            (example,),
            str(path),
            input_names=inputs,
            output_names=outputs,
            dynamic_axes=axes,
            opset_version=17,
            dynamo=False,
        )
    model = onnx.load(str(path))
    kept, casts = [], []
    for tensor in model.graph.initializer:
        array = numpy_helper.to_array(tensor)
        if array.dtype == np.float32 and array.size > 1024:
            half = numpy_helper.from_array(array.astype(np.float16), tensor.name + "_half")
            kept.append(half)
            casts.append(helper.make_node("Cast", [half.name], [tensor.name], to=TensorProto.FLOAT))
        else:
            kept.append(tensor)
    nodes = casts + list(model.graph.node)
    del model.graph.initializer[:], model.graph.node[:]
    model.graph.initializer.extend(kept)
    model.graph.node.extend(nodes)
    helper.set_model_props(model, facts)
    onnx.checker.check_model(model)
    onnx.save(model, str(path))
