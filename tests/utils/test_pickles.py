"""Stand-ins for objects of other packages in pickles: they keep what the pickle holds and do nothing."""

from __future__ import annotations

import pickle
import struct
import time
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from facediff.errors import FaceDiffError
from facediff.utils.limits import LIMITS
from facediff.utils.pickles import FOR_STAND_INS, StandIn, load_pickle
from tests.fakes.flame import foreign, model_pickle


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "file.pkl"


@pytest.mark.parametrize(("python", "protocol"), [(2, 2), (3, 0), (3, 1), (3, 2), (3, 4)])
def test_state_is_kept(file: Path, python: int, protocol: int) -> None:
    inner = foreign("chumpy.ch", "Ch", {"x": np.arange(3.0)})
    file.write_bytes(
        model_pickle([foreign("chumpy.sub.mod", "Other", {"a": inner, "n": 7})], python=python, protocol=protocol)
    )  # type: ignore[arg-type]
    (loaded,) = load_pickle(file, stand_ins=("chumpy",))
    assert isinstance(loaded, StandIn)
    assert loaded.origin == "chumpy.sub.mod.Other"
    assert loaded.state["n"] == 7  # type: ignore[index]
    inside = loaded.state["a"]  # type: ignore[index]
    assert inside.origin == "chumpy.ch.Ch"
    np.testing.assert_array_equal(inside.state["x"], [0, 1, 2])


def test_a_call_becomes_a_stand_in_with_its_arguments(file: Path) -> None:
    file.write_bytes(b"cchumpy.utils\nrun\n(S'rm -rf'\nI5\ntR.")
    loaded = load_pickle(file, stand_ins=("chumpy",))
    assert loaded.origin == "chumpy.utils.run"
    assert loaded.arguments == ("rm -rf", 5)
    assert loaded.state is None


@pytest.mark.parametrize(
    "content",
    [
        b"cchumpyish\nCh\n(tR.",  # another package whose name begins alike
        b"cscipy.sparse.csc\ncsc_matrix\n(tR.",  # a package that was not asked for
        b"cos\nsystem\n(S'true'\ntR.",
        b"ccopy_reg\n_reconstructor\n(cnumpy\nndarray\nc__builtin__\nobject\nNtR.",  # makes what is no stand-in
        b"ccopy_reg\n_reconstructor\n(}tb.",  # tries to change the function
        b"cchumpy.ch\nCh\n}S'origin'\nS'x'\nsb.",  # tries to change the class
        b"ccopy_reg\n__newobj__\n(tR.",
    ],
)
def test_other_names_in_pickles_are_refused(file: Path, content: bytes) -> None:
    file.write_bytes(content)
    with pytest.raises(FaceDiffError, match=r"file\.pkl: not a pickle of plain NumPy arrays"):
        load_pickle(file, stand_ins=("chumpy",))
    for maker in FOR_STAND_INS.values():
        assert not getattr(maker, "__dict__", {}) or maker is object


@pytest.mark.parametrize("content", [b"cchumpy.ch\nCh\n(tR.", b"c__builtin__\nobject\n(tR."])
def test_stand_ins_are_used_only_if_requested(file: Path, content: bytes) -> None:
    file.write_bytes(content)
    with pytest.raises(FaceDiffError, match="it asks for"):
        load_pickle(file)


def test_plain_pickles_are_read_with_stand_ins_too(file: Path) -> None:
    file.write_bytes(pickle.dumps({"a": np.arange(4), "b": {1, 2}}))
    loaded = load_pickle(file, stand_ins=("chumpy",))
    np.testing.assert_array_equal(loaded["a"], np.arange(4))
    assert loaded["b"] == {1, 2}


def crafted(state: tuple[object, ...], data: object = b"12345678") -> bytes:
    """A pickle of an array of one element whose type has been given a state by hand."""

    class Kind:
        def __reduce__(self) -> tuple[object, ...]:
            return np.dtype, ("V8", False, True), state

    class Crafted:
        def __reduce__(self) -> tuple[object, ...]:
            reconstruct = np.zeros(1).__reduce__()[0]
            return reconstruct, (np.ndarray, (0,), b"b"), (1, (1,), Kind(), False, data)

    return pickle.dumps(Crafted(), 2)


@pytest.mark.parametrize(
    "content",
    [
        crafted((3, "|", None, ("a",), {"a": (np.dtype("O"), 0)}, 8, 8, 0)),
        crafted((3, "|", (np.dtype("O"), (1,)), None, None, 8, 8, 0)),
        crafted((3, "<", None, None, None, -1, -1, 0)),
        pickle.dumps(np.array([object, 1], object)),
        pickle.dumps(np.zeros(2, [("a", "f4"), ("b", "i4")])),
    ],
    ids=["field of objects", "subarray of objects", "void", "objects", "structured"],
)
def test_arrays_of_anything_but_plain_values_are_refused(tmp_path: Path, content: bytes) -> None:
    """NumPy would take the bytes of such arrays for pointers and crash, or worse."""
    (tmp_path / "t.pkl").write_bytes(content)
    with pytest.raises(FaceDiffError, match=r"t\.pkl: not a pickle of plain NumPy arrays"):
        load_pickle(tmp_path / "t.pkl")


@pytest.mark.parametrize("protocol", [0, 1, 2, 3, 4, 5])
@pytest.mark.parametrize(
    "array",
    [
        np.arange(6.0).reshape(2, 3),
        np.asfortranarray(np.arange(6, dtype="f4").reshape(2, 3)),
        np.array([1, 2], ">i2"),
        np.array(["a", "bc"]),
        np.array([b"x"]),
        np.array([True, False]),
        np.array(3.5),
        np.zeros((0, 3)),
        np.array([1 + 2j]),
    ],
    ids=str,
)
def test_plain_arrays_of_every_kind_come_back(tmp_path: Path, protocol: int, array: np.ndarray) -> None:
    (tmp_path / "t.pkl").write_bytes(pickle.dumps([array], protocol))
    (found,) = load_pickle(tmp_path / "t.pkl")
    assert np.asarray(found).dtype.newbyteorder("=") == array.dtype.newbyteorder("=")
    assert np.array_equal(found, array)
    assert found.shape == array.shape


def crafted_empty(shape: tuple[int, ...]) -> bytes:
    """A pickle of an array without numbers, of any shape."""

    class Crafted:
        def __reduce__(self) -> tuple[object, ...]:
            return np.zeros(1).__reduce__()[0], (np.ndarray, (0,), b"b"), (1, shape, np.dtype("f4"), False, b"")

    return pickle.dumps(Crafted(), 2)


def doubled(depth: int, ends: bytes = b"") -> bytes:
    """Tuples that hold the one before twice: 2 ** depth numbers in a few bytes."""
    return b"\x80\x02K\x01" + b"".join(b"q" + bytes([i]) + b"h" + bytes([i]) + b"\x86" for i in range(depth)) + ends


def called(function: bytes, argument: bytes, times: int) -> bytes:
    """A list of the results of one call with one large argument, many times over."""
    return b"\x80\x02" + function + b"q\x00" + argument + b"q\x01]" + b"h\x00h\x01\x85Ra" * times + b"."


LARGE = b"X" + struct.pack("<I", 1_000_000) + b"a" * 1_000_000
LONG_LIST = b"](" + b"N" * 100_000 + b"e"

BOMBS: dict[str, bytes] = {
    "empty": b"",
    "cut short": pickle.dumps(np.zeros(9))[:-9],
    "bytes that are not there": b"\x80\x04\x8e" + struct.pack("<Q", 2**40) + b"x.",
    "negative length": b"\x80\x02T" + struct.pack("<i", -1) + b"x.",
    "a frame that is not there": b"\x80\x04\x95" + struct.pack("<Q", 2**40) + b"N.",
    "a huge memo": b"\x80\x02Nr\xff\xff\xff\x7f.",
    "a huge memo as text": b"Np2147483647\n.",
    "a huge number": b"\x80\x02\x8b" + struct.pack("<i", 100_000) + b"\x7f" * 100_000 + b".",
    "a huge number as text": b"L" + b"9" * 100_000 + b"L\n.",
    "keys of one hash": b"\x80\x02}("
    + b"".join(b"\x8a\x14" + ((2**61 - 1) * i << 64).to_bytes(20, "little") + b"N" for i in range(1, 2000))
    + b"u.",
    "shared tuples": doubled(60, b"."),
    "shared tuples, less deep": doubled(40, b"."),
    "a list that holds itself": b"]q\x00h\x00a.",
    "deep": b"]" * 1000 + b"a" * 999 + b".",
    "text encoded many times": called(b"c_codecs\nencode\n", LARGE, 2000),
    "sets of one list": called(b"c__builtin__\nset\n", LONG_LIST, 2000),
    "dicts of one list": called(b"ccollections\nOrderedDict\n", LONG_LIST, 2000),
    "another codec": b"\x80\x02c_codecs\nencode\nX\x01\x00\x00\x00aX\x08\x00\x00\x00punycode\x86R.",
    "attributes of a dict": b"\x80\x02ccollections\nOrderedDict\n)R}X\x01\x00\x00\x00aNsb.",
    "attributes of a function": b"\x80\x02c__builtin__\nset\n}X\x01\x00\x00\x00aNsb.",
    "a buffer from elsewhere": b"\x80\x05\x97.",
    "an extension": b"\x80\x02\x82\x01.",
    "a persistent object": b"Pos.system\n.",
    "an array of endless empty rows": crafted_empty((10**15, 0)),
}


@pytest.mark.parametrize("content", BOMBS.values(), ids=BOMBS)
def test_bombs_are_refused_within_the_budget(file: Path, content: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("pickles", "limits"):
        monkeypatch.setattr(f"facediff.utils.{module}.LIMITS", replace(LIMITS, bytes=2e7, entries=2e5))
    file.write_bytes(content)
    start = time.perf_counter()
    tracemalloc.start()
    try:
        with pytest.raises(FaceDiffError, match=r"file\.pkl: not a pickle of plain NumPy arrays") as refused:
            load_pickle(file)
        most = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert "\n" not in str(refused.value)
    assert len(str(refused.value)) < 500
    assert most < 6e7
    assert time.perf_counter() - start < 20


def test_arrays_that_share_their_bytes_are_counted_as_often_as_they_are_copied(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    state = np.zeros(1_000_000, np.uint8).__reduce__()[2]

    class Copy:
        def __reduce__(self) -> tuple[object, ...]:
            return np.zeros(1).__reduce__()[0], (np.ndarray, (0,), b"b"), state

    monkeypatch.setattr("facediff.utils.pickles.LIMITS", replace(LIMITS, bytes=1e8))
    file.write_bytes(pickle.dumps([Copy() for _ in range(50)], 2))
    assert len(load_pickle(file)) == 50
    content = pickle.dumps([Copy() for _ in range(200)], 2)
    assert len(content) < 2_100_000
    file.write_bytes(content)
    with pytest.raises(FaceDiffError, match="FACEDIFF_MAX_BYTES"):
        load_pickle(file)


@pytest.mark.parametrize("protocol", [0, 1, 2, 3, 4, 5])
def test_a_large_dict_of_small_numbers_is_within_the_budget(file: Path, protocol: int) -> None:
    rows = {f"S{i}": {frame: 7 * frame for frame in range(5000)} for i in range(20)}
    file.write_bytes(pickle.dumps(rows, protocol))
    assert load_pickle(file) == rows
