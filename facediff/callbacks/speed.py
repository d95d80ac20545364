"""Callbacks that make training quicker: cached speech features, and parts of the network compiled by PyTorch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from torch import nn

from facediff.data import SpeechMotionDataModule
from facediff.data.dataset import CachedFeatures
from facediff.errors import FaceDiffError
from facediff.models import AnimationModel
from facediff.utils.arrays import ArrayStore
from facediff.utils.files import cache_dir
from facediff.utils.hints import checks_arguments
from facediff.utils.progress import track

Backend = Callable[..., Any]
"""A compiler of one's own, as ``torch.compile`` takes it."""


class SpeechFeatureCache(Callback):
    """Runs the frozen part of the audio encoder once per clip, and keeps its features on disk.

    The files are keyed by the frozen weights, the number of frozen layers, the precision and the speech itself, so a
    changed encoder or a changed recording never gets old features. Training on whole clips gives the same losses as
    without. Training on windows differs a little: the frozen part then hears the whole clip, not the window alone.

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
        if not isinstance(pl_module, AnimationModel) or not isinstance(data, SpeechMotionDataModule):
            raise FaceDiffError("SpeechFeatureCache works with facediff's models and data modules only")
        if not pl_module.hears_whole_clips:
            raise FaceDiffError(
                f"SpeechFeatureCache: {type(pl_module).__name__} encodes pieces of the speech that are cut anew in "
                f"each step, so that there is nothing to keep; omit the callback"
            )
        encoder = pl_module.speech_encoder
        key = encoder.frozen_key()
        if key is None:
            raise FaceDiffError(
                f"SpeechFeatureCache: the audio encoder {type(encoder).__name__} has no frozen part to keep (or "
                f"spec_augment is on); omit the callback, or use one that has, e.g. --model.audio_encoder=hubert"
            )
        features = CachedFeatures(ArrayStore(self.folder), f"{key}:{trainer.precision}")
        clips = [*data.clips("train"), *data.clips("val")]
        rank, world = trainer.global_rank, trainer.world_size
        shown = track(clips, "speech features", shown=rank == 0 and trainer.progress_bar_callback is not None)
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


class CompiledTraining(Callback):
    """Compiles parts of the network with ``torch.compile`` for the training steps.

    Checkpoints are as without it: parts are compiled in place and keep their names. Validation, previews and everything
    after training run the uncompiled parts. Each part is compiled once for all lengths of clips; the first steps wait
    for that, a minute or so. Losses are the same but for rounding and dropout's random numbers.

    Args:
        parts: names of submodules of the model's network, such as ``decoder`` or ``style_encoder``.
        backend: what compiles, as ``torch.compile`` calls it. The usual one needs a C++ compiler on a processor, and
            Triton and a C compiler on a GPU.
    """

    @checks_arguments
    def __init__(self, parts: Sequence[str] = ("fusion", "decoder"), backend: str | Backend = "inductor") -> None:
        self.parts = list(parts)
        self.backend = backend
        self._compiled: list[nn.Module] = []

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Find the parts."""
        network = getattr(pl_module, "network", None)
        if not isinstance(network, nn.Module):
            raise FaceDiffError(
                f"CompiledTraining: {type(pl_module).__name__} has no network whose parts could be compiled; omit "
                f"the callback"
            )
        modules = dict(network.named_modules())
        for name in self.parts:
            if name not in modules or not name:
                there = ", ".join(child for child, _ in network.named_children())
                raise FaceDiffError(
                    f'CompiledTraining.parts: the network has no part "{name}"; choose among {there}, or parts of these'
                )
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
