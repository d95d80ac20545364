"""Pictures and videos of a model's motion while it trains.

From top to bottom: when the callback draws and with which weights; how one clip is generated and drawn; how the loggers
show it.
"""

from __future__ import annotations

import itertools
import time
import warnings
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, cast

import numpy as np
import numpy.typing as npt
import torch
from jaxtyping import Float
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import WeightAveraging
from lightning.pytorch.loggers import Logger, TensorBoardLogger, WandbLogger
from lightning.pytorch.strategies import DDPStrategy, DeepSpeedStrategy
from lightning.pytorch.trainer.states import TrainerFn
from lightning.pytorch.utilities.seed import isolate_rng
from torch import Tensor

from facediff import registry
from facediff.callbacks.runs import require_facediff, run_folder
from facediff.data import Sample, SpeechMotionDataModule, collate
from facediff.data.corpus import Clip
from facediff.errors import MissingExtraError, check_known
from facediff.metrics import SequenceMetric
from facediff.metrics.base import align
from facediff.models import AnimationModel
from facediff.render import VIEWS, Camera, Renderer, comparison, contact_sheet, portrait, save_image, write_video
from facediff.speech.audio import fit_length, samples_for
from facediff.utils import SAMPLE_RATE
from facediff.utils.hints import checks_arguments
from facediff.utils.ranges import Range

Picture = npt.NDArray[np.uint8]

PICTURES = 6  # Frames on a sheet of pictures
COLUMNS = 2  # Pictures in a row of a sheet
ASPECT = 0.75
"""Width of a panel as a share of its height: heads are higher than wide, and empty ground costs as much as a face."""


class SamplingPreview(Callback):
    """Draws the same few validation clips again and again: truth, prediction and error heat map, with sound.

    Where a callback averages weights (EMA), the averaged weights are drawn. Files appear in the run's folder as
    ``previews/epoch_0020/<clip>.mp4`` and ``.png``; Weights & Biases gets the videos and the table ``preview/clips``,
    TensorBoard a sheet of pictures and the sound; ``preview/seconds`` is the drawing time. One process draws.
    Training is the same, digit for digit, with and without; a preview that fails is a warning. Where there are several
    of these callbacks, the last one counts, so that a config given later replaces the options.

    Args:
        every_n_epochs: draws at the first validation after every so many epochs; None draws at the end only.
        at_end: draws when training ends, unless its last weights have been drawn already.
        clips: how many clips: the first of each of so many speakers.
        names: validation clips to draw instead, by name.
        seconds: longest piece of a clip that is drawn, from its beginning.
        sampler: registered name of the sampler; the model's own if None, or if it has no such sampler.
        steps: its denoising steps; its own default if None.
        seed: seed of the noise, the same in every epoch.
        size: height of a panel in pixels; it is three quarters as wide.
        view: from where: ``front``, ``three_quarter`` or ``side``.
        error_scale: error that gets the last colour, in the corpus's unit of length; if None, the distance from the
            neutral face that one in a hundred vertices of the true motion exceed. The same in every epoch.
    """

    @checks_arguments
    def __init__(
        self,
        every_n_epochs: Annotated[int, Range(1, 10**9)] | None = 10,
        at_end: bool = True,
        clips: Annotated[int, Range(1, 10_000)] = 2,
        names: list[str] | None = None,
        seconds: Annotated[float, Range(0, 3600, above=True)] = 4.0,
        sampler: str | None = "dpm_solver",
        steps: Annotated[int, Range(1, 100_000)] | None = 10,
        seed: Annotated[int, Range(0, 2**64 - 1)] = 0,
        size: Annotated[int, Range(16, 4096)] = 256,
        view: str = "front",
        error_scale: Annotated[float, Range(0, above=True)] | None = None,
    ) -> None:
        check_known("SamplingPreview.view", "view", [view], VIEWS)
        if sampler is not None:
            registry.sampler.get(sampler)  # a wrong name is an error here, not after hours of training
        self.every_n_epochs = every_n_epochs
        self.at_end = at_end
        self.clips = clips
        self.names = names
        self.seconds = seconds
        self.sampler = sampler
        self.steps = steps
        self.seed = seed
        self.size = size
        self.view = view
        self.error_scale = error_scale
        self._chosen: list[str] = []
        self._tables: dict[int, Any] = {}
        self._scale = error_scale

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Choose the clips, or report why there will be no preview."""
        data = trainer.datamodule  # type: ignore[attr-defined]
        model = require_facediff(self, pl_module, data)
        self._chosen, self._scale = [], self.error_scale
        if [callback for callback in trainer.callbacks if type(callback) is type(self)][-1] is not self:  # type: ignore[attr-defined]
            return
        clips = data.clips("val")
        check_known("SamplingPreview.names", "validation clip", self.names or (), [clip.name for clip in clips])
        if trainer.fast_dev_run:  # type: ignore[attr-defined]
            return
        # DeepSpeed's strategy is a DDPStrategy, but spreads the weights over processes like FSDP.
        sharded = isinstance(trainer.strategy, DeepSpeedStrategy) or not isinstance(trainer.strategy, DDPStrategy)
        if model.assets.scored.faces is None:
            if trainer.is_global_zero:  # no fault: the bundled configs ask for previews of any corpus
                files = " or ".join(data.mesh_files) or "its class names no mesh_files"
                print(f"no previews in this run: {data.root} holds no mesh to draw ({files})", flush=True)
        elif trainer.world_size > 1 and sharded:
            self._warn(trainer, f"{type(trainer.strategy).__name__} spreads a model over processes, and one draws")
        elif not clips:
            self._warn(trainer, f"there are no validation clips in {data.root}")
        else:
            self._chosen = self.names or first_of_each_identity(clips, self.clips)

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """A training that is resumed goes on counting epochs."""
        self._drawn_epochs, self._drawn_step = trainer.current_epoch, -1

    def on_validation_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: Any,  # noqa: ANN401
        batch: Any,  # noqa: ANN401
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """Draw after the first batch, which every process has, if it is time: averaged weights are in place here."""
        fitting = trainer.state.fn == TrainerFn.FITTING and not trainer.sanity_checking
        if batch_idx or dataloader_idx or not fitting or self.every_n_epochs is None:
            return
        epochs = trainer.current_epoch + int(trainer.is_last_batch)
        if epochs // self.every_n_epochs > self._drawn_epochs // self.every_n_epochs:
            self._preview(trainer, pl_module, epochs)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Draw the last weights, averaged ones if there are any, in any order of the callbacks."""
        if self.at_end and self._drawn_step != trainer.global_step:
            self._preview(trainer, pl_module, trainer.current_epoch, averaged_weights(trainer, pl_module))

    def _preview(
        self,
        trainer: Trainer,
        model: LightningModule,
        epochs: int,
        weights: AbstractContextManager[None] = nullcontext(),  # noqa: B008 - holds nothing
    ) -> None:
        """Draw with certain weights in place, on one process; nothing here waits for another process."""
        if not self._chosen or not trainer.is_global_zero:
            return
        start = time.perf_counter()
        self._drawn_epochs, self._drawn_step = epochs, trainer.global_step
        previews: list[ClipPreview] = []
        # Errors are caught inside, since the random state would not be put back after one.
        with isolate_rng(), self._surviving(f"after epoch {epochs}"), weights:
            folder = run_folder(trainer) / "previews" / f"epoch_{epochs:04d}"
            # The first seconds of the clips, read from disk without a loader.
            data: SpeechMotionDataModule = trainer.datamodule  # type: ignore[attr-defined]
            dataset = data.dataset("val")
            dataset.window = max(1, round(self.seconds * data.frame_rate))
            indices = {clip.name: index for index, clip in enumerate(dataset.clips)}
            samples = [dataset[indices[name]] for name in self._chosen]
            self._scale = self._scale or default_error_scale(samples)
            for sample in samples:
                if not self._chosen:
                    break  # a package is missing, and a warning has been given
                with self._surviving(f"of {sample.name} after epoch {epochs}"):
                    previews.append(self._clip(trainer, cast(AnimationModel, model), sample, folder, epochs))
            for logger in trainer.loggers if previews else []:
                with self._surviving(f"after epoch {epochs} for {type(logger).__name__}"):
                    show(logger, previews, epochs, trainer.global_step, self._tables)
                    seconds = time.perf_counter() - start
                    logger.log_metrics({"preview/seconds": seconds}, step=trainer.global_step)
            if previews:
                names, seconds = ", ".join(clip.name for clip in previews), time.perf_counter() - start
                print(f"preview after epoch {epochs}: {names} in {seconds:.1f} s, written to {folder}", flush=True)

    def _clip(self, trainer: Trainer, model: AnimationModel, sample: Sample, folder: Path, epochs: int) -> ClipPreview:
        precision = trainer.precision_plugin
        with borrowed(model, self.sampler, self.steps), precision.forward_context(), torch.inference_mode():
            clip = model.with_person_styles(precision.convert_input(collate([sample]).to(model.device)))
            motion = model.generate(clip, seed=self.seed)[0].float().cpu()
        scale = self._scale or default_error_scale([sample])
        return draw_clip(model, sample, motion, folder, epochs, error_scale=scale, size=self.size, view=self.view)

    @contextmanager
    def _surviving(self, step: str) -> Iterator[None]:
        """Turn an error into a warning; one that will come again each time ends the previews."""
        try:
            yield
        except MissingExtraError as error:
            self._chosen = []
            warnings.warn(f"no previews in this run: {error}", stacklevel=4)
        except Exception as error:
            reason = str(error) or type(error).__name__
            warnings.warn(f"the preview {step} failed, and training goes on: {reason}", stacklevel=4)

    def _warn(self, trainer: Trainer, why: str) -> None:
        if trainer.is_global_zero:
            warnings.warn(f"no previews in this run: {why}", stacklevel=3)


@contextmanager
def averaged_weights(trainer: Trainer, model: LightningModule) -> Iterator[None]:
    """A context with the weights of a checkpoint in the model; its own are put back afterwards."""
    # At the end of training, callbacks before the averaging one see the raw weights and later ones the averaged. Saved
    # as into a checkpoint, the averaged ones are obtained in any order.
    averaging = next((callback for callback in trainer.callbacks if isinstance(callback, WeightAveraging)), None)  # type: ignore[attr-defined]
    checkpoint: dict[str, Any] = {"state_dict": {}}
    if averaging is not None:
        averaging.on_save_checkpoint(trainer, model, checkpoint)
    averaged: dict[str, Tensor] = checkpoint["state_dict"]
    weights = {name: tensor for name, tensor in model.state_dict().items() if name in averaged}
    copies = {name: tensor.clone() for name, tensor in weights.items()}
    try:
        copy_weights(averaged, weights)
        yield
    finally:
        copy_weights(copies, weights)


@torch.no_grad()
def copy_weights(source: dict[str, Tensor], target: dict[str, Tensor]) -> None:
    """Copy all weights of ``target`` by name."""
    for name, tensor in target.items():
        tensor.copy_(source[name])


@contextmanager
def borrowed(model: AnimationModel, sampler: str | None, steps: int | None) -> Iterator[None]:
    """A model in evaluation mode with another sampler, if it has that one; both are put back afterwards."""
    with model.choosing():
        # Methods with their own way of sampling keep it.
        if (sampler is not None or steps is not None) and model.has_sampler(sampler):
            model.choose_sampler(sampler, steps)
        yield


def first_of_each_identity(clips: Sequence[Clip], count: int) -> list[str]:
    """Names of ``count`` clips (fewer if there are no more): each identity's first, then each one's second …."""
    rounds: dict[str, Iterator[int]] = defaultdict(itertools.count)
    return [clip.name for clip in sorted(clips, key=lambda clip: next(rounds[clip.identity]))[:count]]


def default_error_scale(samples: Sequence[Sample]) -> float:
    """A scale for errors from the true motion, in its unit, to two digits.

    The distance from the neutral face that one in a hundred vertices and frames exceed; a hundredth of the face's size
    where nothing moves.
    """
    reach = torch.cat([torch.linalg.vector_norm(sample.motion.float(), dim=-1).flatten() for sample in samples])
    size = float((samples[0].template.amax(0) - samples[0].template.amin(0)).max())
    return float(f"{np.quantile(reach.numpy(), 0.99) or 0.01 * size:.2g}")


@dataclass(frozen=True)
class ClipPreview:
    """The drawing of a clip."""

    name: str
    video: Path
    sheet: Picture  # frames of it on one picture (height, width, 3), sRGB
    audio: npt.NDArray[np.float32]  # its sound (samples,) at 16 kHz
    scores: dict[str, float]  # the protocol's metrics of the seconds drawn, by name


def draw_clip(
    model: AnimationModel,
    sample: Sample,
    motion: Float[Tensor, "frames points dims"],
    folder: Path,
    epochs: int,
    *,
    error_scale: float,
    size: int,
    view: str,
) -> ClipPreview:
    """Draw truth, prediction and error of one clip, and write the video and the sheet; each whole or not at all.

    The motion is offsets from the template, and the files get the clip's name; ``error_scale`` (in the corpus's unit),
    ``size`` and ``view`` are as in :class:`SamplingPreview`.
    """
    assets, name = model.assets.scored, sample.identity_name
    clip_scores = scores(model, sample, motion)
    corpus = f"{assets.corpus}, synthetic corpus" if assets.synthetic else assets.corpus
    template, width = assets.template(name).numpy(), round(ASPECT * size)
    truth, motion = (model.assets.to_scored(offsets, name) for offsets in (sample.motion, motion))
    framed = portrait(template, {name: indices.numpy() for name, indices in assets.regions.items()})
    renderer = Renderer(
        cast(Tensor, assets.faces).numpy(),
        template=template,
        size=(size, width),
        camera=Camera.framing(framed, view=view, aspect=width / size),
        colours=None if (colours := assets.colours_of(name)) is None else colours.numpy(),
    )
    frames = comparison(
        renderer,
        truth.numpy() + template,
        motion.numpy() + template,
        highest=error_scale,
        scale_label=length(error_scale, assets.unit),
        footer=f"{sample.name} after epoch {epochs}: {lip_score(clip_scores)} ({corpus})",
    )
    count, rate = len(motion), assets.frame_rate
    picks = [round((i + 0.5) * (count - 1) / PICTURES) for i in range(PICTURES)]
    picked: dict[int, Picture] = {}

    def remembering(frames: Iterable[Picture]) -> Iterator[Picture]:
        # The video is written while it is drawn; the sheet's frames are kept on the way.
        for index, frame in enumerate(frames):
            if index in picks:
                picked[index] = frame
            yield frame

    sound = fit_length(sample.audio.numpy(), samples_for(count, rate))
    video = folder / f"{sample.name}.mp4"
    write_video(video, remembering(frames), rate, sound, SAMPLE_RATE)
    times = [f"{pick / rate:.2f} s" for pick in picks]
    sheet = contact_sheet([picked[pick] for pick in picks], COLUMNS, labels=times)
    save_image(video.with_suffix(".png"), sheet)
    return ClipPreview(sample.name, video, sheet, sound, clip_scores)


def scores(model: AnimationModel, sample: Sample, motion: Tensor) -> dict[str, float]:
    """The protocol's metrics of one clip; in this process alone."""
    evaluation, truth = model.evaluation, sample.motion
    if not evaluation.protocol.channels:
        truth, motion = (model.assets.to_scored(offsets, sample.identity_name) for offsets in (truth, motion))
    collection = evaluation.metrics["val"]["model"].clone().to(motion.device)
    metrics = cast(Iterable[tuple[str, SequenceMetric]], collection.items(copy_state=False))
    (clip,) = align(motion[None], truth[None], clip_names=[sample.name]).clips
    return {name: float(metric.clip_value(clip)) for name, metric in metrics}


def lip_score(clip_scores: dict[str, float]) -> str:
    """The error of the lips, or of all vertices, with its name."""
    title = "lve" if "lve" in clip_scores else "mve"
    return f"{title.upper()} {clip_scores[title]:.3g}"


def length(value: float, unit: str) -> str:
    """A length in a readable unit: small parts of a metre in millimetres."""
    return f"{value * 1000:.3g} mm" if unit == "m" else f"{value:.3g} {unit}"


def show(logger: Logger, clips: Sequence[ClipPreview], epochs: int, step: int, tables: dict[int, Any]) -> None:
    """Give the clips of one epoch to a logger; those without pictures leave them to the files in the run's folder.

    Weights & Biases gets a video per clip and a table that grows by the clips of every epoch (``tables`` holds one for
    each logger), TensorBoard the sheet of pictures and the sound.
    """
    if isinstance(logger, TensorBoardLogger):
        for clip in clips:
            name = f"preview/{clip.name}"
            logger.experiment.add_image(name, clip.sheet, step, dataformats="HWC")
            logger.experiment.add_audio(name, clip.audio[None], step, sample_rate=SAMPLE_RATE)
    elif isinstance(logger, WandbLogger):
        import wandb

        def video(clip: ClipPreview) -> wandb.Video:
            return wandb.Video(str(clip.video), caption=f"{clip.name} after epoch {epochs}", format="mp4")

        columns = ["clip", "epoch", "video", *clips[0].scores]
        table = tables.setdefault(id(logger), wandb.Table(columns=columns, log_mode="INCREMENTAL"))
        for clip in clips:
            table.add_data(clip.name, epochs, video(clip), *clip.scores.values())
        videos: dict[str, Any] = {f"preview/{clip.name}": video(clip) for clip in clips}
        logger.log_metrics({**videos, "preview/clips": table}, step)
