"""The losses of a training step (eq. 15 to 19) of noisy versions of clips, and how they are noised (eq. 1).

An objective knows the clean motion of a batch. The model calls :meth:`TrainingObjective.inputs` before the network,
with unit noise, and :meth:`TrainingObjective.losses` after it, with the features F_dec of the decoder.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from facediff.models.dual_path.recipe import DualPathRecipe
from facediff.models.losses import preconditioned_losses
from facediff.models.losses_fused import fused_losses
from facediff.models.motion_space import Preconditioning


class TrainingObjective(ABC):
    """Noise and losses of one training step.

    Args:
        model: predicts clean motion.
        motion: clean motion M⁰ of every draw: (draws, frames, points, dims) in the corpus's unit for
            :class:`VertexObjective`, (draws, frames, coordinates) of the motion space for :class:`ComponentObjective`.
        mask: True on valid frames.
        step: the diffusion step n of every draw, counted from 0.
    """

    def __init__(
        self, model: DualPathRecipe, motion: Tensor, mask: Bool[Tensor, "draws frames"], step: Int[Tensor, " draws"]
    ) -> None:
        self.model, self.motion, self.mask, self.step = model, motion, mask, step

    @abstractmethod
    def inputs(self, noise: Float[Tensor, "draws frames coordinates"]) -> Float[Tensor, "draws frames inputs"]:
        """The network's input Mⁿ, from unit noise, which may be overwritten."""

    @abstractmethod
    def losses(self, decoded: Float[Tensor, "draws frames dim"]) -> dict[str, Tensor]:
        """The terms and their weighted sum ``loss``, from the decoder's features F_dec."""


class VertexObjective(TrainingObjective):
    """The paper's: Huber losses of the position, velocity and acceleration of vertices, and L_face (eq. 15 to 19)."""

    def inputs(self, noise: Float[Tensor, "draws frames coordinates"]) -> Float[Tensor, "draws frames coordinates"]:
        """√ᾱ M⁰ + √(1 − ᾱ) ε (eq. 1), as :meth:`NoiseProcess.add_noise` but in place.

        On a processor, allocating tensors of this size takes longer than the arithmetic.
        """
        signal = self.model.process.signal.to(noise.device)[self.step][:, None, None]
        return noise.mul_((1 - signal).sqrt()).addcmul_(self.motion.flatten(2), signal.sqrt() * self.model.scale)

    def losses(self, decoded: Float[Tensor, "draws frames dim"]) -> dict[str, Tensor]:
        """Eq. 15 to 19 of the prediction M̂⁰ = W F_dec + b, by the fused twin of ``losses.training_losses``.

        The prediction is never held as a whole: with 70 000 coordinates a frame it takes more memory and time than the
        rest of the step, so the last map, the losses and their gradients are computed block by block.
        """
        model, last = self.model, self.model.network.unembed
        weight: Tensor = last.weight
        bias: Tensor = last.bias
        if model.geometry is not None:  # linear in the last map, which is weighted in place of its result
            with torch.autocast(decoded.device.type, enabled=False):
                weight, bias = model.geometry @ weight, model.geometry @ bias
        target, upper_face = model.weighed(self.motion), model.assets.regions["upper_face"]
        weights = model.options.loss_weights
        return fused_losses(decoded, weight, bias, target, self.mask, upper_face, weights, scale=model.scale)


class ComponentObjective(TrainingObjective):
    """Squared errors in a space of known variances; the network predicts the part that the noisy motion leaves open."""

    mean: Tensor  # posterior mean of the noisy motion, known once the inputs are

    def __init__(
        self, model: DualPathRecipe, motion: Tensor, mask: Tensor, step: Tensor, preconditioning: Preconditioning
    ) -> None:
        super().__init__(model, motion, mask, step)
        self.preconditioning = preconditioning

    def inputs(self, noise: Float[Tensor, "draws frames coordinates"]) -> Float[Tensor, "draws frames inputs"]:
        """Mⁿ (eq. 1), scaled to unit variance; its posterior mean is used again by :meth:`losses`."""
        noisy = self.model.process.add_noise(self.motion, noise, self.step)
        self.mean = self.preconditioning.posterior_mean(noisy, self.step, self.mask)
        return self.preconditioning.inputs(noisy, self.mean, self.step, self.mask)

    def losses(self, decoded: Float[Tensor, "draws frames dim"]) -> dict[str, Tensor]:
        """Weighted squared errors of the coordinates, their velocities and accelerations."""
        features = self.model.network.clean_motion(decoded)
        predicted = self.preconditioning.clean(self.mean, features, self.step, self.mask)
        importance = self.preconditioning.loss[self.step]
        return preconditioned_losses(predicted, self.motion, self.mask, importance, self.model.options.loss_weights)
