"""Metrics of generation beyond the formulas in `further_cases`: motion that stands still."""

from __future__ import annotations

import pytest
import torch

import facediff.metrics as fm


def test_motion_that_stands_still_has_a_spectrum_and_no_ratio() -> None:
    moving = torch.randn(40, 2, 3, generator=torch.Generator().manual_seed(0))
    still = torch.zeros_like(moving)
    assert 15 < fm.spectrum_distance(still, moving).item() < 200
    with pytest.raises(ValueError, match="truth does not move"):
        fm.spectrum_distance(moving, still)
    with pytest.raises(ValueError, match="DifferenceRatio"):
        fm.difference_ratio(still, moving)
