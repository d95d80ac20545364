"""A style-content model as graphs: speech to content, content and style to motion (:mod:`facediff.models.graphs`)."""

from __future__ import annotations

from fractions import Fraction
from typing import TYPE_CHECKING

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from facediff.models.graphs import BATCH, FRAMES, Graph, Graphs, results_of, speech_graph, style_graphs

if TYPE_CHECKING:
    from facediff.models.style_content.model import StyleContentDisentanglement


class MotionGraph(nn.Module):
    """Content and style to offsets from the template."""

    def __init__(self, model: StyleContentDisentanglement) -> None:
        super().__init__()
        self.model = model

    def forward(
        self,
        features: Float[Tensor, "batch frames content_dim"],
        mask: Bool[Tensor, "batch frames"],
        style: Float[Tensor, "batch style_dim"],
    ) -> Float[Tensor, "batch frames vertices 3"]:
        """In the unit of the corpus."""
        return self.model.decode(features, style, mask)


def graphs_of(model: StyleContentDisentanglement) -> Graphs:
    """A style-content model as graphs."""
    network = model.network
    ratio = Fraction(network.ratio).limit_denominator(1000)

    def steps_of(frames: int) -> int:
        # A step more where the ratio is no whole number: it lies beyond what is valid, and is zero.
        return frames * ratio.numerator // ratio.denominator + (ratio.denominator > 1)

    speech = speech_graph(model, network.content_of, steps_of)
    features = results_of(speech)
    batch, frames = features.shape[:2]
    width = sum(network.style_encoder.token_dims)
    motion = Graph(
        "motion",
        MotionGraph(model),
        {
            "features": features,
            "mask": torch.ones(batch, frames, dtype=torch.bool),
            "style": torch.zeros(batch, width),
        },
        {"features": FRAMES, "mask": FRAMES, "style": BATCH},
        ("offsets",),
    )
    return Graphs(
        parts=[speech, motion, *style_graphs(model, width)],
        equal_lengths=not network.audio_encoder.takes_padding,
        blending="motion",
        clock=model.clock,
        style="reference",
    )
