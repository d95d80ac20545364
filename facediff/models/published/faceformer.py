"""FaceFormer (Fan, Lin, Saito, Wang, Komura: "FaceFormer: Speech-Driven 3D Facial Animation with Transformers", 2022).

An autoregressive Transformer decoder over wav2vec 2.0; the network is the one of ``autoregressive.py`` with one column
of a table for each speaker. docs/methods.md lists the options for choices of the published code.
"""

from __future__ import annotations

from functools import partial
from typing import Any, ClassVar

import torch
from torch import Tensor

from facediff import registry
from facediff.data import Batch
from facediff.models.audio_encoders import AudioEncoderFactory
from facediff.models.published.autoregressive import AutoregressiveNetwork, OffsetModel
from facediff.models.published.base import TRAINED_NETWORK, SpeakerTable
from facediff.models.squared_errors import mean_squared_error


@registry.model.register("FaceFormer")
class FaceFormer(OffsetModel):
    """FaceFormer: an autoregressive Transformer with periodic positions and biased attention.

    Args:
        options: see :class:`OffsetModel`, of the other methods with this decoder, see
            :class:`~facediff.models.published.autoregressive.AutoregressiveModel`, and of every model.
    """

    # wav2vec 2.0 base as transformers had it in 2021.
    published_encoder: ClassVar[AudioEncoderFactory] = partial(
        TRAINED_NETWORK, source="facebook/wav2vec2-base-960h", epsilon=1e-5
    )

    def __init__(self, **options: Any) -> None:  # noqa: ANN401
        super().__init__(**options)
        # The style is a map of the one-hot identity without a bias, hence a table of rows; its order is the
        # training command line, which no checkpoint records.
        self.network = AutoregressiveNetwork(
            audio_width=self.audio_width,
            coordinates=self.coordinates,
            style=SpeakerTable(len(self.identities), self.dim),
            decoder=self.decoder_options,
        )

    def losses(self, batch: Batch, generator: torch.Generator | None = None) -> dict[str, Tensor]:
        """The mean squared error of all coordinates."""
        error = mean_squared_error(*self.predicted_and_true(batch))
        return {"reconstruction": error, "loss": error}
