"""JSON and CSV, from elsewhere and for others: strict when read, whole or not at all when written."""

from __future__ import annotations

import csv
import io
import json
import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from facediff.errors import FaceDiffError, damaged
from facediff.utils.files import atomic

# JSON.


def parse_json(text: bytes | str, source: object, *, remedy: str = "expected a JSON file") -> Any:  # noqa: ANN401
    """Plain data of a JSON text, or of its bytes in UTF-8, UTF-16 or UTF-32; no other module parses one.

    Python's parser takes NaN, infinity and keys that occur twice, of which the last counts: all would be wrong in
    silence, and are refused. Messages call the text ``source`` and end in ``remedy``.
    """
    hooks: dict[str, Any] = {"parse_constant": _finite, "parse_float": _finite, "parse_int": _whole}
    with damaged(f"{source}: not readable as JSON", remedy, RecursionError):
        if isinstance(text, bytes):
            text = text.decode(json.detect_encoding(text))
        return json.loads(text, **hooks, object_pairs_hook=_unique)


def load_json(path: Path, *, name: str = "", remedy: str = "expected a JSON file") -> Any:  # noqa: ANN401
    """Plain data that a JSON file holds, as :func:`parse_json` reads it; messages call it ``name``."""
    return parse_json(read_bytes(path, name=name, remedy=remedy), name or path, remedy=remedy)


def read_bytes(path: Path, *, name: str = "", remedy: str) -> bytes:
    """The bytes of a file; arguments as in :func:`load_json`."""
    with damaged(f"{name or path}: cannot be read", remedy, OSError):
        return path.read_bytes()


def read_json(path: Path) -> dict[str, Any] | None:
    """The object that a JSON file holds; None if there is no such file, or it holds anything else."""
    try:
        content = load_json(path)
    except FaceDiffError:
        return None
    return content if isinstance(content, dict) else None


def _finite(number: str) -> float:
    if not math.isfinite(value := float(number)):
        raise ValueError(f"the number {number[:20]} is not finite")
    return value


def _whole(number: str) -> int:
    _finite(number)
    return int(number)


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    mapping: dict[str, Any] = {}
    for key, value in pairs:
        if key in mapping:
            raise ValueError(f'the key "{key}" occurs twice')
        mapping[key] = value
    return mapping


def json_text(
    path: Path | str, content: Mapping[str, Any], *, indent: int | None = 1, ensure_ascii: bool = False
) -> str:
    """An object as the text of a JSON file, which has no words for numbers that are not finite."""
    with damaged(f"{path}: would hold a number that is NaN or infinite", "expected finite inputs, check them"):
        return json.dumps(content, indent=indent, ensure_ascii=ensure_ascii, allow_nan=False)


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write an object as JSON, whole or not at all; equal objects give equal bytes."""
    text = json_text(path, content) + "\n"
    with atomic(path) as temporary:
        # Bytes of a file name that are no UTF-8 become the escapes by which JSON names them; they come back on reading.
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


# CSV.

# A spreadsheet takes a cell that begins with one of these as a formula, and runs it. Names come from foreign files,
# so that such a cell is written with an apostrophe in front (as OWASP advises), which our own readers take away again.
# A cell that already looks like that gets one more, so that every text is read back as it was. Numbers stay numbers.
_FORMULA = tuple("=+-@\t\r\n\uff1d\uff0b\uff0d\uff20")


def _is_formula(text: str) -> bool:
    return text.lstrip(" '").startswith(_FORMULA)


def csv_cell(value: object) -> object:
    """A cell that no spreadsheet takes as a formula: ``=cmd()`` becomes ``'=cmd()``; numbers stay as they are."""
    if not isinstance(value, str) or not _is_formula(value):
        return value
    try:
        float(value)
    except ValueError:
        return f"'{value}"
    return value


def csv_text(cell: str) -> str:
    """The text that :func:`csv_cell` made a cell of."""
    return cell[1:] if cell.startswith("'") and _is_formula(cell) else cell


def write_table(path: Path, table: Iterable[Iterable[object]], *, line_end: str = "\n") -> None:
    """Write a header and rows as CSV, in cells of :func:`csv_cell`; not atomic."""
    with path.open("w", newline="", encoding="utf-8", errors="backslashreplace") as stream:
        csv.writer(stream, lineterminator=line_end).writerows(map(csv_cell, row) for row in table)


def write_rows(path: Path, rows: Sequence[Mapping[str, Any]], *, line_end: str = "\r\n") -> None:
    """Write rows with equal keys as CSV, whole or not at all."""
    header = list(rows[0])
    with atomic(path) as temporary:
        write_table(temporary, [header, *([row[key] for key in header] for row in rows)], line_end=line_end)


def decoded(content: bytes) -> str:
    """The text of a file from elsewhere: UTF-8, or UTF-16 with its mark."""
    return content.decode("utf-16" if content[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig")


def read_table(path: Path, *, remedy: str) -> Iterator[list[str]]:
    """The header and the rows of a CSV file from elsewhere, in cells of :func:`csv_text`, without empty lines.

    It is UTF-8, or what spreadsheets save as Unicode text (UTF-16), with commas or tabs between cells, or with the
    character of a first line such as ``sep=;``. Blanks around cells do not count.
    """
    with damaged(f"{path}: not readable as a UTF-8 table", remedy, OSError, csv.Error):
        text = decoded(path.read_bytes())
        first, _, rest = text.partition("\n")
        separator = ","
        if (stated := re.fullmatch(r'"?sep=(.)"?\s*', first)) is not None:
            separator, text = stated[1], rest
        elif "\t" in first and "," not in first:
            separator = "\t"
        rows = list(csv.reader(io.StringIO(text, newline=""), delimiter=separator, skipinitialspace=separator != "\t"))
        if rows and len(rows[0]) == 1 and ";" in rows[0][0]:
            raise ValueError("row 1 has semicolons between its columns, save it with commas")
    yield from ([csv_text(cell.strip()) for cell in row] for row in rows if any(row))


def read_columns(path: Path, names: Iterable[str] = (), *, remedy: str) -> tuple[list[str], Iterator[list[str]]]:
    """The header and the rows of a file of :func:`read_table`; a column that occurs twice is an error.

    The case of ``names`` does not count; the header has them as they are here.
    """
    rows = read_table(path, remedy=remedy)
    spelling = {name.casefold(): name for name in names}
    header = [spelling.get(name.casefold(), name) for name in next(rows, [])]
    if columns := [name for name, count in Counter(filter(None, header)).items() if count > 1]:
        raise FaceDiffError(f'{path}: has the column "{columns[0]}" twice; {remedy}')
    return header, rows


def read_rows(path: Path, names: Iterable[str] = (), *, remedy: str) -> Iterator[dict[str, str]]:
    """Rows of :func:`read_columns` by column; cells that a row lacks are empty, and further ones are left out."""
    header, rows = read_columns(path, names, remedy=remedy)
    for row in rows:
        yield dict(zip(header, row + [""] * (len(header) - len(row)), strict=False))
