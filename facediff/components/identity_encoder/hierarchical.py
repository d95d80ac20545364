"""The three-level identity embedding of the dual-path style diffusion paper, section 1.3.2."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from facediff.components.identity_encoder.base import IdentityEncoder
from facediff.registry import identity_encoder


@identity_encoder.register("hierarchical")
class HierarchicalIdentity(IdentityEncoder):
    """Coarse, mid and fine embedding of the identity, weighted by attention.

    [β_c, β_m, β_f] = softmax(W₂ [e_c; e_m; e_f] + b₂) (eq. 10);
    F_id = LayerNorm([β_c e_c; β_m e_m; β_f e_f]) (eq. 11).

    Args:
        dim: the system's channels; given by the system.
        n_identities: number of training identities; given by the system.
        level_dim: channels of each level; ``dim`` if None.
    """

    def __init__(self, *, dim: int, n_identities: int, level_dim: int | None = None) -> None:
        super().__init__()
        width = level_dim or dim
        self.coarse = nn.Embedding(n_identities, width)
        self.mid = nn.Embedding(n_identities, width)
        self.fine = nn.Embedding(n_identities, width)
        self.attention = nn.Linear(3 * width, 3)
        self.norm = nn.LayerNorm(3 * width)
        self.token_dims = (width, width, width)

    def level_weights(self) -> Float[Tensor, "identities 3"]:
        """β_c, β_m, β_f of every identity (eq. 10); each row sums to one."""
        tables = (self.coarse.weight, self.mid.weight, self.fine.weight)
        return self.attention(torch.cat(tables, dim=-1)).softmax(-1)

    def forward(self, identity: Int[Tensor, " batch"]) -> Float[Tensor, "batch identity_dim"]:
        """F_id of each clip; the mean over all identities for an unknown one."""
        tables = (self.coarse.weight, self.mid.weight, self.fine.weight)
        weights = self.level_weights()
        weighted = torch.cat([weights[:, i : i + 1] * table for i, table in enumerate(tables)], dim=-1)
        features = self.norm(weighted)
        known = features[identity.clamp_min(0)]
        return torch.where((identity >= 0)[:, None], known, features.mean(0, keepdim=True))
