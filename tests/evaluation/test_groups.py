"""Scores by attributes of clips, against means over the rows of the clips."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from facediff.evaluation import text
from facediff.evaluation.groups import attributes_of
from tests.evaluation.conftest import LENGTHS, Files, write_corpus

MOODS = {"A_e01": "calm", "A_e02": "calm", "A_e03": "lively", "B_C_e01": "lively", "B_C_e02": "calm"}


@pytest.fixture
def moody(tmp_path: Path) -> Files:
    files = write_corpus(tmp_path / "moody")
    lines = ["clip,mood,loud", *(f"{clip},{mood},{len(mood)}" for clip, mood in MOODS.items())]
    (files.root / "clips.csv").write_text("\n".join(lines))
    return files


def test_groups_are_pooled_as_the_whole_is(moody: Files) -> None:
    report = moody.evaluate(
        "ours", "theirs", corpus=moody.root, by=["mood"], metrics=["mean_vertex_error:squared=true"]
    )
    assert [(group.method, group.attributes["mood"], group.sequences) for group in report.groups] == [
        (method, mood, count) for method in ("ours", "theirs") for mood, count in (("calm", 3), ("lively", 2))
    ]
    for group in report.groups:
        method = next(each for each in report.methods if each.name == group.method)
        rows = [row for row in method.sequences if row.attributes == group.attributes]
        frames = [LENGTHS[row.clip] for row in rows]
        for name, pooled in (
            ("paper/lve", True),
            ("paper/fdd", False),
            ("metrics/mean_vertex_error:squared=true", True),
        ):
            values = [row.scores[name] for row in rows]
            assert group.scores[name] == pytest.approx(np.average(values, weights=frames if pooled else None))
    assert "by mood" in text(report)
    assert report.as_dict()["groups"][0]["attributes"] == {"mood": "calm"}


def test_names_of_3dmead_and_biwi_say_emotions() -> None:
    mead = attributes_of(None, ["M003_001_4_1"], ["emotion", "intensity"])
    assert mead == {"M003_001_4_1": {"emotion": "fear", "intensity": "2"}}
    found = attributes_of(None, ["F2_e37", "F2_37"], ["emotion"])
    assert [each["emotion"] for each in found.values()] == ["emotional", "neutral"]
