"""A search of the manual finds the right page first."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.fakes.site_search import ranking

DOCS = Path(__file__).parents[2] / "docs"


def test_headings_count_more_than_text_and_beginnings_of_words_match(tmp_path: Path) -> None:
    (tmp_path / "a.md").write_text("# Frames\n\nmotion motion motion\n")
    (tmp_path / "b.md").write_text("# Motions\n\nframes\n\n```sh\n# motion\n```\n")
    (tmp_path / "c.md").write_text("# Nothing\n\nof that\n")
    assert ranking(tmp_path, "motion") == ["b.md", "a.md"]


@pytest.mark.parametrize(
    ("query", "page"),
    [
        ("learning rate schedule", "training.md"),
        ("batch size", "training.md"),
        ("own model", "components.md"),
        ("DDP", "cluster.md"),
        ("loss", "losses.md"),
        ("blendshapes", "blendshapes.md"),
        ("phone", "parameters.md"),
        ("avatar", "tutorial_avatar.md"),
        ("licence", "publishing.md"),
        ("overrides", "command_line.md"),
        ("blender", "programs.md"),
        ("faceformer", "methods.md"),
        ("low latency", "streaming.md"),
        ("vocaset", "data.md"),
        ("own mesh", "own_mesh.md"),
        ("optimizer", "lightning.md"),
        ("LightningCLI", "lightning.md"),
        ("OmegaConf", "lightning.md"),
        ("profiler", "lightning.md"),
        ("reproducible", "lightning.md"),
        ("checkpointing", "lightning.md"),
        ("best checkpoint", "lightning.md"),
        ("own callback", "lightning.md"),
        ("normalization", "training.md"),
        ("quantization", "exported_models.md"),
        ("own dataset", "own_data.md"),
    ],
)
def test_the_right_page_is_found_first(query: str, page: str) -> None:
    assert ranking(DOCS, query)[0] == page
