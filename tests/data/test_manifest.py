"""Manifests that are damaged, absurd or hostile are refused by name."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from facediff.data.corpus import read_manifest
from facediff.errors import FaceDiffError
from facediff.utils.limits import quoted


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"[]",
        b"null",
        b"{",
        b"\xff\xfe{\x00",
        b"[" * 5000,
        *(
            json.dumps({key: value}).encode()
            for key, value in [
                ("format", 2),
                ("format", "1"),
                ("format", None),
                ("format", True),
                *(("frame_rate", rate) for rate in (-25, 1e-9, 1e9, "25", True, [25], {})),
                *(("n_vertices", count) for count in (0, -1, 1.5, "9", True)),
                *(("unit", unit) for unit in (1, "m\n", "x" * 999, [])),
                *(("person", name) for name in (1, "\x1b", [])),
                *(("corpus", name) for name in (1, {})),
            ]
        ),
        b'{"frame_rate": NaN}',
        b'{"frame_rate": 1e999}',
        b'{"frame_rate": 25, "frame_rate": 30}',
    ],
    ids=quoted,
)
def test_manifest_that_is_wrong_is_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "manifest.json").write_bytes(content)
    with pytest.raises(FaceDiffError, match=r"manifest\.json") as refused:
        read_manifest(tmp_path)
    assert "\n" not in str(refused.value)


def test_manifest_of_a_later_format_says_so(tmp_path: Path) -> None:
    (tmp_path / "manifest.json").write_text('{"format": 2}')
    with pytest.raises(FaceDiffError, match="update facediff"):
        read_manifest(tmp_path)
    (tmp_path / "manifest.json").write_text('{"frame_rate": 25, "unit": "m"}')  # before formats had numbers
    assert read_manifest(tmp_path)["frame_rate"] == 25
