"""Weights of an earlier lifter as the beginning of a training: fewer joints, features and blocks are possible."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.reconstruction.lifted.lifter_input import FEATURES, PARTS
from drocap_ros.skeleton import BODY_15, BODY_17
from drocap_ros.training.torch_extra import pytorch

if TYPE_CHECKING:
    import torch

#: Outputs of a joint: its place, and the logarithms of two expected errors.
_PER_JOINT = 5


def start_from(network: torch.nn.Module, path: Path) -> None:
    """Give a network the weights of the lifter ``path``; its further blocks begin without effect.

    A lifter of ``BODY_15`` is widened: new features begin without effect, new joints at random weights.

    Raises
    ------
    InputError
        When the file is no lifter of this width.
    """
    torch = pytorch()
    vectors, matrices = _weights(path)
    own = [(name, weight) for name, weight in network.named_parameters() if weight.ndim == 2]
    embed, head = network.get_parameter("embed.weight"), network.get_parameter("head.weight")
    same = len(matrices) == len(own)
    body = [(n, w) for n, w in own if n.startswith("body.")]
    found = matrices[1:-2] if same else matrices[1:-1]
    if len(found) > len(body) or any(m.shape != w.shape for m, (_, w) in zip(found, body, strict=False)):
        raise InputError(f"--initial: expected a lifter of {embed.shape[0]} channels, got {path.name}; leave it out")
    with torch.no_grad():
        for name, vector in vectors.items():
            if name in dict(network.named_parameters()) and network.get_parameter(name).shape == vector.shape:
                network.get_parameter(name).copy_(torch.from_numpy(vector))
        for matrix, (_, weight) in zip(found, body, strict=False):
            weight.copy_(torch.from_numpy(matrix))
        for name, weight in body[len(found) :]:
            if name.endswith("out.weight"):
                weight.zero_()
        if same:
            for matrix, weight in zip((matrices[0], *matrices[-2:]), (embed, head, network.signs.weight), strict=True):
                weight.copy_(torch.from_numpy(matrix))
            return
        columns, rows = _widened_features(), _widened_outputs()
        embed.zero_()
        embed[:, columns] = torch.from_numpy(matrices[0])
        head[rows] = torch.from_numpy(matrices[-1])
        network.get_parameter("head.bias")[rows] = torch.from_numpy(vectors["head.bias"])


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


def _widened_features() -> np.ndarray:
    """Places of the features of two frames of ``BODY_15`` among those of ``BODY_17``."""
    few, bones = len(BODY_15), len(BODY_15.bones)
    begin = np.concatenate([[0], np.cumsum(PARTS)])
    frame = np.concatenate([begin[k] + np.arange(count) for k, count in enumerate((2 * few, few, bones, bones))])
    return np.concatenate([frame, FEATURES + frame])


def _widened_outputs() -> np.ndarray:
    """Places of the outputs of two frames of ``BODY_15`` among those of ``BODY_17``."""
    frame = np.arange(len(BODY_15) * _PER_JOINT)
    return np.concatenate([frame, len(BODY_17) * _PER_JOINT + frame])
