"""Running the frozen part of an audio encoder once per clip instead of in every training step."""

from __future__ import annotations

from pathlib import Path

import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from tqdm import tqdm

from facediff.data import SpeechMotionDataModule
from facediff.data.features import CachedFeatures
from facediff.data.store import ArrayStore
from facediff.errors import FaceDiffError
from facediff.files import cache_dir
from facediff.systems import SpeechAnimator


class SpeechFeatureCache(Callback):
    """Keeps what the frozen part of the audio encoder makes of every training and validation clip on disk.

    The files are keyed by the frozen weights, the number of frozen layers, the precision and the speech itself, so a
    changed encoder or a changed recording never meets old features. Training on whole clips gives the same losses as
    without. Training on windows differs a little: the frozen part then hears the whole clip, not the window alone.

    Args:
        folder: where the features are kept; ``speech_features`` in the user's cache folder if None.
    """

    def __init__(self, folder: str | None = None) -> None:
        self.folder = Path(folder).expanduser() if folder is not None else cache_dir() / "speech_features"

    @torch.no_grad()
    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Encode what is not there yet, each process its share, and let the data module read it.

        Raises:
            FaceDiffError: if the audio encoder has no frozen part.
        """
        data = trainer.datamodule  # type: ignore[attr-defined]
        if not isinstance(pl_module, SpeechAnimator) or not isinstance(data, SpeechMotionDataModule):
            raise FaceDiffError("SpeechFeatureCache works with facediff's systems and data modules only")
        encoder = pl_module.speech_encoder
        key = encoder.frozen_key()
        if key is None:
            raise FaceDiffError(
                f"SpeechFeatureCache: the audio encoder {type(encoder).__name__} has no frozen part to keep (or "
                f"spec_augment is on); leave the callback away, or take one that has, e.g. --model.audio_encoder=hubert"
            )
        features = CachedFeatures(ArrayStore(self.folder), f"{key}:{trainer.precision}")
        clips = [*data.clips("train"), *data.clips("val")]
        rank, world = trainer.global_rank, trainer.world_size
        shown = tqdm(
            clips, desc="speech features", leave=False, disable=rank > 0 or trainer.progress_bar_callback is None
        )
        for place, clip in enumerate(shown):
            audio = features.add(data.corpus, clip)
            if audio is None or place % world != rank:
                continue
            batch = audio[None].to(pl_module.device)
            with trainer.precision_plugin.forward_context():
                encoded, lengths = encoder.frozen_features(batch, torch.tensor([audio.numel()], device=batch.device))
            features.put(clip, encoded[0, : int(lengths[0])])
        trainer.strategy.barrier("speech features")
        data.features.reader = features
