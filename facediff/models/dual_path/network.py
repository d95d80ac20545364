"""The conditions of a clip (eq. 14) and the denoising network (figure 3, eq. 12 and 13).

The components that are chosen by name (encoders, fusion, decoder) have files of their own.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from facediff.data import Batch
from facediff.errors import FaceDiffError
from facediff.models.dual_path.conditioning import (
    Conditions,
    StyleTokens,
    TemplateToken,
    check_shape,
)
from facediff.models.dual_path.options import DualPathOptions
from facediff.models.dual_path.speech_style import SpeechStyle
from facediff.models.folding import (
    Blend,
    Fold,
    FoldedSpace,
    State,
    Step,
    VertexSpace,
    WantedMotion,
    WeightCache,
    fold,
    step_of_rows,
    unchanged,
)
from facediff.models.layers import Frames, exporting, frame_mask
from facediff.models.motion_space import MotionSpace, Preconditioning

TRUNK = (
    *("audio_encoder", "style_encoder", "style_tokens", "step_embedding", "fusion", "fused_norm", "decoder"),
    "no_style",
)
"""Parts of a network that depend neither on the face nor on its speakers."""


class DualPathNetwork(nn.Module):
    """Predicts clean motion from noisy motion under speech, identity and style.

    In the denoising loop motion appears in linear maps only: ``embed`` (3V → C) and ``unembed`` (C → 3V), or fewer
    coordinates than 3V in another motion space. Outside it
    ``mesh_encoder`` stands in front of the style encoder (X = Linear(M_ref) in the paper).
    """

    def __init__(
        self, options: DualPathOptions, space: MotionSpace, *, n_vertices: int, dims: int, identities: int
    ) -> None:
        super().__init__()
        self.dim, self.coordinates = dim, coordinates = options.dim, space.coordinates
        # The order in which parts draw their first weights, and below the order in which optimisers have them.
        style = options.style_encoder(dim=dim)
        style_dim = sum(style.token_dims)
        self.audio_encoder = options.audio_encoder(dim=dim)
        self.identity_encoder = identity = options.identity_encoder(dim=dim, n_identities=identities)
        # Without a dynamic style there is nothing to embed, and no idle weights.
        mesh = options.mesh_encoder(dim=dim, n_vertices=n_vertices, dims=dims) if style_dim else None
        fusion, decoder = options.fusion(dim=dim), options.decoder(dim=dim, style_dim=dim)
        template_token = TemplateToken(n_vertices, dims, dim) if options.template_token else None
        speech_style = SpeechStyle(dim, style_dim, identities) if options.style_from_speech else None
        self.style_encoder = style
        self.style_tokens = StyleTokens(identity.token_dims + style.token_dims, dim, options.style_tokens)
        self.embed = nn.Linear(space.inputs, dim)
        self.mesh_encoder = mesh
        self.step_embedding = StepEmbedding(dim)
        self.fusion = fusion
        # Eq. 13's norm. It takes the size of each frame's features away, which is one reason why the network cannot
        # copy its input and a skip around it helps (Preconditioning).
        self.fused_norm = nn.LayerNorm(dim)
        self.decoder = decoder
        self.unembed = nn.Linear(dim, coordinates)
        if space.preconditioning is not None:
            # Training starts from the posterior mean without speech, and not from random motion added to it.
            nn.init.zeros_(self.unembed.weight)
            nn.init.zeros_(self.unembed.bias)
        # Only where it is trained, so that other checkpoints have no weights for it.
        self.no_style = nn.Parameter(torch.zeros(style_dim)) if options.style_dropout else None
        self.speech_style = speech_style
        self.template_token = template_token
        self._of_weights: WeightCache[tuple[Tensor, Fold | None]] = WeightCache()

    def share_trunk(self, source: DualPathNetwork) -> None:
        """Take the parts of :data:`TRUNK` from another network; they then learn from both corpora."""
        for name in TRUNK:
            setattr(self, name, getattr(source, name))

    @property
    def style_dim(self) -> int:
        """Numbers of a style vector: F_dyn, and with :class:`SpeechStyle` the share of its change."""
        return sum(self.style_encoder.token_dims) + (self.speech_style is not None)

    def style_from_speech(
        self,
        style: Float[Tensor, "batch style_dim"],
        audio: Float[Tensor, "batch frames dim"],
        mask: Bool[Tensor, "batch frames"],
    ) -> Float[Tensor, "batch dynamic_dim"]:
        """F_dyn of style vectors, with the change that the speech asks for where they want it."""
        if self.speech_style is None:
            return style
        dynamic, share = style[:, :-1], style[:, -1:]
        # Not asked where nothing is to be added: the map is unknown until training has begun. A graph cannot choose.
        if not exporting() and not bool(share.any()):
            return dynamic
        return dynamic + share * self.speech_style(audio, mask).to(dynamic)

    def conditions(
        self,
        batch: Batch,
        identity: Int[Tensor, " batch"],
        style: Float[Tensor, "batch style_dim"],
        hidden: Bool[Tensor, " batch"] | None = None,
        animated: slice | Tensor = slice(None),
    ) -> Conditions:
        """Everything that is computed once per clip.

        Args:
            batch: its speech, or cached features of it, and its lengths.
            identity: identity indices, −1 for unknown.
            style: style vectors, of :attr:`style_dim` numbers.
            hidden: clips with a hidden dynamic style; None if no clip has.
            animated: the frames that are animated, of speech that is encoded with more around them.
        """
        cached = batch.cached_features or ()
        audio = self.audio_encoder(batch.audio, batch.audio_lengths, batch.frame_lengths, *cached)
        check_shape(self.audio_encoder, audio, *batch.motion.shape[:2], self.dim)
        mask = frame_mask(batch.frame_lengths, audio.shape[1])
        encoded = dynamic_style = self.style_from_speech(style, audio[:, animated], mask[:, animated])
        if self.training and self.speech_style is not None:
            self.speech_style.update(audio.detach(), mask, encoded.detach(), identity)
        # Chosen among given and learnt features, and not only where one is hidden: under several processes every weight
        # needs a gradient in every step.
        if hidden is not None and self.no_style is not None:
            dynamic_style = torch.where(hidden[:, None], self.no_style.to(dynamic_style), dynamic_style)
        tokens = self.style_tokens(torch.cat([self.identity_encoder(identity), dynamic_style], dim=-1))  # eq. 14
        if self.template_token is not None:
            tokens = torch.cat([tokens, self.template_token(batch.template)], dim=1)
        return Conditions(audio, tokens, mask, dynamic=encoded)

    def dynamic_style(
        self, reference: Float[Tensor, "batch frames *numbers"], mask: Bool[Tensor, "batch frames"]
    ) -> Float[Tensor, "batch dynamic_dim"]:
        """F_dyn of scaled reference motion, or of its components (eq. 2 to 9); of width 0 without a dynamic style."""
        if self.mesh_encoder is None:
            return reference.new_zeros((len(reference), 0))
        style = self.style_encoder(self.mesh_encoder(reference), mask)
        check_shape(self.style_encoder, style, reference.shape[0], sum(self.style_encoder.token_dims))
        return style

    def forward(
        self,
        noisy: Float[Tensor, "batch frames coordinates"],
        step: Int[Tensor, " batch"],
        conditions: Conditions,
    ) -> Float[Tensor, "batch frames coordinates"]:
        """Predict the clean scaled motion M̂⁰ from Mⁿ."""
        return self.clean_motion(self.core(self.embed(noisy), step, conditions))

    def core(
        self, motion: Float[Tensor, "batch frames dim"], step: Int[Tensor, " batch"], conditions: Conditions
    ) -> Float[Tensor, "batch frames dim"]:
        """F_m to F_dec: everything between the two vertex-space maps.

        Args:
            motion: F_m.
            step: step numbers counted from 0.
            conditions: as they are, or prepared for inference.
        """
        # A component that prepares nothing need not know that others do.
        fusion, decoder = (
            [] if prepared is None else [prepared] for prepared in (conditions.fusion, conditions.decoder)
        )
        fused = self.fusion(conditions.audio, motion, conditions.mask, *fusion)  # eq. 12
        check_shape(self.fusion, fused, *motion.shape)
        table = conditions.step_table
        embedded = self.step_embedding(step) if table is None else table[step]
        fused = self.fused_norm(fused + embedded[:, None])  # eq. 13
        # The step enters next to the speech and the noisy motion and not through the style tokens: those stay constant
        # over the steps, so that their keys and values are computed once.
        decoded = self.decoder(fused, conditions.style, conditions.mask, *decoder)
        check_shape(self.decoder, decoded, *motion.shape)
        return decoded

    def clean_motion(self, features: Float[Tensor, "batch frames dim"]) -> Float[Tensor, "batch frames coordinates"]:
        """The last map, from F_dec to clean scaled motion."""
        # In mixed precision this map stays in the weights' own type: differences over time of half-precision motion
        # are noise.
        with torch.autocast(features.device.type, enabled=False):
            return self.unembed(features.to(next(self.unembed.parameters()).dtype))

    def prepare_for_inference(
        self,
        conditions: Conditions,
        steps: int,
        *,
        folded: bool,
        blend: Blend = unchanged,
        preconditioning: Preconditioning | None = None,
    ) -> ConditionalDenoiser:
        """The denoiser that a sampler calls, with everything constant over the denoising steps of a clip or window.

        Valid for the current weights and precision only, so it is made again for every run; what follows from the
        weights alone is cached until they change.

        Args:
            conditions: as :meth:`conditions` gives them, or of some frames.
            steps: the process's steps N.
            folded: run in the width of the model where both ends are linear, else on the vertices.
            blend: changes the features that the network gives in every step.
            preconditioning: the scales around the network in a space of its own; None on vertices.
        """
        first, last = self.embed, self.unembed
        # Folding needs both ends linear in the motion. Preconditioning scales the motion differently in every step, and
        # a space of components is narrow already.
        folded = folded and preconditioning is None and isinstance(first, nn.Linear) and isinstance(last, nn.Linear)
        ends = [weight for weight in (first.weight, last.weight, last.bias) if weight is not None] if folded else []

        def of_weights() -> tuple[Tensor, Fold | None]:
            table = self.step_embedding(torch.arange(steps, device=conditions.audio.device))
            return table, fold(first.weight, last.weight, last.bias) if folded else None

        # The table and the fold depend on weights only. They are kept between runs, and made again as soon as any of
        # these weights has changed, as it has after training or moving to another device.
        weights = [self.step_embedding.frequencies, *self.step_embedding.parameters(), *ends]
        table, product = self._of_weights.get(weights, (steps, folded), of_weights)
        audio, style, mask = conditions.audio, conditions.style, conditions.mask
        # For a window of long speech these are made from its own frames, since positions count from the window's start.
        fusion, decoder = self.fusion.prepare(audio, mask), self.decoder.prepare(style, mask)
        prepared = replace(conditions, fusion=fusion, decoder=decoder, step_table=table)
        if preconditioning is not None:
            return PreconditionedDenoiser(self, prepared, preconditioning, mask, blend)
        return ConditionalDenoiser(self, prepared, product, blend)


class StepEmbedding(nn.Module):
    """t_emb: sinusoids of the diffusion step, then an MLP."""

    frequencies: Tensor

    def __init__(self, dim: int) -> None:
        super().__init__()
        half = dim // 2
        frequencies = torch.exp(-math.log(10_000.0) * torch.arange(half) / half)
        self.register_buffer("frequencies", frequencies, persistent=False)
        self.mlp = nn.Sequential(nn.Linear(2 * half, dim), nn.SiLU(), nn.Linear(dim, dim))

    def forward(self, step: Int[Tensor, " batch"]) -> Float[Tensor, "batch dim"]:
        """Embed step numbers counted from 0."""
        # Wavelengths from 2π to 2π · 10 000 steps, so that near and far steps differ in some channel.
        angle = step[:, None].float() * self.frequencies
        return self.mlp(torch.cat([angle.sin(), angle.cos()], dim=-1))


# The network as a sampler sees it.


class ConditionalDenoiser:
    """A network under conditions, in a space in which a sampler runs without knowing which; made for one run.

    Args:
        network: predicts clean motion.
        conditions: its conditions, with everything else that is constant over the denoising steps.
        fold: the products of the network's ends, to run in their width; None to run on the vertices.
        blend: changes the features that the network gives in every step.
    """

    def __init__(
        self,
        network: DualPathNetwork,
        conditions: Conditions,
        fold: Fold | None = None,
        blend: Blend = unchanged,
    ) -> None:
        self.network = network
        self.conditions = conditions
        self.space: VertexSpace | FoldedSpace
        if fold is None:
            self.space = VertexSpace(network.embed, network.clean_motion, network.coordinates)
        else:
            self.space = FoldedSpace(network.embed, fold)
        self.width = self.space.width
        self.blend = blend
        self._last: tuple[Tensor, Tensor] | None = None  # features and prediction of the latest step, if folded

    def features(self, embedded: Frames, step: Step) -> Frames:
        """The network's last features of embedded noisy motion, at a step counted from 0."""
        return self.network.core(embedded, step_of_rows(step, embedded), self.conditions)

    def noise(self, unit: State) -> State:
        """From independent unit Gaussian noise to the image of unit Gaussian noise on vertices."""
        return self.space.noise(unit)

    def denoise(self, state: State, step: Step) -> State:
        """The image of the predicted clean motion M̂⁰."""
        features = self.blend(self.features(self.space.embed(state), step))
        prediction = self.space.clean(features)
        if isinstance(self.space, FoldedSpace):
            self._last = features, prediction
        return prediction

    def motion(self, sample: State, frames: slice = slice(None)) -> WantedMotion:  # noqa: B008
        """Scaled motion of the sampler's result in some frames; where folded, the only map to the vertices."""
        if not isinstance(self.space, FoldedSpace):
            return sample[:, frames]
        # y alone does not say where the vertices are. But the last step of a linear sampler returns the last prediction
        # E M̂⁰, and M̂⁰ = U h + b of the features h that the network gave for it, which were kept.
        if self._last is None or not torch.allclose(sample, self._last[1], rtol=1e-3, atol=1e-4, equal_nan=True):
            raise FaceDiffError(
                "sampler: it is declared linear, but its last step does not return the last prediction; "
                "choose --model.sampling_space=vertices"
            )
        return self.network.clean_motion(self._last[0][:, frames])


class PreconditionedDenoiser(ConditionalDenoiser):
    """Coordinates of motion with known variances; the network predicts the part that the noisy motion leaves open."""

    def __init__(
        self,
        network: DualPathNetwork,
        conditions: Conditions,
        preconditioning: Preconditioning,
        mask: Bool[Tensor, "batch frames"],
        blend: Blend = unchanged,
    ) -> None:
        super().__init__(network, conditions, None, blend)
        self.preconditioning = preconditioning
        self.mask = mask

    def denoise(self, state: State, step: Step) -> State:
        """M̂⁰."""
        scales, steps = self.preconditioning, step_of_rows(step, state)
        # The state stays as it is and only the network's input is scaled: samplers know nothing of preconditioning.
        mean = scales.posterior_mean(state, steps, self.mask)
        features = self.features(self.network.embed(scales.inputs(state, mean, steps, self.mask)), step)
        # The prediction is blended, not the features: the noisy motion is a part of it.
        return self.blend(scales.clean(mean, self.network.clean_motion(features), steps, self.mask))
