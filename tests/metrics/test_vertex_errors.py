"""Vertex errors and dynamics beyond the formulas in `further_cases`: one template for a batch."""

from __future__ import annotations

from typing import Any

import torch

from facediff.metrics import face_dynamics_deviation

Corpus = Any  # the class of that name in conftest.py, which test files cannot import


def test_one_template_serves_a_whole_batch(corpus: Corpus, upper: tuple[int, ...]) -> None:
    batch = corpus.batch([2, 3])
    shared = batch.pop("template")[0]
    one = face_dynamics_deviation(upper=upper, template=shared, **batch)
    many = face_dynamics_deviation(upper=upper, template=torch.stack([shared, shared]), **batch)
    assert one == many
