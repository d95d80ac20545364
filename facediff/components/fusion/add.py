"""The plain sum, for the ablation."""

from __future__ import annotations

from jaxtyping import Bool, Float
from torch import Tensor

from facediff.components.fusion.base import Fusion
from facediff.registry import fusion


@fusion.register("add")
class AddFusion(Fusion):
    """Plain sum of speech and motion features (ablation of the cross-attention).

    Args:
        dim: channels; given by the system.
    """

    def __init__(self, *, dim: int) -> None:
        super().__init__()

    def forward(
        self,
        audio: Float[Tensor, "batch frames dim"],
        motion: Float[Tensor, "batch frames dim"],
        mask: Bool[Tensor, "batch frames"],
    ) -> Float[Tensor, "batch frames dim"]:
        """F_am = F_a + F_m."""
        return audio + motion
