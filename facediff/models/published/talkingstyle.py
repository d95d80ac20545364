"""TalkingStyle (Song et al.: "Personalized Speech-Driven 3D Facial Animation with Style Preservation", 2024).

FaceFormer's autoregressive decoder with six layers over HuBERT large, and a style of two tables of speakers. From top
to bottom: the model, the style, the authors' checkpoints. docs/methods.md says what of the published code
is an option here.
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
from facediff.models.layers import Layers, Share
from facediff.models.published.autoregressive import (
    AutoregressiveNetwork,
    OffsetModel,
    decoder_sizes,
    read_period,
)
from facediff.models.published.base import TRAINED_NETWORK, SpeakerTable
from facediff.models.published.faceformer import LAYER_NAMES
from facediff.models.published.recognition import AuthorsWeights, CheckpointFacts, Recogniser, dataset_facts, register
from facediff.models.squared_errors import mean_squared_error

StyleAttention = Literal["one_key", "components"]
"""What an attention over a speaker's row attends to: each component to itself alone, or to all of them."""

MouthLoss = Literal["flattened", "vertices"]
"""What the numbers of the lips' vertices count: the flattened coordinates, or vertices."""


@registry.model.register("TalkingStyle")
class TalkingStyle(OffsetModel):
    """TalkingStyle: FaceFormer's decoder, deeper, with HuBERT large and a style of its own.

    Args:
        num_layers: layers of the decoder.
        mouth_weight: share of the mouth in the loss; the rest is that of all coordinates.
        mouth_loss: what the mouth is there: as published, the numbers of the lips' vertices count the ``flattened``
            coordinates, x, y and z of vertex 0 first, so that other places than the mouth get the weight; or the
            ``vertices`` that are meant.
        style_attention: as published, the attention over the components of a speaker's row sees them as items of a
            batch, each with itself as the only key (``one_key``), so that its weights are 1 whatever it learns; over
            all ``components``, as is meant, it has something to weigh.
        options: those of the other methods with this decoder, see
            :class:`~facediff.models.published.autoregressive.AutoregressiveModel`, and of every model.
    """

    published_encoder: ClassVar[AudioEncoderFactory] = partial(
        TRAINED_NETWORK, source="facebook/hubert-large-ls960-ft", epsilon=1e-7
    )

    def __init__(
        self,
        *,
        num_layers: Layers = 6,
        mouth_weight: Share = 0.6,
        mouth_loss: MouthLoss = "flattened",
        style_attention: StyleAttention = "one_key",
        **options: Any,  # noqa: ANN401
    ) -> None:
        super().__init__(num_layers=num_layers, **options)
        self.mouth_weight, self.mouth_loss = mouth_weight, mouth_loss
        self.network = AutoregressiveNetwork(
            audio_width=self.audio_width,
            n_vertices=self.n_vertices,
            dims=self.dims,
            style=SpeakerStyle(len(self.identities), self.dim, style_attention),
            decoder=self.decoder_options,
        )

    def personal_modules(self) -> list[nn.Module]:
        """The two tables of speakers."""
        style: SpeakerStyle = self.network.style  # type: ignore[assignment]
        return [style.first, style.second]

    def losses(self, batch: Batch, generator: torch.Generator | None = None) -> dict[str, Tensor]:
        """The mean squared error of all coordinates and that of the mouth."""
        predicted, truth, frames = self.predicted_and_true(batch)
        columns = self.mouth_columns()
        whole = mean_squared_error(predicted, truth, frames)
        mouth = mean_squared_error(predicted[..., columns], truth[..., columns], frames)
        loss = (1.0 - self.mouth_weight) * whole + self.mouth_weight * mouth
        return {"reconstruction": whole, "mouth": mouth, "loss": loss}

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

    Args:
        count: speakers.
        dim: channels of a style.
        over: what the attention attends to.
    """

    LIFTED = 4

    def __init__(self, count: int, dim: int, over: StyleAttention) -> None:
        super().__init__()
        self.over = over
        self.first, self.second = SpeakerTable(count, dim), SpeakerTable(count, dim, "embedding")
        self.query, self.key, self.value = (nn.Linear(1, self.LIFTED) for _ in range(3))
        self.attention = nn.MultiheadAttention(self.LIFTED, 1, batch_first=True)
        self.norm, self.head = nn.LayerNorm(self.LIFTED), nn.Linear(self.LIFTED, 1)
        if over == "one_key":  # no gradient would reach them
            self.query.requires_grad_(False)
            self.key.requires_grad_(False)

    def forward(self, weights: Float[Tensor, "batch identities"]) -> Float[Tensor, "batch dim"]:
        """Styles of speakers, or of mixtures of them."""
        # The published attention sees each of the style's numbers as a sequence of length one, so that it never
        # compares two of them; the released weights need that form.
        components = self.second(weights)[..., None]
        if self.over == "one_key":
            # The softmax over one key is 1: what is left of the attention are the maps of its values.
            width = self.LIFTED
            into, shift = self.attention.in_proj_weight[2 * width :], self.attention.in_proj_bias[2 * width :]
            mixed = self.attention.out_proj(F.linear(self.value(components), into, shift))
        else:
            mixed, _ = self.attention(
                self.query(components), self.key(components), self.value(components), need_weights=False
            )
        return torch.relu(self.first(weights) + self.head(self.norm(mixed))[..., 0])


# The authors' checkpoints.


def convert(weights: AuthorsWeights, facts: CheckpointFacts) -> dict[str, Any]:
    """TalkingStyle's tensors under the names of this file, and its options."""
    dim, _ = weights.shape("audio_feature_map.weight")
    usual = len(dataset_facts()[facts.dataset].identities)
    if len(facts.identities) != usual:
        weights.notes.append(
            f"its table has {len(facts.identities)} speakers, and {facts.dataset} {usual}: it is run as one of "
            f"{facts.dataset}; if it is the authors' mead.pth, their code does not say how that is run, so nothing can "
            f"be compared with it"
        )
    period = read_period(weights, "PPE.pe", facts)
    encoder = weights.backbone("audio_encoder.", kind="hubert", facts=facts, **TalkingStyle.encoder_settings())
    for old, new in (
        ("audio_feature_map.", "audio_map."),
        ("vertice_encoder.", "motion_in."),
        ("vertice_decoder.", "motion_out."),
        ("style_encoder.attention.Wq.", "style.query."),
        ("style_encoder.attention.Wk.", "style.key."),
        ("style_encoder.attention.Wv.", "style.value."),
        ("style_encoder.attention.attention.", "style.attention."),
        ("style_encoder.attention.norm.", "style.norm."),
        ("style_encoder.attention.head.", "style.head."),
    ):
        weights.move_all(old, f"network.{new}")
    weights.renamed["network.style.first.weight"] = weights.get("style_encoder.obj_vector.weight").T.contiguous()
    weights.move("style_encoder.my_obj_vector.weight", "network.style.second.weight")
    weights.move_all("transformer_decoder.layers.", "network.decoder.layers.", LAYER_NAMES)
    return {"audio_encoder": encoder, **decoder_sizes(weights, "transformer_decoder.", dim), "period": period}


register(
    Recogniser(
        method="TalkingStyle",
        marks=("style_encoder.my_obj_vector.weight", "vertice_decoder.weight", "PPE.pe", "audio_feature_map.weight"),
        unless=("lip_map.", "gru.", "feat_map."),
        convert=convert,
        vertices=lambda weights: weights.shape("vertice_decoder.weight")[0] // 3,
        count=lambda weights: weights.shape("style_encoder.my_obj_vector.weight")[0],
        licence="unknown: neither code nor weights state one, and the data is for research",
        licence_source="github.com/wangxuanx/TalkingStyle",
    )
)
