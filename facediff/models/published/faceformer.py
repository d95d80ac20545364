"""FaceFormer (Fan, Lin, Saito, Wang, Komura: "FaceFormer: Speech-Driven 3D Facial Animation with Transformers", 2022).

An autoregressive Transformer decoder over wav2vec 2.0; the network is that of ``autoregressive.py`` with one column of
a table for each speaker. docs/methods/faceformer.md says what of the published code is an option here.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from facediff import registry
from facediff.data import Batch
from facediff.models.audio_encoders import AudioEncoderFactory
from facediff.models.inference import BatchMotion, Progress
from facediff.models.published.autoregressive import (
    AutoregressiveModel,
    AutoregressiveNetwork,
    decoder_sizes,
    read_period,
)
from facediff.models.published.base import SpeakerTable, masked_mean
from facediff.models.published.importing import Found, Recogniser, Request, Weights, recogniser
from facediff.models.speech_networks import Wav2Vec2Encoder


@registry.model.register("FaceFormer")
class FaceFormer(AutoregressiveModel):
    """FaceFormer: an autoregressive Transformer with periodic positions and biased attention.

    Args:
        teacher_forcing: train on the true motion of the frame before, in one pass, and not on the generated one; the
            published training generates.
        options: those of the other methods with this decoder, see :class:`AutoregressiveModel`, and of every model.
    """

    # wav2vec 2.0 base as transformers had it in 2021; all but the convolutions is trained, with masks and layer drop.
    published_encoder: ClassVar[AudioEncoderFactory] = partial(
        Wav2Vec2Encoder,
        source="facebook/wav2vec2-base-960h",
        spec_augment=True,
        layer_drop=0.1,
        epsilon=1e-5,
        edges=False,
    )

    def __init__(self, *, teacher_forcing: bool = False, **options: Any) -> None:  # noqa: ANN401
        super().__init__(**options)
        self.teacher_forcing = teacher_forcing
        self.network = AutoregressiveNetwork(
            audio_width=self.audio_width,
            n_vertices=self.n_vertices,
            style=SpeakerTable(len(self.identities), self.dim),
            decoder=self.decoder_options,
        )

    def personal_modules(self) -> list[nn.Module]:
        """The table of speakers."""
        return [self.network.style]

    def conditions(
        self, batch: Batch, frames: Int[Tensor, " batch"]
    ) -> tuple[Float[Tensor, "batch dim"], Float[Tensor, "batch steps dim"]]:
        """The speaker's style and the speech of so many frames."""
        memory = self.network.audio_map(self.hear(batch, frames))
        return self.network.style(self.identity_weights(batch)), memory

    def losses(self, batch: Batch, generator: torch.Generator | None = None) -> dict[str, Tensor]:
        """The mean squared error of all coordinates."""
        frames = self.trained_frames(batch)
        self.check_length(frames, batch.names[0])
        style, memory = self.conditions(batch, frames)
        truth = (batch.motion * self.scale).flatten(2)[:, : int(frames.max())]
        if self.teacher_forcing:
            made = self.network.teacher_forced(style, memory, truth)
        else:
            made = self.network.generate(style, memory, self.loop)
        error = masked_mean((made - truth).square(), frames)
        return {"reconstruction": error, "loss": error}

    def generate_frames(
        self, batch: Batch, frames: Int[Tensor, " batch"], *, seeds: Sequence[int], progress: Progress | None = None
    ) -> BatchMotion:
        """Frame by frame; nothing is random."""
        self.check_length(frames, batch.names[0])
        style, memory = self.conditions(batch, frames)
        made = self.network.generate(style, memory, self.loop)
        return made.view(*made.shape[:2], self.n_vertices, 3) / self.scale


# The authors' checkpoints.

LAYER_NAMES = (
    ("self_attn.in_proj_", "self_attention.project."),
    ("self_attn.out_proj", "self_attention.out"),
    ("multihead_attn.in_proj_", "cross_attention.project."),
    ("multihead_attn.out_proj", "cross_attention.out"),
    ("linear1", "first"),
    ("linear2", "second"),
    ("norm1", "norms.0"),
    ("norm2", "norms.1"),
    ("norm3", "norms.2"),
)
"""What a decoder layer's tensors are called by PyTorch, and here."""


def convert(weights: Weights, request: Request, found: Found) -> dict[str, Any]:
    """FaceFormer's tensors under the names of this file, and its options."""
    dim, _ = weights.shape("audio_feature_map.weight")
    period = read_period(weights, "PPE.pe", found)
    encoder = weights.backbone(
        "audio_encoder.",
        kind="wav2vec2",
        request=request,
        **{name: value for name, value in FaceFormer.published_encoder.keywords.items() if name != "source"},  # type: ignore[attr-defined]
    )
    for old, new in (("audio_feature_map", "audio_map"), ("vertice_map", "motion_in"), ("vertice_map_r", "motion_out")):
        weights.move_all(f"{old}.", f"network.{new}.")
    weights.made["network.style.weight"] = weights.get("obj_vector.weight").T.contiguous()
    weights.move_all("transformer_decoder.layers.", "network.decoder.layers.", LAYER_NAMES)
    return {"audio_encoder": encoder, **decoder_sizes(weights, "transformer_decoder.", dim), "period": period}


recogniser(
    Recogniser(
        method="FaceFormer",
        marks=("obj_vector.weight", "vertice_map_r.weight", "PPE.pe", "audio_feature_map.weight"),
        unless=("gru.", "style_encoder.", "lip_map.", "feat_map."),
        convert=convert,
        vertices=lambda weights: weights.shape("vertice_map_r.weight")[0] // 3,
        count=lambda weights: weights.shape("obj_vector.weight")[1],
        licence="unknown: no statement on the weights, whose code is under MIT and whose data is for research",
        licence_source="github.com/EvelynFan/FaceFormer",
    )
)
