"""Authors' checkpoints of tests/fakes/published.py as models, with speech and faces for them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from facediff.data import Sample
from facediff.models import AnimationModel, import_checkpoint
from tests.fakes import published
from tests.fakes.published import IDENTITIES, VERTICES, State

# Samples for 40, 41, 58 and 205 steps of speech: odd and even, and where floating point gives a frame less.
SAMPLES = {40: 13_000, 41: 13_270, 58: 18_700, 205: 65_800}


def speech_of(steps: int) -> Tensor:
    time = torch.arange(SAMPLES[steps]) / 16_000
    noise = torch.randn(len(time), generator=torch.Generator().manual_seed(steps))
    return 0.2 * torch.sin(2 * torch.pi * 210 * time) * torch.sin(9 * time) + 0.02 * noise


def templates() -> dict[str, np.ndarray]:
    generator = np.random.default_rng(5)
    return {name: generator.normal(size=(VERTICES, 3)) for name in IDENTITIES}


def imported(state: State, folder: Path, dataset: str, **options: Any) -> AnimationModel:  # noqa: ANN401
    torch.save(state, folder / "author.pth")
    return import_checkpoint(
        folder / "author.pth",
        dataset=dataset,
        identities=IDENTITIES,
        templates=templates(),
        audio_config=published.AUDIO_CONFIG,
        **options,
    )


def face(name: str) -> Tensor:
    return torch.from_numpy(templates()[name]).float().flatten()


def sample_of(speech: Tensor, motion: Tensor, *, identity: int) -> Sample:
    """A training clip."""
    return Sample(
        audio=speech,
        motion=motion,
        template=face(IDENTITIES[identity]).view(VERTICES, 3),
        identity=identity,
        reference=torch.zeros(1, VERTICES, 3),
        name="clip",
        identity_name=IDENTITIES[identity],
        sentence="",
        reference_name="",
    )
