"""The optional extra ``train``: PyTorch, its threads, and ONNX files."""

from __future__ import annotations

import copy
import io
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


def onnx_package() -> Any:
    """The package onnx.

    Raises
    ------
    DrocapError
        When it is not installed.
    """
    try:
        import onnx
    except ImportError:
        raise DrocapError("training needs the package onnx, which is not installed; pip install onnx") from None
    return onnx


def _has_bfloat16() -> bool:
    """Whether the processor has bfloat16; others emulate it, many times slower than single precision."""
    return bool(pytorch().cpu.get_capabilities().get("avx512_bf16", False))


def best_device() -> Any:
    """A GPU where PyTorch finds one that it can use, else the processor."""
    torch = pytorch()
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def mixed_precision(device: Any = None) -> Any:
    """Context of bfloat16 where the device (default: the processor) has it."""
    torch = pytorch()
    on_gpu = device is not None and device.type == "cuda"
    # A recorded graph must not keep weights that were cast before it.
    return torch.autocast(
        "cuda" if on_gpu else "cpu",
        dtype=torch.bfloat16,
        enabled=on_gpu or _has_bfloat16(),
        cache_enabled=not on_gpu,
    )


def reduced(tensor: torch.Tensor) -> torch.Tensor:
    """The tensor in bfloat16 where its device has it."""
    return tensor.bfloat16() if tensor.is_cuda or _has_bfloat16() else tensor


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
    exact: tuple[str, ...] | None = None,
) -> None:
    """Write a network as ONNX with weights in half precision, and ``facts`` as metadata.

    It is computed in single precision.  ``axes`` names the variable dimensions per input and output.  With ``exact``
    the weights have eight bits, and a second file, ``NAME_quick.onnx``, has products of integers (:func:`in_integers`)
    but in modules of these names.
    """
    torch, onnx = pytorch(), onnx_package()
    if path.suffix != ".onnx":
        raise InputError(f"--out: expected a file name ending in .onnx, got {path.name!r}")
    network = copy.deepcopy(network).cpu().eval().float()
    path.parent.mkdir(parents=True, exist_ok=True)
    exported = io.BytesIO()
    with warnings.catch_warnings():
        # The exporter warns of its deprecation and of unfolded slices.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network,
            (example,),
            exported,
            input_names=inputs,
            output_names=outputs,
            dynamic_axes=axes,
            opset_version=17,
            dynamo=False,
        )
    for quick in (False,) if exact is None else (False, True):
        model = onnx.load_from_string(exported.getvalue())
        if quick:
            in_integers(model.graph, exact or ())
        _store_small(model.graph, eight_bits=exact is not None)
        onnx.helper.set_model_props(model, facts)
        onnx.checker.check_model(model)
        onnx.save(model, str(path.with_stem(f"{path.stem}_quick") if quick else path))


def in_integers(graph: Any, exact: tuple[str, ...]) -> None:
    """Make an ONNX graph's products with matrices those of integers, but of nodes with one of these names in theirs.

    Values have eight bits by their range in each call, weights a scale for every column.
    """
    from onnx import TensorProto, helper, numpy_helper

    matrices = {tensor.name: tensor for tensor in graph.initializer}
    nodes: list[Any] = []
    for node in graph.node:
        matrix = matrices.get(node.input[1]) if node.op_type == "MatMul" else None
        if matrix is None or any(name in node.name.split("/") for name in exact):
            nodes.append(node)
            continue
        parts = ("codes", "step", "value", "scale", "zero", "product", "real", "both")
        codes, step, value, scale, zero, product, real, both = (f"{node.name}_{part}" for part in parts)
        graph.initializer.remove(matrix)
        for name, array in zip((codes, step), _codes(numpy_helper.to_array(matrix)), strict=True):
            graph.initializer.append(numpy_helper.from_array(array, name))
        # The runtime knows this sequence and computes it at once.
        nodes += [
            helper.make_node("DynamicQuantizeLinear", [node.input[0]], [value, scale, zero]),
            helper.make_node("MatMulInteger", [value, codes, zero], [product]),
            helper.make_node("Cast", [product], [real], to=TensorProto.FLOAT),
            helper.make_node("Mul", [scale, step], [both]),
            helper.make_node("Mul", [real, both], list(node.output)),
        ]
    del graph.node[:]
    graph.node.extend(nodes)


def _codes(weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weights (K, N), K even, as codes of eight bits (K, N) and the step (N,) between them.

    Processors without instructions for neural networks add two neighbours' products in 16 bits: neighbours have no more
    than 128 together, so that 255 times that fits.
    """
    size = np.abs(weights)
    # 127, as rounding may add one.
    step = (size[::2] + size[1::2]).max(axis=0).clip(1e-9) / 127
    return np.rint(weights / step).astype(np.int8), step.astype(np.float32)


#: Most weights along a column of a matrix that share a scale in eight bits.
_BLOCK = 64


def _store_small(graph: Any, *, eight_bits: bool) -> None:
    """Replace the large weights of an ONNX graph by smaller ones; the runtime unfolds them once, when it loads them."""
    from onnx import TensorProto, helper, numpy_helper

    kept, nodes = [], []
    for tensor in graph.initializer:
        array = numpy_helper.to_array(tensor)
        block = _block(array) if eight_bits else 0
        if array.dtype != np.float32 or array.size <= 1024:
            kept.append(tensor)
        elif block:
            # Of the columns (N, M), one per output: codes (N / block, block, M), scales (N / block, 1, M).
            columns = array.reshape(-1, block, array.shape[1])
            scale = np.maximum(np.abs(columns).max(axis=1, keepdims=True) / 127, 1e-6).astype(np.float16)
            codes = np.clip(np.rint(columns / scale), -127, 127).astype(np.int8)
            names = [f"{tensor.name}_{part}" for part in ("codes", "scale", "float", "blocks", "shape", "step")]
            kept += [
                numpy_helper.from_array(codes, names[0]),
                numpy_helper.from_array(scale, names[1]),
                numpy_helper.from_array(np.array(array.shape, np.int64), names[4]),
            ]
            nodes += [
                helper.make_node("Cast", [names[0]], [names[2]], to=TensorProto.FLOAT),
                helper.make_node("Cast", [names[1]], [names[5]], to=TensorProto.FLOAT),
                helper.make_node("Mul", [names[2], names[5]], [names[3]]),
                helper.make_node("Reshape", [names[3], names[4]], [tensor.name]),
            ]
        else:
            half = numpy_helper.from_array(array.astype(np.float16), tensor.name + "_half")
            kept.append(half)
            nodes.append(helper.make_node("Cast", [half.name], [tensor.name], to=TensorProto.FLOAT))
    nodes += list(graph.node)
    del graph.initializer[:], graph.node[:]
    graph.initializer.extend(kept)
    graph.node.extend(nodes)


def _block(array: np.ndarray) -> int:
    """Largest number of weights that divides the columns evenly, at least 16; 0 where there is none."""
    if array.ndim != 2:
        return 0
    return max((n for n in range(16, _BLOCK + 1) if array.shape[0] % n == 0), default=0)
