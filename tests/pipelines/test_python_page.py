"""docs/python.md: its blocks run one after the other, and the first one is what the project promises."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import facediff

PAGE = (Path(__file__).parents[2] / "docs" / "python.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


def test_the_blocks_run_as_they_stand(workplace: Path) -> None:
    assert "facediff.load(" in BLOCKS[0]
    names: dict[str, Any] = {}
    for block in BLOCKS:
        exec(compile(block, "docs/python.md", "exec"), names)  # noqa: S102 - our own page
    anim = names["anim"]
    assert anim.vertices.dtype == "float32"
    assert anim.vertices.shape == names["truth"].vertices.shape == (len(anim.vertices), 1008, 3)
    assert {"lips", "upper_face"} <= anim.regions.keys()
    assert anim.metadata["style"] == "0.4 F1_e03 + 0.6 M2_e05"
    written = {path.name for path in workplace.iterdir()}
    assert {"f1.glb", "f1.mp4", "f1.npz", "comparison.html", "all.html", "three.html", "f1_cm_obj"} <= written
    assert {"side.mp4", "weights.csv", "talking-face"} <= written
    assert "truth" in (workplace / "comparison.html").read_text()


def test_every_public_name_is_on_the_page() -> None:
    assert [name for name in facediff.__all__ if f"facediff.{name}" not in PAGE] == []
