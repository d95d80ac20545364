"""Graphs of ONNX, read before they are run: whoever made a folder decides what its graphs compute, not what they cost.

A file is read as messages of Protocol Buffers (``onnx.proto``), without its numbers. Loops, branches, functions, files
beside the graph and operators that no export needs are refused, as is what a graph states and does not hold. What an
operator makes of values that are only known when it runs is bounded there: :mod:`facediff.runtime.graphs`.
"""

from __future__ import annotations

import contextlib
import math
import mmap
from pathlib import Path
from typing import Any, cast

import numpy as np

from facediff.errors import FaceDiffError
from facediff.utils.limits import LIMITS, check_array, quoted
from facediff.utils.protobuf import (
    DamagedError,
    Message,
    bytes_field,
    decode_name,
    integer_field,
    parse_message,
    read_varint,
)

REMEDY = "get the folder again, or export the model again"

NODES = 20_000
"""Most nodes of a graph; those of an export have hundreds."""

RANK = 32
"""Most dimensions of a tensor."""

SMALL = 1 << 20
"""Numbers of a result whose size is believed where its shape is not known."""

MANY = 1 << 62
"""Stands for any number of numbers."""

WIDENED = 4
"""Bytes of a number that is computed from stored ones, which may have fewer."""

TYPES = {
    **{1: ("float", 4), 2: ("uint8", 1), 3: ("int8", 1), 4: ("uint16", 2), 5: ("int16", 2), 6: ("int32", 4)},
    **{7: ("int64", 8), 9: ("bool", 1), 10: ("float16", 2), 11: ("double", 8), 12: ("uint32", 4), 13: ("uint64", 8)},
}
"""Types of numbers by ONNX's codes: their names in ``model.json``, and bytes; others (texts, sequences) are unknown."""

FLOATS = {1, 10, 11}

SAME_SHAPE = (
    "Abs Acos Asin Atan Cast Ceil Celu Clip Cos Cosh CumSum Elu Erf Exp Floor Gelu HardSigmoid HardSwish Identity "
    "IsInf IsNaN LeakyRelu Log LogSoftmax Mish Neg Not Reciprocal Relu Round Selu Sigmoid Sign Sin Sinh Softmax "
    "Softplus Softsign Sqrt Tan Tanh"
)
"""Operators whose result has the shape of their first input."""

NO_LARGER = (
    "ArgMax ArgMin BatchNormalization Flatten GlobalAveragePool GlobalMaxPool GroupNormalization InstanceNormalization "
    "LayerNormalization LpNormalization ReduceL1 ReduceL2 ReduceLogSum ReduceLogSumExp ReduceMax ReduceMean ReduceMin "
    "ReduceProd ReduceSum ReduceSumSquare Reshape Slice Split Squeeze Transpose Trilu Unsqueeze"
)
"""Operators whose results have no more numbers than their first input."""

ELEMENTWISE = (
    "Add And Div Equal Greater GreaterOrEqual Less LessOrEqual Max Mean Min Mod Mul Or PRelu Pow Sub Sum Where Xor"
)
"""Operators whose result has the shape to which their inputs are broadcast."""

OTHERS = (
    "AveragePool Concat Constant ConstantOfShape Conv ConvTranspose DequantizeLinear Einsum Expand Gather "
    "GatherElements GatherND Gemm GRU LSTM MatMul MaxPool Pad QuantizeLinear RNN Range ScatterElements ScatterND "
    "Shape Size Tile TopK"
)
"""Other operators of exports, and their kin. None runs another graph or draws numbers."""

OPERATORS = {name: kind for kind in (SAME_SHAPE, NO_LARGER, ELEMENTWISE, OTHERS) for name in kind.split()}
"""All operators that a graph may have, with their kind."""

OPTIONAL = {"Clip": 1, "GRU": 3, "LSTM": 3, "Pad": 2, "RNN": 3, "Slice": 3}
"""From which place on inputs of an operator may be left out by an empty name; elsewhere that can end the process."""


def check_graph(path: Path, opset: int | None = None, ends: dict[str, list[dict[str, Any]]] | None = None) -> int:
    """Read a graph, and refuse what could cost more than the budget, or is not what ``model.json`` says.

    Args:
        path: the file.
        opset: version of the operators; any if None, for models of others, which do not state it elsewhere and may name
            further sets of which they use none.
        ends: inputs and outputs as ``model.json`` describes them; any if None.

    Returns:
        how many bytes a node may have that is computed while the graph is opened.
    """
    try:
        with path.open("rb") as stream:
            content = memoryview(mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ))
        return _Reading(path).model(content, opset, ends)
    except (DamagedError, ValueError, OSError) as error:
        raise FaceDiffError(f"{path}: is no graph of ONNX ({error}); {REMEDY}") from error


class _Reading:
    """What is known of a graph's values while its nodes are read in their order."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.types: dict[bytes, tuple[int, list[str | int]]] = {}  # by the message that declares them
        self.kinds: dict[str, int] = {}  # declared types of values that are computed
        self.stored: dict[str, Message] = {}  # tensors of the file
        self.shapes: dict[str, tuple[int, ...]] = {}  # of the stored, and of what is computed of them alone
        self.counts: dict[str, int] = {}  # most numbers of the same, and of what is computed of shapes
        self.unknown = 0  # nodes that may be computed on opening and whose size is not known

    def refuse(self, problem: str) -> FaceDiffError:
        return FaceDiffError(f"{self.path}: {problem}; {REMEDY}")

    def model(self, content: memoryview, opset: int | None, ends: dict[str, list[dict[str, Any]]] | None) -> int:
        model = parse_message(content)
        if model.keys() & {20, 25}:  # training, functions
            raise self.refuse("holds functions, expected one graph of plain operators")
        imports = [parse_message(each) for each in _messages(model, 8)]
        found = [(_text(each, 1), integer_field(each, 2)) for each in imports]
        if found != [("", opset)] if opset is not None else [domain for domain, _ in found].count("") != 1:
            version = "" if opset is None else f" of version {quoted(opset)}"
            raise self.refuse(f"has operators of {quoted(found)}, expected ONNX's own{version}")
        graph = parse_message(_single(model, 7))
        if 15 in graph:
            raise self.refuse("holds sparse tensors, expected dense ones")
        for number, key in ((11, "inputs"), (12, "outputs")):
            described = [self.value(each) for each in _messages(graph, number)]
            if ends is not None and described != ends.get(key):
                wrong = next((each for each in described if each not in (ends.get(key) or [])), described)
                raise self.refuse(f"has the {key} {quoted(wrong)}, expected those that model.json describes")
        for each in _messages(graph, 13):
            self.value(each)
        for each in _messages(graph, 5):
            tensor = parse_message(each)
            name = _text(tensor, 8)
            self.stored[name], self.shapes[name] = tensor, self.tensor(tensor, name)
            self.counts[name] = math.prod(self.shapes[name])
        nodes = _messages(graph, 1)
        if len(nodes) > NODES:
            raise self.refuse(f"has {len(nodes)} nodes, expected {NODES} at most")
        folded = sum(self.node(parse_message(each)) for each in nodes)
        LIMITS.check("bytes", folded, self.path)
        return int(LIMITS.bytes / (1 + self.unknown))

    def value(self, message: memoryview) -> dict[str, Any]:
        """A declared value as ``model.json`` describes it."""
        fields = parse_message(message)
        name, kind = _text(fields, 1), bytes(_single(fields, 2))
        if kind not in self.types:  # most values of a graph have one of a few types
            self.types[kind] = self.type(memoryview(kind), name)
        code, shape = self.types[kind]
        self.kinds[name] = code
        return {"name": name, "type": TYPES[code][0], "shape": shape}

    def type(self, message: memoryview, name: str) -> tuple[int, list[str | int]]:
        """Code and shape of a declared type."""
        kind = parse_message(message)
        if kind.keys() - {1, 6}:  # a tensor, and a remark
            raise self.refuse(f"{quoted(name)} is no tensor, expected tensors only")
        tensor = parse_message(_single(kind, 1))
        code = integer_field(tensor, 1)
        if code not in TYPES:
            raise self.refuse(f"{quoted(name)} is of the type {code}, expected numbers")
        axes = _messages(parse_message(_single(tensor, 2)), 1) if 2 in tensor else []
        shape = [_text(axis, 2) or integer_field(axis, 1) for axis in map(parse_message, axes)]
        check_array(f"{self.path}: {quoted(name)}", tuple(n for n in shape if isinstance(n, int)), TYPES[code][1])
        return code, shape

    def tensor(self, tensor: Message, name: str) -> tuple[int, ...]:
        """The shape of a stored tensor, whose numbers are all there."""
        if tensor.keys() & {3, 13, 14} and (3 in tensor or 13 in tensor or integer_field(tensor, 14)):
            raise self.refuse(f"{quoted(name)} lies in another file, expected its numbers in this one")
        code, shape = integer_field(tensor, 2), tuple(_integers(tensor, 1))
        if code not in TYPES or len(shape) > RANK:
            raise self.refuse(f"{quoted(name)} is a tensor of the type {code} and {len(shape)} axes, expected numbers")
        size = TYPES[code][1]
        check_array(f"{self.path}: {quoted(name)}", shape, size)
        held = 0
        for number in (4, 5, 6, 7, 9, 10, 11):
            for each in tensor.get(number, ()):
                if isinstance(each, int):
                    held += size
                elif number in (5, 7, 11):  # whole numbers of variable length, each with one last byte
                    held += int(np.count_nonzero(np.frombuffer(each, np.uint8) < 128)) * size
                else:
                    held += len(each)
        if held != math.prod(shape) * size:
            raise self.refuse(f"{quoted(name)} is declared as {shape}, but {held} bytes of numbers are there")
        return shape

    def node(self, node: Message) -> int:
        """Bytes of a node that is computed when the graph is opened; 0 if it is computed later or is not known."""
        operator, inputs = _text(node, 4), [decode_name(each) for each in _messages(node, 1)]
        if _text(node, 7) or operator not in OPERATORS:
            called = f"{_text(node, 7)}.{operator}".strip(".")
            raise self.refuse(f"has the operator {quoted(called)}, expected only those that `export-model` writes")
        for each in _messages(node, 5):
            attribute = parse_message(each)
            if attribute.keys() & {6, 11, 14, 15, 21, 22, 23}:
                raise self.refuse(f"{operator} holds another graph or a sparse tensor, expected plain values")
            for tensor in (*_messages(attribute, 5), *_messages(attribute, 10)):
                self.tensor(parse_message(tensor), operator)
        if any(not name and place < OPTIONAL.get(operator, len(inputs)) for place, name in enumerate(inputs)):
            raise self.refuse(f"{operator} lacks an input, expected all that it needs")
        if operator in ("Div", "Mod"):
            self.divisor(operator, inputs[1:2])
        self.growth(operator, inputs)
        results = [decode_name(each) for each in _messages(node, 2)]
        given = [name for name in inputs if name]
        if operator in ("Shape", "Size"):
            self.counts.update(dict.fromkeys(results, RANK))
            return 0
        if not all(name in self.counts for name in given):
            return 0
        shapes = [self.shapes.get(name) for name in given]
        kind, shape, count = OPERATORS[operator] if given else OTHERS, None, MANY
        if kind is SAME_SHAPE:
            shape, count = shapes[0], self.counts[given[0]]
        elif kind is NO_LARGER:
            count = self.counts[given[0]]
        elif operator == "Concat":
            count = sum(self.counts[name] for name in given)
        elif kind is ELEMENTWISE:
            count = math.prod(self.counts[name] for name in given)
            known = [each for each in shapes if each is not None]
            if len(known) == len(given):
                with contextlib.suppress(ValueError):
                    shape = np.broadcast_shapes(*known)
                    count = math.prod(shape)
        count = min(count, MANY)
        for name in results:
            self.counts[name] = count
            if shape is not None:
                self.shapes[name] = shape
        if shape is None and count > SMALL:
            self.unknown += 1
            return 0
        return WIDENED * count * len(results)

    def divisor(self, operator: str, names: list[str]) -> None:
        """Refuse whole numbers that are divided by something else than positive constants: −1 ends the process."""
        for name in names:
            if name in self.stored and integer_field(self.stored[name], 2) not in FLOATS:
                numbers = self.numbers(name)
                if numbers is not None and all(number > 0 for number in numbers):
                    continue
            elif name in self.stored or self.kinds.get(name) in FLOATS:
                continue
            raise self.refuse(f"{operator} divides by {quoted(name)}, expected positive constants or decimal numbers")

    def growth(self, operator: str, inputs: list[str]) -> None:
        """Refuse a result that stored numbers make too large."""
        place = {"ConstantOfShape": 0, "Expand": 1, "Tile": 1, "Pad": 1, "Range": 0}.get(operator)
        if place is None or len(inputs) <= place:
            return
        known = [self.numbers(name) for name in (inputs[:3] if operator == "Range" else inputs[place : place + 1])]
        sizes = [number for numbers in known for number in numbers or ()]
        if operator == "Range":
            sizes = [(sizes[1] - sizes[0]) // (sizes[2] or 1)] if len(sizes) == 3 else []
        elif operator == "Pad":
            half = len(sizes) // 2
            sizes = [before + after for before, after in zip(sizes[:half], sizes[half:], strict=False)]
        size = WIDENED * math.prod(max(1, number) for number in sizes)
        LIMITS.check("bytes", size, f"{self.path}: {operator}")

    def numbers(self, name: str) -> list[int] | None:
        """The whole numbers of a small stored tensor."""
        tensor = self.stored.get(name)
        if tensor is None or self.counts[name] > 2 * RANK:
            return None
        code = integer_field(tensor, 2)
        if code in FLOATS:
            return None
        if raw := bytes_field(tensor, 9):
            return [int(number) for number in np.frombuffer(raw, np.dtype(TYPES[code][0]))]
        return _integers(tensor, 7 if code == 7 else 11 if code in (12, 13) else 5)


def _messages(fields: Message, number: int) -> list[memoryview]:
    """The values of a field that holds messages or texts."""
    found = fields.get(number, [])
    if not all(isinstance(each, memoryview) for each in found):
        raise DamagedError("a message in it has another type than expected")
    return cast("list[memoryview]", found)


def _single(fields: Message, number: int) -> memoryview:
    """The message of a field; other readers join several ones, which nobody writes."""
    found = _messages(fields, number)
    if len(found) != 1:
        raise DamagedError("a message in it is missing or stands there twice")
    return found[0]


def _text(fields: Message, number: int) -> str:
    return decode_name(bytes_field(fields, number))


def _integers(fields: Message, number: int) -> list[int]:
    """The whole numbers of a field, one by one or packed."""
    found: list[int] = []
    for each in fields.get(number, ()):
        if isinstance(each, int):
            found.append(each)
            continue
        at = 0
        while at < len(each):
            value, at = read_varint(each, at)
            found.append(value)
    return [value - (1 << 64) if value >> 63 else value for value in found]
