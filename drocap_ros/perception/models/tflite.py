"""TensorFlow Lite networks as ONNX: the operators of BlazePose, which package registries hold in that form alone.

The file is a FlatBuffer; the numbers of fields and operators are those of TensorFlow's ``schema.fbs``.  Images between
the operators keep ONNX's order of axes, channels before rows and columns: ``RESHAPE`` alone sees TensorFlow's order.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from drocap_ros.errors import InputError

if TYPE_CHECKING:
    import onnx

#: Numbers of ``TensorType`` -> NumPy's types.
_TYPES = {0: np.float32, 1: np.float16, 2: np.int32, 3: np.uint8, 4: np.int64, 9: np.int8}
#: Numbers of ``SparseIndexVector`` -> NumPy's types.
_INDEX: dict[int, type[np.generic]] = {1: np.int32, 2: np.uint16, 3: np.uint8}
#: Places of TensorFlow's axes (image, row, column, channel) in ONNX's order.
_PLACE = (0, 2, 3, 1)

#: Value of a node's attribute.
Attribute: TypeAlias = "int | str | Sequence[int]"
#: Adds the nodes of one operator: converter, inputs, output, options.
_Operator: TypeAlias = "Callable[[_Converter, list[int], int, Table], None]"


def node(kind: str, inputs: list[str], output: str, **attributes: Attribute) -> onnx.NodeProto:
    """A node of ONNX with one output."""
    from onnx import helper

    made = helper.make_node(kind, inputs, [output])
    made.attribute.extend(helper.make_attribute(name, value) for name, value in attributes.items())
    return made


class Table:
    """A table of a FlatBuffer: fields by their number."""

    def __init__(self, data: bytes, place: int) -> None:
        self.data = data
        self.place = place
        self._fields = place - struct.unpack_from("<i", data, place)[0]

    def _find(self, field: int) -> int:
        """Place of a field; 0 = it has its default."""
        size = struct.unpack_from("<H", self.data, self._fields)[0]
        offset = struct.unpack_from("<H", self.data, self._fields + 4 + 2 * field)[0] if 4 + 2 * field < size else 0
        return self.place + offset if offset else 0

    def number(self, field: int, form: str = "i", default: int = 0) -> int:
        """An integer, by its letter of :mod:`struct`."""
        place = self._find(field)
        return int(struct.unpack_from("<" + form, self.data, place)[0]) if place else default

    def table(self, field: int) -> Table:
        """A table below; an empty one where the field is missing."""
        place = self._find(field)
        return Table(self.data, place + self.number(field, "I")) if place else Table(b"\4\0\4\0\4\0\0\0", 4)

    def array(self, field: int, dtype: type[np.generic] = np.int32) -> np.ndarray:
        """A vector of numbers, (N,)."""
        place = self._find(field)
        if not place:
            return np.zeros(0, dtype)
        place += self.number(field, "I")
        return np.frombuffer(self.data, dtype, struct.unpack_from("<I", self.data, place)[0], place + 4)

    def tables(self, field: int) -> list[Table]:
        """A vector of tables."""
        first = self._find(field)
        if not first:
            return []
        first += self.number(field, "I") + 4
        offsets = self.array(field, np.uint32)
        return [Table(self.data, first + 4 * i + int(offset)) for i, offset in enumerate(offsets)]


class _Converter:
    """One graph on its way; ``constants`` are arrays in TensorFlow's order of axes, by the number of the tensor."""

    def __init__(self, data: bytes) -> None:
        model = Table(data, struct.unpack_from("<I", data)[0])
        (self.graph,) = model.tables(2)
        self.tensors = self.graph.tables(0)
        self.codes = [max(code.number(0, "b"), code.number(3)) for code in model.tables(1)]
        self.nodes: list[onnx.NodeProto] = []
        self.initializers: list[onnx.TensorProto] = []
        self.constants: dict[int, np.ndarray] = {}
        buffers = model.tables(4)
        for i, tensor in enumerate(self.tensors):
            content = buffers[tensor.number(2, "I")].array(0, np.uint8)
            if content.size:
                self.constants[i] = self._dense(tensor, content.view(_TYPES[tensor.number(1, "b")]))

    def shape(self, tensor: int) -> tuple[int, ...]:
        """Of a tensor, in TensorFlow's order."""
        return tuple(int(side) for side in self.tensors[tensor].array(0))

    def _dense(self, tensor: Table, values: np.ndarray) -> np.ndarray:
        """Values of a tensor; a sparse one (``SparsityParameters``) holds those of its blocks that are not zero.

        Its levels are the axes in the order of traversal, then the axes within a block.
        """
        shape = tuple(tensor.array(0))
        sparsity = tensor.table(6)
        order, blocks = sparsity.array(0), sparsity.array(1)
        if not order.size:
            return values.reshape(shape)
        levels = sparsity.tables(2)
        places: np.ndarray = np.zeros((1, 0), int)  # of the values, by level
        for level in levels:
            if level.number(0, "b") == 0:  # dense
                size = level.number(1)
                steps = np.tile(np.arange(size), len(places))
                places = np.repeat(places, size, axis=0)
            else:
                kinds = (_INDEX[level.number(field, "B")] for field in (2, 4))
                starts, steps = (
                    level.table(f).array(0, kind).astype(int) for f, kind in zip((3, 5), kinds, strict=True)
                )
                places = np.repeat(places, np.diff(starts), axis=0)
            places = np.column_stack([places, steps])
        index = np.zeros((len(shape), len(places)), int)
        for place, level, axis in zip(places.T, levels, order, strict=True):
            if axis < len(shape):
                index[axis] += place
            else:  # within a block: the axis counted blocks so far
                blocked = blocks[axis - len(shape)]
                index[blocked] = index[blocked] * level.number(1) + place
        dense = np.zeros(shape, values.dtype)
        dense[tuple(index)] = values
        return dense

    def name(self, tensor: int) -> str:
        """Of a tensor in the graph; a constant is written into it."""
        name = f"t{tensor}"
        if tensor in self.constants and all(known.name != name for known in self.initializers):
            value = self.constants[tensor]
            self.constant(name, np.moveaxis(value, 3, 1) if value.ndim == 4 else value)
        return name

    def constant(self, name: str, value: np.ndarray) -> str:
        """Write a constant in ONNX's order of axes."""
        from onnx import numpy_helper

        value = value.astype(np.float32) if value.dtype.kind == "f" else value
        self.initializers.append(numpy_helper.from_array(np.ascontiguousarray(value), name))
        return name

    def add(self, kind: str, inputs: list[str], output: str, activation: int = 0, **attributes: Attribute) -> None:
        """Add a node and its fused activation: 0 none, 1 ReLU, 3 ReLU up to 6."""
        if activation not in (0, 1, 3):
            raise InputError(f"{kind}: expected ReLU or nothing after it, found activation {activation}; use another")
        self.nodes.append(node(kind, inputs, f"{output}_raw" if activation else output, **attributes))
        if activation:
            bounds = (0.0,) if activation == 1 else (0.0, 6.0)
            limits = [self.constant(f"{output}_limit{i}", np.array(v, np.float32)) for i, v in enumerate(bounds)]
            self.nodes.append(node("Clip", [f"{output}_raw", *limits], output))

    def convert(self) -> None:
        """Nodes of all operators."""
        for operator in self.graph.tables(3):
            code = self.codes[operator.number(0, "I")]
            if code not in _OPERATORS:
                raise InputError(
                    f"expected operators {sorted(_OPERATORS)} of TensorFlow Lite, found {code}; use another"
                )
            inputs = [int(i) for i in operator.array(1)]
            _OPERATORS[code](self, inputs, int(operator.array(2)[0]), operator.table(4))


def _padding(same: bool, sides: tuple[int, ...], kernel: tuple[int, ...], stride: tuple[int, ...]) -> list[int]:
    """Rows and columns before and after, as TensorFlow pads: the odd one after."""
    if not same:
        return [0, 0, 0, 0]
    total = [max((-(-n // s) - 1) * s + k - n, 0) for n, k, s in zip(sides, kernel, stride, strict=True)]
    return [t // 2 for t in total] + [t - t // 2 for t in total]


def _convolution(net: _Converter, inputs: list[int], output: int, options: Table, *, depthwise: bool) -> None:
    activation, dilation = (4, 5) if depthwise else (3, 4)
    if options.number(dilation, default=1) != 1 or (depthwise and options.number(3) != 1):
        raise InputError("a convolution: expected no dilation and one kernel a channel; use another model")
    weights = net.constants[inputs[1]]  # (out, rows, columns, in), depthwise (1, rows, columns, channels)
    kernel, stride = weights.shape[1:3], (options.number(2), options.number(1))
    weights = np.transpose(weights, (3, 0, 1, 2) if depthwise else (0, 3, 1, 2))
    net.add(
        "Conv",
        [net.name(inputs[0]), net.constant(f"w{output}", weights), net.name(inputs[2])],
        f"t{output}",
        options.number(activation, "b"),
        strides=stride,
        pads=_padding(options.number(0, "b") == 0, net.shape(inputs[0])[1:3], kernel, stride),
        group=len(weights) if depthwise else 1,
    )


def _pool(net: _Converter, inputs: list[int], output: int, options: Table) -> None:
    kernel, stride = (options.number(4), options.number(3)), (options.number(2), options.number(1))
    pads = _padding(options.number(0, "b") == 0, net.shape(inputs[0])[1:3], kernel, stride)
    names = [net.name(inputs[0])]
    net.add("MaxPool", names, f"t{output}", options.number(5, "b"), kernel_shape=kernel, strides=stride, pads=pads)


def _pad(net: _Converter, inputs: list[int], output: int, _: Table) -> None:
    before, after = net.constants[inputs[1]][[0, 3, 1, 2]].T
    pads = net.constant(f"p{output}", np.array([*before, *after], np.int64))
    net.add("Pad", [net.name(inputs[0]), pads], f"t{output}")


def _resize(net: _Converter, inputs: list[int], output: int, options: Table) -> None:
    rows, columns, channels = net.shape(output)[1:]
    sizes = net.constant(f"s{output}", np.array([1, channels, rows, columns], np.int64))
    place = "align_corners" if options.number(2, "b") else "half_pixel" if options.number(3, "b") else "asymmetric"
    names = [net.name(inputs[0]), "", "", sizes]
    net.add("Resize", names, f"t{output}", mode="linear", coordinate_transformation_mode=place)


def _reshape(net: _Converter, inputs: list[int], output: int, _: Table) -> None:
    if len(net.shape(output)) == 4 and net.shape(output)[1:3] != (1, 1):
        raise InputError("RESHAPE: expected rows of numbers of it, found an image; use another model")
    name = net.name(inputs[0])
    if len(net.shape(inputs[0])) == 4:
        net.add("Transpose", [name], f"n{output}", perm=(0, 2, 3, 1))
        name = f"n{output}"
    net.add("Reshape", [name, net.constant(f"r{output}", np.array(net.shape(output), np.int64))], f"t{output}")


def _join(net: _Converter, inputs: list[int], output: int, options: Table) -> None:
    axis = options.number(0) % len(net.shape(output))
    names = [net.name(i) for i in inputs]
    net.add(
        "Concat",
        names,
        f"t{output}",
        options.number(1, "b"),
        axis=_PLACE[axis] if len(net.shape(output)) == 4 else axis,
    )


def _plain(kind: str, activation: int | None = None) -> _Operator:
    """An operator that treats all axes alike, and the field of its activation."""

    def add(net: _Converter, inputs: list[int], output: int, options: Table) -> None:
        fused = 0 if activation is None else options.number(activation, "b")
        net.add(kind, [net.name(i) for i in inputs], f"t{output}", fused)

    return add


def _constant(net: _Converter, inputs: list[int], output: int, _: Table) -> None:
    """Half precision and sparse weights are constants in full already."""
    net.constants[output] = net.constants[inputs[0]]


def _depth_to_space(net: _Converter, inputs: list[int], output: int, options: Table) -> None:
    net.add("DepthToSpace", [net.name(inputs[0])], f"t{output}", blocksize=options.number(0))


_OPERATORS: dict[int, _Operator] = {
    0: _plain("Add", 0), 2: _join, 3: partial(_convolution, depthwise=False), 4: partial(_convolution, depthwise=True),
    5: _depth_to_space, 6: _constant, 14: _plain("Sigmoid"), 17: _pool, 22: _reshape, 23: _resize, 34: _pad,
    124: _constant,
}  # fmt: skip


def as_onnx(path: Path) -> tuple[onnx.GraphProto, list[str]]:
    """Graph of a network with one image as its input, and the names of its outputs in the file's order.

    The input ``image`` is (1, 3, H, W) float32; outputs of rows keep their shape.
    """
    from onnx import TensorProto, helper

    data = path.read_bytes()
    if data[4:8] != b"TFL3":
        raise InputError(f"{path}: expected a network of TensorFlow Lite, found something else; name another")
    try:
        net = _Converter(data)
        net.convert()
    except (struct.error, IndexError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: expected a whole network of TensorFlow Lite; {error}; fetch it again") from None
    (image,) = (int(i) for i in net.graph.array(1))
    _, height, width, channels = net.shape(image)
    outputs = [f"t{int(i)}" for i in net.graph.array(2)]
    shapes = [net.shape(int(i)) for i in net.graph.array(2)]
    graph = helper.make_graph(
        net.nodes,
        path.stem,
        [helper.make_tensor_value_info(f"t{image}", TensorProto.FLOAT, (1, channels, height, width))],
        [helper.make_tensor_value_info(n, TensorProto.FLOAT, s) for n, s in zip(outputs, shapes, strict=True)],
        net.initializers,
    )
    return graph, outputs
