"""JSON and CSV: strict when read, in one place only, and every text comes back as it was written."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from facediff.data.corpus import read_clip_table
from facediff.errors import FaceDiffError
from facediff.utils.plain_files import load_json, parse_json, read_json, read_rows, write_rows


@pytest.mark.parametrize(
    "text",
    [
        b"",
        b"\xff\xfe\x00",
        b'{"rate": NaN}',
        b'{"rate": -Infinity}',
        b'{"rate": 1e999}',
        b"[1" + 400 * b"0" + b"]",
        b"1" + 100_000 * b"0",
        b'{"rate": 25, "rate": 30}',
        b"[" * 100_000,
        b'"caf\xe9"',
        b"{'rate': 25}",
        b"[1] [2]",
    ],
    ids=lambda text: repr(text[:16]),
)
def test_json_that_is_not_plain_data_is_refused_by_name(text: bytes, tmp_path: Path) -> None:
    path = tmp_path / "about.json"
    path.write_bytes(text)
    with pytest.raises(FaceDiffError, match=r"about\.json") as error:
        load_json(path)
    assert "\n" not in str(error.value)
    assert read_json(path) is None


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-32"])
def test_json_of_every_unicode_encoding_is_read(encoding: str) -> None:
    text = '{"name": "caf\u00e9 \\ud83d\\ude00 \\\\u0000", "rates": [25, 29.97, -1e-300, 10]}'
    expected = {"name": "caf\u00e9 \U0001f600 \\u0000", "rates": [25, 29.97, -1e-300, 10]}
    assert parse_json(text.encode(encoding), "here") == expected


NAMES = ["=cmd()", "+1", "-2+3", "-clip", "@SUM(A1)", "\t=1", "\r=1", " =1", "'=1", "''=1", "'plain", "plain", "-0.5"]
NAMES += ["\uff1d1"]


def test_names_in_tables_are_no_formulas_and_are_read_back(tmp_path: Path) -> None:
    path = tmp_path / "clips.csv"
    write_rows(path, [{"clip": name, "=head": -0.5} for name in NAMES])
    with path.open(newline="", encoding="utf-8") as stream:
        raw = list(csv.reader(stream))
    for cell in [cell for row in raw for cell in row]:
        assert cell[:1] not in tuple("=@\t\r")
        assert cell[:1] not in tuple("+-") or np.isfinite(float(cell))
    assert list(read_rows(path, remedy="")) == [{"clip": name, "=head": "-0.5"} for name in NAMES]


@pytest.mark.parametrize(
    "content",
    [
        b"clip\n" + b'"' + b"x" * 200_000,  # beyond what a cell may hold
        b"clip,clip\na,b\n",
        b"clip\ncaf\xe9\n",
        b"\xff\xfec\x00l",  # half a character
    ],
    ids=lambda content: repr(content[:12]),
)
def test_tables_that_cannot_be_read_are_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "clips.csv").write_bytes(content)
    with pytest.raises(FaceDiffError, match=r"clips\.csv: "):
        list(read_rows(tmp_path / "clips.csv", remedy="save it again"))


TABLES = {
    "blanks": b"clip, mood , split\nA_e01, calm ,train\n\n , , \nA_e02,lively, test\n",
    "tabs": b"clip\tmood\tsplit\nA_e01\tcalm\ttrain\nA_e02\tlively\ttest\n",
    "sep=,": b"sep=,\r\nclip,mood,split\r\nA_e01,calm,train\r\nA_e02,lively,test\r\n",
    "sep=;": b"sep=;\nclip;mood;split\nA_e01;calm;train\nA_e02;lively;test\n",
    "quoted sep": b'"sep=\t"\nclip\tmood\tsplit\nA_e01\tcalm\ttrain\nA_e02\tlively\ttest\n',
    "mark": b"\xef\xbb\xbfclip,mood,split\nA_e01,calm,train\nA_e02,lively,test\n",
    "mark and sep": b"\xef\xbb\xbfsep=,\nclip,mood,split\nA_e01,calm,train\nA_e02,lively,test\n",
    "case": b"Clip,MOOD,Split\nA_e01,calm,train\nA_e02,lively,test\n",
    "quotes": b'"clip", "mood","split"\n"A_e01", "calm","train"\n"A_e02","lively","test"\n',
    "Unicode text": "\ufeffclip\tmood\tsplit\r\nA_e01\tcalm\ttrain\r\nA_e02\tlively\ttest\r\n".encode("utf-16-le"),
    "empty columns": b"clip,mood,split,,\nA_e01,calm,train,,\nA_e02,lively,test,,\n,,,,\n",
    "classic Mac": b"clip,mood,split\rA_e01,calm,train\rA_e02,lively,test\r",
}


@pytest.mark.parametrize("name", TABLES)
def test_tables_are_read_as_people_write_them(name: str, tmp_path: Path) -> None:
    (tmp_path / "clips.csv").write_bytes(TABLES[name])
    expected = {"A_e01": {"mood": "calm", "split": "train"}, "A_e02": {"mood": "lively", "split": "test"}}
    assert read_clip_table(tmp_path) == expected
    rows = list(read_rows(tmp_path / "clips.csv", ("clip", "mood", "split"), remedy=""))
    assert {row["clip"]: {"mood": row["mood"], "split": row["split"]} for row in rows} == expected


@pytest.mark.parametrize("header", ["clip,mood,mood", "clip,split,Split", "Clip,clip,mood", "clip, mood,mood "])
def test_a_column_that_occurs_twice_is_refused(header: str, tmp_path: Path) -> None:
    (tmp_path / "clips.csv").write_text(f"{header}\na,b,c\n")
    with pytest.raises(FaceDiffError, match="twice"):
        read_clip_table(tmp_path)
