"""An ONNX model whose input may have any height and width."""

from __future__ import annotations

from pathlib import Path


def with_free_size(path: Path) -> bytes | None:
    """The model with height and width of its one image input (N, 3, H, W) left open; None where that cannot be done.

    Exports fix them, though a network of convolutions takes any multiple of its stride.  Whether this one does has to
    be tried: what follows from the size may be written into the graph as constants.
    """
    try:
        import onnx
    except ImportError:
        return None
    try:
        model = onnx.load(path)
    except Exception:  # protobuf's own errors; a file beside the model that is missing
        return None
    inputs = model.graph.input
    if len(inputs) != 1 or len(inputs[0].type.tensor_type.shape.dim) != 4:
        return None
    for axis, name in ((2, "height"), (3, "width")):
        inputs[0].type.tensor_type.shape.dim[axis].dim_param = name
    # What was worked out from the fixed size is worked out again.
    del model.graph.value_info[:]
    for output in model.graph.output:
        for axis, dimension in enumerate(output.type.tensor_type.shape.dim):
            if axis:
                dimension.dim_param = f"{output.name}_{axis}"
    return bytes(model.SerializeToString())
