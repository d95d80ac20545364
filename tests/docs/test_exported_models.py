"""The worked example of docs/exported_models.md: a model of another project as graphs."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch

from facediff.pipelines.export_model import export_model
from tests.fakes.tiny import Tiny

PAGE = Path(__file__).parents[2] / "docs" / "exported_models.md"


@pytest.mark.slow
def test_the_model_of_the_page_is_exported_and_computes_the_same(tiny: Tiny, tmp_path: Path) -> None:
    pytest.importorskip("onnxscript")
    (code,) = [block for block in re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL) if "Graphs(" in block]
    names: dict[str, type] = {"__name__": "example"}  # type: ignore[dict-item]
    exec(compile(code, PAGE, "exec"), names)  # noqa: S102 - the page's own code
    torch.manual_seed(0)
    model = names["Regression"](n_vertices=tiny.n_vertices, identities=tiny.identities, frame_rate=tiny.frame_rate)
    model.adopt(tiny.assets().with_motion_scale(tiny.motion_scale()))
    described = export_model(model, tmp_path / "exported")
    assert sorted(described.graphs) == ["motion", "speech"]
    assert described.check["share_of_range"] < 1e-4
