"""docs/python.md: its blocks run one after the other, and the first one is what the project promises."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

import facediff

PAGE = (Path(__file__).parents[2] / "docs" / "python.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
SHORTER = {"max_epochs=8": "max_steps=1, limit_val_batches=0, logger=False", "dim=64": "dim=16"}
"""What is changed in the block that trains."""


def test_the_blocks_run_as_they_stand(workplace: Path, puppet_corpus: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("facediff.data.puppet.Puppet.prepare_data", lambda self: None)  # five clips are enough
    shorter = {**SHORTER, "Puppet(batch_size=8)": f"Puppet(root={str(puppet_corpus)!r}, batch_size=2)"}
    shorter["trainer.test(own, datamodule=data)\n"] = ""  # of a whole corpus
    assert "facediff.load(" in BLOCKS[0]
    names: dict[str, Any] = {}
    for block in BLOCKS:
        block = block.replace('save("f1.mp4")', 'save("f1.mp4", size=64)')
        if "Trainer(" in block:
            for long, short in shorter.items():
                assert long in block
                block = block.replace(long, short)
        exec(compile(block, "docs/python.md", "exec"), names)  # noqa: S102 - our own page
    anim = names["anim"]
    assert anim.vertices.dtype == "float32"
    assert anim.vertices.shape == names["truth"].vertices.shape == (len(anim.vertices), 5875, 3)
    assert {"lips", "upper_face"} <= anim.regions.keys()
    assert anim.metadata["style"] == "0.4 F1_e03 + 0.6 M2_e05"
    written = {path.name for path in workplace.iterdir()}
    assert {"f1.glb", "f1.mp4", "f1.npz", "comparison.html", "all.html", "three.html", "f1_cm_obj"} <= written
    assert {"side.mp4", "weights.csv", "talking-face"} <= written
    assert "truth" in (workplace / "comparison.html").read_text()
    assert "own.npz" in written


def test_every_public_name_is_on_the_page() -> None:
    assert [name for name in facediff.__all__ if f"facediff.{name}" not in PAGE] == []
