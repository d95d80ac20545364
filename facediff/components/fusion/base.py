"""What every fusion is."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Protocol

from jaxtyping import Bool, Float
from torch import Tensor, nn


class Fusion(nn.Module, ABC):
    """Speech features F_a and embedded noisy motion F_m to one sequence F_am."""

    def prepare(self, audio: Float[Tensor, "batch frames dim"], mask: Bool[Tensor, "batch frames"]) -> object:
        """What stays the same over the denoising steps, computed once a clip; None if there is nothing.

        A fusion that overrides this takes the result as a fourth, optional argument of ``forward`` and gives the same
        with it as without, up to rounding. The arguments are those that ``forward`` will get.
        """
        return None

    @abstractmethod
    def forward(
        self,
        audio: Float[Tensor, "batch frames dim"],
        motion: Float[Tensor, "batch frames dim"],
        mask: Bool[Tensor, "batch frames"],
    ) -> Float[Tensor, "batch frames dim"]:
        """Fuse; frames where ``mask`` is False are padding and never influence the others."""


class FusionFactory(Protocol):
    """Makes a fusion once the system's width is known."""

    def __call__(self, *, dim: int) -> Fusion:
        """Make one for ``dim`` channels."""
        ...
