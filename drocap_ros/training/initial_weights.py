"""Weights of an earlier lifter as the beginning of a training: it may have fewer blocks."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.training.torch_extra import pytorch

if TYPE_CHECKING:
    import torch


def start_from(network: torch.nn.Module, path: Path) -> None:
    """Give a network the weights of the lifter ``path``; its further blocks begin without effect.

    Raises
    ------
    InputError
        When the file is no lifter of this width.
    """
    torch = pytorch()
    vectors, matrices = _weights(path)
    own = dict(network.named_parameters())
    body = [name for name, weight in own.items() if weight.ndim == 2 and name.startswith("body.")]
    # In the order of use: embedding, body, head, signs.
    found = matrices[1:-2]
    names = ["embed.weight", *body[: len(found)], "head.weight", "signs.weight"]
    if len(found) > len(body) or [m.shape for m in matrices] != [tuple(own[name].shape) for name in names]:
        width = own["embed.weight"].shape[0]
        raise InputError(f"--initial: expected a lifter of {width} channels, got {path.name}; leave it out")
    with torch.no_grad():
        for name, vector in vectors.items():
            if name in own and own[name].shape == vector.shape:
                own[name].copy_(torch.from_numpy(vector))
        for name, matrix in zip(names, matrices, strict=True):
            own[name].copy_(torch.from_numpy(matrix))
        for name in body[len(found) :]:
            if name.endswith("out.weight"):
                own[name].zero_()
                own[name.replace("weight", "bias")].zero_()


def origin_of(path: Path) -> str:
    """SHA-256 of a network's file and the command that its metadata names."""
    import onnx

    command = [entry.value for entry in onnx.load(str(path)).metadata_props if entry.key == "command"]
    return f"sha256 {hashlib.sha256(path.read_bytes()).hexdigest()}, made by {''.join(command) or 'an unknown command'}"


def _weights(path: Path) -> tuple[dict[str, np.ndarray], list[np.ndarray]]:
    """Vectors by name and matrices (output, input) in the order of use."""
    import onnx
    from onnx import numpy_helper

    if not path.is_file():
        raise InputError(f"--initial: expected a lifter's ONNX file, found no {path}; leave it out")
    try:
        graph = onnx.load(str(path)).graph
    except Exception as error:
        # Protocol buffers raise classes of their own.
        raise InputError(f"--initial: {path}: expected an ONNX file; {str(error).splitlines()[0][:120]}") from None
    arrays = {t.name.removesuffix("_half"): numpy_helper.to_array(t).astype(np.float32) for t in graph.initializer}
    vectors = {name: value for name, value in arrays.items() if value.ndim == 1}
    # The initializers stand in the order of their names, which are numbers.
    used = [name for node in graph.node if node.op_type == "MatMul" for name in node.input if name in arrays]
    return vectors, [np.ascontiguousarray(arrays[name].T) for name in used]
