"""Sound and error pictures of single test clips, for the dashboard's table."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from lightning.pytorch import Trainer
from lightning.pytorch.utilities import rank_zero_warn

from facediff.data import SpeechMotionDataModule, collate
from facediff.errors import FaceDiffError
from facediff.systems import SpeechAnimator

PICTURE_SIZE = 320
"""Pixels of a picture's sides."""


@dataclass(frozen=True)
class ClipErrors:
    """Where on the face a clip's motion is wrong.

    Attributes:
        split: its test split.
        clip: its name.
        subject: whose face.
        audio: its speech (S,), 16 kHz.
        errors: distance between prediction and truth (V,), mean over the frames, in the corpus's unit.
    """

    split: str
    clip: str
    subject: str
    audio: npt.NDArray[np.float32]
    errors: npt.NDArray[np.float32]


def worst_clips(rows: list[dict[str, Any]], count: int) -> list[dict[str, Any]]:
    """The rows of the model's worst clips by LVE, the worst first; equal ones in the rows' order."""
    mine = [row for row in rows if row["method"] == "model"]
    return sorted(mine, key=lambda row: -float(row["lve"]))[:count]


@torch.inference_mode()
def measure_clips(trainer: Trainer, system: SpeechAnimator, rows: list[dict[str, Any]]) -> list[ClipErrors]:
    """Predict some test clips again, one after the other, and say where they are wrong.

    A clip's noise follows from its name, so this is the motion that the test has scored. Doing it again costs less than
    keeping the motion of every clip that might turn out to be among the worst, and it lets one process show the worst
    clips of all.

    Args:
        trainer: the trainer in its test.
        system: the system tested.
        rows: rows of the table of sequences.
    """
    data = trainer.datamodule  # type: ignore[attr-defined]
    if not isinstance(data, SpeechMotionDataModule):
        raise TypeError("the system's setup accepts no other data module")
    datasets = {split: data.dataset(split) for split in {row["split"] for row in rows}}
    measured = []
    for row in rows:
        dataset = datasets[row["split"]]
        place = [clip.name for clip in dataset.clips].index(row["clip"])
        sample = dataset[place]
        batch = collate([sample]).to(system.device)
        with trainer.precision_plugin.forward_context():
            motion = system.generate(batch, seed=0)
        errors = (motion[0].float() - batch.motion[0]).norm(dim=-1).mean(dim=0)
        measured.append(
            ClipErrors(row["split"], sample.name, sample.subject, sample.audio.numpy(), errors.cpu().numpy())
        )
    return measured


def draw_errors(system: SpeechAnimator, clips: list[ClipErrors]) -> list[npt.NDArray[np.uint8] | None]:
    """The errors as colours on each clip's template, all on one scale from zero to :func:`highest_error`.

    Returns:
        Pictures (height, width, 3), sRGB; None in the place of those that cannot be drawn, with a warning that says
        why: the corpus has no faces, the packages for drawing are missing, or an error is not finite.
    """
    assets = system.assets
    if assets.faces is None:
        rank_zero_warn(f"test/sequences has no error pictures: the corpus {assets.corpus} has no mesh file")
        return [None] * len(clips)
    try:
        from facediff.render import Renderer
        from facediff.render.heat import heat_colours

        pictures: list[npt.NDArray[np.uint8] | None] = []
        for clip in clips:
            template = assets.template(clip.subject).numpy()
            renderer = Renderer(assets.faces.numpy(), template=template, size=PICTURE_SIZE)
            pictures.append(renderer.render(template, colours=heat_colours(clip.errors, highest_error(clips))))
        return pictures
    except FaceDiffError as error:
        # The scores are printed and written by now; a picture is not worth losing the rest of the test's report.
        rank_zero_warn(f"test/sequences has no error pictures: {error}")
        return [None] * len(clips)


def highest_error(clips: list[ClipErrors]) -> float:
    """The largest error of any clip at any vertex: the end of the colour scale; above zero."""
    return max([*(float(clip.errors.max()) for clip in clips), 1e-12])


def wandb_media(system: SpeechAnimator, clips: list[ClipErrors]) -> dict[tuple[str, str], list[Any]]:
    """``wandb.Audio`` and ``wandb.Image`` (or None) of every clip, by split and name."""
    import wandb

    from facediff.data.audio import SAMPLE_RATE

    scale = f"mean error of each vertex, 0 to {highest_error(clips):.3g} {system.assets.unit}" if clips else ""
    return {
        (clip.split, clip.clip): [
            wandb.Audio(clip.audio, sample_rate=SAMPLE_RATE, caption=clip.clip),
            None if picture is None else wandb.Image(picture, caption=f"{clip.clip}: {scale}"),
        ]
        for clip, picture in zip(clips, draw_errors(system, clips), strict=True)
    }
