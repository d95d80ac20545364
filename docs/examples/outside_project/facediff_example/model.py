"""An autoregressive Transformer over speech features with an identity table, after FaceFormer (Fan et al. 2022)."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from facediff.data import Batch
from facediff.models import AnimationModel
from facediff.models.audio_encoders import AudioEncoderFactory, MelEncoder
from facediff.models.inference import Progress


class AutoregressiveTransformer(AnimationModel):
    """Predicts each frame of motion from the frames before it, the speech and the identity.

    Args:
        dim: channels.
        audio_encoder: speech to one feature per frame.
        num_layers: layers of the Transformer decoder.
        num_heads: attention heads.
        options: those of every model, see :class:`facediff.models.AnimationModel`.
    """

    def __init__(
        self,
        *,
        dim: int = 64,
        audio_encoder: AudioEncoderFactory = MelEncoder,
        num_layers: int = 1,
        num_heads: int = 4,
        **options: Any,  # noqa: ANN401
    ) -> None:
        super().__init__(**options)
        self.audio_encoder = audio_encoder(dim=dim)
        self.identity_table = nn.Embedding(len(self.identities), dim)
        self.embed = nn.Linear(self.dims * self.n_vertices, dim)
        layer = nn.TransformerDecoderLayer(dim, num_heads, 2 * dim, dropout=0.0, batch_first=True)
        self.decoder = nn.TransformerDecoder(layer, num_layers)
        self.unembed = nn.Linear(dim, self.dims * self.n_vertices)
        nn.init.zeros_(self.unembed.weight)  # start from a still face
        nn.init.zeros_(self.unembed.bias)

    def forward(
        self, motion: Float[Tensor, "batch frames xyz"], speech: Float[Tensor, "batch frames dim"], identity: Tensor
    ) -> Float[Tensor, "batch frames xyz"]:
        """The motion of every frame, given that of the frame before it (zero before the first) and all earlier ones."""
        frames, dim = speech.shape[1:]
        # An unseen speaker (index −1) is the mean of the identities that the model was trained on.
        table = self.identity_table.weight
        person = torch.where(identity[:, None] < 0, table.mean(0), table[identity])
        # Positions repeat every second, as FaceFormer's do, so that long speech has no unseen ones.
        angle = torch.arange(frames, device=motion.device) % self.frame_rate * 2 * torch.pi / self.frame_rate
        waves = angle[:, None] * torch.arange(1, dim // 2 + 1, device=motion.device)
        x = self.embed(motion) + person[:, None] + torch.cat([waves.sin(), waves.cos()], 1)
        # A frame attends to no later frame of motion, and to the speech of its own time only.
        later = torch.ones(frames, frames, dtype=torch.bool, device=motion.device).triu(1)
        elsewhere = ~torch.eye(frames, dtype=torch.bool, device=motion.device)
        return self.unembed(self.decoder(x, speech, tgt_mask=later, memory_mask=elsewhere))

    def encode_speech(self, batch: Batch) -> Float[Tensor, "batch frames dim"]:
        """One feature per frame."""
        return self.audio_encoder(batch.audio, batch.audio_lengths, batch.frame_lengths, *(batch.cached_features or ()))

    def personal_modules(self) -> list[nn.Module]:
        """What `facediff adapt --train person` trains."""
        return [self.identity_table]

    def losses(self, batch: Batch, generator: torch.Generator | None = None) -> dict[str, Tensor]:
        """Mean squared error of the next frame, with the true frames before it."""
        truth = batch.motion.flatten(2) * self.scale
        before = nn.functional.pad(truth, (0, 0, 1, -1))
        error = self(before, self.encode_speech(batch), batch.identity) - truth
        loss = error[batch.mask].square().mean()
        return {"reconstruction": loss, "loss": loss}

    @torch.no_grad()
    def generate_clips(
        self, batch: Batch, *, seed: int = 0, progress: Progress | None = None
    ) -> Float[Tensor, "batch frames vertices 3"]:
        """One frame after the other; nothing is random, so the seed does not matter."""
        speech = self.encode_speech(batch)
        motion = speech.new_zeros(*speech.shape[:2], self.dims * self.n_vertices)
        for frame in (progress or iter)(range(speech.shape[1])):
            before = nn.functional.pad(motion[:, : frame + 1], (0, 0, 1, -1))
            motion[:, frame] = self(before, speech[:, : frame + 1], batch.identity)[:, -1]
        return (motion / self.scale).view(*speech.shape[:2], self.n_vertices, self.dims)
