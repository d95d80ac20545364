"""Dual-path style diffusion: personalised speech-driven animation by a diffusion model with two style paths.

Li, Song, Liu, An: "Personalised speech-driven 3D facial animation" (2026), called "the paper" in these files.
:meth:`DualPathDiffusion.losses_at` is its algorithm 1 and :meth:`DualPathDiffusion.sample` its algorithm 2; numbers in
circles are the lines of these algorithms. Where the rest of the paper is:

- eq. 1 and the cosine schedule: ``NoiseProcess`` and ``cosine_betas`` in ``models/samplers.py``
- eq. 2 to 9, dynamic style: ``TcnGruTransformer`` in ``models/speaker_encoders.py``, eq. 7 its ``AttentionPooling``
- eq. 10 and 11, identity: ``HierarchicalIdentity`` in the same file
- eq. 12, cross-attention: ``BidirectionalCrossAttention`` in ``models/fusions.py``
- eq. 13 and figure 3: ``DualPathNetwork.core`` in ``network.py``, ``StyleTransformer`` in ``models/decoders.py``
- eq. 14: ``StyleTokens`` in ``conditioning.py``; identities are hidden by ``ConditionedModel.hide`` there
- eq. 15 to 19, losses: ``objective.py``, and as the paper prints them ``models/losses.py``

Ours, and not the paper's: ``recipe.py`` (few sampling steps: ``last_noise_for``), ``speech_style.py`` and expressivity
(``generation.py``).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from facediff import registry
from facediff.data import Batch
from facediff.errors import ArgumentError
from facediff.hyperparameters import takes_options, with_classes
from facediff.models.audio_encoders import AudioEncoderFactory, MelEncoder
from facediff.models.base import AnimationModel
from facediff.models.decoders import DecoderFactory, StyleTransformer
from facediff.models.dual_path.conditioning import CONDITIONS, Conditions, TemplateToken, TokenForm
from facediff.models.dual_path.generation import Generation
from facediff.models.dual_path.graphs import graphs_of
from facediff.models.dual_path.network import DualPathNetwork
from facediff.models.dual_path.objective import objective_of
from facediff.models.dual_path.recipe import NoiseScale
from facediff.models.dual_path.speech_style import SpeechStyle
from facediff.models.folding import Blend, SamplingSpace, unchanged
from facediff.models.fusions import BidirectionalCrossAttention, FusionFactory
from facediff.models.graphs import Graphs
from facediff.models.inference import Expressivity, Progress
from facediff.models.invented_speakers import InventedSpeakers
from facediff.models.layers import Share, Weight, Width
from facediff.models.losses import style_identity_loss
from facediff.models.mesh_encoders import LinearMeshEncoder, MeshEncoderFactory
from facediff.models.motion_space import MotionSpaceFactory, VertexMotion
from facediff.models.samplers import DpmSolverSampler, NoiseProcess, NoiseSource, SamplerFactory, unit_noise
from facediff.models.speaker_encoders import (
    HierarchicalIdentity,
    IdentityEncoderFactory,
    StyleEncoderFactory,
    TcnGruTransformer,
)
from facediff.utils import ranges
from facediff.utils.ranges import Range


@dataclass(kw_only=True)
class DualPathOptions:
    """Options of :class:`DualPathDiffusion`; the ablations of the paper are one override each.

    Args:
        dim: model width C.
        audio_encoder: speech to features F_a.
        identity_encoder: a speaker's label to the static identity F_id; ``none`` for the ablation.
        motion_space: the numbers of a frame that are noised: all vertices, or principal components with a
            preconditioned network (docs/generation.md).
        mesh_encoder: reference motion to one feature per frame, in front of the style encoder.
        style_encoder: these features to the dynamic style F_dyn; ``none`` for the ablation.
        fusion: speech features and noisy motion to one sequence; ``add`` for the ablation.
        decoder: this sequence and the style to clean motion.
        sampler: runs the reverse process in validation, test, prediction and animation.
        sampling_space: where it runs: ``folded`` into ``dim`` dimensions, with the same distribution of motion at a
            cost per step that does not depend on the vertices, or on the ``vertices`` themselves, for comparison. A
            sampler or a network that cannot be folded runs on the vertices anyway.
        diffusion_steps: noising steps N.
        noise_schedule: ``squaredcos_cap_v2`` (the cosine schedule), ``linear`` or ``scaled_linear``.
        noise_draws: how often a clip is noised in a training step, each time to another step with other noise; speech
            and style are encoded once for all of them.
        timestep_sampling: draw training steps ``uniform``, as in the paper, or by ``log_snr``: mostly evenly over the
            logarithm of the signal-to-noise ratio, where noise hides part of the motion. For a motion space with a
            preconditioned network.
        noise_scale: factor on the motion before it is noised; ``auto`` measures on the training split at which
            scale half of its variance shows in the schedule's middle.
        style_tokens: present the style condition as several tokens (``levels``) or one (``single``).
        template_token: let the network see the neutral face f as a further token. The paper's algorithms pass f but do
            not say where it enters. Such a model cannot be exported.
        identity_dropout: share of training clips with a hidden identity, so that unseen speakers can be animated.
        invented_speakers: share of training clips with motion and style reference multiplied by the same random
            gains under a hidden identity, so that the style path learns more speakers than the corpus has.
        style_dropout: share of training clips with a hidden dynamic style, so that the style can guide, and is taken
            from the speech without a reference.
        style_from_speech: learn to predict the style from the speech, by a regression beside the training that changes
            nothing else (:class:`~facediff.models.dual_path.speech_style.SpeechStyle`); without a reference, an
            identity's mean style is then changed as the speech asks.
        speech_dropout: share of training clips with hidden speech, together with all other conditions that may be
            hidden, so that speech can guide.
        speech_guidance: how much more than it has learnt the model follows the speech; 1 or, with ``speech_dropout``,
            another scale.
        identity_guidance: the same for the identity, with ``identity_dropout``.
        style_guidance: the same for the dynamic style, with ``style_dropout``.
        expressivity: 0 for the predicted mean, 1 for a sample, and anything between and up to 2.
        velocity_weight: λ_vel.
        acceleration_weight: λ_acc.
        face_weight: λ_face.
        style_identity_weight: weight of telling the training identity from the dynamic style, by a linear map that is
            used in training only; lets the style hold the person in addition to the mood.
    """

    # Components.
    dim: Width = 256
    audio_encoder: AudioEncoderFactory = MelEncoder
    identity_encoder: IdentityEncoderFactory = HierarchicalIdentity
    motion_space: MotionSpaceFactory = VertexMotion
    mesh_encoder: MeshEncoderFactory = LinearMeshEncoder
    style_encoder: StyleEncoderFactory = TcnGruTransformer
    fusion: FusionFactory = BidirectionalCrossAttention
    decoder: DecoderFactory = StyleTransformer
    sampler: SamplerFactory = DpmSolverSampler
    sampling_space: SamplingSpace = "folded"
    # Noise.
    diffusion_steps: Annotated[int, Range(1, 100_000)] = 1000
    noise_schedule: Literal["squaredcos_cap_v2", "linear", "scaled_linear"] = "squaredcos_cap_v2"
    noise_draws: Annotated[int, Range(1, 64)] = 1
    timestep_sampling: Literal["uniform", "log_snr"] = "uniform"
    noise_scale: NoiseScale = 1.0
    # Conditions: how they are presented, how often they are hidden, how far they guide.
    style_tokens: TokenForm = "levels"
    template_token: bool = False
    identity_dropout: Share = 0.1
    invented_speakers: Share = 0.0
    style_dropout: Share = 0.0
    style_from_speech: bool = False
    speech_dropout: Share = 0.0
    speech_guidance: ranges.GuidanceScale = 1.0
    identity_guidance: ranges.GuidanceScale = 1.0
    style_guidance: ranges.GuidanceScale = 1.0
    expressivity: ranges.Expressivity = 1.0
    # Weights of losses.
    velocity_weight: Weight = 0.003
    acceleration_weight: Weight = 0.003
    face_weight: Weight = 0.0005
    style_identity_weight: Weight = 0.0

    @property
    def loss_weights(self) -> dict[str, float]:
        """The weights of eq. 15."""
        weights = {"velocity": self.velocity_weight, "acceleration": self.acceleration_weight, "face": self.face_weight}
        return {"reconstruction": 1.0, **weights}


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
    chosen: ClassVar[tuple[str, ...]] = (*AnimationModel.chosen, "sampler", "_sampler_options", "guidance")

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
        preconditioned = self.motion_space.preconditioning is not None
        if options.timestep_sampling == "log_snr" and not preconditioned:
            raise ArgumentError({"timestep_sampling": "log_snr"}, "needs motion_space=components")
        dim = options.dim
        style = options.style_encoder(dim=dim)
        style_dim = sum(style.token_dims)
        self.network = DualPathNetwork(
            coordinates=self.motion_space.coordinates,
            inputs=self.motion_space.inputs,
            dim=dim,
            audio_encoder=options.audio_encoder(dim=dim),
            identity_encoder=options.identity_encoder(dim=dim, n_identities=speakers),
            # Without a dynamic style there is nothing to embed, and no idle weights.
            mesh_encoder=options.mesh_encoder(dim=dim, **points) if style_dim else None,
            style_encoder=style,
            fusion=options.fusion(dim=dim),
            decoder=options.decoder(dim=dim, style_dim=dim),
            token_form=options.style_tokens,
            template_token=TemplateToken(self.n_vertices, self.dims, dim) if options.template_token else None,
            speech_may_hide=options.speech_dropout > 0,
            style_may_hide=options.style_dropout > 0,
            starts_at_zero=preconditioned,
            speech_style=SpeechStyle(dim, style_dim, speakers) if options.style_from_speech else None,
        )
        terms = {"style_from_speech": options.style_from_speech, "style_identity_weight": options.style_identity_weight}
        if any(terms.values()) and not style_dim:
            raise ArgumentError(terms, "there is no dynamic style; choose a style_encoder, or omit these options")
        self.style_identity = nn.Linear(style_dim, speakers) if options.style_identity_weight else None
        self.expressivity: Expressivity = options.expressivity
        self.guidance = dict.fromkeys(CONDITIONS, 1.0)
        self.choose_guidance({name: getattr(options, f"{name}_guidance") for name in CONDITIONS})

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
        objective = objective_of(self, batch, step, draws)
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
