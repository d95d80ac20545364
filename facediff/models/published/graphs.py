"""The published methods as graphs; see :mod:`facediff.models.graphs`.

Their audio encoders know no padding, so graphs take clips of one length; their windows go over into one another
in the motion. A training identity is their style.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from facediff.models.graphs import (
    BATCH,
    FRAMES,
    Graph,
    Graphs,
    SamplingLoop,
    Speech,
    StyleSource,
    features_of,
    speech_graph,
)

if TYPE_CHECKING:
    from facediff.models.published.base import DirectModel, PublishedModel


def whole_model(model: PublishedModel, parts: list[Graph], sampling: SamplingLoop | None = None) -> Graphs:
    """What is said of a published method besides its graphs."""
    style: StyleSource = "identity" if model.own_styles() else "none"
    refused = model.table_frames if model.long_speech == "refuse" else None
    return Graphs(
        parts=parts,
        equal_lengths=True,
        blending="motion",
        clock=model.clock,
        style=style,
        epsilon=float(getattr(model.audio_encoder, "epsilon", 1e-7)),
        longest=refused or 0,
        sampling=sampling,
    )


class DirectMotion(nn.Module):
    """Features of speech to offsets from the template."""

    def __init__(self, model: DirectModel) -> None:
        super().__init__()
        self.model = model

    def forward(
        self, features: Float[Tensor, "batch frames *width"], identity: Int[Tensor, " batch"]
    ) -> Float[Tensor, "batch frames vertices 3"]:
        """In the unit of the corpus; the identity is an index, or −1."""
        model = self.model
        made = model.decode(features, model.weights_of(identity), None)
        return made.view(*made.shape[:2], model.n_vertices, 3) / model.scale


def direct_graphs(model: DirectModel) -> Graphs:
    """A method that makes all frames at once."""

    def hear(heard: Speech, frames: Int[Tensor, " batch"], _: int) -> Tensor:
        return model.hear(heard, frames)

    speech = speech_graph(model, hear, lambda frames: model.heard_steps * frames)
    features = features_of(speech)
    inputs: dict[str, Any] = {"features": features, "identity": torch.zeros(len(features), dtype=torch.long)}
    motion = Graph("motion", DirectMotion(model), inputs, {"features": FRAMES, "identity": BATCH}, ("offsets",))
    return whole_model(model, [speech, motion])
