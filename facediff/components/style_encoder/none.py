"""The dynamic style path left out, for the ablation."""

from __future__ import annotations

from jaxtyping import Bool, Float
from torch import Tensor

from facediff.components.style_encoder.base import StyleEncoder
from facediff.registry import style_encoder


@style_encoder.register("none")
class NoStyle(StyleEncoder):
    """No dynamic style condition (ablation).

    Args:
        dim: the system's channels; given by the system.
    """

    def __init__(self, *, dim: int) -> None:
        super().__init__()
        self.token_dims = ()

    def forward(
        self, reference: Float[Tensor, "batch frames dim"], mask: Bool[Tensor, "batch frames"]
    ) -> Float[Tensor, "batch style_dim"]:
        """A feature of width zero."""
        return reference.new_zeros((reference.shape[0], 0))
