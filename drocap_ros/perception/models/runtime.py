"""One network: of ONNX in onnxruntime, with its execution provider, or of TensorFlow Lite in LiteRT."""

from __future__ import annotations

import contextlib
import os
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from drocap_ros.errors import InputError, first_line

#: Side of the detector's input, px, and the number of its anchors in each cell of a stride.
_SIDE = 224
_ANCHORS = {8: 2, 16: 2, 32: 6}
#: Of a raw row of the detector: the middle of the hips, and a point on the circle about it that holds the body.
_HIPS, _CIRCLE = slice(4, 6), slice(6, 8)
#: Width and height of a standing person's box over the circle's radius.
_SIDES = np.array([1.0, 2.0], np.float32)
#: Least score of MediaPipe's detector; trees and furniture reach it.  Scores from here to 1 become those from 0 to 1.
_LEAST = 0.5
#: Side of the pose network's input, px, and its 39 points, of which these are the joints of ``coco21``.
_POSE_SIDE, _POINTS = 256, 39
_COCO_21 = np.r_[0, 2, 5, 7, 8, 11:17, 23:29, 31, 32, 29, 30]


def anchors() -> np.ndarray:
    """Centres (2254, 2) x y of the detector's anchors, px of its input: by stride, row and column."""
    centres = []
    for stride, count in _ANCHORS.items():
        n = _SIDE // stride
        y, x = np.mgrid[:n, :n]
        cells = (np.stack([x, y], -1).reshape(-1, 2) + 0.5) * stride
        centres.append(np.repeat(cells, count, axis=0))
    return np.concatenate(centres).astype(np.float32)


def as_layout(outputs: list[np.ndarray]) -> list[np.ndarray]:
    """The outputs of either network in its layout: ``yolo``, ``movenet`` with joints in space."""
    shapes = [output.shape for output in outputs]
    if shapes == [(1, 2254, 12), (1, 2254, 1)]:
        return [_people(outputs[0], outputs[1])]
    if len(shapes) == 5 and shapes[0] == (1, 5 * _POINTS) and shapes[4] == (1, 3 * _POINTS):
        return _joints(outputs[0], outputs[1], outputs[4])
    raise InputError(f"expected the detector or pose network BlazePose, found outputs {', '.join(map(str, shapes))}")


def _people(rows: np.ndarray, logits: np.ndarray) -> np.ndarray:
    """(1, 5, 2254): cx cy w h px and score of a standing person."""
    hips, circle = rows[..., _HIPS], rows[..., _CIRCLE]
    sides = np.linalg.norm(circle - hips, axis=2, keepdims=True) * _SIDES
    score = (_sigmoid(logits) - _LEAST) / (1 - _LEAST)
    rows = np.concatenate([hips + anchors(), sides, score], axis=2)
    return np.asarray(rows.swapaxes(1, 2))


def _joints(rows: np.ndarray, person: np.ndarray, space: np.ndarray) -> list[np.ndarray]:
    """(1, 1, 21, 3): y, x as shares of the input, and the visibility, less where the network sees nobody.

    And the joints in space (1, 21, 3): m about the hips' middle, x right, y down, z away along the ray to it.
    """
    points = rows.reshape(1, 1, _POINTS, -1)[:, :, _COCO_21]
    seen = _sigmoid(points[..., 3:4]) * person
    places = np.concatenate([points[..., [1, 0]] / _POSE_SIDE, seen], axis=3)
    return [places.astype(np.float32), space.reshape(1, _POINTS, 3)[:, _COCO_21]]


def _sigmoid(values: np.ndarray) -> np.ndarray:
    return np.asarray(0.5 + 0.5 * np.tanh(0.5 * values))


_PROVIDERS = {
    "cpu": "CPUExecutionProvider",
    "cuda": "CUDAExecutionProvider",
    "tensorrt": "TensorrtExecutionProvider",
    "openvino": "OpenVINOExecutionProvider",
    "coreml": "CoreMLExecutionProvider",
}
#: Without TensorRT, which builds an engine for minutes at the first start.
_AUTO_ORDER = ("cuda", "cpu")

_ELEMENT_TYPES = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(uint8)": np.uint8,
    "tensor(int32)": np.int32,
}


#: Suffixes of networks.
SUFFIXES = (".onnx", ".tflite")


class Tensor(NamedTuple):
    """An input or output of a network; onnxruntime's have the same fields and more."""

    name: str
    shape: Sequence[int]
    type: str


class Model(ABC):
    """A loaded network; ``inputs`` and ``outputs`` have name, shape and type of each tensor.

    path : of its file
    provider : what computes it
    metadata : of the file
    """

    path: Path
    provider: str
    inputs: Sequence[Any]
    outputs: Sequence[Any]
    metadata: dict[str, str]

    @abstractmethod
    def _run(self, tensor: np.ndarray) -> list[np.ndarray]:
        """Outputs, in order."""

    def make_dynamic(self) -> bool:
        """Make the input's height and width dynamic; False where that is impossible."""
        return False

    def make_fixed(self) -> None:  # noqa: B027  # nothing to undo where the size is fixed
        """Undo :meth:`make_dynamic`."""

    def __call__(self, tensor: np.ndarray) -> list[np.ndarray]:
        """Outputs, in order, for one input tensor."""
        try:
            outputs = self._run(tensor)
        except Exception as error:  # noqa: BLE001  # the exceptions of both runtimes have no common base
            raise InputError(
                f"{self.path}: the model stopped: {first_line(error)[:200]}; check its input size"
            ) from None
        for info, value in zip(self.outputs, outputs, strict=True):
            # The sum is NaN or infinite whenever an element is; one pass, no temporary array.
            if value.dtype.kind == "f" and not np.isfinite(value.sum(dtype=np.float64)):
                raise InputError(
                    f"{self.path}: output {info.name}: expected finite numbers, got NaN or infinity; replace the model"
                )
        return outputs


def network_files(folder: Path) -> list[Path]:
    """Networks of a folder, by name."""
    return sorted(path for path in folder.glob("[!.]*") if path.suffix in SUFFIXES)


def open_model(path: Path, threads: int = 1, provider: str = "auto") -> Model:
    """The network of a file; parameters as of :class:`OnnxModel`."""
    return LiteModel(path, threads) if path.suffix == SUFFIXES[1] else OnnxModel(path, threads, provider)


class LiteModel(Model):
    """BlazePose as MediaPipe has it, TensorFlow Lite in LiteRT; its outputs are those of this package's layouts.

    path : the ``.tflite`` file
    threads : on the CPU
    """

    provider = "LiteRT"

    def __init__(self, path: Path, threads: int = 1) -> None:
        self.path, self.metadata = Path(path), {}
        try:
            from ai_edge_litert.interpreter import Interpreter
        except ImportError:
            raise InputError(f"{path}: {MISSING_LITERT}") from None
        try:
            with _silent():
                self._network = Interpreter(str(path), num_threads=threads)
                self._network.allocate_tensors()
            image = self._network.get_input_details()[0]
            self._input = image["index"]
            self._outputs = [tensor["index"] for tensor in self._network.get_output_details()]
            self.inputs = [Tensor(image["name"], [int(side) for side in image["shape"]], "tensor(float)")]
            trial = self._run(np.zeros(self.inputs[0].shape, np.float32))
        except (ValueError, RuntimeError, InputError) as error:
            raise InputError(
                f"{path}: expected a network that LiteRT can run; {first_line(error)[:200]}; fetch it again"
            ) from None
        self.outputs = [Tensor(f"out{i}", value.shape, "tensor(float)") for i, value in enumerate(trial)]

    def _run(self, tensor: np.ndarray) -> list[np.ndarray]:
        self._network.set_tensor(self._input, np.ascontiguousarray(tensor, np.float32))
        self._network.invoke()
        return as_layout([self._network.get_tensor(index) for index in self._outputs])


#: What to do where no LiteRT is.
MISSING_LITERT = "expected the package ai-edge-litert, which runs it, found none; run pip install ai-edge-litert"


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """LiteRT greets on the standard error of the process, which no option changes."""
    kept = os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


class OnnxModel(Model):
    """A loaded ONNX model.

    path : the ``.onnx`` file
    threads : intra-op threads on the CPU
    provider : "auto" or a key of the execution providers
    """

    def __init__(self, path: Path, threads: int = 1, provider: str = "auto") -> None:
        import onnxruntime as ort

        self.path = Path(path)
        if not self.path.is_file():
            raise InputError(f"{self.path}: expected an ONNX model, found no such file; see `drocap models list`")
        options = ort.SessionOptions()
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        options.log_severity_level = 4
        # A spinning thread pool starves the decoder and the other nodes of a companion computer.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        providers = choose_providers(provider, ort.get_available_providers())
        self._open = partial(ort.InferenceSession, sess_options=options, providers=providers)
        try:
            self._session = self._open(str(self.path))
        except Exception as error:  # noqa: BLE001  # onnxruntime's exceptions have no common base
            raise InputError(
                f"{self.path}: expected an ONNX model that onnxruntime {ort.__version__} can run;"
                f" {first_line(error)[:200]}; export or fetch it again"
            ) from None
        self.provider: str = self._session.get_providers()[0]
        self.inputs = self._session.get_inputs()
        self.outputs = self._session.get_outputs()
        self.metadata: dict[str, str] = dict(self._session.get_modelmeta().custom_metadata_map)
        if len(self.inputs) != 1 or self.inputs[0].type not in _ELEMENT_TYPES:
            found = ", ".join(f"{t.name} {t.type}" for t in self.inputs)
            raise InputError(f"{self.path}: expected one image input (float, uint8 or int32), found {found}")
        self._dtype = _ELEMENT_TYPES[self.inputs[0].type]
        self._names = [t.name for t in self.outputs]

    def make_dynamic(self) -> bool:
        """Make the input's height and width dynamic; False where that is impossible.

        On the CPU only: other providers compile for each size.  The caller tests the outputs and calls
        :meth:`make_fixed` where they do not follow the input.
        """
        source = with_dynamic_size(self.path) if self.provider == _PROVIDERS["cpu"] else None
        if source is None:
            return False
        try:
            self._session = self._open(source)
        except Exception:  # noqa: BLE001  # onnxruntime's exceptions have no common base
            return False
        return True

    def make_fixed(self) -> None:
        """Undo :meth:`make_dynamic`."""
        self._session = self._open(str(self.path))

    def _run(self, tensor: np.ndarray) -> list[np.ndarray]:
        return list(self._session.run(self._names, {self.inputs[0].name: tensor.astype(self._dtype, copy=False)}))


def with_dynamic_size(path: Path) -> bytes | None:
    """The model with dynamic height and width of its one image input (N, 3, H, W); None where that is impossible.

    Exports fix both, although a convolutional network accepts any multiple of its stride.  The caller has to test the
    model: constants in the graph may depend on the size.
    """
    try:
        import onnx

        model = onnx.load(path)
    except Exception:  # noqa: BLE001  # no package, protobuf's own errors, no file of external weights
        return None
    inputs = model.graph.input
    if len(inputs) != 1 or len(inputs[0].type.tensor_type.shape.dim) != 4:
        return None
    for axis, name in ((2, "height"), (3, "width")):
        inputs[0].type.tensor_type.shape.dim[axis].dim_param = name
    # Inferred shapes hold the fixed size.
    del model.graph.value_info[:]
    for output in model.graph.output:
        for axis, dimension in enumerate(output.type.tensor_type.shape.dim):
            if axis:
                dimension.dim_param = f"{output.name}_{axis}"
    return bytes(model.SerializeToString())


def choose_providers(wanted: str, offered: list[str]) -> list[str]:
    """Execution providers in order of use, always ending with the CPU."""
    if wanted == "auto":
        return [_PROVIDERS[key] for key in _AUTO_ORDER if _PROVIDERS[key] in offered]
    name = _PROVIDERS.get(wanted, wanted)
    if name not in offered:
        have = ", ".join(key for key, full in _PROVIDERS.items() if full in offered)
        raise InputError(f"provider: expected one of {have} (offered by this onnxruntime), got {wanted!r}")
    cpu = _PROVIDERS["cpu"]
    return [name] if name == cpu else [name, cpu]
