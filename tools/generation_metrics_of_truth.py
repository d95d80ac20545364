"""Puppet's generation metrics for a perfect generator: other truths of the same speech, as a table.

The built-in corpus draws blinks, drift and habits of the brows at random, so it can be asked for another truth of the
same sentence by the same speaker. Scored like samples of a model, these are the best that a model can be: no score
below is reached by drawing from the right distribution, and some of them are not where one might expect them. FDD of
single clips, for instance, cannot vanish, since the clip that was recorded is one of many.

    $ python tools/generation_metrics_of_truth.py

writes them as motion files instead, a folder for each seed, which ``facediff evaluate`` scores as it does a method's:

    $ python tools/generation_metrics_of_truth.py --write truths --samples 5 --drawn-speakers 42
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from facediff.data import Batch, Puppet
from facediff.data.prepare.runner import write_motion
from facediff.models.base import AnimationModel
from facediff.models.generation_metrics import GENERATION_METRICS, GenerationScores, SamplingOptions, measure
from facediff.speech.espeak import Utterance
from facediff.synthetic.second_edition import PerformedClip, perform_clip, performed_clips, rig_of, speak_clip
from facediff.utils.files import atomic

SKIPPED = ("mve_", "nearest", "real_time")
"""Metrics that ask for the motion of another reference, or for a time."""


class OtherTruths(AnimationModel):
    """Draws another truth of a clip's speech for every seed, in place of a model's samples."""

    samples: ClassVar[bool] = True

    def losses(self, batch: Batch, generator: torch.Generator | None = None) -> dict[str, Tensor]:
        """Nothing is learnt."""
        raise NotImplementedError

    def generate_clips(self, batch: Batch, *, seed: int = 0, progress: Any = None) -> Tensor:  # noqa: ANN401
        """Motion of every clip."""
        motion = torch.zeros_like(batch.motion)
        for row, name in enumerate(batch.names):
            drawn = other_truth(name, seed + 1)  # the corpus itself is of seed 0
            motion[row, : len(drawn)] = drawn
        return motion

    def generate_samples(self, clip: Batch, seeds: Sequence[int], *, progress: Any = None) -> Tensor:  # noqa: ANN401
        """Several truths of one clip."""
        return torch.cat([self.generate_clips(clip, seed=seed) for seed in seeds])


@lru_cache(maxsize=64)
def other_truth(name: str, seed: int) -> Tensor:
    """Offsets from the template (frames, vertices, 3) of a clip, with its random part drawn again."""
    clip, spoken = said(name)
    # Of the corpus's own draws, that of middle liveliness is the truth (seed 0); others are taken as they come.
    performance = perform_clip(clip if seed == 0 else replace(clip, split="train"), spoken, seed)[0]
    return torch.from_numpy(np.einsum("tk,kvc->tvc", performance.weights.astype(np.float32), shapes(clip.identity)))


@lru_cache(maxsize=1024)
def said(name: str) -> tuple[PerformedClip, Utterance]:
    """A clip, and what it sounds like."""
    clip = next(clip for clip in performed_clips() if clip.name == name)
    return clip, speak_clip(clip)


@lru_cache(maxsize=16)
def shapes(identity: str) -> NDArray[np.float32]:
    """Displacements of a speaker's shapes (54, vertices, 3)."""
    return rig_of(identity)[1:]


def measured(root: Path | None = None, samples: int = 10, most_clips: int | None = None) -> GenerationScores:
    """The generation metrics of other truths.

    Args:
        root: the corpus; the user's cache if None.
        samples: of each clip.
        most_clips: clips of a split; all if None.
    """
    data = Puppet(root=root, edition=2)
    data.prepare_data()
    data.setup("fit")
    data.setup("test")

    def load() -> AnimationModel:
        model = OtherTruths(
            n_vertices=data.n_vertices, identities=data.identities, frame_rate=data.frame_rate, motion_scale="none"
        )
        model.adopt(data.assets())
        return model.eval()

    sampling = SamplingOptions(samples=samples, references=1)
    return measure({"another truth": load}, data, sampling=sampling, most_clips=most_clips)


def write_truths(folder: Path, data: Puppet, seeds: Sequence[int]) -> None:
    """Write other truths of all test clips, absolute vertices (frames, 3V) as ``folder/seedN/CLIP.npy``."""
    data.prepare_data()
    data.setup("test")
    for seed in seeds:
        place = folder / f"seed{seed}"
        place.mkdir(parents=True, exist_ok=True)
        for clip in (clip for split in data.test_splits for clip in data.clips(split)):
            rest = np.asarray(data.corpus.templates[clip.identity], np.float32)
            write_motion(place / f"{clip.name}.npy", rest + other_truth(clip.name, seed).numpy())


def table(scores: GenerationScores) -> str:
    """Markdown: a row for each metric, a column for each split."""
    lines = ["| metric | " + " | ".join(scores.values) + " |", "|---|" + "---|" * len(scores.values)]
    for name in GENERATION_METRICS:
        values = [scores.mean(split, name) for split in scores.values]
        if name.startswith(SKIPPED) or None in values:
            continue
        lines.append(f"| {scores.title(name)} | " + " | ".join(f"{value:.4g}" for value in values if value is not None))
        lines[-1] += " |"
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data-root", type=Path, help="where the corpus is (default: the user's cache folder)")
    parser.add_argument("--samples", type=int, default=10, help="other truths of each clip (default: 10)")
    parser.add_argument("--clips", type=int, help="clips of a split (default: all)")
    parser.add_argument("--output", type=Path, help="also write the table to this file")
    parser.add_argument("--write", type=Path, metavar="FOLDER", help="write the motion of seeds 1 to --samples instead")
    parser.add_argument("--drawn-speakers", type=int, default=0, help="of the corpus whose clips are written")
    options = parser.parse_args(arguments)
    if options.write is not None:
        data = Puppet(root=options.data_root, drawn_speakers=options.drawn_speakers, edition=2)
        write_truths(options.write, data, range(1, options.samples + 1))
        return
    text = table(measured(options.data_root, options.samples, options.clips))
    print(text)
    if options.output is not None:
        with atomic(options.output) as partial:
            partial.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
