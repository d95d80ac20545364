"""Vertex errors and dynamics beyond the formulas in `further_cases`: long sequences, offsets and templates."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from facediff.metrics import face_dynamics_deviation, mean_vertex_error

Corpus = Any  # the class of that name in conftest.py, which test files cannot import


def test_long_sequences_are_worked_in_pieces_with_the_same_result() -> None:
    truth, prediction = torch.randn(2, 9, 23370, 3, generator=torch.manual_seed(0)).unbind(0)
    expected = (truth.double() - prediction.double()).norm(dim=-1).mean().item()
    assert mean_vertex_error(prediction, truth).item() == pytest.approx(expected, rel=1e-12)
    spreads = [motion.double().square().sum(-1).std(0, correction=0).mean() for motion in (truth, prediction)]
    found = face_dynamics_deviation(prediction, truth, range(23370), sign="signed")
    assert found.item() == pytest.approx((spreads[0] - spreads[1]).item(), rel=1e-9)


def test_one_template_serves_a_whole_batch(corpus: Corpus, upper: tuple[int, ...]) -> None:
    batch = corpus.batch([2, 3])
    shared = batch.pop("template")[0]
    one = face_dynamics_deviation(upper=upper, template=shared, **batch)
    many = face_dynamics_deviation(upper=upper, template=torch.stack([shared, shared]), **batch)
    assert one == many
