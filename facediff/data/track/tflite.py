"""A convolutional network of TensorFlow Lite as a graph of ONNX, in memory: the operations of Google's face landmarker.

A ``.tflite`` file is a flatbuffer (google.github.io/flatbuffers): tables with numbered fields. Fields
and operations have the numbers of ``tensorflow/lite/schema/schema.fbs``.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.errors import needs_extra

Array = npt.NDArray[Any]

OPERATIONS = {
    0: "ADD",
    2: "CONCATENATION",
    3: "CONV_2D",
    4: "DEPTHWISE_CONV_2D",
    6: "DEQUANTIZE",
    14: "LOGISTIC",
    17: "MAX_POOL_2D",
    19: "RELU",
    22: "RESHAPE",
    34: "PAD",
    54: "PRELU",
}
TYPES: dict[int, type[np.generic]] = {0: np.float32, 1: np.float16, 2: np.int32}
FUSED = {"CONV_2D": 3, "DEPTHWISE_CONV_2D": 4, "MAX_POOL_2D": 5, "ADD": 0}
"""Field of the activation in the options of an operation."""
EMPTY = struct.pack("<HHi", 4, 4, 4)
"""A table without fields."""
CHANNELS_FIRST, CHANNELS_LAST = (0, 3, 1, 2), (0, 2, 3, 1)


class FlatTable:
    """A table of a flatbuffer.

    Args:
        data: the whole file.
        offset: where the table begins.
    """

    def __init__(self, data: bytes, offset: int) -> None:
        self.data, self.offset = data, offset
        self.offsets = offset - self._read("i", offset)  # of the fields

    def _read(self, form: str, at: int) -> int:
        return int(struct.unpack_from(f"<{form}", self.data, at)[0])

    def _position(self, field: int) -> int | None:
        """Where a field lies; None if the table lacks it."""
        entry = 4 + 2 * field
        step = self._read("H", self.offsets + entry) if entry < self._read("H", self.offsets) else 0
        return self.offset + step if step else None

    def _vector(self, field: int) -> tuple[int, int]:
        """Where the entries of a list begin, and their number."""
        at = self._position(field)
        if at is None:
            return 0, 0
        first = at + self._read("I", at)
        return first + 4, self._read("I", first)

    def number(self, field: int, form: str = "i", default: int = 0) -> int:
        """A whole number, in a form of :mod:`struct`."""
        at = self._position(field)
        return default if at is None else self._read(form, at)

    def table(self, field: int) -> FlatTable:
        """A table, without fields if it is missing."""
        at = self._position(field)
        return FlatTable(EMPTY, 4) if at is None else FlatTable(self.data, at + self._read("I", at))

    def tables(self, field: int) -> list[FlatTable]:
        """A list of tables."""
        first, count = self._vector(field)
        return [FlatTable(self.data, at + self._read("I", at)) for at in range(first, first + 4 * count, 4)]

    def numbers(self, field: int, kind: type[np.generic] = np.int32) -> Array:
        """A list of numbers."""
        first, count = self._vector(field)
        return np.frombuffer(self.data, kind, count, first)


class Converter:
    """Writes the operations of a network as nodes of ONNX, with channels first inside.

    Args:
        data: a ``.tflite`` file.
    """

    def __init__(self, data: bytes) -> None:
        with needs_extra("onnx", "onnx", "tracking faces"):
            import onnx
        self.onnx = onnx
        model = FlatTable(data, struct.unpack_from("<I", data)[0])
        self.codes = [max(code.number(0, "b"), code.number(3)) for code in model.tables(1)]
        self.graph = model.tables(2)[0]
        tensors = self.graph.tables(0)
        self.shapes = [tuple(tensor.numbers(0).tolist()) for tensor in tensors]
        buffers = model.tables(4)
        self.constants: dict[int, Array] = {}
        for number, tensor in enumerate(tensors):
            content = buffers[tensor.number(2, "I")].numbers(0, np.uint8)
            if content.size:
                self.constants[number] = content.view(TYPES[tensor.number(1, "b")]).reshape(self.shapes[number])
        self.nodes: list[Any] = []
        self.weights: list[Any] = []

    @property
    def shapes_of_ends(self) -> list[tuple[int, ...]]:
        """Of the image, and of the outputs in the order of the file."""
        return [self.shapes[number] for number in (*self.graph.numbers(1), *self.graph.numbers(2))]

    def convert(self) -> bytes:
        """The graph; its input is an image (1, height, width, 3), its outputs are in the order of the file."""
        helper = self.onnx.helper
        float32 = self.onnx.TensorProto.FLOAT
        (image,), outputs = self.graph.numbers(1).tolist(), self.graph.numbers(2).tolist()
        self.node("Transpose", ["image"], f"t{image}", perm=CHANNELS_FIRST)
        for operation in self.graph.tables(3):
            code = self.codes[operation.number(0, "I")]
            inputs, result = operation.numbers(1).tolist(), operation.numbers(2).tolist()[0]
            self.operation(OPERATIONS[code], inputs, result, operation.table(4))
        for number in outputs:
            self.node("Identity", [self.rows(number)], f"out{number}")
        graph = helper.make_graph(
            self.nodes,
            "face",
            [helper.make_tensor_value_info("image", float32, self.shapes[image])],
            [helper.make_tensor_value_info(f"out{number}", float32, self.shapes[number]) for number in outputs],
            self.weights,
        )
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
        return bytes(model.SerializeToString())

    def node(self, kind: str, inputs: Sequence[str], output: str = "", **attributes: Any) -> str:  # noqa: ANN401
        """Add a node with one output; its name."""
        output = output or f"n{len(self.nodes)}"
        self.nodes.append(self.onnx.helper.make_node(kind, list(inputs), [output], **attributes))
        return output

    def constant(self, array: Array) -> str:
        """Add a constant; its name."""
        name = f"c{len(self.weights)}"
        self.weights.append(self.onnx.numpy_helper.from_array(np.ascontiguousarray(array), name))
        return name

    def value(self, number: int) -> str:
        """A tensor of the file, with channels first."""
        if number not in self.constants:
            return f"t{number}"
        array = self.constants[number].astype(np.float32)
        return self.constant(array.transpose(CHANNELS_FIRST) if array.ndim == 4 else array)

    def rows(self, number: int) -> str:
        """A tensor of the file, with channels last as there."""
        image = len(self.shapes[number]) == 4
        return self.node("Transpose", [self.value(number)], perm=CHANNELS_LAST) if image else self.value(number)

    def operation(self, kind: str, inputs: list[int], result: int, options: FlatTable) -> None:
        """Add one operation."""
        output = f"t{result}"
        if options.number(FUSED.get(kind, 99), "b"):
            raise ValueError(f"operation {kind} with an activation in it, which is not supported")
        if kind == "DEQUANTIZE":  # weights are stored in half precision
            self.constants[result] = self.constants[inputs[0]]
        elif kind in ("CONV_2D", "DEPTHWISE_CONV_2D"):
            kernel = self.constants[inputs[1]].astype(np.float32)
            kernel = kernel.transpose((3, 0, 1, 2) if kind != "CONV_2D" else CHANNELS_FIRST)
            tensors = [self.value(inputs[0]), self.constant(kernel), *map(self.value, inputs[2:])]
            groups = 1 if kind == "CONV_2D" else len(kernel)
            self.node("Conv", tensors, output, group=groups, **window(options))
        elif kind == "MAX_POOL_2D":
            size = [options.number(4), options.number(3)]
            self.node("MaxPool", [self.value(inputs[0])], output, kernel_shape=size, **window(options))
        elif kind == "PRELU":
            # relu(x) + slope · (x − relu(x)): ONNX Runtime takes two thirds of the time of its own PRelu.
            x, slope = self.value(inputs[0]), self.constants[inputs[1]].astype(np.float32).reshape(1, -1, 1, 1)
            positive = self.node("Relu", [x])
            negative = self.node("Mul", [self.node("Sub", [x, positive]), self.constant(slope)])
            self.node("Add", [positive, negative], output)
        elif kind == "PAD":
            pads = self.constants[inputs[1]].astype(np.int64)[list(CHANNELS_FIRST)].T.flatten()
            self.node("Pad", [self.value(inputs[0]), self.constant(pads)], output)
        elif kind == "RESHAPE":
            shape = self.constant(np.array(self.shapes[result], np.int64))
            self.node("Reshape", [self.rows(inputs[0]), shape], output)
        elif kind == "CONCATENATION":
            self.node("Concat", list(map(self.value, inputs)), output, axis=options.number(0))
        else:
            names = {"ADD": "Add", "RELU": "Relu", "LOGISTIC": "Sigmoid"}
            self.node(names[kind], list(map(self.value, inputs)), output)


def window(options: FlatTable) -> dict[str, Any]:
    """Padding and strides, which have the same numbers in all operations that have a window."""
    padding = "VALID" if options.number(0, "b") else "SAME_UPPER"
    return {"auto_pad": padding, "strides": [options.number(2), options.number(1)]}
