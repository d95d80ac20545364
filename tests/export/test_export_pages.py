"""The pages about exporting name what there is, and their commands are understood."""

from __future__ import annotations

import re
import runpy
import sys
from pathlib import Path

import cv2
import pytest

from facediff.animation import Animation
from facediff.export import FORMATS, write_animations

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "docs" / "export.md", ROOT / "docs" / "programs.md"]


def test_the_table_of_formats_is_complete() -> None:
    rows = re.findall(r"^\| `(\.\w+)` \|(.*)\|$", PAGES[0].read_text(), re.MULTILINE)
    assert sorted(suffix for suffix, _ in rows) == list(FORMATS)
    for suffix, row in rows:
        speech = row.split("|")[4]
        assert ("in it" in speech) == (FORMATS[suffix].speech == "in the file")
        assert ("next to it" in speech or "in the folder" in speech) == (FORMATS[suffix].speech == "next to it")
        assert ("y up" in row and "any" not in row) == (FORMATS[suffix].units == "m")


def test_the_picture_is_drawn_from_the_file_alone(
    animation: Animation, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_animations(tmp_path / "a.glb", [animation])
    words = [str(tmp_path / "a.glb"), str(tmp_path / "a.png"), "--times", "0", "0.5", "--size", "64"]
    monkeypatch.setattr(sys, "argv", ["glb_sheet.py", *words])
    runpy.run_path(str(ROOT / "tools" / "glb_sheet.py"), run_name="__main__")
    assert cv2.imread(str(tmp_path / "a.png")).shape[1] == 2 * 64 + 6
