"""Training from cached features of a frozen encoder is training without them, only quicker."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import lightning.pytorch as pl
import pytest
import torch

from facediff import registry
from facediff.callbacks import SpeechFeatureCache
from facediff.models import DualPathDiffusion
from tests.fakes.tiny import Tiny

MakeModel = Callable[..., DualPathDiffusion]
MakeTrainer = Callable[..., pl.Trainer]


class Losses(pl.Callback):
    def __init__(self) -> None:
        self.found: list[float] = []

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: object, *_: object
    ) -> None:
        self.found.append(float(outputs["loss"]))  # type: ignore[index]

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        self.found.append(float(trainer.callback_metrics["val/loss"]))


@pytest.fixture
def losses(
    make_model: MakeModel, make_trainer: MakeTrainer, hubert_source: Path, tiny_root: Path
) -> Callable[..., tuple[list[float], int]]:
    """Losses of two epochs of training and validation, and how many clips went through the convolutions."""

    def train(
        *callbacks: pl.Callback, window: int | None = None, frozen: int = 2, **options: object
    ) -> tuple[list[float], int]:
        encoder = partial(registry.audio_encoder.hubert, source=str(hubert_source), frozen_layers=frozen)
        pl.seed_everything(1, workers=True, verbose=False)
        model = make_model(audio_encoder=encoder, **options)
        clips: list[int] = []
        model.network.audio_encoder.hubert.feature_extractor.register_forward_pre_hook(
            lambda _, args: clips.append(len(args[0]))
        )
        spy = Losses()
        data = Tiny(root=str(tiny_root), window=window, max_frames_per_batch=60)
        trainer = make_trainer(max_epochs=2, callbacks=[spy, *callbacks])
        trainer.fit(model, datamodule=data)
        return spy.found, sum(clips)

    return train


@pytest.mark.parametrize(
    "frozen", [pytest.param(0, marks=pytest.mark.slow), 2, pytest.param(-1, marks=pytest.mark.slow)]
)
def test_speech_feature_cache_gives_the_same_losses(
    losses: Callable[..., tuple[list[float], int]], tmp_path: Path, frozen: int
) -> None:
    without, _ = losses(frozen=frozen)
    making, encoded = losses(SpeechFeatureCache(str(tmp_path)), frozen=frozen)
    reading, encoded_again = losses(SpeechFeatureCache(str(tmp_path)), frozen=frozen)
    assert len(without) >= 8
    assert making == pytest.approx(without, rel=1e-6)
    assert reading == making
    # Eight training clips and two for validation, once each; then never again, though each is used in both epochs.
    # (Lightning's summary and sampling run no encoder; validation samples from cached features too.)
    assert (encoded, encoded_again) == (10, 0)


def test_speech_feature_cache_works_with_a_schedule(
    losses: Callable[..., tuple[list[float], int]], tmp_path: Path
) -> None:
    """It has the loaders made before the features are there."""
    _, encoded = losses(SpeechFeatureCache(str(tmp_path)), lr_schedule="cosine", warmup_steps=2)
    assert encoded == 10


def test_speech_feature_cache_gives_windows_their_part(
    losses: Callable[..., tuple[list[float], int]], tmp_path: Path
) -> None:
    found, encoded = losses(SpeechFeatureCache(str(tmp_path)), window=7)
    assert all(map(torch.isfinite, map(torch.tensor, found)))
    assert encoded == 10
