"""Dual-path style diffusion: personalised speech-driven animation by a diffusion model with two style paths.

Li, Song, Liu, An: "Personalised speech-driven 3D facial animation" (2026), called "the paper" in these files. This file
has the model: options, loss, sampling; ``network.py`` has its network. Components chosen by name have files
of their own; docs/method.md says where each equation is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Any, ClassVar, Literal, cast

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from facediff import registry
from facediff.data import Batch, Reference, SpeechMotionDataModule, collate
from facediff.errors import ArgumentError, FaceDiffError, choices
from facediff.models.audio_encoders import AudioEncoderFactory, MelEncoder
from facediff.models.base import AnimationModel
from facediff.models.decoders import DecoderFactory, StyleTransformer
from facediff.models.dual_path.graphs import graphs_of
from facediff.models.dual_path.network import (
    Conditions,
    DualPathNetwork,
    Hidden,
    SpeechStyle,
    TemplateToken,
    TokenForm,
)
from facediff.models.folding import (
    Blend,
    ConditionalDenoiser,
    SamplingSpace,
    unchanged,
)
from facediff.models.fusions import BidirectionalCrossAttention, FusionFactory
from facediff.models.graphs import Graphs
from facediff.models.inference import ClipNoise, Expressivity, Progress, Style, WindowNoise, WindowOverlap
from facediff.models.invented_speakers import InventedSpeakers
from facediff.models.layers import Share, Weight, Width
from facediff.models.losses import preconditioned_losses, style_identity_loss
from facediff.models.losses_fused import fused_losses
from facediff.models.mesh_encoders import ComponentMeshEncoder, LinearMeshEncoder, MeshEncoderFactory
from facediff.models.motion_space import ComponentMotion, MotionSpaceFactory, Preconditioning, Projection, VertexMotion
from facediff.models.samplers import (
    MANY_STEPS,
    DpmSolverSampler,
    NoiseProcess,
    NoiseSource,
    SamplerFactory,
    ended_earlier,
    half_hidden,
    unit_noise,
    widened,
)
from facediff.models.speaker_encoders import (
    HierarchicalIdentity,
    IdentityEncoderFactory,
    StyleEncoderFactory,
    TcnGruTransformer,
)
from facediff.speech.windows import LOW_LATENCY_AHEAD, LOW_LATENCY_STEPS, MotionWindow
from facediff.utils import ranges
from facediff.utils.hints import defaults, mismatch
from facediff.utils.ranges import Range

NumericScale = Annotated[float, Range(1e-6, 1e6)]
NoiseScale = NumericScale | Literal["auto"]

TimestepSampling = Literal["uniform", "log_snr"]

NOISE_SCALE_KEY = "facediff_noise_scale"
PRINCIPAL = 64
"""Components by which the noise scale is measured."""
CONDITIONS = ("speech", "identity", "style")
"""What motion is conditioned on, in the order in which guidance adds it."""


@registry.model.register("DualPathDiffusion")
class DualPathDiffusion(AnimationModel):
    """Personalised speech-driven animation by dual-path style diffusion.

    Speech features, a hierarchical identity embedding and a dynamic style encoder condition a diffusion model over
    vertex motion. Every part is chosen by name; the ablations of the paper are one override each:
    ``style_encoder=none``, ``identity_encoder=none``, ``fusion=add``.

    Args:
        dim: model width C.
        audio_encoder: speech to features.
        identity_encoder: a speaker's label to the static identity.
        motion_space: the numbers of a frame that are noised: all vertices, or principal components with a
            preconditioned network (docs/generation.md).
        mesh_encoder: reference motion to one feature per frame, in front of the style encoder.
        style_encoder: these features to the dynamic style.
        fusion: speech features and noisy motion to one sequence.
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
        noise_scale: what motion is multiplied by before it is noised; ``auto`` measures on the training split at which
            scale half of its variance shows in the schedule's middle.
        style_tokens: present the style condition as several tokens (``levels``) or one (``single``).
        template_token: let the network see the neutral face f, as in algorithms 1 and 2 of the paper, which say not
            where; here as a further token. Such a model cannot be exported.
        identity_dropout: share of training clips whose identity is hidden, so that unseen speakers can be animated.
        invented_speakers: share of training clips whose motion and style reference are multiplied by the same random
            gains under a hidden identity, so that the style path learns more speakers than the corpus has.
        style_dropout: share of training clips whose dynamic style is hidden, so that the style can guide, and is taken
            from the speech where none is given.
        style_from_speech: learn what speech says of the style, by a regression beside the training that changes
            nothing else (:class:`~facediff.models.dual_path.network.SpeechStyle`); where no style is given, an
            identity's usual one is then changed as the speech asks.
        speech_dropout: share of training clips whose speech is hidden, together with whatever else may be hidden, so
            that speech can guide.
        speech_guidance: how much more than it has learnt the model follows the speech; 1 or, with ``speech_dropout``,
            another scale.
        identity_guidance: the same for the identity, with ``identity_dropout``.
        style_guidance: the same for the dynamic style, with ``style_dropout``.
        expressivity: 0 for the mean prediction, 1 for a sample, and anything between and up to 2.
        velocity_weight: λ_vel.
        acceleration_weight: λ_acc.
        face_weight: λ_face.
        style_identity_weight: of telling the training identity from the dynamic style, by a linear map that is used in
            training only; lets the style hold the person in addition to the mood.
        options: those of every model, see :class:`facediff.models.AnimationModel`.
    """

    samples: ClassVar[bool] = True
    low_latency_steps = LOW_LATENCY_STEPS
    chosen: ClassVar[tuple[str, ...]] = (*AnimationModel.chosen, "sampler", "_sampler_options", "guidance")
    # Not the factory itself: jsonargparse's holds the parser, and with it the trainer and its processes, which weight
    # averaging would copy together with the model.
    _sampler_options: dict[str, Any] | None = None
    _step_weights: Tensor | None = None  # follow from the motion space, known when training begins

    def __init__(
        self,
        *,
        dim: Width = 256,
        audio_encoder: AudioEncoderFactory = MelEncoder,
        identity_encoder: IdentityEncoderFactory = HierarchicalIdentity,
        motion_space: MotionSpaceFactory = VertexMotion,
        mesh_encoder: MeshEncoderFactory = LinearMeshEncoder,
        style_encoder: StyleEncoderFactory = TcnGruTransformer,
        fusion: FusionFactory = BidirectionalCrossAttention,
        decoder: DecoderFactory = StyleTransformer,
        sampler: SamplerFactory = DpmSolverSampler,
        sampling_space: SamplingSpace = "folded",
        diffusion_steps: Annotated[int, Range(1, 100_000)] = 1000,
        noise_schedule: Literal["squaredcos_cap_v2", "linear", "scaled_linear"] = "squaredcos_cap_v2",
        noise_draws: Annotated[int, Range(1, 64)] = 1,
        timestep_sampling: TimestepSampling = "uniform",
        noise_scale: NoiseScale = 1.0,
        style_tokens: TokenForm = "levels",
        template_token: bool = False,
        identity_dropout: Share = 0.1,
        invented_speakers: Share = 0.0,
        style_dropout: Share = 0.0,
        style_from_speech: bool = False,
        speech_dropout: Share = 0.0,
        speech_guidance: ranges.GuidanceScale = 1.0,
        identity_guidance: ranges.GuidanceScale = 1.0,
        style_guidance: ranges.GuidanceScale = 1.0,
        expressivity: ranges.Expressivity = 1.0,
        velocity_weight: Weight = 0.003,
        acceleration_weight: Weight = 0.003,
        face_weight: Weight = 0.0005,
        style_identity_weight: Weight = 0.0,
        **options: Any,  # noqa: ANN401
    ) -> None:
        super().__init__(**options)
        self.identity_dropout = identity_dropout
        invented = InventedSpeakers(self.n_vertices, self.dims, invented_speakers) if invented_speakers else None
        self.invented_speakers = invented
        self.style_dropout = style_dropout
        self.speech_dropout = speech_dropout
        self.expressivity: Expressivity = expressivity
        self.loss_weights = {
            "reconstruction": 1.0,
            "velocity": velocity_weight,
            "acceleration": acceleration_weight,
            "face": face_weight,
        }
        self.noise_draws = noise_draws
        self.timestep_sampling = timestep_sampling
        self.style_identity_weight = style_identity_weight
        self.noise_scale: NoiseScale = noise_scale
        self.process = NoiseProcess(diffusion_steps, noise_schedule, 1.0 if noise_scale == "auto" else noise_scale)
        self.sampler = sampler(process=self.process)
        self._usual_steps = self.sampler.steps
        self.sampling_space: SamplingSpace = sampling_space
        points = {"n_vertices": self.n_vertices, "dims": self.dims}
        self.motion_space = motion_space(**points, steps=diffusion_steps)
        if timestep_sampling == "log_snr" and self.motion_space.preconditioning is None:
            raise ArgumentError(
                {"timestep_sampling": timestep_sampling}, "needs motion_space=components, which knows what noise hides"
            )
        style, speakers = style_encoder(dim=dim), len(self.identities)
        self.network = DualPathNetwork(
            coordinates=self.motion_space.coordinates,
            inputs=self.motion_space.inputs,
            dim=dim,
            audio_encoder=audio_encoder(dim=dim),
            identity_encoder=identity_encoder(dim=dim, n_identities=speakers),
            # Without a dynamic style there is nothing to embed, and no idle weights.
            mesh_encoder=mesh_encoder(dim=dim, **points) if style.token_dims else None,
            style_encoder=style,
            fusion=fusion(dim=dim),
            decoder=decoder(dim=dim, style_dim=dim),
            token_form=style_tokens,
            template_token=TemplateToken(self.n_vertices, self.dims, dim) if template_token else None,
            speech_may_hide=speech_dropout > 0,
            style_may_hide=style_dropout > 0,
            starts_at_zero=self.motion_space.preconditioning is not None,
            speech_style=SpeechStyle(dim, sum(style.token_dims), speakers) if style_from_speech else None,
        )
        if (style_from_speech or style_identity_weight) and not style.token_dims:
            needing = {"style_from_speech": style_from_speech, "style_identity_weight": style_identity_weight}
            raise ArgumentError(
                needing, "there is no dynamic style; choose a style_encoder, or leave out what needs it"
            )
        self.style_identity = nn.Linear(sum(style.token_dims), speakers) if style_identity_weight else None
        self.guidance = dict.fromkeys(CONDITIONS, 1.0)
        self.choose_guidance({"speech": speech_guidance, "identity": identity_guidance, "style": style_guidance})

    def measure(self, data: SpeechMotionDataModule, at_least: int = 0) -> Float[Tensor, "components all"] | None:
        """Besides principal components, how much noise hides of the training motion."""
        shapes = super().measure(data, PRINCIPAL if self.noise_scale == "auto" else at_least)
        space, covariance = self.motion_space, None
        if space.prior_frames > 1 and isinstance(space, ComponentMotion):
            project = space.components.project
            covariance = data.covariance_over_time(lambda motion: project(motion * self.scale), space.prior_frames)
        if self.noise_scale == "auto" and shapes is not None:
            # Shapes are as long as their standard deviations, so their squared lengths are the components' variances.
            variances = shapes[:PRINCIPAL].square().sum(1)
            noised = space.noised_variances(variances)
            if covariance is not None and isinstance(space, ComponentMotion):
                # What a frame hides is less when its neighbours tell it.
                noised, variances = space.modes(covariance)
            self.rescale_noise(half_hidden(noised, variances))
        space.fit(self.process.signal, covariance)
        if (token := self.network.template_token) is not None:
            faces = self.assets.templates
            token.measure(torch.stack([faces[identity] for identity in self.identities if identity in faces]))
        return shapes

    def scale_like(self, other: DualPathDiffusion, data: SpeechMotionDataModule) -> None:
        """Give the largest movement the size that it has in another face's model.

        Unit variance of a coordinate says little: 60 weights are smaller as a whole than the coordinates of 6 000
        vertices by a factor of 20, and the same noise would hide another share of them.

        Args:
            other: a measured model.
            data: this model's corpus, on which it has been measured too.
        """
        own, theirs = self.motion_space, other.motion_space
        scale = self.assets.motion_scale
        if scale is None or not isinstance(own, ComponentMotion) or not isinstance(theirs, ComponentMotion):
            return
        ratio = float(theirs.components.deviations[0] / own.components.deviations[0])
        self.adopt(self.assets.with_motion_scale(scale * ratio))
        self.measure(data)

    def motion_weights(self, data: SpeechMotionDataModule) -> Float[Tensor, "points dims"]:
        """The motion space's weights of regions, of those that the corpus lists."""
        weighted = self.weighted_assets
        weights, regions = super().motion_weights(data), dict(weighted.regions)
        if not weighted.space.is_vertices:
            regions["eyelids"] = torch.tensor(weighted.space.region("eyes"), dtype=torch.long)
        elif "eyelids" in self.motion_space.region_weights and (pairs := data.eyelid_pairs()) is not None:
            regions["eyelids"] = pairs.flatten()
        # The last of them counts where regions overlap: eyelids lie in the upper face.
        for region, weight in self.motion_space.region_weights.items():
            if region in regions:
                weights[regions[region]] = weight
        return weights

    def training_projection(self) -> Projection | None:
        """Principal components, where no part of the model needs the vertices.

        Otherwise a batch of 8 clips of 6 000 vertices is read, padded, scaled and projected twice: 0.3 s of a step of
        0.8 s on one processor.
        """
        takers = [part for part in (self.motion_space, self.network.mesh_encoder) if part is not None]
        components = [part.components for part in takers if isinstance(part, ComponentMotion | ComponentMeshEncoder)]
        if self.invented_speakers is not None or len(components) < len(takers):
            return None
        return max(components, key=lambda each: each.count).projection(self.scale)

    def rescale_noise(self, scale: float) -> None:
        """Noise motion at another scale from now on."""
        self.process = NoiseProcess(self.process.steps, self.process.schedule, scale)
        options = self._sampler_options
        options = self.hparams["sampler"]["init_args"] if options is None else options
        self.sampler = type(self.sampler)(process=self.process, **options)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add the measured noise scale."""
        super().on_save_checkpoint(checkpoint)
        checkpoint[NOISE_SCALE_KEY] = self.process.scale

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Take the noise scale from the checkpoint."""
        super().on_load_checkpoint(checkpoint)
        if self.noise_scale == "auto":
            scale = checkpoint.get(NOISE_SCALE_KEY, 1.0)
            if mismatch(NumericScale, scale) is not None:
                raise FaceDiffError(f"its {NOISE_SCALE_KEY} is {str(scale)[:40]}; the file is damaged")
            self.rescale_noise(float(scale))

    def personal_modules(self) -> list[nn.Module]:
        """The identity's and the dynamic style's encoders, and how these and the face are presented to the decoder."""
        network = self.network
        parts = (
            *(network.identity_encoder, network.mesh_encoder, network.style_encoder, network.style_tokens),
            *(network.template_token, self.style_identity),
        )
        return [part for part in parts if part is not None]

    def choose_sampler(self, name: str | None = None, steps: int | None = None) -> None:
        """Sample in another way from now on; checkpoints keep the sampler that the model was made with.

        A sampler chosen by name keeps the spacing and the last noise that the model was made with, where as many steps
        have that much noise; its other options are its own. Where both ends of the path are set, as ``first_noise``
        and ``last_noise``, fewer steps end at more noise (:func:`~facediff.models.samplers.ended_earlier`), and
        their samples are taken further from the mean (:func:`~facediff.models.samplers.widened`).
        """
        chosen = registry.sampler.get(name) if name is not None else type(self.sampler)
        first: dict[str, Any] = self.hparams["sampler"]["init_args"]
        options = dict(first if self._sampler_options is None else self._sampler_options)
        if name is not None:
            shared = {"spacing", "last_noise", "first_noise"} & first.keys() & defaults(chosen).keys()
            options = {key: first[key] for key in sorted(shared)}
        options |= {} if steps is None else {"steps": steps}
        count = options.get("steps", defaults(chosen).get("steps"))
        if count is not None and options.get("first_noise") and options.get("last_noise"):
            share = count / min(self._usual_steps, MANY_STEPS)
            options["last_noise"] = ended_earlier(first["first_noise"], first["last_noise"], share)
            if "spread" in defaults(chosen) and self.motion_space.preconditioning is not None:
                wider = widened(first["first_noise"], first["last_noise"], share)
                options["spread"] = min(2.0, wider * first.get("spread", 1.0))
        try:
            self.sampler = chosen(process=self.process, **options)
        except ArgumentError:
            if name is None:
                raise
            # A thousand steps of ddpm go to the clean end: fewer of the process have the last noise of ten.
            options = {} if steps is None else {"steps": steps}
            self.sampler = chosen(process=self.process, **options)
        self._sampler_options = options

    def choose_low_latency(self) -> None:
        """Frame by frame, and in :attr:`low_latency_steps` denoising steps of the present sampler at most."""
        self.windows = LOW_LATENCY_AHEAD
        self.choose_sampler(steps=min(self.low_latency_steps, self.sampler.steps))

    def choose_expressivity(self, expressivity: Expressivity) -> None:
        """Go from the mean prediction (0) to a sample (1) or beyond; checkpoints keep what the model was made with."""
        # One number for each vertex lets the lips follow the mean while the brows are sampled.
        numbers = expressivity.flatten().tolist() if isinstance(expressivity, Tensor) else [expressivity]
        if isinstance(expressivity, Tensor) and expressivity.shape != (self.n_vertices,):
            raise FaceDiffError(
                f"expressivity: has the shape {tuple(expressivity.shape)}; expected one number, or one for each of "
                f"{self.n_vertices} vertices"
            )
        wrong = [(number, word) for number in numbers if (word := mismatch(ranges.Expressivity, number)) is not None]
        if wrong:
            raise FaceDiffError(f"expressivity {wrong[0][0]}: out of range; expected {wrong[0][1]}")
        self.expressivity = expressivity

    @property
    def guidable(self) -> list[str]:
        """The conditions that were hidden now and then in training, so that the model knows motion without them."""
        network = self.network
        shares = {
            "speech": self.speech_dropout,
            "identity": self.identity_dropout if network.identity_encoder.token_dims else 0.0,
            "style": self.style_dropout if network.style_encoder.token_dims else 0.0,
        }
        return [name for name in CONDITIONS if shares[name] > 0]

    def choose_guidance(self, scales: Mapping[str, float]) -> None:
        """Follow conditions more (above 1) or less from now on; checkpoints keep what the model was made with."""
        for name, scale in scales.items():
            if name not in CONDITIONS:
                raise FaceDiffError(f'guidance: there is no condition "{name}": {choices(name, CONDITIONS)}')
            if (expected := mismatch(ranges.GuidanceScale, scale)) is not None:
                raise FaceDiffError(f"guidance: {name}={scale} is out of range; expected {expected}")
            if scale != 1 and name not in self.guidable:
                raise FaceDiffError(
                    f"guidance: {name}={scale:g} needs a model that knows motion without it; train one with "
                    f"model.{name}_dropout=0.1"
                )
        self.guidance = {**self.guidance, **scales}

    def views(self) -> dict[tuple[str, ...], float]:
        """Which conditions are hidden in the predictions that guidance combines, and the share of each.

        With the conditions c₁ … c_K that can be hidden and their scales w₁ … w_K, the prediction is
        G(∅) + Σ_k w_k [G(c₁ … c_k) − G(c₁ … c_{k−1})] (incremental guidance; Sun et al. 2024, DiffPoseTalk, after Ho
        and Salimans 2022). Predictions whose share is zero are not computed: with all scales 1 there is one.
        """
        names = self.guidable
        scales = [1.0, *(self.guidance[name] for name in names), 0.0]
        shares = {tuple(names[shown:]): scales[shown] - scales[shown + 1] for shown in range(len(names) + 1)}
        return {hidden: share for hidden, share in shares.items() if share}

    def losses(self, batch: Batch, generator: torch.Generator | None = None) -> dict[str, Tensor]:
        """Noise each clip to a random step (algorithm 1, lines 3 and 4), then take the four losses (eq. 15 to 19)."""
        if self.training and self.invented_speakers is not None:
            batch = self.invented_speakers(batch, self.scale)
        device, count = batch.motion.device, len(batch) * self.noise_draws
        space, weights = self.motion_space.preconditioning, self._step_weights
        if self.timestep_sampling == "log_snr" and space is not None and (weights is None or not self.training):
            weights = self.process.even_in_log_snr(space.hidden().cpu()).to(device)
            # Not from validation: weight averages are swapped in there, whose tables may not be known yet.
            self._step_weights = weights if self.training else None
        step = self.process.draw_steps(count, device, generator, weights=weights)
        shape = (count, batch.motion.shape[1], self.motion_space.coordinates)
        return self.losses_at(batch, step, unit_noise(shape, device, generator))

    def losses_at(
        self, batch: Batch, step: Int[Tensor, " draws"], noise: Float[Tensor, "draws frames coordinates"]
    ) -> dict[str, Tensor]:
        """The losses at given steps with given noise, which is overwritten.

        Args:
            batch: clips with their true motion.
            step: each draw's step, counted from 0; one draw of every clip, or several of the first, of the second ….
            noise: unit noise of every draw.
        """
        space = self.motion_space
        conditions, motion, mask = self.conditions(batch), batch.motion, batch.mask
        if space.preconditioning is not None:
            motion = space.encode(self._scaled(motion))
        # Several noisy versions of a clip share its conditions: they lower the variance of the gradient at the price of
        # the denoising network alone, without encoding speech and style again.
        draws = len(step) // len(batch)
        drawn = conditions
        if draws > 1:
            drawn = conditions.drawn(draws)
            motion, mask = motion.repeat_interleave(draws, 0), mask.repeat_interleave(draws, 0)
        if space.preconditioning is not None:
            losses = self._preconditioned_losses(drawn, motion, mask, step, noise, space.preconditioning)
        else:
            losses = self._vertex_losses(drawn, motion, mask, step, noise)
        if self.style_identity is not None and conditions.dynamic is not None:
            # It looks at F_dyn alone: no denoising step takes part, so it costs one pass of the style encoder.
            term = style_identity_loss(self.style_identity(conditions.dynamic), batch.identity)
            losses |= {"style_identity": term, "loss": losses["loss"] + self.style_identity_weight * term}
        return losses

    def _vertex_losses(
        self,
        conditions: Conditions,
        motion: Float[Tensor, "draws frames points dims"],
        mask: Bool[Tensor, "draws frames"],
        step: Int[Tensor, " draws"],
        noise: Float[Tensor, "draws frames coordinates"],
    ) -> dict[str, Tensor]:
        """The losses on the vertices."""
        network = self.network
        # √ᾱ M⁰ + √(1 − ᾱ) ε, as NoiseProcess.add_noise, but in place: on a processor, allocating tensors of this size
        # takes longer than the arithmetic.
        signal = self.process.signal.to(noise.device)[step][:, None, None]
        noisy = noise.mul_((1 - signal).sqrt()).addcmul_(motion.flatten(2), signal.sqrt() * self.scale)
        decoded = network.core(network.embed(noisy), step, conditions)
        last: Tensor = network.unembed.weight
        rest: Tensor = network.unembed.bias
        if self.geometry is not None:  # linear in the last map, which is weighed in place of its result
            with torch.autocast(noise.device.type, enabled=False):
                last, rest = self.geometry @ last, self.geometry @ rest
        return fused_losses(
            decoded,
            last,
            rest,
            self.weighed(motion),
            mask,
            self.assets.regions["upper_face"],
            self.loss_weights,
            scale=self.scale,
        )

    def _preconditioned_losses(
        self,
        conditions: Conditions,
        clean: Float[Tensor, "draws frames coordinates"],
        mask: Bool[Tensor, "draws frames"],
        step: Int[Tensor, " draws"],
        noise: Float[Tensor, "draws frames coordinates"],
        scales: Preconditioning,
    ) -> dict[str, Tensor]:
        """The losses in a space of known variances."""
        noisy = self.process.add_noise(clean, noise, step)
        mean = scales.posterior_mean(noisy, step, mask)
        embedded = self.network.embed(scales.inputs(noisy, mean, step, mask))
        features = self.network.clean_motion(self.network.core(embedded, step, conditions))
        predicted = scales.clean(mean, features, step, mask)
        return preconditioned_losses(predicted, clean, mask, scales.loss[step], self.loss_weights)

    def conditions(self, batch: Batch, *, guided: bool = False, animated: slice = slice(None)) -> Conditions:
        """Everything that is computed once per clip; in training, conditions are hidden now and then.

        Args:
            batch: the clips.
            guided: follow the conditions as :meth:`choose_guidance` says; else as the model has learnt to.
            animated: the frames that are animated, of speech that is encoded with more around them.
        """
        network, identity = self.network, batch.identity
        hidden = self.hide(len(identity)) if self.training else Hidden()
        if hidden.identity is not None:
            # Index −1 stands for an unseen speaker. Clips that are shown under it teach the model to take the person
            # from the style alone.
            identity, hidden = identity.masked_fill(hidden.identity, -1), hidden._replace(identity=None)
        views = self.views() if guided else {}
        if [*views] not in ([], [()]):
            # All views are rows of one batch, so that guidance costs one call of the network per step and not one per
            # view.
            hidden = Hidden(*(self._in_views(name, views, len(batch)) for name in CONDITIONS))
            conditions = network.conditions(batch, identity, self.style_of(batch), hidden, animated)
            return replace(conditions, shares=tuple(views.values()))
        if hidden.speech is None and hidden.style is None:
            return network.conditions(batch, identity, self.style_of(batch), animated=animated)
        return network.conditions(batch, identity, self.style_of(batch), hidden, animated)

    def hide(self, clips: int) -> Hidden:
        """Which conditions of which training clips are hidden."""
        shares = {"identity": self.identity_dropout, "style": self.style_dropout, "speech": self.speech_dropout}
        drawn = {
            name: torch.rand(clips, device=self.device) < share if share else None for name, share in shares.items()
        }
        # Guidance starts from the motion without any of the conditions that can be hidden, which would hardly ever be
        # seen if each were drawn by itself.
        if (silent := drawn["speech"]) is not None:
            drawn = {name: None if mask is None else mask | silent for name, mask in drawn.items()}
        return Hidden(**drawn)

    def _in_views(self, name: str, views: Mapping[tuple[str, ...], float], clips: int) -> Tensor:
        return torch.tensor([name in hidden for hidden in views], device=self.device).repeat_interleave(clips)

    def default_style(self, identity: str) -> Reference | Style:
        """The style that is heard from the speech, by a model that was trained to.

        A stored reference would carry its mood into all speech. With ``style_from_speech``, the usual style of an
        identity of the training, or else that of its reference, is changed as the speech asks; with ``style_dropout``
        alone, the model knows the motion of an identity of the training without a reference.
        """
        learnt, speech_style = self.network.no_style, self.network.speech_style
        if speech_style is not None and speech_style.ready and identity not in self.person_styles:
            index = self.assets.identity_index(identity)
            if index >= 0 and (usual := speech_style.usual(index)) is not None:
                return Style(identity, torch.cat([usual, usual.new_ones(1)]).cpu())
            reference = cast(Reference, super().default_style(identity))  # all other styles are of person_styles
            motion = reference.motion.float()[None].to(self.device)
            with torch.no_grad():
                vector = self.encode_style(motion, torch.ones(motion.shape[:2], dtype=torch.bool, device=self.device))
            return Style(reference.clip, torch.cat([vector[0, :-1], vector.new_ones(1)]).cpu())
        if learnt is None or identity not in self.assets.identities or identity in self.person_styles:
            return super().default_style(identity)
        return Style(identity, nn.functional.pad(learnt.detach(), (0, self.network.style_dim - len(learnt))).cpu())

    @torch.no_grad()
    def fit_to_features(self, data: SpeechMotionDataModule) -> dict[str, Tensor]:
        """What speech says of the style, from each training clip's own style.

        Training gathers it on the way, from encoders that still change and styles of other clips in the same mood. As
        there, a style counts by its distance from the mean of its identity's clips so far, itself included: in one pass
        over n clips of an identity, the changes are too small by H_n / n of them on average, H_n = 1 + 1/2 + … + 1/n.
        """
        network, speech_style = self.eval().network, self.network.speech_style
        if speech_style is None:
            return {}
        speech_style.forget()
        dataset = data.dataset("train")
        for place in range(len(dataset)):
            batch = collate([dataset[place]]).to(self.device)
            features = network.audio_encoder(batch.audio, batch.audio_lengths, batch.frame_lengths)
            style = network.dynamic_style(self._scaled(batch.motion), batch.mask)
            speech_style.update(features, batch.mask, style, batch.identity, memory=1.0)
        return {f"network.speech_style.{name}": sums.clone() for name, sums in speech_style.named_buffers()}

    def encode_style(
        self, reference: Float[Tensor, "batch frames *numbers"], mask: Bool[Tensor, "batch frames"]
    ) -> Float[Tensor, "batch style_dim"]:
        """F_dyn of reference motions (eq. 2 to 9), which speech does not change; of width 0 without a dynamic path."""
        style = self.network.dynamic_style(self._scaled(reference), mask)
        return nn.functional.pad(style, (0, self.network.style_dim - style.shape[1]))

    def _scaled(self, motion: Tensor) -> Tensor:
        """Offsets in the network's unit and precision; components of training motion are in that unit already."""
        return motion if motion.dim() == 3 else motion.to(self.dtype) * self.scale

    def graphs(self) -> Graphs:
        """Audio encoder, denoising step and last map; the sampler as numbers."""
        return graphs_of(self)

    @torch.no_grad()
    def generate_clips(
        self, batch: Batch, *, seed: int = 0, progress: Progress | None = None
    ) -> Float[Tensor, "batch frames points dims"]:
        """Algorithm 2 with the model's sampler, in its sampling space; conditions are computed once.

        All noise of a clip follows from the seed and its name: its motion does not depend on the rest of the batch.
        """
        lengths = batch.frame_lengths.tolist()
        noise = ClipNoise(batch.names, lengths, [seed] * len(batch), self.device)
        of_mean = ClipNoise(mean_names(batch), lengths, [0] * len(batch), self.device)
        return self.sample(self.conditions(batch, guided=True), noise, of_mean, progress=progress)

    @torch.no_grad()
    def generate_samples(
        self, clip: Batch, seeds: Sequence[int], *, progress: Progress | None = None
    ) -> Float[Tensor, "samples frames points dims"]:
        """The same for several seeds: speech and style are encoded once."""
        lengths = clip.frame_lengths.tolist()
        noise = ClipNoise(clip.names * len(seeds), lengths * len(seeds), seeds, self.device)
        of_mean = ClipNoise(mean_names(clip), lengths, [0], self.device)
        return self.sample(self.conditions(clip, guided=True), noise, of_mean, samples=len(seeds), progress=progress)

    @torch.no_grad()
    def generate_window(
        self, clip: Batch, window: MotionWindow, seeds: Sequence[int], before: list[Tensor] | None
    ) -> tuple[Float[Tensor, "samples frames points dims"], list[Tensor]]:
        """The same for a window of long speech, blended in every denoising step with the window before it."""
        # The speech before the window is encoded with it but not animated: features at its start depend on it.
        own = slice(window.context, window.context + window.frames + window.plan.ahead)
        conditions = self.conditions(clip, guided=True, animated=own).frames(own.start, own.stop)
        kept, new = slice(max(0, window.frames - window.kept), window.frames), slice(window.fixed, window.frames)
        overlap_blend = WindowOverlap(before, kept, window.fixed)
        noise = WindowNoise(clip.names[0], window, seeds, self.device)
        of_mean = WindowNoise(mean_names(clip)[0], window, [0], self.device)
        motion = self.sample(conditions, noise, of_mean, samples=len(seeds), blend=overlap_blend, wanted=new)
        return motion, overlap_blend.features

    def sample(
        self,
        conditions: Conditions,
        unit: NoiseSource,
        of_mean: NoiseSource,
        *,
        samples: int = 1,
        blend: Blend = unchanged,
        wanted: slice = slice(None),  # noqa: B008 - it cannot be changed
        progress: Progress | None = None,
    ) -> Float[Tensor, "batch wanted points dims"]:
        """Run the sampler from noise to motion, in offsets from the template.

        Args:
            conditions: of the clips, of one clip, or of a window.
            unit: gives unit noise, for every clip and sample.
            of_mean: gives the unit noise from which the mean is predicted, for every clip.
            samples: how many of one clip.
            blend: changes the features of every step.
            wanted: the frames whose motion is wanted.
            progress: wraps the iteration over steps.
        """
        expressivity = self.expressivity
        whole = not isinstance(expressivity, Tensor)
        mean = None if whole and expressivity == 1 else self._mean(conditions, of_mean, blend, wanted)
        if mean is not None and whole and expressivity == 0:
            return mean.expand(samples * len(mean), -1, -1, -1)
        # Samples of one clip share its speech features and style: only the noisy motion differs.
        conditions = conditions.repeated(samples)
        denoiser = self.denoiser(conditions, blend)

        def noise(like: Tensor) -> Tensor:
            return denoiser.noise(unit(like))

        sample = self.sampler.run(
            denoiser.denoise, noise(self._empty(denoiser, conditions)), noise=noise, progress=progress
        )
        motion = self._motion(denoiser, sample, wanted)
        if mean is None:
            return motion
        share = expressivity.to(motion)[:, None] if isinstance(expressivity, Tensor) else expressivity
        # Linear in the offset of the vertices, so that 0 and 1 give mean and sample exactly, and any factor between
        # keeps the sample's timing.
        return mean + share * (motion - mean)

    def _mean(self, conditions: Conditions, of_mean: NoiseSource, blend: Blend, wanted: slice) -> Tensor:
        """The mean of motion under the conditions, one for each clip."""
        # At the last step nothing of the motion is left in the noise, so the prediction that errs least is the mean of
        # all motions that the conditions allow. A network lets some of the noise through all the same, nearly linearly:
        # between noise and its negative that cancels (2 evaluations leave 1/20 of the variance of one). The noise is
        # the mean's own, so that a clip has one mean whatever the seed.
        denoiser = self.denoiser(conditions, blend)
        noise = denoiser.noise(of_mean(self._empty(denoiser, conditions)))
        ends = [
            self._motion(denoiser, denoiser.denoise(start, self.process.steps - 1), wanted) for start in (noise, -noise)
        ]
        return (ends[0] + ends[1]) / 2

    @property
    def folds(self) -> bool:
        """Whether the sampler runs on folded motion: not where it acts on vertices, or goes on after its last step.

        Nor where the network's output is preconditioned, which works on components, which are few already.
        """
        whole = self.sampler.linear and self.sampler.spread == 1
        return self.sampling_space == "folded" and whole and self.motion_space.preconditioning is None

    def denoiser(self, conditions: Conditions, blend: Blend) -> ConditionalDenoiser:
        """The network under some conditions, in the space in which the sampler runs."""
        preconditioning = self.motion_space.preconditioning
        return self.network.prepare_for_inference(
            conditions, self.process.steps, folded=self.folds, blend=blend, preconditioning=preconditioning
        )

    def _empty(self, denoiser: ConditionalDenoiser, conditions: Conditions) -> Tensor:
        """A state with no values yet."""
        rows, frames = conditions.mask.shape
        shape = (rows // len(denoiser.shares), frames, denoiser.width)
        return torch.empty(shape, device=self.device, dtype=next(self.parameters()).dtype)

    def _motion(
        self, denoiser: ConditionalDenoiser, sample: Tensor, wanted: slice
    ) -> Float[Tensor, "batch wanted points dims"]:
        """Offsets from the template in some frames."""
        return self.motion_space.decode(denoiser.motion(sample, wanted)) / self.scale


def mean_names(batch: Batch) -> list[str]:
    """Names of the noise from which clips' means are predicted: other noise than that of any sample."""
    return [f"{name}/mean" for name in batch.names]
