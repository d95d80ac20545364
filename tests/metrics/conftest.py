"""A ragged corpus, and padding."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

LENGTHS = (7, 1, 30, 12, 2)
VERTICES = 40
LIPS = (3, 4, 9, 31)
UPPER = (0, 1, 20, 25, 39)

Array = NDArray[Any]


@dataclass(frozen=True)
class Corpus:
    """Sequences of different lengths (frames, vertices, 3) and a template (vertices, 3) for each."""

    truths: list[Array]
    predictions: list[Array]
    templates: list[Array]

    def batch(self, places: Sequence[int], extra: int = 0) -> dict[str, Any]:
        """Arguments of `update` for some sequences, padded with NaN, which must never be read."""
        lengths = [len(self.truths[place]) for place in places]
        frames = max(lengths) + extra

        def pad(sequences: list[Array]) -> Tensor:
            out = torch.full((len(places), frames, VERTICES, 3), float("nan"), dtype=torch.float32)
            for row, place in enumerate(places):
                out[row, : lengths[row]] = torch.from_numpy(sequences[place])
            return out

        return {
            "prediction": pad(self.predictions),
            "truth": pad(self.truths),
            "template": torch.from_numpy(np.stack([self.templates[place] for place in places])),
            "lengths": torch.tensor(lengths),
        }


@pytest.fixture(scope="session")
def corpus() -> Corpus:
    """Absolute vertices of a size like BIWI's: coordinates near one, motion of a hundredth, errors less."""
    rng = np.random.default_rng(0)
    templates = [rng.uniform(-1, 1, (VERTICES, 3)).astype(np.float32) for _ in LENGTHS]
    truths, predictions = [], []
    for frames, template in zip(LENGTHS, templates, strict=True):
        motion = 0.01 * rng.standard_normal((frames, VERTICES, 3))
        error = 0.004 * rng.standard_normal((frames, VERTICES, 3))
        truths.append((template + motion).astype(np.float32))
        predictions.append((template + rng.uniform(0.6, 1.2) * motion + error).astype(np.float32))
    return Corpus(truths, predictions, templates)


@pytest.fixture(scope="session")
def lips() -> tuple[int, ...]:
    """Lip vertices of the corpus."""
    return LIPS


@pytest.fixture(scope="session")
def upper() -> tuple[int, ...]:
    """Upper-face vertices of the corpus."""
    return UPPER
