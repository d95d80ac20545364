"""Curves of the mouth's opening, and the outline of a waveform."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from facediff.evaluation.figures import (
    FigureData,
    opening_curves,
    read_pairs,
)
from facediff.evaluation.figures import material as material_module
from facediff.evaluation.figures.lips import envelope
from facediff.metrics import mouth_opening_difference
from tests.fakes.tiny import RATE, VERTICES

Read = Callable[[str, str], NDArray[np.float64]]


@pytest.fixture(params=[2**20, 100], ids=["whole clips", "single frames"])
def chunk(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(material_module, "CHUNK", request.param)


@pytest.mark.usefixtures("chunk")
def test_opening_curves_are_those_of_the_metrics(own_material: FigureData, read: Read, tiny_root: Path) -> None:
    pairs = read_pairs(None, tiny_root, VERTICES)
    curves, note = opening_curves(own_material, "A_e06", pairs)
    assert note is None
    for name, found in curves.openings.items():
        each = [
            np.linalg.norm(read(name, "A_e06")[:, a] - read(name, "A_e06")[:, b], axis=1) for a, b in [(0, 6), (1, 7)]
        ]
        np.testing.assert_allclose(found, np.mean(each, axis=0), rtol=1e-12)
    np.testing.assert_allclose(curves.times, (np.arange(len(curves.times)) + 0.5) / RATE)
    apart = mouth_opening_difference(torch.tensor(read("ours", "A_e06")), torch.tensor(read("truth", "A_e06")), pairs)
    assert np.abs(curves.openings["ours"] - curves.openings["truth"]).mean() == pytest.approx(apart.item())


def test_the_envelope_holds_every_sample() -> None:
    samples = np.random.default_rng(0).normal(size=1003).astype("f4")
    low, high = envelope(samples, 10)
    assert (len(low), low.min(), high.max()) == (10, samples.min(), samples.max())
    parts = np.split(samples, np.linspace(0, 1003, 11).astype(int)[1:-1])
    np.testing.assert_array_equal(low, [part.min() for part in parts])
    np.testing.assert_array_equal(high, [part.max() for part in parts])
    assert len(envelope(samples[:3], 10)[0]) == 3
