"""What every published method gets of training: processes, 16 bits, kept features, adaptation, policies, previews."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile
import torch
from lightning.pytorch import Callback, LightningDataModule, LightningModule, Trainer, seed_everything

from facediff.callbacks import SpeechFeatureCache
from facediff.cli.app import main
from facediff.errors import FaceDiffError
from facediff.models import AnimationModel, load_model
from facediff.models.published.importing import save_model
from facediff.models.speech_networks import Wav2Vec2Encoder
from tests.fakes.fixtures import quiet_trainer
from tests.fakes.tiny import RATE, SEEN, UNSEEN, VERTICES, Tiny
from tests.models.published.conftest import TEXT
from tests.models.published.test_laws import with_assets

MakeMethod = Callable[..., AnimationModel]
MakeTrainer = Callable[..., Trainer]
SPEECH: dict[str, Any] = {"audio_encoder": partial(Wav2Vec2Encoder, config=TEXT), "audio_dim": None}
DROPPING: dict[str, Any] = {
    "audio_encoder": partial(
        Wav2Vec2Encoder, config={**TEXT, "num_hidden_layers": 3}, spec_augment=True, layer_drop=0.5
    ),
    "audio_dim": None,
}
"""With layers that are skipped, and masks, at random in each process."""


class Losses(Callback):
    def __init__(self) -> None:
        self.found: list[float] = []

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, outputs: Any, *_: object) -> None:  # noqa: ANN401
        self.found.append(float(outputs["loss"]))


class Together(Callback):
    """Lets each process draw numbers of its own, and notes what it has at the end."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        torch.manual_seed(trainer.global_rank)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        finite = all(bool(value.isfinite().all()) for value in pl_module.parameters())
        noted = [trainer.global_step, finite, digest(pl_module)]
        (self.folder / f"{trainer.global_rank}.json").write_text(json.dumps(noted))


def digest(model: LightningModule) -> str:
    """Of all weights."""
    values = [value.detach().double().numpy().tobytes() for value in model.state_dict().values()]
    return hashlib.sha256(b"".join(values)).hexdigest()


def train_together(model: LightningModule, data: LightningDataModule, folder: Path, **options: Any) -> None:  # noqa: ANN401
    """Two processes train one model, though in each other layers are skipped and other steps are masked."""
    before = digest(model)
    limits = {"limit_train_batches": 2, "limit_val_batches": 1, "callbacks": [Together(folder)]}
    quiet_trainer(folder, devices=2, strategy="ddp_fork", **limits, **options).fit(model, datamodule=data)
    one, other = (json.loads((folder / f"{rank}.json").read_text()) for rank in range(2))
    assert one == other
    assert one[:2] == [2, True]
    assert one[2] != before


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_two_processes_train_one_model(method: str, make_method: MakeMethod, tiny_root: Path, tmp_path: Path) -> None:
    train_together(make_method(method, **DROPPING), Tiny(root=str(tiny_root), batch_size=2), tmp_path)


@pytest.mark.two_methods
def test_kept_speech_features_change_no_loss(
    method: str, make_method: MakeMethod, make_trainer: MakeTrainer, tiny: Tiny, tmp_path: Path
) -> None:
    found, encoded = [], []
    for callbacks in ([], [SpeechFeatureCache(str(tmp_path))], [SpeechFeatureCache(str(tmp_path))]):
        seed_everything(1, verbose=False)
        model, clips, losses = make_method(method, **SPEECH), [], Losses()
        if callbacks and not model.encodes_whole_clips:
            with pytest.raises(FaceDiffError, match=f"SpeechFeatureCache: {method}"):
                make_trainer(callbacks=callbacks).fit(model, datamodule=tiny)
            return
        model.audio_encoder.network.feature_extractor.register_forward_pre_hook(
            lambda _, given, clips=clips: clips.append(len(given[0]))
        )
        make_trainer(limit_train_batches=2, limit_val_batches=0, callbacks=[losses, *callbacks]).fit(
            model, datamodule=tiny
        )
        found.append(losses.found)
        encoded.append(len(clips))
    assert len(found[0]) == 2
    assert found[1] == pytest.approx(found[0], rel=1e-5)
    assert found[2] == found[1]
    assert encoded[0] > 0
    assert encoded[2] == 0  # not even once


def test_speech_features_of_an_encoder_without_a_frozen_part_are_not_kept(
    method: str, make_method: MakeMethod, make_trainer: MakeTrainer, tiny: Tiny, tmp_path: Path
) -> None:
    with pytest.raises(FaceDiffError, match="SpeechFeatureCache"):
        make_trainer(callbacks=[SpeechFeatureCache(str(tmp_path))]).fit(make_method(method), datamodule=tiny)


@pytest.mark.two_methods
def test_the_command_line_adapts_animates_in_windows_and_exports(
    method: str, make_method: MakeMethod, tiny_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = with_assets(make_method(method))
    checkpoint, adapted = tmp_path / "model.ckpt", tmp_path / "adapted.ckpt"
    model.data_source = {"class_path": "tests.fakes.tiny.Tiny", "root": str(tiny_root)}
    save_model(model, checkpoint)
    words = ["--checkpoint", str(checkpoint), "--person", UNSEEN, "-o", str(adapted), "--quiet"]
    words += ["--epochs", "1", "--accelerator", "cpu"]
    words += ["--corpus", "tests.fakes.tiny.Tiny", "--data-root", str(tiny_root)]
    assert main(["adapt", *words]) == 0
    grown = load_model(adapted)
    assert grown.identities == [UNSEEN, *SEEN]
    wave = np.sin(np.arange(3 * 16_000) / 9.0)
    soundfile.write(tmp_path / "speech.wav", 0.1 * wave, 16_000)
    spoken = [str(tmp_path / "speech.wav"), "--checkpoint", str(adapted), "--identity", UNSEEN, "--window", "1"]
    assert main(["animate", *spoken, "-o", str(tmp_path / "face.glb"), "--quiet"]) == 0
    frames = re.search(r"(\d+) frames", capsys.readouterr().out)
    assert frames is not None
    assert int(frames[1]) in (3 * RATE, 3 * RATE - 1)
    assert (tmp_path / "face.glb").stat().st_size > int(frames[1]) * VERTICES
