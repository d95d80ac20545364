"""Networks of TensorFlow Lite as graphs of ONNX, against the operations written out in NumPy."""

from __future__ import annotations

import flatbuffers
import numpy as np
import onnxruntime
import pytest
import torch

from facediff.data.track.tflite import OPERATIONS, Converter

CODES = {name: code for code, name in OPERATIONS.items()}


Fields = dict[int, tuple[str, int]]
Operation = tuple[str, list[int], int, dict[int, int]]


def write_model(tensors: list[tuple[tuple[int, ...], np.ndarray | None]], operations: list[Operation]) -> bytes:
    """A ``.tflite`` file: shapes of tensors with their constants; operations with inputs, output and options."""
    builder = flatbuffers.Builder(1 << 14)

    def table(fields: Fields) -> int:
        builder.StartObject(max(fields, default=-1) + 1)
        for number, (form, value) in fields.items():
            if form == "offset":
                builder.PrependUOffsetTRelativeSlot(number, value, 0)
            else:
                slots = {"b": builder.PrependInt8Slot, "i": builder.PrependInt32Slot, "I": builder.PrependUint32Slot}
                slots[form](number, value, 0)
        return int(builder.EndObject())

    def tables(offsets: list[int]) -> tuple[str, int]:
        builder.StartVector(4, len(offsets), 4)
        for offset in reversed(offsets):
            builder.PrependUOffsetTRelative(offset)
        return "offset", builder.EndVector()

    def numbers(values: list[int]) -> tuple[str, int]:
        return "offset", builder.CreateNumpyVector(np.array(values, np.int32))

    kinds = {np.dtype(np.float32): 0, np.dtype(np.float16): 1, np.dtype(np.int32): 2}
    buffers, written = [table({})], []
    for shape, constant in tensors:
        fields = {0: numbers(list(shape))}
        if constant is not None:
            fields |= {1: ("b", kinds[constant.dtype]), 2: ("I", len(buffers))}
            content = builder.CreateNumpyVector(np.frombuffer(constant.tobytes(), np.uint8))
            buffers.append(table({0: ("offset", content)}))
        written.append(table(fields))
    names = sorted({kind for kind, *_ in operations})
    codes = [table({0: ("b", CODES[name]), 3: ("i", CODES[name])}) for name in names]
    nodes = []
    for kind, inputs, output, options in operations:
        first = "i" if kind == "CONCATENATION" else "b"
        chosen = table({field: (first if field == 0 else "i", value) for field, value in options.items()})
        ends = {1: numbers(inputs), 2: numbers([output]), 4: ("offset", chosen)}
        nodes.append(table({0: ("I", names.index(kind)), **ends}))
    graph = table({0: tables(written), 1: numbers([0]), 2: numbers([operations[-1][2]]), 3: tables(nodes)})
    builder.Finish(table({1: tables(codes), 2: tables([graph]), 4: tables(buffers)}))
    return bytes(builder.Output())


def convolve(image: np.ndarray, kernel: np.ndarray, stride: int, *, depthwise: bool) -> np.ndarray:
    """SAME padding as TensorFlow has it: the odd pixel below and to the right."""
    size, channels = kernel.shape[1], image.shape[2]
    total = [max((-(-n // stride) - 1) * stride + size - n, 0) for n in image.shape[:2]]
    padded = np.pad(image, [(t // 2, t - t // 2) for t in total] + [(0, 0)])
    weights = kernel.transpose(3, 0, 1, 2) if depthwise else kernel.transpose(0, 3, 1, 2)
    inputs = (torch.from_numpy(np.ascontiguousarray(each)) for each in (padded.transpose(2, 0, 1)[None], weights))
    result = torch.nn.functional.conv2d(*inputs, stride=stride, groups=channels if depthwise else 1)
    return result[0].permute(1, 2, 0).numpy()


def run(model: bytes, image: np.ndarray) -> np.ndarray:
    session = onnxruntime.InferenceSession(Converter(model).convert())
    return np.asarray(session.run(None, {"image": image[None].astype(np.float32)})[0])


def test_a_network_of_all_operations_is_that_of_numpy() -> None:
    random = np.random.default_rng(0)
    half = lambda *shape: random.normal(0, 0.5, shape).astype(np.float16)  # noqa: E731
    kernel, deep, slope, bias = half(6, 3, 3, 3), half(1, 3, 3, 6), half(1, 1, 6), half(6)
    pads = np.array([[0, 0], [0, 0], [0, 0], [0, 2]], np.int32)
    shapes: list[tuple[tuple[int, ...], np.ndarray | None]] = [
        *[((1, 9, 8, 3), None), (kernel.shape, kernel), (kernel.shape, None), ((6,), bias), ((6,), None)],
        *[((1, 5, 4, 6), None), (slope.shape, slope), (slope.shape, None), ((1, 5, 4, 6), None), (deep.shape, deep)],
        *[(deep.shape, None), ((1, 5, 4, 6), None), ((1, 5, 4, 6), None), ((1, 2, 2, 6), None), (pads.shape, pads)],
        *[((1, 2, 2, 8), None), ((1, 32, 1), None), ((1, 64, 1), None), ((1, 64, 1), None), ((1, 5, 4, 6), None)],
    ]
    convolution = {0: 0, 1: 2, 2: 2}
    model = write_model(
        shapes,
        [
            *[("DEQUANTIZE", [k], k + 1, {}) for k in (1, 3, 6, 9)],
            ("CONV_2D", [0, 2, 4], 5, convolution),
            ("PRELU", [5, 7], 8, {}),
            ("DEPTHWISE_CONV_2D", [8, 10, 4], 11, {0: 0, 1: 1, 2: 1, 3: 1}),
            ("ADD", [11, 8], 12, {}),
            ("RELU", [12], 19, {}),
            ("MAX_POOL_2D", [19], 13, {0: 1, 1: 2, 2: 2, 3: 2, 4: 2}),
            ("PAD", [13, 14], 15, {}),
            ("RESHAPE", [15], 16, {}),
            ("CONCATENATION", [16, 16], 17, {0: 1}),
            ("LOGISTIC", [17], 18, {}),
        ],
    )
    image = random.normal(size=(9, 8, 3))
    x = convolve(image, kernel.astype(float), 2, depthwise=False) + bias
    x = np.where(x > 0, x, x * slope.astype(float)[0, 0])
    x = np.maximum(convolve(x, deep.astype(float), 1, depthwise=True) + bias + x, 0)
    x = np.pad(x[:4, :4].reshape(2, 2, 2, 2, 6).max(axis=(1, 3)), ((0, 0), (0, 0), (0, 2))).reshape(1, 32, 1)
    np.testing.assert_allclose(run(model, image), 1 / (1 + np.exp(-np.concatenate([x, x], axis=1))), atol=1e-5)


@pytest.mark.parametrize(("kind", "code"), [("RELU", 99), ("ADD", 0)])
def test_what_is_not_converted_is_named(kind: str, code: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(CODES, kind, code)
    model = write_model([((1, 2, 2, 3), None), ((1, 2, 2, 3), None)], [(kind, [0, 0], 1, {0: 3})])
    with pytest.raises((KeyError, ValueError), match=r"99|operation ADD"):
        Converter(model).convert()
