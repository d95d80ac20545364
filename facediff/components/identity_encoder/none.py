"""The identity path left out, for the ablation."""

from __future__ import annotations

from jaxtyping import Float, Int
from torch import Tensor

from facediff.components.identity_encoder.base import IdentityEncoder
from facediff.registry import identity_encoder


@identity_encoder.register("none")
class NoIdentity(IdentityEncoder):
    """No identity condition (ablation).

    Args:
        dim: the system's channels; given by the system.
        n_identities: number of training identities; given by the system.
    """

    def __init__(self, *, dim: int, n_identities: int) -> None:
        super().__init__()
        self.token_dims = ()

    def forward(self, identity: Int[Tensor, " batch"]) -> Float[Tensor, "batch identity_dim"]:
        """A feature of width zero."""
        return identity.new_zeros((identity.shape[0], 0)).float()
