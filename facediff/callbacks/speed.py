"""A callback that makes training quicker: cached speech features."""

from __future__ import annotations

from pathlib import Path

import torch
from lightning.pytorch import Callback, LightningModule, Trainer

from facediff.callbacks.runs import require_facediff
from facediff.data.dataset import CachedFeatures
from facediff.errors import FaceDiffError
from facediff.utils.arrays import ArrayStore
from facediff.utils.files import cache_dir
from facediff.utils.hints import checks_arguments
from facediff.utils.progress import track


class SpeechFeatureCache(Callback):
    """Runs the frozen part of the audio encoder once per clip, and keeps its features on disk.

    The files are keyed by the frozen weights, the number of frozen layers, the precision and the speech itself, so a
    changed encoder or a changed recording never gets old features. Training on whole clips gives the same losses as
    without. Training on windows differs a little: the frozen part then encodes the entire clip, not the window.

    Args:
        folder: where the features are kept; ``speech_features`` in the user's cache folder if None.
    """

    @checks_arguments
    def __init__(self, folder: str | None = None) -> None:
        self.folder = Path(folder).expanduser() if folder is not None else cache_dir() / "speech_features"

    @torch.no_grad()
    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Encode the clips that have no features yet, each process its share, and let the data module read all."""
        data = trainer.datamodule  # type: ignore[attr-defined]
        model = require_facediff(self, pl_module, data)
        encoder = model.speech_encoder
        key = encoder.frozen_key() if model.encodes_whole_clips else None
        if key is None:
            raise FaceDiffError(
                f"SpeechFeatureCache: {type(model).__name__} encodes random pieces of the speech, or its audio encoder "
                f"{type(encoder).__name__} has no frozen part; omit the callback, or use an "
                f"encoder with one, e.g. --model.audio_encoder=hubert"
            )
        features = CachedFeatures(ArrayStore(self.folder), f"{key}:{trainer.precision}")
        clips = [*data.clips("train"), *data.clips("val")]
        rank, world = trainer.global_rank, trainer.world_size
        progress = track(clips, "speech features", shown=rank == 0 and trainer.progress_bar_callback is not None)
        for index, clip in enumerate(progress):
            audio = features.add(data.corpus, clip)
            if audio is None or index % world != rank:
                continue
            batch = audio[None].to(model.device)
            with trainer.precision_plugin.forward_context():
                encoded, lengths = encoder.frozen_features(batch, torch.tensor([audio.numel()], device=batch.device))
            features.put(clip, encoded[0, : int(lengths[0])])
        trainer.strategy.barrier("speech features")
        data.features.reader = features
