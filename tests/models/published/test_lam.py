"""LAM-Audio2Expression from its authors' files gives what a reference of PyTorch's own layers gives."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from facediff.models import LamAudio2Expression, import_checkpoint
from facediff.spaces.layouts import layout
from tests.models.published.conftest import MEL, TEXT

DIM, PEOPLE, PERSON = 16, 3, 4


def speech_of(samples: int) -> Tensor:
    time = np.arange(samples) / 16_000
    noise = np.random.default_rng(samples).normal(size=samples)
    return torch.from_numpy((0.3 * np.sin(1300 * time) * np.sin(9 * time) + 0.02 * noise).astype(np.float32))


class Block(nn.Module):
    """A layer with the authors' names."""

    def __init__(self, inputs: int, residual: bool) -> None:
        super().__init__()
        self.conv, self.norm, self.residual = nn.Conv1d(inputs, DIM, 3, padding=1), nn.LayerNorm(DIM), residual
        if residual and inputs != DIM:
            self.residual_layer = nn.Sequential(nn.Conv1d(inputs, DIM, 3, padding=1))

    def forward(self, x: Tensor) -> Tensor:
        out = self.norm(self.conv(x).transpose(1, 2)).transpose(1, 2)
        if self.residual:
            out = out + (self.residual_layer(x) if hasattr(self, "residual_layer") else x)
        return out.relu()


class Author(nn.Module):
    """The published network by the formulas of its report, with its names."""

    def __init__(self, layers: int) -> None:
        from transformers import Wav2Vec2Config, Wav2Vec2Model

        super().__init__()
        self.audio_encoder = Wav2Vec2Model(Wav2Vec2Config(**TEXT, mask_time_prob=0.05))
        self.audio_encoder.lm_head = nn.Linear(8, 3)
        self.feature_projection = nn.Linear(8, DIM)
        self.identity_encoder = nn.Module()
        self.identity_encoder.id_mlp = nn.Conv1d(PEOPLE, PERSON, 1)
        self.identity_encoder.first_net = nn.Module()
        blocks = [Block(DIM + PERSON, True), Block(DIM, True), Block(DIM, True)]
        self.identity_encoder.first_net.conv_layers = nn.Sequential(*blocks)
        self.identity_encoder.grus = nn.GRU(DIM, DIM)
        if layers:
            layer = nn.TransformerEncoderLayer(DIM, 8, 2 * DIM, batch_first=True)
            self.identity_encoder.transformer_encoder = nn.TransformerEncoder(layer, layers)
        self.decoder = nn.ModuleList([nn.Sequential(*(Block(DIM, False) for _ in range(3)))])
        self.output_proj = nn.Linear(DIM, 52)

    @torch.inference_mode()
    def forward(self, speech: Tensor, person: int) -> Tensor:
        frames = math.ceil(len(speech) / 16_000 * 30)
        network = self.audio_encoder
        features = F.interpolate(network.feature_extractor(speech[None]), frames, mode="linear", align_corners=True)
        hidden = network.encoder(network.feature_projection(features.transpose(1, 2))[0]).last_hidden_state
        x = self.feature_projection(hidden).transpose(1, 2)
        one_hot = F.one_hot(torch.tensor([person]), PEOPLE).float()[..., None].expand(-1, -1, frames)
        x = self.identity_encoder.first_net.conv_layers(torch.cat([x, self.identity_encoder.id_mlp(one_hot)], 1))
        if hasattr(self.identity_encoder, "transformer_encoder"):
            x = self.identity_encoder.transformer_encoder(x.transpose(1, 2)).transpose(1, 2)
        return torch.sigmoid(self.output_proj(self.decoder[0](x).transpose(1, 2)))[0]


def author(folder: Path, layers: int, prefix: str = "module.backbone.") -> tuple[Author, Path]:
    torch.manual_seed(layers)
    made = Author(layers).eval()
    path = folder / "lam_audio2exp.tar"
    torch.save({"epoch": 3, "state_dict": {prefix + name: value for name, value in made.state_dict().items()}}, path)
    return made, path


def imported(path: Path, **options: Any) -> LamAudio2Expression:  # noqa: ANN401
    model = import_checkpoint(path, audio_config=TEXT, **options)
    assert isinstance(model, LamAudio2Expression)
    return model


@pytest.mark.parametrize(("layers", "prefix"), [(0, "module.backbone."), (2, "backbone."), (0, "")])
def test_parity(layers: int, prefix: str, tmp_path: Path) -> None:
    reference, path = author(tmp_path, layers, prefix)
    model, speech = imported(path, num_heads=8), speech_of(13_270)
    assert model.space.channels == layout("arkit").channels
    for person, name in enumerate(model.identities):
        values = model.animate(speech, identity=name).vertices[..., 0]
        assert values.shape == (25, 52)  # 24.88 frames
        torch.testing.assert_close(values, reference(speech, person), rtol=0, atol=1e-5)


def test_channels_of_a_range_are_bounded_and_rotations_are_not() -> None:
    space = layout("live_link")
    torch.manual_seed(0)
    model = LamAudio2Expression(
        n_vertices=61, identities=["A"], frame_rate=30.0, space=space, audio_encoder=MEL, audio_dim=8, dim=8
    )
    torch.nn.init.normal_(model.network.motion_out.weight, std=30.0)
    values = model.network(torch.randn(1, 9, 8), torch.ones(1, 1))[0]
    assert values[:, list(space.face)].amin() >= 0
    assert values[:, list(space.face)].amax() <= 1
    turns = [*space.head, *space.eyes]
    assert values[:, turns].abs().amax() > 1
