"""Dual-path style diffusion: personalised speech-driven animation by a diffusion model with two style paths.

Li, Song, Liu, An: "Personalised speech-driven 3D facial animation" (2026), called "the paper" in these files.
:meth:`DualPathDiffusion.losses_at` is its algorithm 1 and :meth:`DualPathDiffusion.sample` its algorithm 2; numbers in
circles are the lines of these algorithms. Where the rest of the paper is:

- eq. 1 and the cosine schedule: ``NoiseProcess`` and ``cosine_betas`` in ``models/samplers.py``
- eq. 2 to 9, dynamic style: ``TcnGruTransformer`` in ``models/speaker_encoders.py``, eq. 7 its ``AttentionPooling``
- eq. 10 and 11, identity: ``HierarchicalIdentity`` in the same file
- eq. 12, cross-attention: ``BidirectionalCrossAttention`` in ``models/fusions.py``
- eq. 13 and figure 3: ``DualPathNetwork.core`` in ``network.py``, ``StyleTransformer`` in ``models/decoders.py``
- eq. 14: ``StyleTokens`` in ``conditioning.py``; identities are hidden by ``DualPathRecipe.hide`` in ``recipe.py``
- eq. 15 to 19, losses: ``objective.py``, and as the paper prints them ``models/losses.py``

Ours, and not the paper's: ``recipe.py`` (few sampling steps: ``last_noise_for``), ``speech_style.py`` and expressivity
(``generation.py``).
"""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from facediff import registry
from facediff.data import Batch
from facediff.errors import ArgumentError
from facediff.hyperparameters import takes_options, with_classes
from facediff.models.base import AnimationModel
from facediff.models.dual_path.conditioning import Conditions
from facediff.models.dual_path.generation import Generation
from facediff.models.dual_path.graphs import graphs_of
from facediff.models.dual_path.network import DualPathNetwork
from facediff.models.dual_path.objective import ComponentObjective, TrainingObjective, VertexObjective
from facediff.models.dual_path.options import DualPathOptions
from facediff.models.folding import Blend, unchanged
from facediff.models.graphs import Graphs
from facediff.models.inference import Expressivity, Progress
from facediff.models.invented_speakers import InventedSpeakers
from facediff.models.losses import style_identity_loss
from facediff.models.samplers import NoiseProcess, NoiseSource, unit_noise


@registry.model.register("DualPathDiffusion")
class DualPathDiffusion(Generation):
    """Personalised speech-driven animation by dual-path style diffusion.

    Speech features, a hierarchical identity embedding and a dynamic style encoder condition a diffusion model over
    vertex motion. Every part is chosen by name.

    Args:
        options: of :class:`DualPathOptions` as keyword arguments, and of every model
            (:class:`facediff.models.AnimationModel`).
    """

    samples: ClassVar[bool] = True
    options: DualPathOptions
    chosen: ClassVar[tuple[str, ...]] = (*AnimationModel.chosen, "sampler", "_sampler_options")

    @takes_options(DualPathOptions)
    def __init__(self, options: DualPathOptions, **common: Any) -> None:  # noqa: ANN401
        super().__init__(**common)
        self.options = with_classes(options)
        points, speakers = {"n_vertices": self.n_vertices, "dims": self.dims}, len(self.identities)
        share = options.invented_speakers
        self.invented_speakers = InventedSpeakers(**points, share=share) if share else None
        scale = 1.0 if options.noise_scale == "auto" else options.noise_scale
        self.process = NoiseProcess(options.diffusion_steps, options.noise_schedule, scale)
        self.sampler = options.sampler(process=self.process)
        self._trained_steps = self.sampler.steps
        self.motion_space = options.motion_space(**points, steps=options.diffusion_steps)
        if options.timestep_sampling == "log_snr" and self.motion_space.preconditioning is None:
            raise ArgumentError({"timestep_sampling": "log_snr"}, "needs motion_space=components")
        self.network = DualPathNetwork(options, self.motion_space, **points, identities=speakers)
        style_dim = sum(self.network.style_encoder.token_dims)
        terms = {"style_from_speech": options.style_from_speech, "style_identity_weight": options.style_identity_weight}
        if any(terms.values()) and not style_dim:
            raise ArgumentError(terms, "there is no dynamic style; choose a style_encoder, or omit these options")
        self.style_identity = nn.Linear(style_dim, speakers) if options.style_identity_weight else None
        self.expressivity: Expressivity = options.expressivity

    # Algorithm 1: training.

    def losses(self, batch: Batch, generator: torch.Generator | None = None) -> dict[str, Tensor]:
        """Algorithm 1 for a batch ②, at random steps ③ with random noise."""
        if self.training and self.invented_speakers is not None:
            batch = self.invented_speakers(batch, self.scale)
        device, draws = batch.motion.device, len(batch) * self.options.noise_draws
        step = self.process.draw_steps(draws, device, generator, weights=self.step_weights())  # ③ n
        shape = (draws, batch.motion.shape[1], self.motion_space.coordinates)
        return self.losses_at(batch, step, unit_noise(shape, device, generator))

    def losses_at(
        self, batch: Batch, step: Int[Tensor, " draws"], noise: Float[Tensor, "draws frames coordinates"]
    ) -> dict[str, Tensor]:
        """Algorithm 1, lines ③ to ⑦, at given steps with given noise, which is overwritten.

        Args:
            batch: clips A, M⁰, M_ref, C and f.
            step: each draw's step n, counted from 0; one draw of every clip, or several of the first, of the second ….
            noise: unit noise of every draw.
        """
        # Several noisy versions of a clip share its conditions: they lower the variance of the gradient at the price of
        # the denoising network alone.
        draws = len(step) // len(batch)
        objective = self.objective(batch, step, draws)
        conditions = self.conditions(batch)  # ④ F_a, F_dyn, F_id
        noisy = objective.inputs(noise)  # ③ Mⁿ by eq. 1
        motion = self.network.embed(noisy)  # ⑤ F_m
        # ⑥ up to the last map, which makes M̂⁰: it is computed together with the losses.
        decoded = self.network.core(motion, step, conditions if draws == 1 else conditions.for_draws(draws))
        losses = objective.losses(decoded)  # ⑦ eq. 15 to 19
        if self.style_identity is not None and conditions.dynamic is not None:  # ours; it depends on F_dyn alone
            term = style_identity_loss(self.style_identity(conditions.dynamic), batch.identity)
            total = losses["loss"] + self.options.style_identity_weight * term
            losses |= {"style_identity": term, "loss": total}
        return losses

    def objective(self, batch: Batch, step: Int[Tensor, " draws"], draws: int) -> TrainingObjective:
        """The objective of the motion space for so many draws of every clip."""
        motion, mask, scales = batch.motion, batch.mask, self.motion_space.preconditioning
        if scales is not None:
            motion = self.motion_space.encode(self.scaled(motion))
        if draws > 1:
            motion, mask = motion.repeat_interleave(draws, 0), mask.repeat_interleave(draws, 0)
        if scales is None:
            return VertexObjective(self, motion, mask, step)
        return ComponentObjective(self, motion, mask, step, scales)

    # Algorithm 2: sampling.

    def sample(
        self,
        conditions: Conditions,
        unit: NoiseSource,
        *,
        blend: Blend = unchanged,
        frames: slice = slice(None),  # noqa: B008 - it cannot be changed
        progress: Progress | None = None,
    ) -> Float[Tensor, "batch frames points dims"]:
        """Algorithm 2: motion as offsets from the template.

        Args:
            conditions: ② F_a, F_dyn and F_id, a row for each sample.
            unit: source of unit noise.
            blend: changes the features of every step.
            frames: the frames to decode.
            progress: wraps the iteration over steps.
        """
        denoiser = self.denoiser(conditions, blend)

        def noise(like: Tensor) -> Tensor:
            return denoiser.noise(unit(like))

        state = noise(self.empty_state(denoiser))  # ① M^N
        # ③ for n = N … 1: ④ ⑤ M̂⁰ = denoise(Mⁿ, n), ⑥ z, ⑦ Mⁿ⁻¹ from Mⁿ and M̂⁰ (Sampler.run, Sampler.update)
        state = self.sampler.run(denoiser.denoise, state, noise=noise, progress=progress)
        return self.decode(denoiser, state, frames)  # ⑨

    # Style, adaptation, export.

    def encode_style(
        self, reference: Float[Tensor, "batch frames *numbers"], mask: Bool[Tensor, "batch frames"]
    ) -> Float[Tensor, "batch style_dim"]:
        """F_dyn of reference motions (eq. 2 to 9), which speech does not change; of width 0 without a dynamic path."""
        style = self.network.dynamic_style(self.scaled(reference), mask)
        return nn.functional.pad(style, (0, self.network.style_dim - style.shape[1]))

    def personal_modules(self) -> list[nn.Module]:
        """The encoders of identity and dynamic style, and the maps that present these and the face to the decoder."""
        network = self.network
        parts = (
            *(network.identity_encoder, network.mesh_encoder, network.style_encoder, network.style_tokens),
            *(network.template_token, self.style_identity),
        )
        return [part for part in parts if part is not None]

    def graphs(self) -> Graphs:
        """Audio encoder, denoising step and last map; the sampler as numbers."""
        return graphs_of(self)
