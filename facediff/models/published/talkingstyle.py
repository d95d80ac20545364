"""TalkingStyle (Song et al.: "Personalized Speech-Driven 3D Facial Animation with Style Preservation", 2024).

FaceFormer's autoregressive decoder with six layers over HuBERT large, and a style of two tables of speakers. From top
to bottom: the model, the style, the authors' checkpoints. docs/methods.md lists the options for choices
of the published code.
"""

from __future__ import annotations

from functools import partial
from typing import Any, ClassVar, Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from facediff import registry
from facediff.data import Batch
from facediff.models.audio_encoders import AudioEncoderFactory
from facediff.models.layers import Layers
from facediff.models.published.autoregressive import AutoregressiveNetwork, OffsetModel
from facediff.models.published.base import TRAINED_NETWORK, SpeakerTable
from facediff.models.squared_errors import mean_squared_error

MouthLoss = Literal["flattened", "vertices"]
"""Meaning of the numbers of the lips' vertices: positions among flattened coordinates, or vertices."""


MOUTH_SHARE = 0.6
"""Share of the mouth in the loss; the rest is of all coordinates."""


@registry.model.register("TalkingStyle")
class TalkingStyle(OffsetModel):
    """TalkingStyle: FaceFormer's decoder, deeper, with HuBERT large and a style of its own.

    Args:
        num_layers: layers of the decoder.
        mouth_loss: the mouth's coordinates: as published, the numbers of the lips' vertices count the ``flattened``
            coordinates, x, y and z of vertex 0 first, so that other places than the mouth get the weight; or the
            ``vertices`` that are meant.
        options: of the other methods with this decoder, see
            :class:`~facediff.models.published.autoregressive.AutoregressiveModel`, and of every model.
    """

    published_encoder: ClassVar[AudioEncoderFactory] = partial(
        TRAINED_NETWORK, source="facebook/hubert-large-ls960-ft", epsilon=1e-7
    )

    def __init__(
        self,
        *,
        num_layers: Layers = 6,
        mouth_loss: MouthLoss = "flattened",
        **options: Any,  # noqa: ANN401
    ) -> None:
        super().__init__(num_layers=num_layers, **options)
        self.mouth_loss = mouth_loss
        self.network = AutoregressiveNetwork(
            audio_width=self.audio_width,
            coordinates=self.coordinates,
            style=SpeakerStyle(len(self.identities), self.dim),
            decoder=self.decoder_options,
        )

    def personal_modules(self) -> list[nn.Module]:
        """The two tables of speakers."""
        style: SpeakerStyle = self.network.style  # type: ignore[assignment]
        return [style.first, style.second]

    def losses(self, batch: Batch, generator: torch.Generator | None = None) -> dict[str, Tensor]:
        """The mean squared error of all coordinates and of the mouth."""
        predicted, truth, frames = self.predicted_and_true(batch)
        columns = self.mouth_columns()
        face = mean_squared_error(predicted, truth, frames)
        mouth = mean_squared_error(predicted[..., columns], truth[..., columns], frames)
        loss = (1.0 - MOUTH_SHARE) * face + MOUTH_SHARE * mouth
        return {"reconstruction": face, "mouth": mouth, "loss": loss}

    def mouth_columns(self) -> Int[Tensor, " columns"]:
        """The coordinates that the loss takes for the mouth's."""
        lips = self.assets.regions["lips"].to(self.device)
        # Published: vertex numbers index the flattened coordinates, so that others than the mouth's are weighted.
        if self.mouth_loss == "flattened":
            return lips
        return (self.dims * lips[:, None] + torch.arange(self.dims, device=self.device)).flatten()


class SpeakerStyle(nn.Module):
    """ReLU(a + head(norm(attention(e)))) of two rows a and e for each speaker, component by component.

    Each of the numbers of e becomes three vectors of four numbers, by which the attention has its query, key and value.
    The published attention sees each number as a sequence of length one, so that the softmax over its only key is 1
    and query and key have no influence: the maps of its values are left.
    """

    LIFTED = 4

    def __init__(self, count: int, dim: int) -> None:
        super().__init__()
        self.first, self.second = SpeakerTable(count, dim), SpeakerTable(count, dim, "embedding")
        self.query, self.key, self.value = (nn.Linear(1, self.LIFTED) for _ in range(3))
        self.attention = nn.MultiheadAttention(self.LIFTED, 1, batch_first=True)
        self.norm, self.head = nn.LayerNorm(self.LIFTED), nn.Linear(self.LIFTED, 1)
        self.query.requires_grad_(False)  # no gradient would reach them
        self.key.requires_grad_(False)

    def forward(self, weights: Float[Tensor, "batch identities"]) -> Float[Tensor, "batch dim"]:
        """Styles of speakers, or of mixtures of them."""
        values, width = self.value(self.second(weights)[..., None]), self.LIFTED
        into, shift = self.attention.in_proj_weight[2 * width :], self.attention.in_proj_bias[2 * width :]
        mixed = self.attention.out_proj(F.linear(values, into, shift))
        return torch.relu(self.first(weights) + self.head(self.norm(mixed))[..., 0])
