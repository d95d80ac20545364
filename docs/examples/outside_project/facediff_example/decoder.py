"""A decoder."""

from __future__ import annotations

from torch import Tensor, nn

from facediff.models.decoders import Decoder


class MovingAverageDecoder(Decoder):
    """Averages each frame with its neighbours and adds the mean style token.

    Args:
        dim: channels; given by the model.
        style_dim: channels of a style token; given by the model.
        reach: neighbours on either side.
    """

    def __init__(self, *, dim: int, style_dim: int, reach: int = 1) -> None:
        super().__init__()
        self.average = nn.AvgPool1d(2 * reach + 1, stride=1, padding=reach)
        self.style = nn.Linear(style_dim, dim)

    def forward(self, fused: Tensor, style: Tensor, mask: Tensor) -> Tensor:
        """F_dec of each frame."""
        smooth = self.average((fused * mask[..., None]).transpose(1, 2)).transpose(1, 2)
        return smooth + self.style(style.mean(1, keepdim=True))
