"""One ONNX model in onnxruntime, with its execution provider and threads."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from drocap_ros.errors import InputError, first_line

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


class OnnxModel:
    """A loaded model; ``inputs`` and ``outputs`` are onnxruntime's name, shape and type of each tensor.

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

    def __call__(self, tensor: np.ndarray) -> list[np.ndarray]:
        """Outputs, in order, for one input tensor."""
        try:
            outputs = self._session.run(self._names, {self.inputs[0].name: tensor.astype(self._dtype, copy=False)})
        except Exception as error:  # noqa: BLE001  # onnxruntime's exceptions have no common base
            raise InputError(
                f"{self.path}: the model stopped: {first_line(error)[:200]}; check its input size"
            ) from None
        for info, value in zip(self.outputs, outputs, strict=True):
            # The sum is NaN or infinite whenever an element is; one pass, no temporary array.
            if value.dtype.kind == "f" and not np.isfinite(value.sum(dtype=np.float64)):
                raise InputError(
                    f"{self.path}: output {info.name}: expected finite numbers, got NaN or infinity; replace the model"
                )
        return list(outputs)


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
