"""Graphs of ONNX, read before they are run: only known operators, and no other files.

A file is a message of Protocol Buffers (``onnx.proto``). Loops, branches, functions and operators that no export needs
are refused, as are tensors that lie in other files. The time and the memory that a graph takes are not bounded.
"""

from __future__ import annotations

import mmap
from pathlib import Path

from facediff.errors import FaceDiffError
from facediff.utils.limits import quoted
from facediff.utils.protobuf import fields

REMEDY = "get the folder again, or export the model again"

_NAMES = (
    "Abs Acos Add And ArgMax ArgMin Asin Atan AveragePool BatchNormalization Cast Ceil Celu Clip Concat Constant "
    "ConstantOfShape Conv ConvTranspose Cos Cosh CumSum DequantizeLinear Div Einsum Elu Equal Erf Exp Expand "
    "Flatten Floor GRU Gather GatherElements GatherND Gelu Gemm GlobalAveragePool GlobalMaxPool Greater "
    "GreaterOrEqual GroupNormalization HardSigmoid HardSwish Identity InstanceNormalization IsInf IsNaN LSTM "
    "LayerNormalization LeakyRelu Less LessOrEqual Log LogSoftmax LpNormalization MatMul Max MaxPool Mean Min Mish "
    "Mod Mul Neg Not Or PRelu Pad Pow QuantizeLinear RNN Range Reciprocal ReduceL1 ReduceL2 ReduceLogSum "
    "ReduceLogSumExp ReduceMax ReduceMean ReduceMin ReduceProd ReduceSum ReduceSumSquare Relu Reshape Round "
    "ScatterElements ScatterND Selu Shape Sigmoid Sign Sin Sinh Size Slice Softmax Softplus Softsign Split Sqrt "
    "Squeeze Sub Sum Tan Tanh Tile TopK Transpose Trilu Unsqueeze Where Xor"
)
OPERATORS = frozenset(_NAMES.split())
"""Operators of exports, and their kin. None runs another graph, reads a file or draws numbers."""


def check_graph(path: Path) -> None:
    """Refuse a graph that is damaged, has operators other than :data:`OPERATORS`, or reads other files."""
    try:
        with path.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as content:
            problem = problem_of_model(content)
    except (ValueError, LookupError, OSError) as error:
        raise FaceDiffError(f"{path}: not an ONNX graph ({error}); {REMEDY}") from error
    if problem:
        raise FaceDiffError(f"{path}: {problem}; {REMEDY}")


def problem_of_model(content: mmap.mmap) -> str:
    """Why a model is refused; empty if it is not."""
    # Fields of ModelProto: 7 graph, 20 training, 25 functions; of GraphProto: 1 nodes, 5 tensors, 15 sparse tensors; of
    # NodeProto: 4 operator, 5 attributes, 7 domain; of AttributeProto: 5, 10 tensors, 6, 11 graphs, 22, 23 sparse ones.
    for number, start, end in fields(content, 0, len(content)):
        if number in (20, 25):
            return "holds functions, expected one graph of plain operators"
        for part, *span in fields(content, start, end) if number == 7 else ():
            if part == 15:
                return "holds sparse tensors, expected dense ones"
            if part == 5 and is_external(content, *span):
                return "has tensors in another file, expected them in this one"
            if part == 1 and (problem := problem_of_node(content, *span)):
                return problem
    return ""


def problem_of_node(content: mmap.mmap, start: int, end: int) -> str:
    """Why a node is refused; empty if it is not."""
    names = {4: "", 7: ""}
    for number, *span in fields(content, start, end):
        if number in names:
            names[number] = content[slice(*span)].decode()
        for part, *inner in fields(content, *span) if number == 5 else ():
            if part in (6, 11, 22, 23):
                return f"{quoted(names[4])} holds another graph or a sparse tensor, expected plain values"
            if part in (5, 10) and is_external(content, *inner):
                return "has tensors in another file, expected them in this one"
    operator = ".".join(filter(None, (names[7], names[4])))
    allowed = operator in OPERATORS
    return "" if allowed else f"has the operator {quoted(operator)}, expected only those that `export-model` writes"


def is_external(content: mmap.mmap, start: int, end: int) -> bool:
    """Whether a tensor names another file, or says that its numbers lie in one."""
    return any(number == 13 or (number == 14 and content[at]) for number, at, _ in fields(content, start, end))
