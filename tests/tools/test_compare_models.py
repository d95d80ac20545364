"""The comparison's own formulas, against the package's metrics and against vectors whose answer is known."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from facediff.metrics import face_dynamics_deviation
from tools import compare_models


def test_deviation_is_the_metric_where_lengths_are_equal() -> None:
    motion, truth, upper = torch.randn(20, 9, 3), torch.randn(20, 9, 3), torch.tensor([1, 4, 7])
    want = face_dynamics_deviation(motion, truth, upper.tolist(), sign="signed")
    assert compare_models.deviation(motion, truth, upper) == pytest.approx(float(want), rel=1e-6)


def test_nearest_speaker_by_vectors_that_tell(monkeypatch: pytest.MonkeyPatch) -> None:
    samples = [SimpleNamespace(identity_name=name) for name in "AABBCC"]
    monkeypatch.setattr(compare_models, "held_out", lambda data: samples)
    vectors = torch.tensor([[0.0, 0], [0, 1], [9, 0], [9, 1], [0, 9], [8, 0.5]])
    monkeypatch.setattr(compare_models, "styles", lambda model, given: vectors)
    # The fifth is alone and has an A nearest, the sixth has a B; all others have their own.
    assert compare_models.style_accuracy(None, None) == pytest.approx(4 / 6)  # type: ignore[arg-type]


@pytest.mark.parametrize(("told", "low", "high"), [(True, 0.99, 1.0), (False, 0.0, 0.35)])
def test_the_probe_finds_a_speaker_who_is_there_and_no_other(
    told: bool, low: float, high: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    torch.manual_seed(0)
    samples, features = [], []
    for index, name in enumerate("ABCDEFGH"):
        for sentence in range(28, 33):
            samples.append(SimpleNamespace(identity_name=name, sentence=f"e{sentence}"))
            content = torch.randn(60, 16)
            content[:, index] += 8.0 * told
            features.append(content)
    monkeypatch.setattr(compare_models, "held_out", lambda data: samples)
    monkeypatch.setattr(compare_models, "contents", lambda model, given: features)
    assert low <= compare_models.content_probe(None, None) <= high  # type: ignore[arg-type]


def test_the_table_has_a_line_per_figure() -> None:
    rows = [{"model": "one", "LVE": 1.25e-5, "parameters": 1234}, {"model": "two", "LVE": 2e-5}]
    assert compare_models.table(rows).splitlines() == [
        "| | one | two |",
        "|---|---|---|",
        "| LVE | 1.25e-05 | 2e-05 |",
        "| parameters | 1,234 |  |",
    ]
