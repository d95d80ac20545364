"""Identity encoders: the static path of the dual-path paper, section 1.3.2, and its ablation."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Protocol

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from facediff.registry import identity_encoder


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
            identity: index into the training identities, or −1 for an unseen speaker, who gets the mean of the
                training identities' features.
        """


class IdentityEncoderFactory(Protocol):
    """Makes an identity encoder once the model's sizes are known."""

    def __call__(self, *, dim: int, n_identities: int) -> IdentityEncoder:
        """Make one for ``n_identities`` identities in a model of ``dim`` channels."""
        ...


@identity_encoder.register("hierarchical")
class HierarchicalIdentity(IdentityEncoder):
    """Coarse, mid and fine embedding of the identity, weighted by attention.

    [β_c, β_m, β_f] = softmax(W₂ [e_c; e_m; e_f] + b₂) (eq. 10);
    F_id = LayerNorm([β_c e_c; β_m e_m; β_f e_f]) (eq. 11).

    Args:
        dim: the model's channels; given by the model.
        n_identities: number of training identities; given by the model.
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
        return self.attention(torch.cat(self._tables(), dim=-1)).softmax(-1)

    def forward(self, identity: Int[Tensor, " batch"]) -> Float[Tensor, "batch identity_dim"]:
        """F_id of each clip; the mean over all identities for an unseen speaker."""
        # Of every identity, not of the batch's alone: an unseen speaker gets the mean over all of them.
        weights = self.level_weights().unbind(-1)
        weighted = [weight[:, None] * table for weight, table in zip(weights, self._tables(), strict=True)]
        features = self.norm(torch.cat(weighted, dim=-1))  # eq. 11
        return torch.where((identity >= 0)[:, None], features[identity.clamp_min(0)], features.mean(0, keepdim=True))

    def _tables(self) -> list[Tensor]:
        return [self.coarse.weight, self.mid.weight, self.fine.weight]


@identity_encoder.register("none")
class NoIdentity(IdentityEncoder):
    """No identity condition (ablation).

    Args:
        dim: the model's channels; given by the model.
        n_identities: number of training identities; given by the model.
    """

    def __init__(self, *, dim: int, n_identities: int) -> None:
        super().__init__()
        self.token_dims = ()

    def forward(self, identity: Int[Tensor, " batch"]) -> Float[Tensor, "batch identity_dim"]:
        """A feature of width zero."""
        return identity.new_zeros((identity.shape[0], 0)).float()
