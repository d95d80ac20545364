"""A clip of a preview: which, how it is sampled, and how it is drawn."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
import numpy.typing as npt
import torch
from jaxtyping import Float
from torch import Tensor

from facediff.data import Sample, SpeechMotionDataModule, collate
from facediff.data.audio import SAMPLE_RATE, fit_length, samples_for
from facediff.data.corpus import Clip
from facediff.errors import FaceDiffError
from facediff.metrics import Region, SequenceMetric
from facediff.metrics.clips import align
from facediff.render import Renderer, comparison, contact_sheet, save_image, write_video
from facediff.systems import SpeechAnimator

Picture = npt.NDArray[np.uint8]

PICTURES = 6
"""Frames on a sheet of pictures."""

ASPECT = 0.75
"""Width of a panel as a share of its height: heads are higher than wide, and empty ground costs as much as a face."""


@dataclass(frozen=True)
class ClipPreview:
    """What was drawn of a clip.

    Attributes:
        name: the clip.
        video: the mp4 file.
        sheet: frames of it on one picture (height, width, 3), sRGB.
        audio: its sound (samples,) at 16 kHz.
        scores: the protocol's metrics of the seconds drawn, by name.
    """

    name: str
    video: Path
    sheet: Picture
    audio: npt.NDArray[np.float32]
    scores: dict[str, float]


def first_of_each_subject(clips: Sequence[Clip], count: int) -> list[str]:
    """Names of ``count`` clips (fewer if there are no more): each subject's first, then each one's second …."""
    rounds: dict[str, int] = {}
    placed = []
    for place, clip in enumerate(clips):
        rounds[clip.subject] = rounds.get(clip.subject, 0) + 1
        placed.append((rounds[clip.subject], place, clip.name))
    return [name for _, _, name in sorted(placed)[:count]]


def short_samples(data: SpeechMotionDataModule, names: Sequence[str], seconds: float) -> list[Sample]:
    """The first seconds of validation clips, read from disk without a loader."""
    dataset = data.dataset("val")
    dataset.window = max(1, round(seconds * data.frame_rate))
    places = {clip.name: place for place, clip in enumerate(dataset.clips)}
    return [dataset[places[name]] for name in names]


def default_error_scale(samples: Sequence[Sample]) -> float:
    """A scale for errors from the true motion, in its unit, to two digits.

    The distance from the neutral face that one in a hundred vertices and frames exceed; a hundredth of the face's size
    where nothing moves.
    """
    reach = torch.cat([torch.linalg.vector_norm(sample.motion.float(), dim=-1).flatten() for sample in samples])
    size = float((samples[0].template.amax(0) - samples[0].template.amin(0)).max())
    return float(f"{np.quantile(reach.numpy(), 0.99) or 0.01 * size:.2g}")


@contextmanager
def borrowed(system: SpeechAnimator, sampler: str | None, steps: int | None) -> Iterator[None]:
    """A system in evaluation mode with another sampler, if it samples; both are as they were afterwards."""
    modes = [(module, module.training) for module in system.modules()]
    kept = {name: value for name, value in vars(system).items() if name == "sampler"}
    system.eval()
    try:
        if system.samples and (sampler is not None or steps is not None):
            system.choose_sampler(sampler, steps)
        yield
    finally:
        vars(system).update(kept)
        for module, training in modes:
            module.training = training


@torch.inference_mode()
def sampled(system: SpeechAnimator, sample: Sample, seed: int) -> Float[Tensor, "frames vertices 3"]:
    """The motion of one clip, offsets from its template, on the CPU."""
    return system.generate(collate([sample]).to(system.device), seed=seed)[0].float().cpu()


def scores(system: SpeechAnimator, sample: Sample, motion: Tensor) -> dict[str, float]:
    """The protocol's metrics of one clip; in this process alone, unlike those of a whole split."""
    assets, protocol = system.assets, system.evaluation.protocol
    regions = [
        Region.from_indices(f"{assets.corpus}/{name}", assets.regions[name], n_vertices=assets.n_vertices)
        for name in ("lips", "upper_face")
    ]
    metrics = cast(Iterable[tuple[str, SequenceMetric]], protocol.build(*regions).items(copy_state=False))
    (clip,) = align(motion[None], sample.motion[None], clip_names=[sample.name]).with_templates([None]).clips
    return {name: float(metric.clip_value(clip)) for name, metric in metrics}


@dataclass(frozen=True)
class Drawing:
    """How clips are drawn.

    Attributes:
        size: height of a panel in pixels.
        view: from where the face is seen.
        columns: pictures in a row of a sheet.
    """

    size: int = 256
    view: str = "front"
    columns: int = 2

    def write(
        self, system: SpeechAnimator, sample: Sample, motion: Tensor, folder: Path, *, epochs: int, error_scale: float
    ) -> ClipPreview:
        """Draw truth, prediction and error of one clip, and write the video and the sheet; each whole or not at all.

        Args:
            system: gives faces, colours, unit and metrics.
            sample: the true clip.
            motion: predicted offsets from the template, (frames, vertices, 3).
            folder: where the files go, under the clip's name.
            epochs: epochs trained so far.
            error_scale: error that gets the last colour, in the corpus's unit.

        Raises:
            FaceDiffError: if the corpus has no mesh, the motion is not finite, or a file cannot be written.
        """
        assets = system.assets
        if assets.faces is None:
            raise FaceDiffError(f"{assets.corpus} has no mesh to draw")
        found = scores(system, sample, motion)
        colours = None if assets.colours is None else assets.colours.numpy()
        template = sample.template.numpy()
        size = (self.size, round(ASPECT * self.size))
        renderer = Renderer(assets.faces.numpy(), template=template, view=self.view, size=size, colours=colours)
        corpus = f"{assets.corpus}, synthetic corpus" if assets.synthetic else assets.corpus
        frames = comparison(
            renderer,
            (sample.motion + sample.template).numpy(),
            (motion + sample.template).numpy(),
            highest=error_scale,
            scale_label=length(error_scale, assets.unit),
            labels=("truth", "facediff", "error"),
            footer=f"{sample.name} after epoch {epochs}: LVE {found['lve']:.3g} ({corpus})",
        )
        count, rate = len(motion), assets.frame_rate
        picks = [round((i + 0.5) * (count - 1) / PICTURES) for i in range(PICTURES)]
        picked: dict[int, Picture] = {}
        sound = fit_length(sample.audio.numpy(), samples_for(count, rate))
        video = folder / f"{sample.name}.mp4"
        write_video(video, remembering(frames, set(picks), picked), rate, sound, SAMPLE_RATE)
        times = [f"{pick / rate:.2f} s" for pick in picks]
        sheet = contact_sheet([picked[pick] for pick in picks], self.columns, labels=times)
        save_image(video.with_suffix(".png"), sheet)
        return ClipPreview(sample.name, video, sheet, sound, found)


def remembering(frames: Iterable[Picture], places: set[int], found: dict[int, Picture]) -> Iterator[Picture]:
    """The frames as they are; those at some places are kept in ``found``."""
    for place, frame in enumerate(frames):
        if place in places:
            found[place] = frame
        yield frame


def length(value: float, unit: str) -> str:
    """A length for people: small parts of a metre in millimetres."""
    return f"{value * 1000:.3g} mm" if unit == "m" else f"{value:.3g} {unit}"
