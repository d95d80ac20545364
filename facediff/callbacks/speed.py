"""Callbacks that make training quicker: cached speech features, and parts of the network compiled by PyTorch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from torch import nn

from facediff.callbacks.runs import require_facediff
from facediff.data.dataset import CachedFeatures
from facediff.errors import FaceDiffError, check_known
from facediff.utils.arrays import ArrayStore
from facediff.utils.files import cache_dir
from facediff.utils.hints import checks_arguments
from facediff.utils.progress import track

Backend = Callable[..., Any]
"""Your own compiler, as ``torch.compile`` takes it."""


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
                f"{type(encoder).__name__} has no frozen part (or spec_augment is on); omit the callback, or use an "
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


class CompiledTraining(Callback):
    """Compiles parts of the network with ``torch.compile`` for the training steps.

    Checkpoints are as without it: parts are compiled in place and keep their names. Validation, previews and everything
    after training run the uncompiled parts. Each part is compiled once for all lengths of clips; the first steps wait
    for that, a minute or so. Losses are the same but for rounding and dropout's random numbers.

    Args:
        parts: names of submodules of the model's network, such as ``decoder`` or ``style_encoder``.
        backend: of ``torch.compile``. The usual one needs a C++ compiler on a processor, and
            Triton and a C compiler on a GPU.
    """

    @checks_arguments
    def __init__(self, parts: Sequence[str] = ("fusion", "decoder"), backend: str | Backend = "inductor") -> None:
        self.parts = list(parts)
        self.backend = backend
        self._compiled: list[nn.Module] = []

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Find the parts."""
        network = getattr(pl_module, "network", None) or nn.Module()
        modules = dict(network.named_modules())
        check_known("CompiledTraining.parts", "part of the network", self.parts, [*filter(None, modules)])
        self._compiled = [modules[name] for name in self.parts]

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Mark the parts; each is compiled when it is first used."""
        for part in self._compiled:
            if part._compiled_call_impl is None:
                part.compile(backend=self.backend, dynamic=True)

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Use the compiled parts again; a run that is resumed within an epoch begins without this hook."""
        self.on_train_start(trainer, pl_module)

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Other callbacks that act when training has ended, such as a last preview, run the uncompiled parts."""
        self._undo()

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Sampling runs a part on shapes of its own, and would compile it for each of them."""
        self._undo()

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Use the compiled parts again."""
        if self._compiled and not trainer.sanity_checking:
            self.on_train_start(trainer, pl_module)

    def on_fit_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Leave the model as it was."""
        self._undo()
        self._compiled = []

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        """Leave the model as it was, also after an interruption."""
        self.on_fit_end(trainer, pl_module)

    def _undo(self) -> None:
        for part in self._compiled:
            part._compiled_call_impl = None
