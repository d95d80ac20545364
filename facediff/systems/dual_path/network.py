"""The network of dual-path style diffusion: conditions once per clip, one denoising pass per step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from facediff.components.audio_encoder import AudioEncoder
from facediff.components.decoder import Decoder
from facediff.components.fusion import Fusion
from facediff.components.identity_encoder import IdentityEncoder
from facediff.components.layers import frame_mask
from facediff.components.mesh_encoder import MeshEncoder
from facediff.components.style_encoder import StyleEncoder
from facediff.systems.dual_path.step_embedding import StepEmbedding

TokenForm = Literal["levels", "single"]


@dataclass(frozen=True)
class Conditions:
    """What does not change over the denoising steps of a clip.

    Attributes:
        audio: speech features F_a.
        style: style tokens, the condition F_s.
        mask: True on valid frames.
    """

    audio: Float[Tensor, "batch frames dim"]
    style: Float[Tensor, "batch tokens dim"]
    mask: Bool[Tensor, "batch frames"]

    def frames(self, start: int, end: int) -> Conditions:
        """Those of some of the frames."""
        return Conditions(self.audio[:, start:end], self.style, self.mask[:, start:end])

    def repeated(self, times: int) -> Conditions:
        """One clip's conditions for several takes of it; nothing is copied."""
        if times == 1:
            return self
        audio, style = (value.expand(times, -1, -1) for value in (self.audio, self.style))
        return Conditions(audio, style, self.mask.expand(times, -1))


@dataclass(frozen=True)
class PreparedConditions(Conditions):
    """Conditions with everything else that does not change over the steps; whole, not to be sliced.

    It holds for the weights and the precision in which it was made.

    Attributes:
        fusion: what the fusion prepared.
        decoder: what the decoder prepared.
        steps: the embedding of each step; None if steps are embedded as they come.
    """

    fusion: object = None
    decoder: object = None
    steps: Float[Tensor, "steps dim"] | None = None


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
        if form == "single" and token_dims:
            token_dims = (sum(token_dims),)
        self.token_dims = token_dims
        self.projections = nn.ModuleList(nn.Linear(width, dim) for width in token_dims)
        self.null = None if token_dims else nn.Parameter(torch.zeros(1, 1, dim))

    def forward(self, style: Float[Tensor, "batch style_dim"]) -> Float[Tensor, "batch tokens dim"]:
        """Split F_s and project each part."""
        if self.null is not None:
            return self.null.expand(len(style), -1, -1)
        parts = torch.split(style, list(self.token_dims), dim=-1)
        return torch.stack([p(part) for p, part in zip(self.projections, parts, strict=True)], dim=1)


class DualPathNetwork(nn.Module):
    """Predicts clean motion from noisy motion under speech, identity and style.

    In the denoising loop vertices appear in linear maps only: ``embed`` (3V → C) and ``unembed`` (C → 3V). Outside it
    ``mesh_encoder`` stands in front of the style encoder (X = Linear(M_ref) in the paper).

    Args:
        n_vertices: vertices V of the topology.
        dim: channels C.
        audio_encoder: speech to F_a.
        identity_encoder: identity to F_id.
        mesh_encoder: reference motion to one feature per frame; None without a dynamic style.
        style_encoder: these features to F_dyn.
        fusion: F_a and F_m to F_am.
        decoder: F_fused and style tokens to F_dec.
        token_form: how F_s is presented to the decoder.
    """

    def __init__(
        self,
        *,
        n_vertices: int,
        dim: int,
        audio_encoder: AudioEncoder,
        identity_encoder: IdentityEncoder,
        mesh_encoder: MeshEncoder | None,
        style_encoder: StyleEncoder,
        fusion: Fusion,
        decoder: Decoder,
        token_form: TokenForm,
    ) -> None:
        super().__init__()
        self.coordinates = 3 * n_vertices
        self.audio_encoder = audio_encoder
        self.identity_encoder = identity_encoder
        self.style_encoder = style_encoder
        self.style_tokens = StyleTokens(identity_encoder.token_dims + style_encoder.token_dims, dim, token_form)
        self.embed = nn.Linear(3 * n_vertices, dim)
        self.mesh_encoder = mesh_encoder
        self.step_embedding = StepEmbedding(dim)
        self.fusion = fusion
        self.fused_norm = nn.LayerNorm(dim)
        self.decoder = decoder
        self.unembed = nn.Linear(dim, 3 * n_vertices)

    def conditions(
        self,
        audio: Float[Tensor, "batch samples"],
        audio_lengths: Int[Tensor, " batch"],
        frame_lengths: Int[Tensor, " batch"],
        identity: Int[Tensor, " batch"],
        dynamic_style: Float[Tensor, "batch dynamic_dim"],
        features: tuple[Float[Tensor, "batch steps channels"], Int[Tensor, " batch"]] | None = None,
    ) -> Conditions:
        """Everything that is computed once per clip.

        Args:
            audio: waveforms at 16 kHz.
            audio_lengths: valid samples.
            frame_lengths: motion frames wanted.
            identity: identity indices, −1 for unknown.
            dynamic_style: F_dyn, as :meth:`dynamic_style` gives it.
            features: cached result of the audio encoder's frozen part, and its lengths.
        """
        encoded = self.audio_encoder(audio, audio_lengths, frame_lengths, *(features or ()))
        style = torch.cat([self.identity_encoder(identity), dynamic_style], dim=-1)
        return Conditions(encoded, self.style_tokens(style), frame_mask(frame_lengths, encoded.shape[1]))

    def prepared(self, conditions: Conditions, steps: int | None = None) -> PreparedConditions:
        """What :meth:`core` would compute anew in each of many steps, computed once.

        To be called on conditions as they will be used, after any slicing, once a clip or window; :meth:`core` gives
        the same with the result as with the conditions themselves, up to rounding.

        Args:
            conditions: as :meth:`conditions` gives them, or parts of them.
            steps: the process's steps N, for a table of their embeddings; none is used if None.
        """
        audio, style, mask = conditions.audio, conditions.style, conditions.mask
        return PreparedConditions(
            audio,
            style,
            mask,
            fusion=self.fusion.prepare(audio, mask),
            decoder=self.decoder.prepare(style, mask),
            steps=None if steps is None else self.step_embedding.table(steps),
        )

    def dynamic_style(
        self, reference: Float[Tensor, "batch frames vertices 3"], mask: Bool[Tensor, "batch frames"]
    ) -> Float[Tensor, "batch dynamic_dim"]:
        """F_dyn of scaled reference motion; of width 0 without a dynamic style.

        Args:
            reference: scaled reference motion.
            mask: True on valid frames.
        """
        if self.mesh_encoder is None:
            return reference.new_zeros((len(reference), 0))
        return self.style_encoder(self.mesh_encoder(reference), mask)

    def forward(
        self,
        noisy: Float[Tensor, "batch frames coordinates"],
        step: Int[Tensor, " batch"],
        conditions: Conditions,
    ) -> Float[Tensor, "batch frames coordinates"]:
        """Predict the clean scaled motion M̂⁰ from Mⁿ."""
        return self.leave(self.core(self.embed(noisy), step, conditions))

    def leave(self, features: Float[Tensor, "batch frames dim"]) -> Float[Tensor, "batch frames coordinates"]:
        """F_dec to the clean scaled motion.

        In mixed precision this map stays in the weights' own type: differences over time of half-precision motion are
        noise.
        """
        with torch.autocast(features.device.type, enabled=False):
            return self.unembed(features.to(next(self.unembed.parameters()).dtype))

    def core(
        self, motion: Float[Tensor, "batch frames dim"], step: Int[Tensor, " batch"], conditions: Conditions
    ) -> Float[Tensor, "batch frames dim"]:
        """F_m to F_dec: everything between the two vertex-space maps.

        Args:
            motion: F_m.
            step: step numbers counted from 0.
            conditions: as they are, or :meth:`prepared`.
        """
        ready = conditions if isinstance(conditions, PreparedConditions) else PreparedConditions(**vars(conditions))
        # A component that prepares nothing need not know that others do.
        known = [() if part is None else (part,) for part in (ready.fusion, ready.decoder)]
        fused = self.fusion(ready.audio, motion, ready.mask, *known[0])
        embedded = self.step_embedding(step) if ready.steps is None else ready.steps[step]
        fused = self.fused_norm(fused + embedded[:, None])  # eq. 13
        return self.decoder(fused, ready.style, ready.mask, *known[1])
