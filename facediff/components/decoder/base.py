"""What every decoder is."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Protocol

from jaxtyping import Bool, Float
from torch import Tensor, nn


class Decoder(nn.Module, ABC):
    """Fused features F_fused and style tokens F_s to features that one linear map turns into clean motion."""

    def prepare(self, style: Float[Tensor, "batch tokens style_dim"], mask: Bool[Tensor, "batch frames"]) -> object:
        """What stays the same over the denoising steps, computed once a clip; None if there is nothing.

        A decoder that overrides this takes the result as a fourth, optional argument of ``forward`` and gives the same
        with it as without, up to rounding. The arguments are those that ``forward`` will get.
        """
        return None

    @abstractmethod
    def forward(
        self,
        fused: Float[Tensor, "batch frames dim"],
        style: Float[Tensor, "batch tokens style_dim"],
        mask: Bool[Tensor, "batch frames"],
    ) -> Float[Tensor, "batch frames dim"]:
        """Decode; there is at least one style token; frames where ``mask`` is False are padding."""


class DecoderFactory(Protocol):
    """Makes a decoder once the system's widths are known."""

    def __call__(self, *, dim: int, style_dim: int) -> Decoder:
        """Make one for ``dim`` channels and style tokens of ``style_dim`` channels."""
        ...
