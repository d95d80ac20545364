"""UniTalker from its authors' files gives what a reference of PyTorch's own layers gives."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from facediff.data import Assets, Batch, collate
from facediff.errors import FaceDiffError
from facediff.models import UniTalker, import_checkpoint
from facediff.models.published.base import DirectModel
from facediff.models.published.cards import cards
from facediff.models.published.positions import periodic_bias, periodic_positions
from facediff.utils.licences import commercial_use
from tests.fakes.tiny import RATE, SEEN, VERTICES
from tests.models.published.conftest import MEL, TEXT
from tests.models.published.test_lam import DIM, Block, speech_of
from tests.models.published.test_laws import clips, with_assets

ROWS, COMPONENTS, STYLE = 935, 3, 4
DATA = next(card.data for card in cards() if card.method == "UniTalker")
WIDE = {**TEXT, "num_buckets": 8, "max_bucket_distance": 20}


class Author(nn.Module):
    """The published network by the formulas of its report, with its names."""

    def __init__(self, kind: str, decoder: str) -> None:
        import transformers

        super().__init__()
        config = getattr(transformers, f"{kind}Config")(**{**WIDE, "model_type": kind.lower()}, mask_time_prob=0.05)
        self.audio_encoder = getattr(transformers, f"{kind}Model")(config)
        self.decoder = nn.Module()
        self.decoder.learnable_style_emb = nn.Embedding(ROWS, STYLE if decoder == "conv" else DIM)
        self.decoder.audio_feature_map = nn.Linear(8, DIM)
        self.kind = decoder
        if decoder == "conv":
            self.decoder.tcn = nn.Module()
            self.decoder.tcn.first_net = nn.Module()
            blocks = [Block(DIM + STYLE, True), Block(DIM, True), Block(DIM, True)]
            self.decoder.tcn.first_net.conv_layers = nn.Sequential(*blocks)
        else:
            self.decoder.PPE = nn.Module()
            self.decoder.PPE.register_buffer("pe", periodic_positions(3030, DIM, 30)[None])
            layer = nn.TransformerDecoderLayer(DIM, 4, 2 * DIM, batch_first=True)
            self.decoder.transformer_decoder = nn.TransformerDecoder(layer, 1)
        heads = {entry["head"]: entry["width"] if "layout" in entry else COMPONENTS for entry in DATA.values()}
        self.out_head_dict = nn.ModuleDict({name: nn.Linear(DIM, width) for name, width in heads.items()})

    @torch.inference_mode()
    def forward(self, speech: Tensor, row: int, key: str) -> Tensor:
        frames = round(len(speech) / 16_000 * DATA[key].get("frame_rate", 30.0))
        hidden = self.audio_encoder(speech[None]).last_hidden_state.transpose(1, 2)
        hidden = F.interpolate(hidden, frames, mode="linear", align_corners=True).transpose(1, 2)
        x = self.decoder.audio_feature_map(hidden)
        style = self.decoder.learnable_style_emb.weight[row].expand(1, frames, -1)
        if self.kind == "conv":
            x = self.decoder.tcn.first_net.conv_layers(torch.cat([x, style], 2).transpose(1, 2)).transpose(1, 2)
        else:
            tokens = style + self.decoder.PPE.pe[:, :frames]
            own = ~torch.eye(frames, dtype=torch.bool)
            x = self.decoder.transformer_decoder(tokens, x, tgt_mask=periodic_bias(frames, 4, 30), memory_mask=own)
        return self.out_head_dict[DATA[key]["head"]](x)[0]


def author(folder: Path, kind: str = "WavLM", decoder: str = "conv") -> tuple[Author, Path]:
    torch.manual_seed(5)
    made, path = Author(kind, decoder).eval(), folder / "UniTalker-B-D0-D7.pt"
    torch.save(made.state_dict(), path)
    return made, path


def write_release(root: Path, key: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Neutral faces, mean and components of one data set, as its archive holds them."""
    entry, generator = DATA[key], np.random.default_rng(1)
    folder = root / entry["folder"]
    folder.mkdir(parents=True)
    faces = generator.normal(size=(entry.get("template_row", 0) + 1, entry["width"])).astype(np.float16)
    np.save(folder / "id_template.npy", faces)
    mean, basis = generator.normal(size=entry["width"]), generator.normal(size=(COMPONENTS + 1, entry["width"]))
    pca = {"original_data_mean": mean.astype("f4"), "components_to_data": basis.astype("f4")}
    np.savez(folder / "pca.npz", **pca, data_components_mean=np.zeros(COMPONENTS + 1))
    return faces, pca["original_data_mean"], pca["components_to_data"]


def imported(path: Path, **options: Any) -> UniTalker:  # noqa: ANN401
    model = import_checkpoint(path, audio_config=WIDE, **options)
    assert isinstance(model, UniTalker)
    return model


def first_row(key: str) -> int:
    return sum(entry["speakers"] for name, entry in DATA.items() if name < key)


@pytest.mark.parametrize("decoder", ["conv", "transformer"])
def test_parity_of_weights(decoder: str, tmp_path: Path) -> None:
    reference, path = author(tmp_path, decoder=decoder)
    speech = speech_of(13_270)
    for key, channels in (("D3", 52), ("D5", 413), ("D7", 51)):
        model = imported(path, dataset=key)
        assert len(model.space.channels) == channels
        for name, row in ((model.identities[1], first_row(key) + 1), ("common", ROWS - 1)):
            values = model.animate(speech, identity=name).vertices[..., 0]
            torch.testing.assert_close(values, reference(speech, row, key), rtol=0, atol=1e-5)


@pytest.mark.parametrize("key", ["D0", "D2"])
def test_parity_of_vertices(key: str, tmp_path: Path) -> None:
    reference, path = author(tmp_path)
    faces, mean, basis = write_release(tmp_path / "data", key)
    model, speech, entry = imported(path, dataset=key, data_root=tmp_path / "data"), speech_of(9000), DATA[key]
    assert commercial_use(model.licences) == "forbidden"
    coefficients = reference(speech, first_row(key) + 2, key).numpy()
    face = faces[entry.get("template_row", 0)].astype(np.float32) * np.float32(entry.get("scale", 1.0))
    expected = coefficients @ basis[:COMPONENTS] + mean + face
    vertices = model.animate(speech, identity=model.identities[2]).vertices.flatten(1)
    np.testing.assert_allclose(vertices.numpy(), expected, rtol=0, atol=3e-5)
    with pytest.raises(FaceDiffError, match="data_root"):
        imported(path, dataset=key)
    (tmp_path / "data" / entry["folder"] / "pca.npz").unlink()
    with pytest.raises(FaceDiffError, match="pca.npz"):
        imported(path, dataset=key, data_root=tmp_path / "data")


@pytest.mark.parametrize("kind", ["WavLM", "Wav2Vec2"])
def test_long_speech_is_standardised_and_again_in_each_window(kind: str, tmp_path: Path) -> None:
    """Over 5 s of overlap one window goes over into the next, whose ends are of one window alone."""
    reference, path = author(tmp_path, kind)
    speech = speech_of(30 * 16_000) * torch.linspace(0.5, 1.5, 30 * 16_000)

    def heard(piece: Tensor) -> Tensor:
        level = (piece - piece.mean()) / (piece.var(correction=0) + 1e-7).sqrt()
        return piece if kind == "WavLM" else level

    pieces = [reference(heard(heard(speech)[a * 16_000 : b * 16_000]), ROWS - 1, "D3") for a, b in ((0, 25), (20, 45))]
    share = torch.linspace(0, 1, 150)[:, None]
    shared = (1 - share) * pieces[0][600:] + share * pieces[1][:150]
    expected = torch.cat([pieces[0][:600], shared, pieces[1][150:]])
    model = imported(path)
    assert model.graphs().longest == 750, "a graph has no windows"
    values = model.animate(speech, identity="common").vertices[..., 0]
    torch.testing.assert_close(values, expected, rtol=0, atol=1e-5)


def test_windows_lie_at_their_time_at_any_frame_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    """Speech that rises by 1 a second, and a network whose motion is the speech of a frame's moment."""
    sizes = {"n_vertices": 1, "identities": ["A"], "frame_rate": 29.97, "components": 0}
    model = UniTalker(audio_encoder=MEL, audio_dim=16, **sizes)
    vertex = torch.zeros(1, dtype=torch.long)
    regions = {"lips": vertex, "upper_face": vertex}
    model.adopt(Assets("tiny", True, "m", 29.97, ["A"], {"A": torch.zeros(1, 3)}, None, regions))

    def generate(self: UniTalker, batch: Batch, frames: Tensor, **_: object) -> Tensor:
        places = (torch.arange(int(frames[0])) * 16_000 / 29.97).long()
        return batch.audio[:, places.clamp_max(batch.audio.shape[1] - 1), None, None].expand(-1, -1, 1, 3)

    monkeypatch.setattr(DirectModel, "generate_frames", generate)
    for seconds in (150.0, 151.03):
        clip = model.clip_of(torch.arange(seconds * 16_000) / 16_000, "A", None)
        count = model.frames_of(clip.audio.shape[1])
        motion = model.generate_frames(clip, torch.tensor([count]), seeds=[0])[0, :, 0, 0]
        torch.testing.assert_close(motion, torch.arange(count) / 29.97, rtol=0, atol=0.02)


def test_neutral_values_are_added_to_every_head(tmp_path: Path) -> None:
    reference, path = author(tmp_path)
    faces, _, _ = write_release(tmp_path / "data", "D6")
    file = tmp_path / "data" / "hparams.json"
    file.write_text(json.dumps({"encoder_config": WIDE, "data_root": ".", "dataset": "D6"}), encoding="utf-8")
    speech = speech_of(7000)
    for row in (4, 2):
        model = import_checkpoint(path, hparams=file, **({} if row == 4 else {"template_row": row}))
        values = model.animate(speech, identity="common").vertices[..., 0]
        expected = reference(speech, ROWS - 1, "D6") + torch.from_numpy(faces[row].astype(np.float32))
        torch.testing.assert_close(values, expected, rtol=0, atol=1e-5)
    with pytest.raises(FaceDiffError, match="template_row"):
        import_checkpoint(path, hparams=file, template_row=9)
    with pytest.raises(FaceDiffError, match="data_root"):
        imported(path, dataset="D6", template_row=2)


def test_a_file_of_other_speakers_is_asked_about(tmp_path: Path) -> None:
    made, path = author(tmp_path)
    state = {**made.state_dict(), "decoder.learnable_style_emb.weight": torch.randn(9, STYLE)}
    torch.save(state, path)
    with pytest.raises(FaceDiffError, match="expected 8"):
        imported(path, dataset="D6")
    names = [f"S{row}" for row in range(8)]
    assert imported(path, dataset="D6", identities=names).identities == names
    with pytest.raises(FaceDiffError, match="D9"):
        imported(path, dataset="D9")


def test_the_loss_counts_vertices_and_their_components() -> None:
    model = with_assets(
        UniTalker(
            **{"n_vertices": VERTICES, "identities": SEEN, "frame_rate": float(RATE)},
            **{"audio_encoder": MEL, "audio_dim": 8, "dim": 8, "style_dim": 4, "components": 4},
        )
    )
    assert isinstance(model, UniTalker)
    model.eval()
    basis = torch.linalg.qr(torch.randn(3 * VERTICES, 4, generator=torch.Generator().manual_seed(0)))[0].T * 2
    mean = torch.full((3 * VERTICES,), 0.1)
    model.network.attach(mean, basis)
    codes = torch.randn(1, 3, 4)
    torch.testing.assert_close(model.network.coefficients(model.network.motion(codes)), codes)
    batch = collate(clips(9))
    losses = model.losses(batch)
    truth = batch.motion.flatten(2)
    torch.testing.assert_close(losses["reconstruction"], (truth - mean).square().mean())
    own = (truth - mean) @ basis.T / 4
    torch.testing.assert_close(losses["components"], own.square().mean())
    torch.testing.assert_close(losses["loss"], losses["reconstruction"] + 0.01 * losses["components"])


def test_the_speech_network_is_trained_from_the_second_epoch_on() -> None:
    sizes = {"n_vertices": VERTICES, "identities": SEEN, "frame_rate": float(RATE), "components": 0}
    model = with_assets(UniTalker(audio_encoder=MEL, audio_dim=8, dim=8, style_dim=4, **sizes)).train()
    torch.nn.init.normal_(model.network.head.weight)
    for epoch, trained in ((0, False), (1, True)):
        model._trainer = SimpleNamespace(current_epoch=epoch)
        model.zero_grad()
        model.losses(collate(clips(9, 14)))["loss"].backward()
        gradients = [weight.grad for weight in model.audio_encoder.parameters()]
        assert all(gradient is not None for gradient in gradients)  # every process needs one
        assert any(bool(gradient.any()) for gradient in gradients) == trained
        assert model.network.audio_map.weight.grad.any()
