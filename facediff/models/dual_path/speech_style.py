"""Style predicted from speech: a regression from speech features to style vectors, an addition to the paper."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from facediff.models.folding import WeightCache
from facediff.models.speaker_encoders import mean_and_deviation

MEMORY = 0.999
"""Share of the statistics that stays after a training step: the last 8 000 clips of steps of eight count."""
RIDGE = 0.03
"""Penalty of the map, as a share of the statistics' variance."""
USUAL = 3.0
"""Standard deviations up to which a statistic counts; rooms and voices outside the training data lie beyond."""
REACH = 2.0
"""Longest change of the style, in root mean squares of the changes that the training speech asks for."""


class SpeechStyle(nn.Module):
    """The change of an identity's usual style that its speech asks for: a linear map, fitted beside the training.

    Without a reference, a model has the identity and the speech alone. Its learnt stand-in for a hidden style
    leaves the mood to the denoising network, which hardly takes it up in a short training; a regression on the style
    vectors themselves does (docs/generation.md has the figures).

    With the statistics x of a clip's speech features (mean and deviation of each channel) and the clip's style vector
    s, W minimises E‖s − s̄ − W x̂‖² + λ‖W‖², where s̄ is the mean style of the clip's identity and x̂ is x, standardised
    over all speakers: an unseen voice has no mean of its own. The sums that this needs are updated in
    every training step, at no further pass of an encoder, and older steps fade from them as the encoders change. Where
    several processes train, the first one's clips count, which are drawn from all in every epoch.

    Speech counts as it is animated: in a stream, each window asks by its own speech, and of windows of a second the
    answers vary by half as much as between clips.
    """

    squares: Tensor
    products: Tensor
    styles: Tensor
    counts: Tensor

    def __init__(self, dim: int, style_dim: int, identities: int) -> None:
        super().__init__()
        numbers = 2 * dim + 1  # the last is 1, whose sums are the mean and the count
        self.register_buffer("squares", torch.zeros(numbers, numbers))
        self.register_buffer("products", torch.zeros(numbers, style_dim))
        self.register_buffer("styles", torch.zeros(identities, style_dim))
        self.register_buffer("counts", torch.zeros(identities))
        self._fitted: WeightCache[tuple[Tensor, Tensor, Tensor, Tensor]] = WeightCache()

    @property
    def ready(self) -> bool:
        """Whether enough clips were seen for a map."""
        return float(self.squares[-1, -1]) > 1 and bool((self.counts > 1).any())

    @torch.no_grad()
    def update(
        self,
        features: Float[Tensor, "batch frames dim"],
        mask: Bool[Tensor, "batch frames"],
        style: Float[Tensor, "batch style_dim"],
        identity: Int[Tensor, " batch"],
        memory: float = MEMORY,
    ) -> None:
        """Take in the clips of a training step; clips of hidden identities are left out."""
        visible = identity >= 0
        style, identity = style.to(self.styles.dtype)[visible], identity[visible]
        with torch.autocast(features.device.type, enabled=False):
            numbers = self._numbers(features[visible], mask[visible]).to(style.dtype)
            for vector, index in zip(style, identity.tolist(), strict=True):
                self.counts[index] += 1
                self.styles[index].lerp_(vector, max(1 / float(self.counts[index]), 1 - memory**8))
            self.squares.mul_(memory).addmm_(numbers.T, numbers)
            self.products.mul_(memory).addmm_(numbers.T, style - self.styles[identity])

    def forget(self) -> None:
        """Begin again, without any clip."""
        for sums in self.buffers():
            sums.zero_()

    def usual(self, identity: int) -> Float[Tensor, " style_dim"] | None:
        """The mean style of a training identity; None if no clip of it was seen."""
        return self.styles[identity].clone() if float(self.counts[identity]) > 0 else None

    def forward(
        self, features: Float[Tensor, "batch frames dim"], mask: Bool[Tensor, "batch frames"]
    ) -> Float[Tensor, "batch style_dim"]:
        """The change of the style that speech asks for, at most :data:`REACH` times a usual one."""
        mean, deviation, weight, reach = self._fitted.get([self.squares, self.products], "map", self._fit)
        with torch.autocast(features.device.type, enabled=False):
            standard = (self._numbers(features, mask)[:, :-1] - mean) / deviation
            change = standard.clamp(-USUAL, USUAL) @ weight
            return change * (reach / change.norm(dim=1, keepdim=True).clamp_min(1e-9)).clamp_max(1.0)

    def _numbers(self, features: Tensor, mask: Tensor) -> Float[Tensor, "batch numbers"]:
        return nn.functional.pad(mean_and_deviation(features.float(), mask), (0, 1), value=1.0)

    def _fit(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Mean and deviation of the statistics, the map W from them, and the longest change."""
        squares, products = self.squares.double(), self.products.double()
        count = squares[-1, -1].clamp_min(1e-9)
        mean = squares[-1, :-1] / count
        covariance = squares[:-1, :-1] / count - mean[:, None] * mean
        deviation = covariance.diagonal().clamp_min(1e-12).sqrt()
        correlation = covariance / (deviation[:, None] * deviation)
        # The intercept is left out: it would be a change that speech does not ask for.
        shared = (products[:-1] - mean[:, None] * products[-1]) / (count * deviation[:, None])
        weight = torch.linalg.solve(correlation + RIDGE * torch.eye(len(mean)).to(correlation), shared)
        reach = REACH * (weight * (correlation @ weight)).sum().clamp_min(0).sqrt()
        return mean.float(), deviation.float(), weight.float(), reach.float()
