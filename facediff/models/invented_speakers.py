"""Training clips of speakers who do not exist, so that the reference alone says how a stranger moves."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor, nn

from facediff.data import Batch
from facediff.data.batch import UNKNOWN_IDENTITY
from facediff.models.motion_space import PrincipalComponents

COMPONENTS = 64
"""Principal components that get gains of their own."""


class InventedSpeakers(nn.Module):
    """Turns a share of the training clips into clips of speakers who do not exist.

    A corpus has a handful of speakers. A style encoder that has seen only these learns to recognise them, and answers a
    stranger with one of them. Here all of a clip's motion is multiplied by one random gain and each of its principal
    components by another, its style reference gets the very same gains, and the identity is hidden: how wide this
    speaker opens the jaw or raises the brows can be told from the reference only. Timing, and the shapes of movements,
    stay the speaker's.
    """

    def __init__(self, n_vertices: int, dims: int, share: float, deviation: float = 0.1) -> None:
        super().__init__()
        self.share = share
        self.deviation = deviation
        self.components = PrincipalComponents(n_vertices, dims, COMPONENTS)

    def forward(self, batch: Batch, scale: float) -> Batch:
        """The batch with some of its clips changed; nothing is changed in place."""
        device = batch.motion.device
        drawn_clips = torch.rand(len(batch), device=device) < self.share
        if not drawn_clips.any():
            return batch
        clips = int(drawn_clips.sum())
        every = (torch.randn(clips, 1, device=device) * self.deviation).exp()
        factors = (torch.randn(clips, COMPONENTS, device=device) * self.deviation / 2).exp()
        changed = {name: getattr(batch, name).clone() for name in ("motion", "reference")}
        for motion in changed.values():
            motion[drawn_clips] = self.changed(motion[drawn_clips] * scale, every, factors) / scale
        names = zip(batch.identity_names, drawn_clips.tolist(), strict=True)
        return replace(
            batch,
            **changed,
            identity=batch.identity.masked_fill(drawn_clips, UNKNOWN_IDENTITY),
            identity_names=[f"invented {number}" if new else name for number, (name, new) in enumerate(names)],
        )

    def changed(
        self,
        motion: Float[Tensor, "clips frames points dims"],
        every: Float[Tensor, "clips 1"],
        factors: Float[Tensor, "clips components"],
    ) -> Float[Tensor, "clips frames points dims"]:
        """Scaled motion with one gain on all of it and one on each of its principal components.

        Motion outside the components, of which there is little, gets the common gain alone.
        """
        mean = self.components.mean.view(-1, self.components.dims)
        amounts = self.components.project(motion)
        moved = motion + self.components.expand(amounts * (factors - 1)[:, None]) - mean
        return mean + every[:, :, None, None] * (moved - mean)
