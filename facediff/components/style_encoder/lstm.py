"""A causal recurrent style encoder: the last state of an LSTM over the frames."""

from __future__ import annotations

from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from facediff.components.style_encoder.base import StyleEncoder
from facediff.registry import style_encoder


@style_encoder.register("lstm")
class LstmStyle(StyleEncoder):
    """Last state of an LSTM that reads the frames in order (Chai et al., style-content disentanglement).

    Args:
        dim: channels of a frame; given by the system.
        style_dim: channels of the style.
        num_layers: recurrent layers.
        pooling: the ``last`` state, as in the published work, or the ``mean`` of the states over all frames, which
            forgets less of a long reference.
    """

    def __init__(
        self, *, dim: int, style_dim: int = 32, num_layers: int = 1, pooling: Literal["last", "mean"] = "last"
    ) -> None:
        super().__init__()
        self.lstm = nn.LSTM(dim, style_dim, num_layers, batch_first=True)
        self.pooling = pooling
        self.token_dims = (style_dim,)

    def forward(
        self, reference: Float[Tensor, "batch frames dim"], mask: Bool[Tensor, "batch frames"]
    ) -> Float[Tensor, "batch style_dim"]:
        """The state after each clip's last frame."""
        states = self.states(reference, mask)
        if self.pooling == "mean":
            return (states * mask[..., None]).sum(1) / mask.sum(1)[:, None].clamp_min(1)
        last = mask.sum(1) - 1
        return states[torch.arange(len(states), device=states.device), last]

    def states(
        self, reference: Float[Tensor, "batch frames dim"], mask: Bool[Tensor, "batch frames"]
    ) -> Float[Tensor, "batch frames style_dim"]:
        """The state after each frame: it depends on that frame and those before it alone."""
        # Padding comes after all valid frames; zeros keep what is not finite there out of the gradient.
        states: Tensor = self.lstm(reference.masked_fill(~mask[..., None], 0.0))[0]
        return states
