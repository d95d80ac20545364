"""Fusions of speech with noisy motion: bidirectional cross-attention (dual-path paper, section 1.4) and a plain sum."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple, Protocol

from torch import Tensor, nn

from facediff.models.layers import Attention, FrameMask, Frames, Heads, Rotation, Share, Width, needed_mask
from facediff.registry import fusion


class Fusion(nn.Module, ABC):
    """Speech features F_a and embedded noisy motion F_m to one sequence F_am."""

    def prepare(self, audio: Frames, mask: FrameMask) -> object:
        """What stays the same over the denoising steps, computed once a clip; None if there is nothing.

        A fusion that overrides this takes the result as a fourth, optional argument of ``forward`` and gives the same
        with it as without, up to rounding. The arguments are those that ``forward`` will get.
        """
        return None

    @abstractmethod
    def forward(self, audio: Frames, motion: Frames, mask: FrameMask) -> Frames:
        """Fuse; frames where ``mask`` is False are padding and never influence the others."""


class FusionFactory(Protocol):
    """Makes a fusion once the model's width is known."""

    def __call__(self, *, dim: int) -> Fusion:
        """Make one for ``dim`` channels."""


class FusionConstants(NamedTuple):
    """Constants of a clip's fusion, computed once for all steps."""

    query: Tensor
    mask: Tensor | None
    rotation: Rotation | None


@fusion.register("cross_attention")
class BidirectionalCrossAttention(Fusion):
    """Speech attends to motion, then motion attends to the enriched speech; their sum is F_am (eq. 12).

    F'_a = F_a + Attn(query F_a, key/value F_m); F'_m = F_m + Attn(query F_m, key/value F'_a), with the inputs of
    each attention normalised (pre-norm form of figure 2). Both sequences share one time axis, so queries and keys
    carry rotary positions; without them the attention could not tell one frame's speech from another's.

    Args:
        num_heads: attention heads.
        rotary: rotary positions in both attentions.
        dropout: dropout on each attention's result.
    """

    def __init__(self, *, dim: Width, num_heads: Heads = 4, rotary: bool = True, dropout: Share = 0.1) -> None:
        super().__init__()
        self.audio_norm = nn.LayerNorm(dim)
        self.motion_norm = nn.LayerNorm(dim)
        # A norm of its own: F'_a is the sum of two sequences and larger than either of them.
        self.enriched_norm = nn.LayerNorm(dim)
        self.audio_from_motion = Attention(dim, dim, num_heads, rotary=rotary)
        self.motion_from_audio = Attention(dim, dim, num_heads, rotary=rotary)
        self.dropout = nn.Dropout(dropout)

    def forward(
        self, audio: Frames, motion: Frames, mask: FrameMask, prepared: FusionConstants | None = None
    ) -> Frames:
        """F_am = F'_a + F'_m."""
        # Training does not prepare, and keeps the mask: looking whether it is needed would wait for the device.
        query, needed, rotation = self._constants(audio, mask) if prepared is None else prepared
        # F'_a: each frame of speech looks for the motion that belongs to it.
        normed_motion = self.motion_norm(motion)
        of_motion = self.audio_from_motion.keys_values(normed_motion, rotation)
        audio = audio + self.dropout(self.audio_from_motion.attend(query, of_motion, needed))
        # F'_m: each frame of motion looks at the speech that knows of the motion by now.
        enriched = self.enriched_norm(audio)
        motion = motion + self.dropout(self.motion_from_audio(normed_motion, enriched, needed, rotation))
        return audio + motion

    def prepare(self, audio: Frames, mask: FrameMask) -> FusionConstants:
        """The speech's queries; keys and values depend on the noisy motion, and so does F'_a."""
        return self._constants(audio, needed_mask(mask))

    def _constants(self, audio: Tensor, mask: Tensor | None) -> FusionConstants:
        rotation = self.audio_from_motion.rotation(audio.shape[1])
        return FusionConstants(self.audio_from_motion.queries(self.audio_norm(audio), rotation), mask, rotation)


@fusion.register("add")
class AddFusion(Fusion):
    """Plain sum of speech and motion features (ablation of the cross-attention)."""

    def __init__(self, *, dim: Width) -> None:
        super().__init__()

    def forward(self, audio: Frames, motion: Frames, mask: FrameMask) -> Frames:
        """F_am = F_a + F_m."""
        return audio + motion
