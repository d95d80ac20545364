"""The conditions of a clip: speech features F_a and style tokens F_s (eq. 14), which of them are hidden, and guidance.

They are computed once for all denoising steps (algorithm 1, line 4; algorithm 2, line 2). Hiding conditions in training
and guiding by them in sampling are additions to the paper.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, Protocol

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from facediff.data import Batch
from facediff.errors import FaceDiffError, check_known
from facediff.models.audio_encoders import AudioEncoder
from facediff.models.base import AnimationModel
from facediff.models.dual_path.speech_style import SpeechStyle
from facediff.models.layers import exporting, frame_mask
from facediff.models.mesh_encoders import MeshEncoder
from facediff.models.speaker_encoders import IdentityEncoder, StyleEncoder
from facediff.utils import ranges
from facediff.utils.hints import check_number

TokenForm = Literal["levels", "single"]

CONDITIONS = ("speech", "identity", "style")
"""What motion is conditioned on, in the order in which guidance adds it."""


class Hidden(NamedTuple):
    """Which clips lack which condition, by True; None if no clip does."""

    speech: Bool[Tensor, " batch"] | None = None
    identity: Bool[Tensor, " batch"] | None = None
    style: Bool[Tensor, " batch"] | None = None


@dataclass(frozen=True)
class Conditions:
    """Everything that stays constant over the denoising steps of a clip.

    Attributes:
        audio: speech features F_a.
        style: style tokens, the condition F_s.
        mask: True on valid frames.
        fusion: prepared by the fusion for inference.
        decoder: prepared by the decoder for inference.
        step_table: the embedding of each step; None if steps are embedded as they come.
        shares: under guidance the rows are all clips, then all clips with some conditions hidden, and so on; this is
            the contribution of each part's prediction.
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

    def frames(self, places: Int[Tensor, " animated"]) -> Conditions:
        """The conditions of some of the frames, with nothing prepared."""
        return Conditions(self.audio[:, places], self.style, self.mask[:, places], shares=self.shares)

    def for_draws(self, times: int) -> Conditions:
        """The conditions of several noisy versions of every clip, clip by clip."""
        audio, style, mask = (value.repeat_interleave(times, 0) for value in (self.audio, self.style, self.mask))
        return Conditions(audio, style, mask, shares=self.shares)

    def repeated(self, times: int) -> Conditions:
        """One clip's conditions for several samples of it, with nothing prepared; nothing is copied without need."""
        if times == 1:
            return self
        if len(self.shares) > 1:
            return self.for_draws(times)
        audio, style = (value.expand(times, -1, -1) for value in (self.audio, self.style))
        return Conditions(audio, style, self.mask.expand(times, -1))


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
        # The paper's form, for comparison; its attention has nothing to choose between.
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
    """The neutral face f as a token beside the style tokens, since the way a face moves follows from its shape too.

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
        """Measure mean and size on the faces of the training; a single face counts as it is."""
        self.mean.copy_(templates.mean(0))
        deviation = (templates - self.mean).square().mean().sqrt()
        self.deviation.copy_(deviation if deviation > 0 else torch.ones(()))

    def forward(self, template: Float[Tensor, "batch points dims"]) -> Float[Tensor, "batch 1 dim"]:
        """What neutral faces have of their own."""
        return self.project(((template - self.mean) / self.deviation).flatten(1))[:, None]


class ConditionEncoding(nn.Module):
    """The half of a network that turns speech, identity and reference motion into conditions.

    Attributes:
        dim: channels C.
        audio_encoder: speech to F_a.
        identity_encoder: identity to F_id.
        mesh_encoder: reference motion to one feature per frame; None without a dynamic style.
        style_encoder: these features to F_dyn.
        style_tokens: F_id and F_dyn to the tokens F_s.
        no_speech: the learnt stand-in for hidden speech; None where speech is never hidden.
        no_style: the same for the dynamic style.
        speech_style: style from speech; None where the model does not learn it.
        template_token: the neutral face as a further token; None if the network does not see it.
    """

    dim: int
    audio_encoder: AudioEncoder
    identity_encoder: IdentityEncoder
    mesh_encoder: MeshEncoder | None
    style_encoder: StyleEncoder
    style_tokens: StyleTokens
    no_speech: nn.Parameter | None
    no_style: nn.Parameter | None
    speech_style: SpeechStyle | None
    template_token: TemplateToken | None

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
        hidden: Hidden = Hidden(),  # noqa: B008 - it cannot be changed
        animated: slice | Tensor = slice(None),
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
        check_shape(self.audio_encoder, audio, *batch.motion.shape[:2], self.dim)
        mask = frame_mask(batch.frame_lengths, audio.shape[1])
        encoded = dynamic_style = self.style_from_speech(style, audio[:, animated], mask[:, animated])
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


def check_shape(part: nn.Module, result: Tensor, *expected: int) -> None:
    """Name a component, perhaps a user's own, with a result of the wrong shape, before it fails elsewhere."""
    if not exporting() and result.shape != expected:
        raise FaceDiffError(f"{type(part).__name__}: gives the shape {tuple(result.shape)}; expected {expected}")


class HidingOptions(Protocol):
    """Options of :class:`~facediff.models.dual_path.model.DualPathOptions` that are read here."""

    identity_dropout: float
    style_dropout: float
    speech_dropout: float


class ConditionedModel(AnimationModel):
    """A model whose conditions are sometimes hidden in training, so that sampling can be guided by them."""

    network: ConditionEncoding
    options: HidingOptions
    guidance: dict[str, float]

    @property
    def guidable(self) -> list[str]:
        """The conditions that were hidden now and then in training, so that the model knows motion without them."""
        network = self.network
        shares = {
            "speech": self.options.speech_dropout,
            "identity": self.options.identity_dropout if network.identity_encoder.token_dims else 0.0,
            "style": self.options.style_dropout if network.style_encoder.token_dims else 0.0,
        }
        return [name for name in CONDITIONS if shares[name] > 0]

    def choose_guidance(self, scales: Mapping[str, float]) -> None:
        """Follow conditions more (above 1) or less from now on; checkpoints keep the original scales."""
        check_known("guidance", "condition", scales, CONDITIONS)
        for name, scale in scales.items():
            check_number("guidance", name, scale, ranges.GUIDANCE_SCALE.least, ranges.GUIDANCE_SCALE.most)
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
        and Salimans 2022). Predictions with a share of zero are not computed: with all scales 1 there is one.
        """
        names = self.guidable
        scales = [1.0, *(self.guidance[name] for name in names), 0.0]
        shares = {tuple(names[k:]): scales[k] - scales[k + 1] for k in range(len(names) + 1)}
        return {hidden: share for hidden, share in shares.items() if share}

    def conditions(self, batch: Batch, *, guided: bool = False, animated: slice | Tensor = slice(None)) -> Conditions:
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
        shares = {
            "identity": self.options.identity_dropout,
            "style": self.options.style_dropout,
            "speech": self.options.speech_dropout,
        }
        masks = {
            name: torch.rand(clips, device=self.device) < share if share else None for name, share in shares.items()
        }
        # Guidance starts from the motion without any of the conditions that can be hidden, which would hardly ever be
        # seen if each were drawn by itself.
        if (silent := masks["speech"]) is not None:
            masks = {name: None if mask is None else mask | silent for name, mask in masks.items()}
        return Hidden(**masks)

    def _in_views(self, name: str, views: Mapping[tuple[str, ...], float], clips: int) -> Tensor:
        return torch.tensor([name in hidden for hidden in views], device=self.device).repeat_interleave(clips)
