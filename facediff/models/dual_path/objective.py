"""The losses of a training step (eq. 15 to 19) of noisy versions of clips, and how they are noised (eq. 1).

An objective knows the clean motion of a batch. The model calls :meth:`TrainingObjective.inputs` before the network,
with unit noise, and :meth:`TrainingObjective.losses` after it, with the features F_dec of the decoder.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from facediff.data import Batch
from facediff.models.dual_path.network import DualPathNetwork
from facediff.models.dual_path.recipe import DualPathRecipe
from facediff.models.losses import preconditioned_losses
from facediff.models.losses_fused import fused_losses
from facediff.models.motion_space import Preconditioning
from facediff.models.samplers import NoiseProcess


@dataclass(kw_only=True)
class TrainingObjective(ABC):
    """Noise and losses of one training step.

    Attributes:
        network: predicts clean motion.
        process: adds noise.
        motion: clean motion M⁰ of every draw: (draws, frames, points, dims) in the corpus's unit for
            :class:`VertexObjective`, (draws, frames, coordinates) of the motion space for :class:`ComponentObjective`.
        mask: True on valid frames.
        step: the diffusion step n of every draw, counted from 0.
        weights: of the terms in the sum (eq. 15).
    """

    network: DualPathNetwork
    process: NoiseProcess
    motion: Tensor
    mask: Bool[Tensor, "draws frames"]
    step: Int[Tensor, " draws"]
    weights: Mapping[str, float]

    @abstractmethod
    def inputs(self, noise: Float[Tensor, "draws frames coordinates"]) -> Float[Tensor, "draws frames inputs"]:
        """The network's input Mⁿ, from unit noise, which may be overwritten."""

    @abstractmethod
    def losses(self, decoded: Float[Tensor, "draws frames dim"]) -> dict[str, Tensor]:
        """The terms and their weighted sum ``loss``, from the decoder's features F_dec."""


@dataclass(kw_only=True)
class VertexObjective(TrainingObjective):
    """The paper's: Huber losses of the position, velocity and acceleration of vertices, and L_face (eq. 15 to 19).

    Attributes:
        scale: factor from ``motion`` to the motion that is noised.
        target: ``motion`` as its errors are weighted.
        geometry: the weights of the channels of a parametric space; None for vertices.
        upper_face: indices of the vertices R of eq. 19.
    """

    scale: float
    target: Tensor
    geometry: Tensor | None
    upper_face: Int[Tensor, " upper_face"]

    def inputs(self, noise: Float[Tensor, "draws frames coordinates"]) -> Float[Tensor, "draws frames coordinates"]:
        """√ᾱ M⁰ + √(1 − ᾱ) ε (eq. 1), as :meth:`NoiseProcess.add_noise` but in place.

        On a processor, allocating tensors of this size takes longer than the arithmetic.
        """
        signal = self.process.signal.to(noise.device)[self.step][:, None, None]
        return noise.mul_((1 - signal).sqrt()).addcmul_(self.motion.flatten(2), signal.sqrt() * self.scale)

    def losses(self, decoded: Float[Tensor, "draws frames dim"]) -> dict[str, Tensor]:
        """Eq. 15 to 19 of the prediction M̂⁰ = W F_dec + b, by the fused twin of ``losses.training_losses``.

        The prediction is never held as a whole: with 70 000 coordinates a frame it takes more memory and time than the
        rest of the step, so the last map, the losses and their gradients are computed block by block.
        """
        weight: Tensor = self.network.unembed.weight
        bias: Tensor = self.network.unembed.bias
        if self.geometry is not None:  # linear in the last map, which is weighted in place of its result
            with torch.autocast(decoded.device.type, enabled=False):
                weight, bias = self.geometry @ weight, self.geometry @ bias
        return fused_losses(
            decoded, weight, bias, self.target, self.mask, self.upper_face, self.weights, scale=self.scale
        )


@dataclass(kw_only=True)
class ComponentObjective(TrainingObjective):
    """Squared errors in a space of known variances; the network predicts the part that the noisy motion leaves open.

    Attributes:
        preconditioning: the scales around the network.
        mean: posterior mean of the noisy motion, known once the inputs are.
    """

    preconditioning: Preconditioning
    mean: Tensor = field(init=False)

    def inputs(self, noise: Float[Tensor, "draws frames coordinates"]) -> Float[Tensor, "draws frames inputs"]:
        """Mⁿ (eq. 1), scaled to unit variance; its posterior mean is used again by :meth:`losses`."""
        noisy = self.process.add_noise(self.motion, noise, self.step)
        self.mean = self.preconditioning.posterior_mean(noisy, self.step, self.mask)
        return self.preconditioning.inputs(noisy, self.mean, self.step, self.mask)

    def losses(self, decoded: Float[Tensor, "draws frames dim"]) -> dict[str, Tensor]:
        """Weighted squared errors of the coordinates, their velocities and accelerations."""
        features = self.network.clean_motion(decoded)
        predicted = self.preconditioning.clean(self.mean, features, self.step, self.mask)
        importance = self.preconditioning.loss[self.step]
        return preconditioned_losses(predicted, self.motion, self.mask, importance, self.weights)


def objective_of(model: DualPathRecipe, batch: Batch, step: Int[Tensor, " draws"], draws: int) -> TrainingObjective:
    """The objective of a model's motion space."""
    space, motion, mask = model.motion_space, batch.motion, batch.mask
    if space.preconditioning is not None:
        motion = space.encode(model.scaled(motion))
    if draws > 1:
        motion, mask = motion.repeat_interleave(draws, 0), mask.repeat_interleave(draws, 0)
    weights = model.options.loss_weights
    common: dict[str, Any] = {"network": model.network, "process": model.process, "weights": weights}
    common |= {"motion": motion, "mask": mask, "step": step}
    if space.preconditioning is not None:
        return ComponentObjective(**common, preconditioning=space.preconditioning)
    return VertexObjective(
        **common,
        scale=model.scale,
        target=model.weighed(motion),
        geometry=model.geometry,
        upper_face=model.assets.regions["upper_face"],
    )
