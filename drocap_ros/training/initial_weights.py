"""Weights of an earlier lifter as the beginning of a training."""

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
    """Give a network the weights of the lifter ``path``.

    Raises
    ------
    InputError
        When the file is no lifter of the same layers.
    """
    torch = pytorch()
    vectors, matrices = _weights(path)
    own = [weight for _, weight in network.named_parameters() if weight.ndim == 2]
    named = {name: weight for name, weight in network.named_parameters() if weight.ndim == 1}
    if [m.shape for m in matrices] != [w.shape for w in own] or any(
        name not in vectors or vectors[name].shape != weight.shape for name, weight in named.items()
    ):
        raise InputError(
            f"--initial: expected a lifter of {len(own)} layers and {len(own[0])} channels, found other layers in"
            f" {path.name}; leave it out"
        )
    with torch.no_grad():
        for weight, matrix in zip(own, matrices, strict=True):
            weight.copy_(torch.from_numpy(matrix))
        for name, weight in named.items():
            weight.copy_(torch.from_numpy(vectors[name]))


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
    arrays = {t.name: numpy_helper.to_array(t).astype(np.float32) for t in graph.initializer}
    vectors = {name.removesuffix("_half"): value for name, value in arrays.items() if value.ndim == 1}
    matrices = [np.ascontiguousarray(value.T) for value in arrays.values() if value.ndim == 2]
    return vectors, matrices
