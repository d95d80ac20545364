"""The second method's model in miniature."""

from __future__ import annotations

from functools import partial

import torch

from facediff import registry
from facediff.models import StyleContentDisentanglement
from tests.fakes.tiny import SEEN, VERTICES

SMALL: dict[str, object] = {
    "dim": 16,
    "content_dim": 8,
    "speech_layers": 1,
    "decoder_channels": (16, 16, 16),
    "decoder_hidden": (16, 16),
    "basis_size": 6,
    "audio_encoder": partial(registry.audio_encoder.mel, hidden_dim=16, num_layers=1, dropout=0.0),
    "mesh_encoder": partial(registry.mesh_encoder.spiral, channels=(4, 4), spiral_length=5),
    "style_encoder": partial(registry.style_encoder.lstm, style_dim=4),
}


def make(**options: object) -> StyleContentDisentanglement:
    """A model for the miniature corpus; the same weights each time."""
    torch.manual_seed(0)
    sizes: dict[str, object] = {"n_vertices": VERTICES, "identities": SEEN, "frame_rate": 25.0}
    return StyleContentDisentanglement(**{**sizes, **SMALL, **options})  # type: ignore[arg-type]
