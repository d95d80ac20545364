"""Plain data of files as dataclasses: each kind of field is taken and refused in a sentence that names it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest

from facediff.errors import FaceDiffError
from facediff.utils.ranges import Range
from facediff.utils.records import DERIVED, Items, Text, read_record

Word = Annotated[str, Text("[a-z]+", "small letters", longest=8)]


@dataclass(frozen=True)
class Inner:
    count: Annotated[int, Range(1, 9)]
    kind: Literal["a", "b"] = "a"


@dataclass(frozen=True)
class Outer:
    word: Word
    parts: Mapping[Word, Inner] = field(default_factory=dict)
    many: Annotated[tuple[Inner, ...], Items(1, 2)] = (Inner(1),)
    pair: tuple[str, float] = ("", 0.0)
    file: Annotated[Path, Text("[^/]*", "a name")] | None = None
    anything: Any = None
    flag: bool = False
    name: str = field(default="derived", metadata=DERIVED)


def test_what_fits_is_read_and_null_is_the_default() -> None:
    content = {"word": "yes", "parts": {"one": {"count": 2}}, "many": [{"count": 3, "kind": "b"}], "pair": ["x", 1]}
    read = read_record(Outer, {**content, "file": "f", "flag": None, "anything": [1]}, "file.json")
    assert read == Outer("yes", {"one": Inner(2)}, (Inner(3, "b"),), ("x", 1), Path("f"), [1])
    assert read_record(Outer, {**content, "more": 1}, "f", strict=False).word == "yes"
    assert asdict(read)["parts"] == {"one": {"count": 2, "kind": "a"}}


WRONG: dict[str, dict[str, object]] = {
    "word is None": {"word": None},
    "word is 'no one'": {"word": "no one"},
    "word is 'aaaaaaaaa'": {"word": "a" * 9},
    "parts is \\[\\]": {"parts": []},
    "parts: a key is 'X'": {"parts": {"X": {"count": 1}}},
    "parts.one.count is 0; expected a whole number from 1 to 9": {"parts": {"one": {"count": 0}}},
    "parts.one.count is True": {"parts": {"one": {"count": True}}},
    "many\\[0\\].kind is 'c'; expected one of a, b": {"many": [{"count": 1, "kind": "c"}]},
    "many is \\[\\]": {"many": []},
    "pair is \\['x'\\]": {"pair": ["x"]},
    "pair\\[1\\] is nan": {"pair": ["x", float("nan")]},
    "file is 'a/b'|file is PosixPath": {"file": "a/b"},
    "flag is 1": {"flag": 1},
    'has no field "name"': {"name": "mine"},
    'has no field "wrd": did you mean "word"': {"wrd": "x"},
}


@pytest.mark.parametrize("named", WRONG)
def test_what_does_not_fit_is_one_sentence(named: str) -> None:
    with pytest.raises(FaceDiffError, match=rf"^file\.json: ({named})"):
        read_record(Outer, {"word": "yes", **WRONG[named]}, "file.json")
