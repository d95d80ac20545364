"""The conditions of a clip: speech features F_a and style tokens F_s (eq. 14).

They are computed once for all denoising steps (algorithm 1, line 4; algorithm 2, line 2).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from facediff.errors import FaceDiffError
from facediff.models.dual_path.options import TokenForm
from facediff.models.layers import exporting


@dataclass(frozen=True)
class Conditions:
    """Everything that stays constant over the denoising steps of a clip.

    Attributes:
        audio: speech features F_a.
        style: style tokens, the condition F_s.
        mask: True on valid frames.
        fusion: prepared by the fusion for inference.
        decoder: prepared by the decoder for inference.
        step_table: the embedding of each step; None if steps are embedded as they come.
        dynamic: F_dyn of the clips, as it was encoded; None where conditions were changed.
    """

    audio: Float[Tensor, "batch frames dim"]
    style: Float[Tensor, "batch tokens dim"]
    mask: Bool[Tensor, "batch frames"]
    fusion: object = None
    decoder: object = None
    step_table: Float[Tensor, "steps dim"] | None = None
    dynamic: Float[Tensor, "batch dynamic_dim"] | None = None

    def frames(self, places: Int[Tensor, " animated"]) -> Conditions:
        """The conditions of some of the frames, with nothing prepared."""
        return Conditions(self.audio[:, places], self.style, self.mask[:, places])

    def for_draws(self, times: int) -> Conditions:
        """The conditions of several noisy versions of every clip, clip by clip."""
        return Conditions(*(value.repeat_interleave(times, 0) for value in (self.audio, self.style, self.mask)))

    def repeated(self, times: int) -> Conditions:
        """One clip's conditions for several samples of it, with nothing prepared; nothing is copied without need."""
        if times == 1:
            return self
        audio, style = (value.expand(times, -1, -1) for value in (self.audio, self.style))
        return Conditions(audio, style, self.mask.expand(times, -1))


class StyleTokens(nn.Module):
    """F_s = Concat(F_id, F_dyn) (eq. 14), presented to the decoder as tokens.

    Attention over a single key is constant, so by default each part of F_s (coarse, mid, fine, dynamic) becomes a
    token with a projection of its own.
    """

    def __init__(self, token_dims: tuple[int, ...], dim: int, form: TokenForm) -> None:
        super().__init__()
        # The paper's form, for comparison; its attention has nothing to choose between.
        if form == "single" and token_dims:
            token_dims = (sum(token_dims),)
        self.token_dims = token_dims
        # A projection of their own puts parts of different widths into one space, and tells the decoder which level a
        # token is: tokens carry no positions.
        self.projections = nn.ModuleList(nn.Linear(width, dim) for width in token_dims)
        self.null = None if token_dims else nn.Parameter(torch.zeros(1, 1, dim))

    def forward(self, style: Float[Tensor, "batch style_dim"]) -> Float[Tensor, "batch tokens dim"]:
        """Split F_s and project each part."""
        if self.null is not None:
            return self.null.expand(len(style), -1, -1)
        parts = torch.split(style, list(self.token_dims), dim=-1)
        return torch.stack([p(part) for p, part in zip(self.projections, parts, strict=True)], dim=1)


class TemplateToken(nn.Module):
    """The neutral face f as a token beside the style tokens, since the way a face moves follows from its shape too."""

    mean: Tensor
    deviation: Tensor

    def __init__(self, points: int, dims: int, dim: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(points, dims))
        self.register_buffer("deviation", torch.ones(()))
        self.project = nn.Linear(points * dims, dim)

    def measure(self, templates: Float[Tensor, "identities points dims"]) -> None:
        """Measure mean and size on the faces of the training; a single face counts as it is."""
        self.mean.copy_(templates.mean(0))
        deviation = (templates - self.mean).square().mean().sqrt()
        self.deviation.copy_(deviation if deviation > 0 else torch.ones(()))

    def forward(self, template: Float[Tensor, "batch points dims"]) -> Float[Tensor, "batch 1 dim"]:
        """What neutral faces have of their own."""
        return self.project(((template - self.mean) / self.deviation).flatten(1))[:, None]


def check_shape(part: nn.Module, result: Tensor, *expected: int) -> None:
    """Name a component, perhaps a user's own, with a result of the wrong shape, before it fails elsewhere."""
    if not exporting() and result.shape != expected:
        raise FaceDiffError(f"{type(part).__name__}: gives the shape {tuple(result.shape)}; expected {expected}")
