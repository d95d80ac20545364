"""Noise that all threads draw."""

from __future__ import annotations

import pytest
import torch

from facediff.models import samplers as draws
from facediff.models.samplers import unit_noise

CPU = torch.device("cpu")


def test_unit_noise_does_not_depend_on_the_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(draws, "PART", 100)
    found = []
    for threads in (1, 3):
        monkeypatch.setattr(torch, "get_num_threads", lambda threads=threads: threads)
        found.append(unit_noise((3, 7, 50), CPU, torch.Generator().manual_seed(5)))
    assert torch.equal(*found)
    assert found[0].shape == (3, 7, 50)
    assert not torch.equal(found[0], unit_noise((3, 7, 50), CPU, torch.Generator().manual_seed(6)))
    with torch.inference_mode():
        assert torch.equal(found[0], unit_noise((3, 7, 50), CPU, torch.Generator().manual_seed(5)))


def test_unit_noise_follows_the_global_seed() -> None:
    torch.manual_seed(1)
    first, second = unit_noise((20,), CPU), unit_noise((20,), CPU)
    torch.manual_seed(1)
    assert torch.equal(unit_noise((20,), CPU), first)
    assert not torch.equal(first, second)


def test_unit_noise_is_unit_gaussian_with_independent_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(draws, "PART", 10_000)
    noise = unit_noise((20, 10_000), CPU, torch.Generator().manual_seed(0)).double()
    # Standard errors: 1 / √200 000 for the mean, √(2 / 200 000) for the variance, 1 / √10 000 between rows.
    assert abs(float(noise.mean())) < 4 / 200_000**0.5
    assert abs(float(noise.var()) - 1) < 4 * (2 / 200_000) ** 0.5
    assert float((torch.corrcoef(noise) - torch.eye(20)).abs().max()) < 0.05
