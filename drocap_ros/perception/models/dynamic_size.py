"""ONNX model with a dynamic input height and width."""

from __future__ import annotations

from pathlib import Path


def with_dynamic_size(path: Path) -> bytes | None:
    """The model with dynamic height and width of its one image input (N, 3, H, W); None where that is impossible.

    Exports fix both, although a convolutional network accepts any multiple of its stride.  The caller has to test the
    model: constants in the graph may depend on the size.
    """
    try:
        import onnx
    except ImportError:
        return None
    try:
        model = onnx.load(path)
    except Exception:  # protobuf's own errors; a missing file of external weights
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
