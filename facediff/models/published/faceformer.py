"""FaceFormer (Fan, Lin, Saito, Wang, Komura: "FaceFormer: Speech-Driven 3D Facial Animation with Transformers", 2022).

An autoregressive Transformer decoder over wav2vec 2.0; the network is that of ``autoregressive.py`` with one column of
a table for each speaker. docs/methods.md says what of the published code is an option here.
"""

from __future__ import annotations

from functools import partial
from typing import Any, ClassVar

import torch
from torch import Tensor

from facediff import registry
from facediff.data import Batch
from facediff.models.audio_encoders import AudioEncoderFactory
from facediff.models.published.autoregressive import (
    AutoregressiveNetwork,
    OffsetModel,
    decoder_sizes,
    read_period,
)
from facediff.models.published.base import TRAINED_NETWORK, SpeakerTable
from facediff.models.published.recognition import AuthorsWeights, CheckpointFacts, Recogniser, register
from facediff.models.squared_errors import mean_squared_error


@registry.model.register("FaceFormer")
class FaceFormer(OffsetModel):
    """FaceFormer: an autoregressive Transformer with periodic positions and biased attention.

    Args:
        options: those of :class:`OffsetModel`, of the other methods with this decoder, see
            :class:`~facediff.models.published.autoregressive.AutoregressiveModel`, and of every model.
    """

    # wav2vec 2.0 base as transformers had it in 2021.
    published_encoder: ClassVar[AudioEncoderFactory] = partial(
        TRAINED_NETWORK, source="facebook/wav2vec2-base-960h", epsilon=1e-5
    )

    def __init__(self, **options: Any) -> None:  # noqa: ANN401
        super().__init__(**options)
        # The style is a map of the one-hot identity without a bias, hence a table of rows; its order is that of the
        # training command line, which no checkpoint records.
        self.network = AutoregressiveNetwork(
            audio_width=self.audio_width,
            n_vertices=self.n_vertices,
            dims=self.dims,
            style=SpeakerTable(len(self.identities), self.dim),
            decoder=self.decoder_options,
        )

    def losses(self, batch: Batch, generator: torch.Generator | None = None) -> dict[str, Tensor]:
        """The mean squared error of all coordinates."""
        error = mean_squared_error(*self.predicted_and_true(batch))
        return {"reconstruction": error, "loss": error}


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


def convert(weights: AuthorsWeights, facts: CheckpointFacts) -> dict[str, Any]:
    """FaceFormer's tensors under the names of this file, and its options."""
    dim, _ = weights.shape("audio_feature_map.weight")
    period = read_period(weights, "PPE.pe", facts)
    encoder = weights.backbone("audio_encoder.", kind="wav2vec2", facts=facts, **FaceFormer.encoder_settings())
    for old, new in (("audio_feature_map", "audio_map"), ("vertice_map", "motion_in"), ("vertice_map_r", "motion_out")):
        weights.move_all(f"{old}.", f"network.{new}.")
    weights.renamed["network.style.weight"] = weights.get("obj_vector.weight").T.contiguous()
    weights.move_all("transformer_decoder.layers.", "network.decoder.layers.", LAYER_NAMES)
    return {"audio_encoder": encoder, **decoder_sizes(weights, "transformer_decoder.", dim), "period": period}


register(
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
