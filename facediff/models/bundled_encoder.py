"""The audio encoder of the model that comes with facediff, as a start for models of few people."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from facediff.models.audio_encoders import ConvBlock, Lengths, MelEncoder, Waves
from facediff.models.layers import Frames, Share, Width, frame_mask
from facediff.registry import audio_encoder
from facediff.utils.hub import BUNDLED
from facediff.utils.protobuf import parts, whole_number

GRAPH, PREFIX = "speech.onnx", "model.network.audio_encoder."
HALF = 10  # ONNX's number of the type


@audio_encoder.register("bundled")
class BundledEncoder(MelEncoder):
    """The encoder of the bundled model, and two convolutions after it.

    It has heard 109 voices, in noise and in rooms, so that a model of one person keeps up with other voices.

    Args:
        frozen: train the convolutions only, and leave the encoder as it is.
        dropout: dropout in the convolutions.
    """

    def __init__(self, *, dim: Width, frozen: bool = True, dropout: Share = 0.0) -> None:
        super().__init__(dim=128, hidden_dim=128, num_layers=4, dropout=0.0)
        self.load_state_dict(graph_weights(BUNDLED / GRAPH))
        self.requires_grad_(not frozen)
        self.trained = nn.ModuleList(ConvBlock(128, dilation, dropout) for dilation in (1, 2))
        self.widen = nn.Sequential(nn.LayerNorm(128), nn.Linear(128, dim))

    def forward(self, audio: Waves, audio_lengths: Lengths, frame_lengths: Lengths) -> Frames:
        """Encode; see :class:`~facediff.models.audio_encoders.AudioEncoder`."""
        x = super().forward(audio, audio_lengths, frame_lengths)
        mask = frame_mask(frame_lengths, x.shape[1])[..., None].to(x.dtype)
        for block in self.trained:
            x = block(x, mask)
        return self.widen(x) * mask


@cache
def graph_weights(path: Path) -> dict[str, Tensor]:
    """The weights of the encoder in an exported graph, by their names in PyTorch."""
    graph = list(parts(next(content for number, content in parts(path.read_bytes()) if number == 7)))
    arrays: dict[str, Tensor] = {}
    for tensor in (list(parts(content)) for number, content in graph if number == 5):
        shape = [whole_number(content) for number, content in tensor if number == 1]
        facts = dict(tensor)
        kind = np.float16 if whole_number(facts[2]) == HALF else np.float32
        if 9 in facts and len(facts[9]) == np.dtype(kind).itemsize * int(np.prod(shape)):
            array = np.frombuffer(facts[9], kind).reshape(shape).astype(np.float32)
            arrays[facts[8].decode().removesuffix("_16")] = torch.from_numpy(array)
    weights = {name.removeprefix(PREFIX): array for name, array in arrays.items() if name.startswith(PREFIX)}
    # The weights of linear layers are transposed and nameless: the bias that is added to their product has the name.
    products: dict[str, str] = {}
    for node in (list(parts(content)) for number, content in graph if number == 1):
        inputs = [content.decode() for number, content in node if number == 1]
        kind_of_node, output = dict(node)[4].decode(), dict(node)[2].decode()
        if kind_of_node == "MatMul":
            products[output] = inputs[1]
        bias = next((name for name in inputs if name.startswith(PREFIX) and name.endswith(".bias")), "")
        factor = next((products[name] for name in inputs if name in products), "")
        if kind_of_node == "Add" and bias and factor in arrays:
            weights[bias.removeprefix(PREFIX).removesuffix("bias") + "weight"] = arrays[factor].T.contiguous()
    return weights
