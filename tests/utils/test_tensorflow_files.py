"""TensorFlow's files, against writers that share no code with the readers; damaged ones say what is wrong."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from facediff.errors import FaceDiffError
from facediff.utils.tensorflow_files import crc32c, masked_crc, read_bundle, read_graph
from tests.fakes import tensorflow as tf


def arrays(count: int = 9) -> dict[str, np.ndarray]:
    generator = np.random.default_rng(0)
    made = {f"scope/layer_{i}/weights": generator.normal(size=(i + 1, 3)).astype(np.float32) for i in range(count)}
    return made | {"global_step": np.array(7, np.int64), "empty": np.zeros((0, 4), np.float32)}


def same(found: dict[str, torch.Tensor], expected: dict[str, np.ndarray]) -> bool:
    return found.keys() == expected.keys() and all(
        np.array_equal(found[name].numpy(), value) and found[name].numpy().dtype == value.dtype
        for name, value in expected.items()
    )


def test_the_checksum_is_that_of_rfc_3720() -> None:
    assert crc32c(bytes(32)) == 0x8A9136AA  # B.4
    assert crc32c(bytes(range(32))) == 0x46DD794E
    for length in (0, 1, 1001):
        data = np.random.default_rng(length).bytes(length)
        assert masked_crc(crc32c(data)) == tf.checksum(data)


@pytest.mark.parametrize(
    "options", [{}, {"shards": 3}, {"per_block": 1}, {"per_block": 100, "interval": 16}, {"snappy": True}]
)
def test_a_bundle(options: dict[str, int], tmp_path: Path) -> None:
    index = tf.write_bundle(tmp_path / "model", arrays(), **options)
    assert same(read_bundle(index), arrays())


def test_shards_may_lie_elsewhere(tmp_path: Path) -> None:
    index = tf.write_bundle(tmp_path / "model", arrays(), shards=2)
    (tmp_path / "other").mkdir()
    moved = tmp_path / "model.data-00001-of-00002"
    moved = moved.rename(tmp_path / "other" / moved.name)
    assert same(read_bundle(index, [moved]), arrays())
    with pytest.raises(FaceDiffError, match="model.data-00001-of-00002"):
        read_bundle(index)


def test_snappy_copies_that_reach_into_themselves(tmp_path: Path) -> None:
    from facediff.utils.tensorflow_files import decompress_snappy

    # "abc", a copy of 7 bytes from 3 back with one byte of offset, one of 5 from 10 back with two, one with four.
    data = bytes([19]) + bytes([2 << 2]) + b"abc" + bytes([3 << 2 | 1, 3]) + bytes([4 << 2 | 2, 10, 0])
    data += bytes([3 << 2 | 3, 1, 0, 0, 0])
    assert decompress_snappy(memoryview(data)) == b"abc" + b"abcabca" + b"abcab" + b"bbbb"


def at(place: int, value: int) -> Callable[[bytearray], None]:
    def change(content: bytearray) -> None:
        content[place] ^= value

    return change


def cut(share: float) -> Callable[[bytearray], None]:
    def change(content: bytearray) -> None:
        del content[int(share * len(content)) :]

    return change


INDEX: dict[str, Callable[[bytearray], None]] = {
    "empty": cut(0),
    "cut short": cut(0.5),
    "a byte short": cut(0.999),
    "another byte in a block": at(9, 1),
    "a block's kind": at(4, 255),
    "no table": at(-1, 255),
    "a block beyond the end": at(-47, 255),
    "the footer's number has no end": lambda content: content.__setitem__(slice(-48, -8), b"\xff" * 40),
}


@pytest.mark.parametrize("name", INDEX)
def test_a_damaged_index_is_named(name: str, tmp_path: Path) -> None:
    index = tf.write_bundle(tmp_path / "model", arrays())
    content = bytearray(index.read_bytes())
    INDEX[name](content)
    index.write_bytes(content)
    with pytest.raises(FaceDiffError, match=r"model\.index") as caught:
        read_bundle(index)
    assert str(caught.value).count(". ") == 0


def wrong(place: int, value: bytes) -> Callable[[str, dict[int, bytes]], None]:
    def change(name: str, fields: dict[int, bytes]) -> None:
        if name == "scope/layer_3/weights":
            fields[place] = value

    return change


ENTRIES = {
    "a shape larger than the bytes": (2, tf.field(2, tf.shape_message((2**40, 2**40)))),
    "a negative size": (2, tf.field(2, tf.shape_message((-4, 3)))),
    "too many dimensions": (2, tf.field(2, tf.shape_message((1,) * 1000))),
    "a shard that is not there": (3, tf.field(3, 5)),
    "an offset beyond the end": (4, tf.field(4, 2**62)),
    "a negative offset": (4, tf.field(4, -8)),
    "another size": (5, tf.field(5, 2**40)),
    "a negative number of bytes": (5, tf.field(5, -1)),
    "another checksum": (6, tf.fixed32(6, 1)),
    "slices": (7, tf.field(7, b"")),
    "another kind of field": (4, tf.field(4, b"text")),
    "a field that is cut short": (4, tf.number(4 * 8 + 2) + tf.number(1000)),
    "a group": (4, tf.number(4 * 8 + 3)),
    "a number without end": (4, tf.number(4 * 8) + b"\xff" * 12),
}


@pytest.mark.parametrize("name", ENTRIES)
def test_an_entry_that_lies_is_refused(name: str, tmp_path: Path) -> None:
    index = tf.write_bundle(tmp_path / "model", arrays(), change=wrong(*ENTRIES[name]))
    with pytest.raises(FaceDiffError, match=r"model\.(index|data)"):
        read_bundle(index)


def test_texts_are_left_out(tmp_path: Path) -> None:
    index = tf.write_bundle(tmp_path / "model", arrays(), change=wrong(1, tf.field(1, 7)))
    assert read_bundle(index).keys() == arrays().keys() - {"scope/layer_3/weights"}


def test_names_are_sorted_and_short(tmp_path: Path) -> None:
    entries = [(b"", tf.field(1, 1)), (b"x" * 10_000, b"")]
    (tmp_path / "long.index").write_bytes(tf.table(entries))
    with pytest.raises(FaceDiffError, match=r"long\.index"):
        read_bundle(tmp_path / "long.index")

    # An index that names one block a thousand times.
    content = tf.block([(b"a", b"1")], 1)
    stored = content + b"\x00" + struct.pack("<I", tf.checksum(content + b"\x00"))
    again = tf.block([(b"%05d" % i, tf.number(0) + tf.number(len(content))) for i in range(1000)], 16)
    place = tf.number(len(stored)) + tf.number(len(again))
    stored += again + b"\x00" + struct.pack("<I", tf.checksum(again + b"\x00"))
    footer = (place + place).ljust(40, b"\x00") + struct.pack("<Q", 0xDB4775248B80FB57)
    (tmp_path / "again.index").write_bytes(stored + footer)
    with pytest.raises(FaceDiffError, match="sorted"):
        read_bundle(tmp_path / "again.index")


@pytest.mark.parametrize("share", [0.0, 0.5, 0.99])
def test_truncated_data_is_named(share: float, tmp_path: Path) -> None:
    index = tf.write_bundle(tmp_path / "model", arrays())
    data = tmp_path / "model.data-00000-of-00001"
    data.write_bytes(data.read_bytes()[: int(share * data.stat().st_size)])
    with pytest.raises(FaceDiffError, match="data-00000-of-00001"):
        read_bundle(index)


# Graphs.


def test_a_graph(tmp_path: Path) -> None:
    weights = {"h1": np.ones((3, 2), np.float32), "b1": np.arange(2, dtype=np.float32), "half": np.ones(2, np.float16)}
    assert same(read_graph(tf.write_graph(tmp_path / "graph.pb", weights)), weights)


def test_constants_as_lists_of_numbers(tmp_path: Path) -> None:
    """One number, repeated to fill its shape, as TensorFlow writes constants of equal numbers."""
    tensor = tf.field(1, 1) + tf.field(2, tf.shape_message((2, 3)))
    few = tensor + tf.number(5 * 8 + 2) + tf.number(8) + struct.pack("<2f", 1.0, 2.0)
    single = tensor + tf.number(5 * 8 + 5) + struct.pack("<f", 4.0)  # not packed, as old versions wrote lists
    nodes = [tf.node(name, "Const", {"value": tf.field(8, each)}) for name, each in (("few", few), ("one", single))]
    (tmp_path / "graph.pb").write_bytes(b"".join(tf.field(1, node) for node in nodes))
    found = read_graph(tmp_path / "graph.pb")
    assert found["few"].tolist() == [[1, 2, 2], [2, 2, 2]]
    assert found["one"].tolist() == [[4, 4, 4], [4, 4, 4]]


def tensor_node(shape: tuple[int, ...], content: bytes) -> bytes:
    return tf.node(
        "h1", "Const", {"value": tf.field(8, tf.field(1, 1) + tf.field(2, tf.shape_message(shape)) + content)}
    )


GRAPHS = {
    "empty": b"",
    "text": b"node {\n  name: 'h1'\n}\n",
    "no weights": tf.field(1, tf.node("x", "Placeholder")),
    "nodes are numbers": tf.field(1, 3),
    "cut short": tf.field(1, tensor_node((2,), tf.field(4, bytes(8))))[:-3],
    "a shape larger than the bytes": tf.field(1, tensor_node((2**20, 2**20), tf.field(4, bytes(8)))),
    "one number for far too many": tf.field(1, tensor_node((2**20, 2**20), tf.number(45) + bytes(4))),
    "no numbers": tf.field(1, tensor_node((2,), b"")),
    "a negative size": tf.field(1, tensor_node((-1,), tf.field(4, bytes(8)))),
    "a name that is no text": tf.field(1, tensor_node((2,), tf.field(4, bytes(8))).replace(b"h1", b"\xff\xfe")),
    "the same name twice": 2 * tf.field(1, tensor_node((2,), tf.field(4, bytes(8)))),
}


@pytest.mark.parametrize("name", GRAPHS)
def test_a_damaged_graph_is_named(name: str, tmp_path: Path) -> None:
    (tmp_path / "graph.pb").write_bytes(GRAPHS[name])
    with pytest.raises(FaceDiffError, match=r"graph\.pb") as caught:
        read_graph(tmp_path / "graph.pb")
    assert str(caught.value).count(". ") == 0
