"""A plan of two methods, played by a stand-in."""

from __future__ import annotations

from pathlib import Path

import pytest

PLAN = """\
seeds: [0, 1]
baseline: one
corpora: {tiny: {}}
methods:
  one: {config: one.yaml}
  two: {config: two.yaml, before: {prior: {config: one.yaml}}, options: {model.prior: "{prior}"}}
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a plan and two configs."""
    monkeypatch.setenv("STAND_IN_CALLS", str(tmp_path / "calls"))
    monkeypatch.setenv("FACEDIFF_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))
    (tmp_path / "part.yaml").write_text("dim: 3\n")
    (tmp_path / "one.yaml").write_text("model: part.yaml\n")
    (tmp_path / "two.yaml").write_text("model: {dim: 4}\n")
    (tmp_path / "plan.yaml").write_text(PLAN)
    return tmp_path
