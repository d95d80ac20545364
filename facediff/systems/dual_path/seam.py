"""How windows of long speech are joined: in every denoising step, not afterwards."""

from __future__ import annotations

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor

from facediff.systems.long_speech import crossfaded


class Seam:
    """Blends, step by step, the features of the shared frames with those that the window before had there.

    The map from features to clean motion is affine and the shares add up to one, so this is a blend of the two
    predictions of clean motion, at the width of the model. The first shared frame keeps the old window's predictions
    and its noise in every step, and so the old window's motion; the network sees the shared frames as they are and
    continues them. So the motion has no joint that would have to be smoothed afterwards.

    Args:
        before: features of the window before in the shared frames, one tensor for each step; None for the first window.
        kept: frames at the end that the next window will share.
    """

    def __init__(self, before: Sequence[Tensor] | None, kept: int) -> None:
        self.before = before
        self.kept = kept
        self.features: list[Tensor] = []

    def __call__(self, features: Float[Tensor, "takes frames dim"]) -> Float[Tensor, "takes frames dim"]:
        """The features of the next step, blended."""
        if self.before is not None:
            features = crossfaded(self.before[len(self.features)], features)
        self.features.append(features[:, -self.kept :].clone())
        return features


def unchanged(features: Tensor) -> Tensor:
    """In place of a seam where there is none."""
    return features
