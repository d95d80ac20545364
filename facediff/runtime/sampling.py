"""The loop over the denoising steps of an exported model: the sampler's table of numbers, run with NumPy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from facediff.runtime.noise import ClipNoise, WindowNoise

if TYPE_CHECKING:
    from facediff.runtime.model import RuntimeModel

Array = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Conditions:
    """What motion is conditioned on besides speech."""

    identity: int
    style: Array
    style_name: str
    seed: int
    expressivity: float


class Sampling:
    """One run of the sampler, of a clip or of a window that continues another.

    Args:
        model: the model.
        conditions: what motion is conditioned on.
        before: what the window before kept, one array for each evaluation of the network; None for nothing.
        shared: frames that this window shares with it.

    Attributes:
        kept: what the next window is blended with, one array for each evaluation.
    """

    def __init__(
        self, model: RuntimeModel, conditions: Conditions, before: Sequence[Array] | None, shared: int
    ) -> None:
        self.model = model
        self.conditions = conditions
        self.before = before
        self.shared = shared
        self.kept: list[Array] = []

    def run(self, features: Array, noise: ClipNoise | WindowNoise, of_mean: ClipNoise | WindowNoise) -> Array:
        """Offsets from the template (1, frames, vertices, 3)."""
        about, share = self.model.description, self.conditions.expressivity
        mean = None
        if share != 1:
            # As the model's own mean: the prediction at the last step, averaged over a noise and its negative.
            start = self._coloured(of_mean(features.shape[1], about.state))
            ends = [self._decoded(self._evaluate(features, each, about.last_step)) for each in (start, -start)]
            mean = (ends[0] + ends[1]) * np.float32(0.5)
            if share == 0:
                return mean
        motion = self._decoded(self._loop(features, noise))
        return motion if mean is None else np.asarray(mean + np.float32(share) * (motion - mean), np.float32)

    def _loop(self, features: Array, noise: ClipNoise | WindowNoise) -> tuple[Array, Array]:
        """The sampler's result, and what was kept of the last step."""
        about = self.model.description
        frames = features.shape[1]
        noisy = self._coloured(noise(frames, about.state))
        predictions: list[Array] = []
        kept = noisy
        for step, (of_noisy, first, second, third, of_noise) in zip(about.steps, about.table, strict=True):
            prediction, kept = self._evaluate(features, noisy, step)
            predictions = [prediction, *predictions][:3]
            made = np.float32(of_noisy) * noisy
            for factor, each in zip((first, second, third), predictions, strict=False):
                if factor:
                    made = made + np.float32(factor) * each
            if of_noise:
                made = made + np.float32(of_noise) * self._coloured(noise(frames, about.state))
            noisy = made
        return noisy, kept

    def _evaluate(self, features: Array, noisy: Array, step: int) -> tuple[Array, Array]:
        """The network's prediction at a step, blended with that of the window before."""
        frames, about = features.shape[1], self.model.description
        before, share = np.zeros((1, frames, about.kept), np.float32), np.ones((1, frames), np.float32)
        if self.before is not None:
            before[:, : self.shared] = self.before[len(self.kept)]
            # 0 at the first shared frame, smooth at both ends: the rule of facediff.models.inference.crossfaded.
            place = np.arange(self.shared, dtype=np.float32) / np.float32(self.shared)
            share[:, : self.shared] = place * place * (3 - 2 * place)
        prediction, kept = self.model.run(
            "step",
            {
                "features": features,
                "mask": np.ones((1, frames), bool),
                "identity": np.array([self.conditions.identity], np.int64),
                "style": self.conditions.style[None],
                "state": noisy,
                "step": np.array([step], np.int64),
                "before": before,
                "share": share,
            },
        )
        self.kept.append(kept)
        return prediction, kept

    def _decoded(self, result: tuple[Array, Array]) -> Array:
        sample, kept = result
        last = kept if self.model.description.decoded == "kept" else sample
        return self.model.run("motion", {"sample": last})[0]

    def _coloured(self, unit: Array) -> Array:
        root = self.model.arrays.get("noise")
        return unit if root is None else unit @ root
