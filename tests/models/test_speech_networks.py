"""HuBERT: what is frozen, what stays off, how many steps, and what a broken directory says."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from facediff import registry
from facediff.errors import FaceDiffError
from facediff.hyperparameters import describe
from facediff.models.audio_encoders import HubertEncoder, standardise
from facediff.models.layers import interpolate_frames
from facediff.models.speech_networks import Wav2Vec2Encoder

Change = Callable[[Path], object]


@pytest.fixture
def copy(hubert_source: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(hubert_source, tmp_path / "copy"))


def clip(frames: int, batch: int = 1) -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    audio = torch.randn(batch, frames * 640, generator=generator)
    return audio, torch.full((batch,), frames * 640), torch.full((batch,), frames)


@pytest.mark.parametrize(
    ("frozen", "trained"), [(0, {"layers.0", "layers.1", "layers.2", "encoder"}), (2, {"layers.2"}), (-1, set())]
)
def test_hubert_keeps_frozen_weights_and_trains_the_others(hubert_source: Path, frozen: int, trained: set[str]) -> None:
    encoder = HubertEncoder(dim=8, source=str(hubert_source), frozen_layers=frozen).train()
    before = {name: value.clone() for name, value in encoder.named_parameters()}
    optimizer = torch.optim.AdamW(encoder.parameters(), lr=0.01, weight_decay=0.05)
    encoder(*clip(6, batch=2)).square().sum().backward()
    optimizer.step()
    for name, value in encoder.named_parameters():
        if value.requires_grad:
            assert not torch.equal(value, before[name]), name
        else:
            assert value.grad is None
            assert torch.equal(value, before[name]), name
    learning = {name for name, value in encoder.named_parameters() if value.requires_grad}
    parts = {".".join(name.split(".")[2:4]) for name in learning if name.startswith("hubert.encoder.layers")}
    if any(name.startswith(("hubert.encoder.layer_norm", "hubert.encoder.pos_conv")) for name in learning):
        parts.add("encoder")
    assert parts == trained
    assert not any("feature_extractor" in name or "feature_projection" in name for name in learning)


def test_hubert_trains_its_feature_projection_where_asked(hubert_source: Path) -> None:
    encoder = HubertEncoder(dim=8, source=str(hubert_source), frozen_layers=2, train_projection=True).train()
    encoder(*clip(6, batch=2)).square().sum().backward()
    moved = {name.split(".")[1] for name, value in encoder.named_parameters() if value.grad is not None}
    assert "feature_projection" in moved
    assert "feature_extractor" not in moved
    frozen = [value for name, value in encoder.named_parameters() if "encoder.layers.1." in name]
    assert frozen
    assert all(value.grad is None for value in frozen)  # a gradient passes through them and changes nothing


def test_hubert_training_is_not_random_by_default(
    hubert_source: Path, without_dropout: Callable[[nn.Module], nn.Module]
) -> None:
    """Long enough for SpecAugment to find something to mask."""
    inputs = clip(50)

    def outputs(**options: object) -> list[Tensor]:
        torch.manual_seed(0)
        encoder = HubertEncoder(dim=8, source=str(hubert_source), **options)
        calm = encoder.eval()(*inputs)
        without_dropout(encoder)
        return [calm, *(encoder(*inputs) for _ in range(3))]

    calm, *trained = outputs()
    for out in trained:
        torch.testing.assert_close(out, calm, rtol=0, atol=1e-5)
    for option in ({"spec_augment": True}, {"layer_drop": 0.9}):
        calm, *trained = outputs(**option)
        assert any(not torch.allclose(out, calm, atol=1e-3) for out in trained), option


@pytest.mark.parametrize("spec_augment", [False, True])
def test_layer_drop_spares_frozen_layers(hubert_source: Path, spec_augment: bool) -> None:
    encoder = HubertEncoder(
        dim=8, source=str(hubert_source), frozen_layers=1, layer_drop=1.0, spec_augment=spec_augment
    ).train()
    run: list[int] = []
    for number, layer in enumerate(encoder.hubert.encoder.layers):
        layer.register_forward_hook(lambda *_, number=number: run.append(number))
    encoder(*clip(50))
    assert run == [0]


@pytest.mark.parametrize("frames", [3, 50])
def test_several_processes_give_every_hubert_weight_a_gradient(
    hubert_source: Path, frames: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also of layers that are skipped, and of the mask where speech is too short for one."""
    monkeypatch.setattr(torch.distributed, "is_initialized", lambda: True)
    encoder = HubertEncoder(
        dim=8, source=str(hubert_source), frozen_layers=1, layer_drop=1.0, spec_augment=True
    ).train()
    encoder(*clip(frames)).square().sum().backward()
    assert [name for name, value in encoder.named_parameters() if value.requires_grad and value.grad is None] == []


def test_hubert_convolutions_keep_time(hubert_source: Path) -> None:
    """The centre of what a step hears is the centre of its own 320 samples."""
    encoder = HubertEncoder(dim=8, source=str(hubert_source)).eval()
    # Group normalisation over time, in the first block, lets every step hear a little of everything.
    encoder.hubert.feature_extractor.conv_layers[0].layer_norm = nn.Identity()
    waves: list[Tensor] = []
    heard: list[Tensor] = []
    encoder.hubert.feature_extractor.register_forward_pre_hook(lambda _, args: waves.append(args[0]))
    encoder.hubert.feature_extractor.register_forward_hook(lambda *args: heard.append(args[2]))
    encoder(torch.randn(1, 6400, requires_grad=True), torch.tensor([6400]), torch.tensor([10]))
    edge = (waves[0].shape[1] - 6400) // 2
    for step in (3, 9, 15):
        (gradient,) = torch.autograd.grad(heard[0][0, :, step].sum(), waves[0], retain_graph=True)
        places = gradient[0].nonzero().flatten() - edge
        assert float(places[0] + places[-1]) / 2 == pytest.approx(320 * step + 160, abs=2)


def test_hubert_checkpoint_needs_no_source(hubert_source: Path, copy: Path, tmp_path: Path) -> None:
    factory = partial(registry.audio_encoder.hubert, source=str(copy), frozen_layers=1)
    encoder = factory(dim=8).eval()
    saved = {"hparams": describe(factory, encoder), "state": encoder.state_dict()}
    torch.save(saved, tmp_path / "model.ckpt")
    shutil.rmtree(copy)
    loaded = torch.load(tmp_path / "model.ckpt", weights_only=True)
    assert loaded["hparams"]["class_path"] == "facediff.registry.audio_encoder.hubert"
    torch.manual_seed(5)
    again = HubertEncoder(dim=8, **loaded["hparams"]["init_args"]).eval()
    again.load_state_dict(loaded["state"])
    assert torch.equal(again(*clip(7)), encoder(*clip(7)))
    assert [p.requires_grad for p in again.parameters()] == [p.requires_grad for p in encoder.parameters()]


def edit(key: str, value: object) -> Change:
    def change(folder: Path) -> None:
        config = json.loads((folder / "config.json").read_text())
        (folder / "config.json").write_text(json.dumps({**config, key: value}))

    return change


CORRUPTIONS: dict[str, Change] = {
    "weights are text": lambda folder: (folder / "model.safetensors").write_text("text " * 100),
    "weights are cut": lambda folder: (folder / "model.safetensors").write_bytes(
        (folder / "model.safetensors").read_bytes()[:5000]
    ),
    "weights are empty": lambda folder: (folder / "model.safetensors").write_bytes(b""),
    "weights are absent": lambda folder: (folder / "model.safetensors").unlink(),
    "config is absent": lambda folder: (folder / "config.json").unlink(),
    "config is no json": lambda folder: (folder / "config.json").write_text("{"),
    "config is a list": lambda folder: (folder / "config.json").write_text("[1]"),
    "another width": edit("hidden_size", 64),
    "more layers than weights": edit("num_hidden_layers", 5),
    "nothing at all": lambda folder: [file.unlink() for file in folder.iterdir()],
}


@pytest.mark.parametrize("case", CORRUPTIONS)
def test_hubert_corrupt_directory_is_named(copy: Path, case: str) -> None:
    CORRUPTIONS[case](copy)
    with pytest.raises(FaceDiffError, match="audio_encoder.source: .*copy") as caught:
        HubertEncoder(dim=8, source=str(copy))
    assert "\n" not in str(caught.value)


def test_hubert_trains_all_but_the_frozen_part_in_full_precision(hubert_source: Path) -> None:
    # from_pretrained hands a model over in evaluation mode, and Lightning leaves modes as they are.
    encoder = HubertEncoder(dim=8, source=str(hubert_source), frozen_layers=1)
    layers = encoder.hubert.encoder.layers
    assert [layer.training for layer in layers] == [False, True, True]
    assert not encoder.hubert.feature_extractor.training
    assert encoder.training
    assert {p.dtype for p in encoder.parameters()} == {torch.float32}
    assert not any(module.training for module in encoder.eval().modules())
    assert [layer.training for layer in encoder.train().hubert.encoder.layers] == [False, True, True]


@pytest.fixture(params=[False, True], ids=["base", "large"])
def either_source(request: pytest.FixtureRequest, hubert_source: Path, tmp_path: Path) -> Path:
    """A HuBERT whose Transformer normalises first, as the base model does, or last, as the large ones do."""
    if not request.param:
        return hubert_source
    from transformers import HubertConfig, HubertModel

    config = json.loads((hubert_source / "config.json").read_text())
    torch.manual_seed(0)
    large = HubertModel(HubertConfig.from_dict({**config, "do_stable_layer_norm": True, "feat_extract_norm": "layer"}))
    large.save_pretrained(tmp_path / "large")
    return tmp_path / "large"


@pytest.mark.parametrize(
    ("frozen", "projection"), [(0, False), (1, False), (2, False), (3, False), (-1, False), (0, True), (2, True)]
)
def test_hubert_parts_together_are_the_published_model(either_source: Path, frozen: int, projection: bool) -> None:
    encoder = HubertEncoder(dim=8, source=str(either_source), frozen_layers=frozen, train_projection=projection).eval()
    audio, lengths, frames = clip(9, batch=2)
    features, steps = encoder.frozen_features(audio, lengths)
    assert steps.tolist() == [18, 18]
    hidden = encoder.hubert(torch.nn.functional.pad(standardise(audio, lengths), (40, 40))).last_hidden_state
    expected = interpolate_frames(encoder.out(hidden), steps, frames)
    torch.testing.assert_close(encoder(audio, lengths, frames), expected, rtol=0, atol=1e-6)
    assert torch.equal(encoder(audio, lengths, frames, features, steps), encoder(audio, lengths, frames))


def test_hubert_features_of_clips_do_not_mix(hubert_source: Path) -> None:
    encoder = HubertEncoder(dim=8, source=str(hubert_source), frozen_layers=1).eval()
    audio, frames = torch.randn(2, 9 * 640), torch.tensor([9, 4])
    audio[1, 4 * 640 :] = 0
    features, steps = encoder.frozen_features(audio, frames * 640)
    alone, _ = encoder.frozen_features(audio[1:, : 4 * 640], frames[1:] * 640)
    torch.testing.assert_close(features[1, :8], alone[0], rtol=0, atol=1e-6)
    whole = encoder(audio, frames * 640, frames)
    torch.testing.assert_close(encoder(audio, frames * 640, frames, features, steps), whole, rtol=0, atol=0)


def test_hubert_frozen_key_changes_with_the_features(hubert_source: Path) -> None:
    def key(change: Callable[[HubertEncoder], object] = lambda encoder: None, **options: object) -> str | None:
        torch.manual_seed(0)
        encoder = HubertEncoder(dim=8, source=str(hubert_source), **options)
        with torch.no_grad():
            change(encoder)
        return encoder.frozen_key()

    first = key()
    assert first == key() == key(lambda e: e.out.weight.add_(1)) == key(layer_drop=0.5)
    assert first == key(lambda e: e.hubert.encoder.layers[2].final_layer_norm.weight.add_(1))
    assert key(lambda e: e.hubert.encoder.layers[1].final_layer_norm.weight.add_(1)) != first
    assert key(lambda e: e.hubert.feature_projection.projection.bias.add_(1)) != first
    assert key(frozen_layers=1) != first
    assert key(train_projection=True) != first
    assert key(spec_augment=True) != first


@pytest.mark.parametrize(("frozen", "first"), [(0, 0), (2, 2), (-1, None)])
def test_wav2vec2_trains_the_layers_above_the_frozen_ones(frozen: int, first: int | None, hubert_source: Path) -> None:
    """0 freezes the convolutions alone, further layers go with the feature projection, −1 freezes all."""
    encoder = Wav2Vec2Encoder(dim=None, source=str(hubert_source), frozen_layers=frozen, edges=False)
    trained = {name for name, weight in encoder.network.named_parameters() if weight.requires_grad}
    layers = {int(name.split(".")[2]) for name in trained if name.startswith("encoder.layers.")}
    assert layers == (set() if first is None else set(range(first, len(encoder.network.encoder.layers))))
    assert any(name.startswith("feature_projection.") for name in trained) == (frozen == 0)
    assert not any(name.startswith("feature_extractor.") for name in trained)
    assert any(name.startswith("encoder.pos_conv_embed.") for name in trained) == (frozen >= 0)
