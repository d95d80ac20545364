"""What every identity encoder is."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Protocol

from jaxtyping import Float, Int
from torch import Tensor, nn

UNKNOWN = -1
"""The identity index of a person who is not among the training identities."""


class IdentityEncoder(nn.Module, ABC):
    """An identity index to a static identity feature F_id.

    Attributes:
        token_dims: how F_id splits into style tokens, e.g. (C, C, C) for coarse, mid and fine; their sum is the
            width of F_id. Empty where the encoder contributes nothing.
    """

    token_dims: tuple[int, ...]

    @abstractmethod
    def forward(self, identity: Int[Tensor, " batch"]) -> Float[Tensor, "batch identity_dim"]:
        """Encode.

        Args:
            identity: index into the training identities, or :data:`UNKNOWN` (−1) for anybody else, who gets the
                mean of the training identities' features.
        """


class IdentityEncoderFactory(Protocol):
    """Makes an identity encoder once the system's sizes are known."""

    def __call__(self, *, dim: int, n_identities: int) -> IdentityEncoder:
        """Make one for ``n_identities`` people in a system of ``dim`` channels."""
        ...
