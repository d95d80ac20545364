"""The network of dual-path style diffusion: conditions, the denoising network and its own layers.

The components that are chosen by name have files of their own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from facediff.data import Batch
from facediff.errors import FaceDiffError
from facediff.models.audio_encoders import AudioEncoder
from facediff.models.decoders import Decoder
from facediff.models.folding import (
    Blend,
    ConditionalDenoiser,
    Fold,
    PreconditionedDenoiser,
    WeightCache,
    fold,
    unchanged,
)
from facediff.models.fusions import Fusion
from facediff.models.layers import exporting, frame_mask
from facediff.models.mesh_encoders import MeshEncoder
from facediff.models.motion_space import Preconditioning
from facediff.models.speaker_encoders import IdentityEncoder, StyleEncoder, mean_and_deviation

TokenForm = Literal["levels", "single"]

MEMORY = 0.999
"""Share of what is known that stays after a training step: the last 8 000 clips of steps of eight count."""
RIDGE = 0.03
"""Penalty of the map, as a share of the statistics' variance."""
USUAL = 3.0
"""Standard deviations up to which a statistic counts; rooms and voices that nobody trained with lie beyond."""
REACH = 2.0
"""Longest change of the style, in root mean squares of what the training speech asks for."""


class Hidden(NamedTuple):
    """Which clips lack which condition, by True; None if no clip does."""

    speech: Bool[Tensor, " batch"] | None = None
    identity: Bool[Tensor, " batch"] | None = None
    style: Bool[Tensor, " batch"] | None = None


@dataclass(frozen=True)
class Conditions:
    """What does not change over the denoising steps of a clip.

    Attributes:
        audio: speech features F_a.
        style: style tokens, the condition F_s.
        mask: True on valid frames.
        fusion: what the fusion prepared for inference.
        decoder: what the decoder prepared for inference.
        step_table: the embedding of each step; None if steps are embedded as they come.
        shares: under guidance the rows are all clips, then all clips with some conditions hidden, and so on; this is
            what the prediction of each of these parts contributes.
        dynamic: F_dyn of the clips, as it was encoded; None where conditions were changed.
    """

    audio: Float[Tensor, "batch frames dim"]
    style: Float[Tensor, "batch tokens dim"]
    mask: Bool[Tensor, "batch frames"]
    fusion: object = None
    decoder: object = None
    step_table: Float[Tensor, "steps dim"] | None = None
    shares: tuple[float, ...] = (1.0,)
    dynamic: Float[Tensor, "batch dynamic_dim"] | None = None

    def frames(self, start: int, end: int) -> Conditions:
        """The conditions of some of the frames, with nothing prepared."""
        return Conditions(self.audio[:, start:end], self.style, self.mask[:, start:end], shares=self.shares)

    def drawn(self, times: int) -> Conditions:
        """The conditions of several noisy versions of every clip, those of a clip one after the other."""
        audio, style, mask = (value.repeat_interleave(times, 0) for value in (self.audio, self.style, self.mask))
        return Conditions(audio, style, mask, shares=self.shares)

    def repeated(self, times: int) -> Conditions:
        """One clip's conditions for several samples of it, with nothing prepared; nothing is copied without need."""
        if times == 1:
            return self
        if len(self.shares) > 1:
            return self.drawn(times)
        audio, style = (value.expand(times, -1, -1) for value in (self.audio, self.style))
        return Conditions(audio, style, self.mask.expand(times, -1))


TRUNK = (
    *("audio_encoder", "style_encoder", "style_tokens", "step_embedding", "fusion", "fused_norm", "decoder"),
    *("no_speech", "no_style"),
)
"""Parts of a network that depend neither on the face nor on its speakers."""


class DualPathNetwork(nn.Module):
    """Predicts clean motion from noisy motion under speech, identity and style.

    In the denoising loop motion appears in linear maps only: ``embed`` (3V → C) and ``unembed`` (C → 3V), or fewer
    coordinates than 3V in another motion space. Outside it
    ``mesh_encoder`` stands in front of the style encoder (X = Linear(M_ref) in the paper).

    Args:
        coordinates: numbers in a frame of motion.
        inputs: numbers in a frame that the network sees; as many if None.
        dim: channels C.
        audio_encoder: speech to F_a.
        identity_encoder: identity to F_id.
        mesh_encoder: reference motion to one feature per frame; None without a dynamic style.
        style_encoder: these features to F_dyn.
        fusion: F_a and F_m to F_am.
        decoder: F_fused and style tokens to F_dec.
        token_form: how F_s is presented to the decoder.
        speech_may_hide: learn what stands for speech that is not given.
        style_may_hide: the same for the dynamic style.
        speech_style: what speech says of the style; None if that is not asked.
        template_token: the neutral face to a further token; None if the network does not see it.
        starts_at_zero: let training start from the posterior mean without speech, and not from random motion added to
            it.
    """

    def __init__(
        self,
        *,
        coordinates: int,
        inputs: int | None = None,
        dim: int,
        audio_encoder: AudioEncoder,
        identity_encoder: IdentityEncoder,
        mesh_encoder: MeshEncoder | None,
        style_encoder: StyleEncoder,
        fusion: Fusion,
        decoder: Decoder,
        token_form: TokenForm,
        speech_may_hide: bool = False,
        style_may_hide: bool = False,
        speech_style: SpeechStyle | None = None,
        template_token: TemplateToken | None = None,
        starts_at_zero: bool = False,
    ) -> None:
        super().__init__()
        self.coordinates = coordinates
        self.audio_encoder = audio_encoder
        self.identity_encoder = identity_encoder
        self.style_encoder = style_encoder
        self.style_tokens = StyleTokens(identity_encoder.token_dims + style_encoder.token_dims, dim, token_form)
        self.embed = nn.Linear(coordinates if inputs is None else inputs, dim)
        self.mesh_encoder = mesh_encoder
        self.step_embedding = StepEmbedding(dim)
        self.fusion = fusion
        # Eq. 13's norm. It takes the size of each frame's features away, which is one reason why the network cannot
        # copy its input and a skip around it helps (Preconditioning).
        self.fused_norm = nn.LayerNorm(dim)
        self.decoder = decoder
        self.unembed = nn.Linear(dim, coordinates)
        if starts_at_zero:
            nn.init.zeros_(self.unembed.weight)
            nn.init.zeros_(self.unembed.bias)
        # Only where they are trained, so that other checkpoints have no weights for them.
        self.no_speech = nn.Parameter(torch.zeros(dim)) if speech_may_hide else None
        self.no_style = nn.Parameter(torch.zeros(sum(style_encoder.token_dims))) if style_may_hide else None
        self.speech_style = speech_style
        self.template_token = template_token
        self._of_weights: WeightCache[tuple[Tensor, Fold | None]] = WeightCache()

    def share_trunk(self, other: DualPathNetwork) -> None:
        """Replace the parts whose sizes no corpus decides by those of another network, which then learn from both."""
        for name in TRUNK:
            setattr(self, name, getattr(other, name))

    def trunk(self) -> list[nn.Parameter]:
        """The weights of :data:`TRUNK`."""
        parts = [getattr(self, name) for name in TRUNK]
        own = [part for part in parts if isinstance(part, nn.Parameter)]
        return own + [weight for part in parts if isinstance(part, nn.Module) for weight in part.parameters()]

    @property
    def style_dim(self) -> int:
        """Numbers of a style vector: F_dyn, and with :class:`SpeechStyle` how much of what the speech asks is added."""
        return sum(self.style_encoder.token_dims) + (self.speech_style is not None)

    def heard_style(
        self,
        style: Float[Tensor, "batch style_dim"],
        audio: Float[Tensor, "batch frames dim"],
        mask: Bool[Tensor, "batch frames"],
    ) -> Float[Tensor, "batch dynamic_dim"]:
        """F_dyn of style vectors, changed as the speech asks where they say so.

        Args:
            style: style vectors.
            audio: features of the speech that is animated.
            mask: True on valid frames.
        """
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
        hidden: Hidden = Hidden(),  # noqa: B008 - it cannot be changed
        animated: slice = slice(None),
    ) -> Conditions:
        """Everything that is computed once per clip.

        Args:
            batch: its speech, or cached features of it, and its lengths.
            identity: identity indices, −1 for unknown.
            style: style vectors, of :attr:`style_dim` numbers.
            hidden: conditions that are not given; for a multiple of the clips, which are then repeated as a whole.
            animated: the frames that are animated, of speech that is encoded with more around them.
        """
        cached = batch.cached_features or ()
        audio = self.audio_encoder(batch.audio, batch.audio_lengths, batch.frame_lengths, *cached)
        check_shape(self.audio_encoder, audio, *batch.motion.shape[:2], *self.fused_norm.normalized_shape)
        mask = frame_mask(batch.frame_lengths, audio.shape[1])
        encoded = dynamic_style = self.heard_style(style, audio[:, animated], mask[:, animated])
        if self.training and self.speech_style is not None:
            self.speech_style.update(audio.detach(), mask, encoded.detach(), identity)
        # Guidance asks for several views of every clip. The speech is encoded once and then repeated, since the audio
        # encoder is the dearest part of the conditions.
        times = max((len(mask) for mask in hidden if mask is not None), default=len(batch)) // len(batch)
        if times > 1:
            audio, mask = audio.repeat(times, 1, 1), mask.repeat(times, 1)
            identity, dynamic_style = identity.repeat(times), dynamic_style.repeat(times, 1)
        if hidden.identity is not None:
            identity = identity.masked_fill(hidden.identity, -1)  # an unseen speaker
        # Chosen among given and learnt features, and not only where one is hidden: under several processes every weight
        # needs a gradient in every step.
        if hidden.speech is not None and self.no_speech is not None:
            audio = torch.where(hidden.speech[:, None, None], self.no_speech.to(audio), audio)
        if hidden.style is not None and self.no_style is not None:
            dynamic_style = torch.where(hidden.style[:, None], self.no_style.to(dynamic_style), dynamic_style)
        tokens = self.style_tokens(torch.cat([self.identity_encoder(identity), dynamic_style], dim=-1))  # eq. 14
        if self.template_token is not None:
            tokens = torch.cat([tokens, self.template_token(batch.template).repeat(times, 1, 1)], dim=1)
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
        """Everything that is constant over the denoising steps of a clip or window, as what a sampler calls.

        It holds for the weights and the precision in which it was made, so it is made again for every run; what follows
        from the weights alone is kept until they change.

        Args:
            conditions: as :meth:`conditions` gives them, or those of some frames.
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
        ready = replace(conditions, fusion=fusion, decoder=decoder, step_table=table)
        if preconditioning is not None:
            own = mask if len(ready.shares) == 1 else mask.chunk(len(ready.shares))[0]  # guided views repeat the rows
            return PreconditionedDenoiser(self, ready, preconditioning, own, blend, ready.shares)
        return ConditionalDenoiser(self, ready, product, blend, ready.shares)


def check_shape(part: nn.Module, result: Tensor, *expected: int) -> None:
    """Name a component, perhaps of a user's own, whose result would end in an error elsewhere."""
    if not exporting() and result.shape != expected:
        raise FaceDiffError(f"{type(part).__name__}: gives the shape {tuple(result.shape)}; expected {expected}")


class StyleTokens(nn.Module):
    """F_s = Concat(F_id, F_dyn) (eq. 14), presented to the decoder as tokens.

    Attention over a single key is constant, so by default each part of F_s (coarse, mid, fine, dynamic) becomes a
    token with a projection of its own.

    Args:
        token_dims: widths of the parts; may be empty, then one learnt token stands for "no condition".
        dim: channels of a token.
        form: a token per part (``levels``) or one token for all (``single``).
    """

    def __init__(self, token_dims: tuple[int, ...], dim: int, form: TokenForm) -> None:
        super().__init__()
        # The paper's form, whose attention has nothing to choose between; kept for comparison.
        if form == "single" and token_dims:
            token_dims = (sum(token_dims),)
        self.token_dims = token_dims
        # A projection of their own puts parts of different widths into one space, and tells the decoder which level a
        # token is: tokens carry no positions.
        self.projections = nn.ModuleList(nn.Linear(width, dim) for width in token_dims)
        self.null = None if token_dims else nn.Parameter(torch.zeros(1, 1, dim))

    def forward(self, style: Float[Tensor, "batch style_dim"]) -> Float[Tensor, "batch tokens dim"]:
        """Split F_s and project each part."""
        if self.null is not None:
            return self.null.expand(len(style), -1, -1)
        parts = torch.split(style, list(self.token_dims), dim=-1)
        return torch.stack([p(part) for p, part in zip(self.projections, parts, strict=True)], dim=1)


class TemplateToken(nn.Module):
    """The neutral face f as a token beside those of the style, for how a face moves follows from its shape too.

    Args:
        points: vertices.
        dims: numbers of a vertex.
        dim: channels of the token.
    """

    mean: Tensor
    deviation: Tensor

    def __init__(self, points: int, dims: int, dim: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(points, dims))
        self.register_buffer("deviation", torch.ones(()))
        self.project = nn.Linear(points * dims, dim)

    def measure(self, templates: Float[Tensor, "identities points dims"]) -> None:
        """Take the mean and the size of faces from those of the training; a single face counts as it is."""
        self.mean.copy_(templates.mean(0))
        deviation = (templates - self.mean).square().mean().sqrt()
        self.deviation.copy_(deviation if deviation > 0 else torch.ones(()))

    def forward(self, template: Float[Tensor, "batch points dims"]) -> Float[Tensor, "batch 1 dim"]:
        """What neutral faces have of their own."""
        return self.project(((template - self.mean) / self.deviation).flatten(1))[:, None]


class StepEmbedding(nn.Module):
    """t_emb: sinusoids of the diffusion step, then an MLP.

    Args:
        dim: channels C.
    """

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


class SpeechStyle(nn.Module):
    """The change of an identity's usual style that its speech asks for: a linear map, fitted beside the training.

    Where nobody names a style, a model has the identity and the speech alone. Its learnt stand-in for a hidden style
    leaves the mood to the denoising network, which hardly takes it up in a short training; a regression on the style
    vectors themselves does (docs/generation.md has the figures).

    With the statistics x of a clip's speech features (mean and deviation of each channel) and the clip's style vector
    s, W minimises E‖s − s̄ − W x̂‖² + λ‖W‖², where s̄ is the mean style of the clip's identity and x̂ is x, standardised
    over all speakers: a voice that was never heard has no mean of its own. The sums that this needs are updated in
    every training step, at no further pass of an encoder, and older steps fade from them as the encoders change. Where
    several processes train, the first one's clips count, which are drawn from all in every epoch.

    Speech is heard as it is animated: in a stream, each window asks by its own speech, and of windows of a second the
    answers vary by half as much as those of different clips.

    Args:
        dim: channels of the speech features.
        style_dim: numbers of a style vector.
        identities: training identities.
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
        """Take in the clips of a training step; those of hidden identities are left out.

        Args:
            features: of their speech.
            mask: True on valid frames.
            style: their style vectors.
            identity: indices, −1 for hidden.
            memory: share of what is known that stays.
        """
        known = identity >= 0
        style, identity = style.to(self.styles.dtype)[known], identity[known]
        with torch.autocast(features.device.type, enabled=False):
            numbers = self._numbers(features[known], mask[known]).to(style.dtype)
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
        """The change of the style that speech asks for, at most :data:`REACH` times a usual one.

        Args:
            features: of the speech.
            mask: True on valid frames.
        """
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
