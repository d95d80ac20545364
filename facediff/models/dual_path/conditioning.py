"""The conditions of a clip: speech features F_a and style tokens F_s (eq. 14), and which of them are hidden.

They are computed once for all denoising steps (algorithm 1, line 4; algorithm 2, line 2). Hiding conditions in training
is an addition to the paper.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from facediff.data import Batch
from facediff.errors import FaceDiffError
from facediff.models.audio_encoders import AudioEncoder
from facediff.models.base import AnimationModel
from facediff.models.dual_path.options import DualPathOptions, TokenForm
from facediff.models.dual_path.speech_style import SpeechStyle
from facediff.models.layers import exporting, frame_mask
from facediff.models.mesh_encoders import MeshEncoder
from facediff.models.speaker_encoders import IdentityEncoder, StyleEncoder


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
        dynamic: F_dyn of the clips, as it was encoded; None where conditions were changed.
    """

    audio: Float[Tensor, "batch frames dim"]
    style: Float[Tensor, "batch tokens dim"]
    mask: Bool[Tensor, "batch frames"]
    fusion: object = None
    decoder: object = None
    step_table: Float[Tensor, "steps dim"] | None = None
    dynamic: Float[Tensor, "batch dynamic_dim"] | None = None

    def frames(self, places: Int[Tensor, " animated"]) -> Conditions:
        """The conditions of some of the frames, with nothing prepared."""
        return Conditions(self.audio[:, places], self.style, self.mask[:, places])

    def for_draws(self, times: int) -> Conditions:
        """The conditions of several noisy versions of every clip, clip by clip."""
        return Conditions(*(value.repeat_interleave(times, 0) for value in (self.audio, self.style, self.mask)))

    def repeated(self, times: int) -> Conditions:
        """One clip's conditions for several samples of it, with nothing prepared; nothing is copied without need."""
        if times == 1:
            return self
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
        no_style: the learnt stand-in for a hidden dynamic style; None where it is never hidden.
        speech_style: style from speech; None where the model does not learn it.
        template_token: the neutral face as a further token; None if the network does not see it.
    """

    dim: int
    audio_encoder: AudioEncoder
    identity_encoder: IdentityEncoder
    mesh_encoder: MeshEncoder | None
    style_encoder: StyleEncoder
    style_tokens: StyleTokens
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


def check_shape(part: nn.Module, result: Tensor, *expected: int) -> None:
    """Name a component, perhaps a user's own, with a result of the wrong shape, before it fails elsewhere."""
    if not exporting() and result.shape != expected:
        raise FaceDiffError(f"{type(part).__name__}: gives the shape {tuple(result.shape)}; expected {expected}")


class ConditionedModel(AnimationModel):
    """A model with conditions that are sometimes hidden in training."""

    network: ConditionEncoding
    options: DualPathOptions

    def conditions(self, batch: Batch, animated: slice | Tensor = slice(None)) -> Conditions:
        """Everything that is computed once per clip; in training, identity and style are hidden now and then.

        Args:
            batch: the clips.
            animated: the frames that are animated, of speech that is encoded with more around them.
        """
        identity, style = self.hide(len(batch)) if self.training else (None, None)
        # Index −1 stands for an unseen speaker. Clips that are shown under it teach the model to take the person from
        # the style alone.
        identities = batch.identity if identity is None else batch.identity.masked_fill(identity, -1)
        return self.network.conditions(batch, identities, self.style_of(batch), style, animated)

    def hide(self, clips: int) -> list[Bool[Tensor, " batch"] | None]:
        """Which training clips have a hidden identity, and which a hidden style; None if no clip does."""
        shares = (self.options.identity_dropout, self.options.style_dropout)
        return [torch.rand(clips, device=self.device) < share if share else None for share in shares]
