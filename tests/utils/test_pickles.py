"""Stand-ins for objects of other packages in pickles: they keep what the pickle holds and do nothing."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest

from facediff.errors import FaceDiffError
from facediff.utils.pickles import StandIn, load_pickle
from tests.fakes.flame import foreign, model_pickle
from tests.fakes.hostile import Harm


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


@pytest.mark.parametrize("content", [b"cchumpy.ch\nCh\n(tR.", b"c__builtin__\nobject\n(tR."])
def test_stand_ins_are_used_only_if_requested(file: Path, content: bytes) -> None:
    file.write_bytes(content)
    with pytest.raises(FaceDiffError, match="it asks for"):
        load_pickle(file)


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
    (tmp_path / "t.pkl").write_bytes(pickle.dumps([array, {"b": {1, 2}}], protocol))
    found, plain = load_pickle(tmp_path / "t.pkl")
    assert plain == {"b": {1, 2}}
    assert np.asarray(found).dtype.newbyteorder("=") == array.dtype.newbyteorder("=")
    assert np.array_equal(found, array)
    assert found.shape == array.shape


HOSTILE: dict[str, bytes] = {
    "empty": b"",
    "cut short": pickle.dumps(np.zeros(9))[:-9],
    "another codec": b"\x80\x02c_codecs\nencode\nX\x01\x00\x00\x00\xff\xffX\x08\x00\x00\x00punycode\x86R.",
    "attributes of a function": b"\x80\x02c_codecs\nencode\n(N}X\x0c\x00\x00\x00__defaults__Nst\x62.",
    "an extension": b"\x80\x02\x82\x01.",
    "a persistent object": b"Pos.system\n.",
    "more than its bytes": crafted((3, "<", None, None, None, 8, 8, 0), b"1"),
}


@pytest.mark.parametrize("content", HOSTILE.values(), ids=HOSTILE)
def test_damaged_and_hostile_pickles_are_refused_in_a_sentence(file: Path, content: bytes) -> None:
    file.write_bytes(content)
    with pytest.raises(FaceDiffError, match=r"file\.pkl: not a pickle of plain NumPy arrays") as refused:
        load_pickle(file)
    assert "\n" not in str(refused.value)


def test_nothing_of_a_pickle_runs(file: Path) -> None:
    harm = Harm(file.with_name("harm"))
    for content in ([harm], {"a": np.array([harm], object)}):
        file.write_bytes(pickle.dumps(content))
        for stand_ins in ((), ("chumpy", "scipy")):
            with pytest.raises(FaceDiffError):
                load_pickle(file, stand_ins=stand_ins)
    assert not harm.path.exists()
