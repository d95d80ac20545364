"""What every style encoder is."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Protocol

from jaxtyping import Bool, Float
from torch import Tensor, nn


class StyleEncoder(nn.Module, ABC):
    """A reference motion, embedded to ``dim`` channels per frame, to one dynamic style feature F_dyn.

    Attributes:
        token_dims: how F_dyn splits into style tokens; its sum is the width of F_dyn. Empty where the encoder
            contributes nothing.
    """

    token_dims: tuple[int, ...]

    @abstractmethod
    def forward(
        self, reference: Float[Tensor, "batch frames dim"], mask: Bool[Tensor, "batch frames"]
    ) -> Float[Tensor, "batch style_dim"]:
        """Encode; frames where ``mask`` is False are padding and never count."""


class StyleEncoderFactory(Protocol):
    """Makes a style encoder once the system's width is known."""

    def __call__(self, *, dim: int) -> StyleEncoder:
        """Make one for references embedded to ``dim`` channels."""
        ...
