"""Pictures of what the model can do by now, while it trains."""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Any, cast

from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.strategies import DDPStrategy, DeepSpeedStrategy
from lightning.pytorch.trainer.states import TrainerFn
from lightning.pytorch.utilities.seed import isolate_rng

from facediff import registry
from facediff.callbacks.sampling_preview_drawing import (
    ClipPreview,
    Drawing,
    borrowed,
    default_error_scale,
    first_of_each_subject,
    sampled,
    short_samples,
)
from facediff.callbacks.sampling_preview_loggers import Showcase, run_folder
from facediff.callbacks.sampling_preview_weights import averaged_weights
from facediff.data import Sample, SpeechMotionDataModule
from facediff.errors import FaceDiffError, MissingExtraError, choices
from facediff.render import VIEWS
from facediff.systems import SpeechAnimator


class SamplingPreview(Callback):
    """Draws the same few validation clips again and again: truth, prediction and error heat map, with sound.

    Where a callback averages weights (EMA), the averaged weights are what is drawn. Files appear in the run's folder as
    ``previews/epoch_0020/<clip>.mp4`` and ``.png``; Weights & Biases gets the videos and the table ``preview/clips``,
    TensorBoard a sheet of pictures and the sound; ``preview/seconds`` says what it cost. One process draws. Training is
    the same, digit for digit, with and without; a preview that fails is a warning. Where there are several of these
    callbacks, the last one counts, so that a config given later replaces the options.

    Args:
        every_n_epochs: draws at the first validation after every so many epochs; None draws at the end only.
        at_end: draws when training ends, unless its last weights have been drawn already.
        clips: how many clips: the first of each of so many people.
        names: validation clips to draw instead, by name.
        seconds: longest piece of a clip that is drawn, from its beginning.
        sampler: registered name of the sampler; the system's own if None.
        steps: its denoising steps; its own default if None.
        seed: seed of the noise, the same in every epoch.
        size: height of a panel in pixels; it is three quarters as wide.
        view: from where: ``front``, ``three_quarter`` or ``side``.
        error_scale: error that gets the last colour, in the corpus's unit of length; if None, the distance from the
            neutral face that one in a hundred vertices of the true motion exceed. The same in every epoch.

    Raises:
        FaceDiffError: if an option is impossible, or a named clip is no validation clip.
    """

    def __init__(
        self,
        every_n_epochs: int | None = 10,
        at_end: bool = True,
        clips: int = 2,
        names: list[str] | None = None,
        seconds: float = 4.0,
        sampler: str | None = "dpm_solver",
        steps: int | None = 10,
        seed: int = 0,
        size: int = 256,
        view: str = "front",
        error_scale: float | None = None,
    ) -> None:
        for option, value in (
            ("every_n_epochs", every_n_epochs),
            ("clips", clips),
            ("seconds", seconds),
            ("steps", steps),
            ("size", size),
            ("error_scale", error_scale),
        ):
            if value is not None and not value > 0:
                raise FaceDiffError(f"SamplingPreview: {option} is {value}, expected a number above zero")
        if view not in VIEWS:
            raise FaceDiffError(f'SamplingPreview: there is no view "{view}": {choices(view, VIEWS)}')
        if sampler is not None:
            registry.sampler.get(sampler)  # a wrong name is told now, not after hours of training
        self.every_n_epochs = every_n_epochs
        self.at_end = at_end
        self.clips = clips
        self.names = names
        self.seconds = seconds
        self.sampler = sampler
        self.steps = steps
        self.seed = seed
        self.drawing = Drawing(size=size, view=view)
        self.error_scale = error_scale
        self._chosen: list[str] = []
        self._showcase = Showcase()
        self._scale = error_scale
        self._drawn_epochs = 0
        self._drawn_step = -1

    @property
    def state_key(self) -> str:
        """Differs by the options, since several of these callbacks may be given."""
        return self._generate_state_key(
            every_n_epochs=self.every_n_epochs,
            at_end=self.at_end,
            clips=self.names or self.clips,
            seconds=self.seconds,
            size=self.drawing.size,
            view=self.drawing.view,
        )

    def state_dict(self) -> dict[str, Any]:
        """The error scale and what has been drawn, so that a resumed run goes on alike."""
        return {"error_scale": self._scale, "drawn_epochs": self._drawn_epochs, "drawn_step": self._drawn_step}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on where a checkpoint was; an error scale given as an option stays."""
        self._scale = self.error_scale or state_dict["error_scale"]
        self._drawn_epochs, self._drawn_step = state_dict["drawn_epochs"], state_dict["drawn_step"]

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Settle the clips, or say why there will be no preview."""
        data = trainer.datamodule  # type: ignore[attr-defined]
        if not isinstance(pl_module, SpeechAnimator) or not isinstance(data, SpeechMotionDataModule):
            raise FaceDiffError("SamplingPreview works with facediff's systems and data modules only")
        self._chosen = []
        if [found for found in trainer.callbacks if type(found) is type(self)][-1] is not self:  # type: ignore[attr-defined]
            return
        sharded = isinstance(trainer.strategy, DeepSpeedStrategy) or not isinstance(trainer.strategy, DDPStrategy)
        clips = data.clips("val")
        missing = [name for name in self.names or [] if name not in {clip.name for clip in clips}]
        if missing:
            raise FaceDiffError(f"SamplingPreview: {missing[0]} is no validation clip of {data.root}; see data.clips")
        if trainer.fast_dev_run:  # type: ignore[attr-defined]
            return
        if pl_module.assets.faces is None:
            if trainer.is_global_zero:  # no fault: the shipped configs ask for previews, whatever the corpus has
                files = " or ".join(data.mesh_files)
                print(f"no previews in this run: {data.root} holds no mesh to draw ({files})", flush=True)
        elif trainer.world_size > 1 and sharded:
            self._warn(trainer, f"{type(trainer.strategy).__name__} spreads a model over processes, and one draws")
        elif not clips:
            self._warn(trainer, f"there are no validation clips in {data.root}")
        else:
            self._chosen = self.names or first_of_each_subject(clips, self.clips)

    def on_validation_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: Any,  # noqa: ANN401
        batch: Any,  # noqa: ANN401
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """Draw beside the first batch, which every process has, if it is time: averaged weights are in place here."""
        fitting = trainer.state.fn == TrainerFn.FITTING and not trainer.sanity_checking
        if batch_idx or dataloader_idx or not fitting or self.every_n_epochs is None:
            return
        epochs = trainer.current_epoch + int(trainer.is_last_batch)
        if epochs // self.every_n_epochs > self._drawn_epochs // self.every_n_epochs:
            self._preview(trainer, pl_module, epochs)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Draw the last weights, averaged ones if there are any, whichever callback comes first."""
        if self.at_end and self._drawn_step != trainer.global_step:
            self._preview(trainer, pl_module, trainer.current_epoch, averaged_weights(trainer, pl_module))

    def _preview(
        self,
        trainer: Trainer,
        system: LightningModule,
        epochs: int,
        weights: AbstractContextManager[None] = nullcontext(),  # noqa: B008 - holds nothing
    ) -> None:
        """Draw with certain weights in place, on one process; nothing here waits for another process."""
        if not self._chosen or not trainer.is_global_zero:
            return
        start = time.perf_counter()
        self._drawn_epochs, self._drawn_step = epochs, trainer.global_step
        drawn: list[ClipPreview] = []
        # What fails is caught inside, since the random state would not be put back after an error.
        with isolate_rng(), self._surviving(f"after epoch {epochs}"), weights:
            folder = run_folder(trainer) / "previews" / f"epoch_{epochs:04d}"
            samples = short_samples(trainer.datamodule, self._chosen, self.seconds)  # type: ignore[attr-defined]
            self._scale = self._scale or default_error_scale(samples)
            for sample in samples:
                if not self._chosen:
                    break  # a package is missing, which has been told
                with self._surviving(f"of {sample.name} after epoch {epochs}"):
                    drawn.append(self._clip(trainer, cast(SpeechAnimator, system), sample, folder, epochs))
            for logger in trainer.loggers if drawn else []:
                with self._surviving(f"after epoch {epochs} for {type(logger).__name__}"):
                    self._showcase.show(logger, drawn, epochs, trainer.global_step)
                    seconds = time.perf_counter() - start
                    logger.log_metrics({"preview/seconds": seconds}, step=trainer.global_step)
            if drawn:
                names, seconds = ", ".join(clip.name for clip in drawn), time.perf_counter() - start
                print(f"preview after epoch {epochs}: {names} in {seconds:.1f} s, written to {folder}", flush=True)

    def _clip(self, trainer: Trainer, system: SpeechAnimator, sample: Sample, folder: Path, epochs: int) -> ClipPreview:
        with borrowed(system, self.sampler, self.steps), trainer.precision_plugin.forward_context():
            motion = sampled(system, sample, self.seed)
        scale = self._scale or default_error_scale([sample])
        return self.drawing.write(system, sample, motion, folder, epochs=epochs, error_scale=scale)

    @contextmanager
    def _surviving(self, what: str) -> Iterator[None]:
        """Turn an error into a warning; one that will come again each time ends the previews."""
        try:
            yield
        except MissingExtraError as error:
            self._chosen = []
            warnings.warn(f"no previews in this run: {error}", stacklevel=4)
        except Exception as error:
            reason = str(error) or type(error).__name__
            warnings.warn(f"the preview {what} failed, and training goes on: {reason}", stacklevel=4)

    def _warn(self, trainer: Trainer, why: str) -> None:
        if trainer.is_global_zero:
            warnings.warn(f"no previews in this run: {why}", stacklevel=3)
