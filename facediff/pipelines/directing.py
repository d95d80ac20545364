"""Keys over time of the style.

A model generates with one style from beginning to end. Where keys change it, the same speech is generated once for each
style with the same random numbers, and the motions are blended frame by frame by the keys' shares. That works for every
model, in one pass, by windows and in streams, and a style that never changes is the plain option to the last bit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from facediff.editing.controls.direction import ENDED, Direction, Key, text_shares
from facediff.errors import FaceDiffError, located
from facediff.models.inference import Progress, SpeechStream
from facediff.models.styles import style_from
from facediff.speech.windows import in_parts

if TYPE_CHECKING:
    import numpy.typing as npt

    from facediff.data import Reference
    from facediff.models import AnimationModel, Style


@dataclass(frozen=True, eq=False)
class StyledRun:
    """One way of generating a recording."""

    style: Reference | Style | None  # the identity's own one if None
    keys: tuple[Key, ...] = ()  # of the style
    text: str = ""  # the keys' value that stands for it


def plan_runs(
    direction: Direction | None,
    model: AnimationModel,
    identity: str,
    style: Reference | Style | None,
    style_template: str | Path | None = None,
) -> list[StyledRun]:
    """One run for each style in the keys; one with ``style`` where they name none."""
    if direction is None:
        return [StyledRun(style)]
    for name in ENDED:
        if direction.under(name):
            raise FaceDiffError(f"{direction.source}: channel {name}: follows no keys any more; give --{name} instead")
    if (keys := direction.channels.get("style")) is None:
        return [StyledRun(style)]
    with located(f"{direction.source}: channel style"):
        texts = dict.fromkeys(str(key.value) for key in keys)
        styles = {text: style_from(text, identity, model, template=style_template) for text in texts}
    return [StyledRun(style, keys, text) for text, style in styles.items()]


def blend(motions: Sequence[Tensor], runs: Sequence[StyledRun], frame_rate: float, start: int = 0) -> Tensor:
    """Motions (seeds, T, V, 3) of the runs, blended by their shares in each frame from number ``start`` on."""
    count = motions[0].shape[1]
    if len(runs) == 1 or not count:
        return motions[0]
    shares = text_shares(runs[0].keys, (start + np.arange(count)) / frame_rate, eased=True)
    blended = torch.zeros_like(motions[0])
    for motion, run in zip(motions, runs, strict=True):
        share = torch.from_numpy(shares[run.text]).to(motion)
        counting = share != 0
        # A frame that is one run's alone stays as it is to the last bit: 0 + 1 · x.
        blended[:, counting] += share[counting][None, :, None, None] * motion[:, counting]
    return blended


class DirectedStream:
    """Animates speech while it arrives, as :class:`facediff.models.inference.SpeechStream` does, along keys over time.

    It gives absolute vertices (seeds, m, V, 3) as arrays.

    Attributes:
        frames: how many have been given out so far.
    """

    def __init__(
        self,
        model: AnimationModel,
        runs: Sequence[StyledRun],
        *,
        identity: str,
        condition: str | None,
        seeds: Sequence[int],
        precision: Callable[[], AbstractContextManager[object]] = nullcontext,
    ) -> None:
        self.model, self.runs, self._precision = model, list(runs), precision
        self._choices = model.choices()
        self.frames = 0
        self._template = model.assets.template(identity)
        with precision():
            self.streams = [
                model.stream(identity=identity, condition=condition, style=run.style, seeds=seeds) for run in self.runs
            ]

    @property
    def style_names(self) -> list[str]:
        """Names of the styles of the runs, each once."""
        return list(dict.fromkeys(stream.clip.reference_names[0] for stream in self.streams))

    def feed(self, samples: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Take more speech (n,) at 16 kHz, and give the vertices (seeds, m, V, 3) that have become certain."""
        return self._blended(lambda stream: stream.feed(samples))

    def finish(self, frames: int | None = None) -> npt.NDArray[np.float32]:
        """Give the vertices that are left; of so many frames in all, if they are given."""
        return self._blended(lambda stream: stream.finish(frames))

    def parts(
        self, speech: npt.NDArray[np.float32], *, progress: Progress | None = None
    ) -> Iterator[npt.NDArray[np.float32]]:
        """All vertices for a recording, part by part."""
        return in_parts(self, speech, progress=progress)

    def _blended(self, step: Callable[[SpeechStream], Tensor]) -> npt.NDArray[np.float32]:
        with self._precision(), self.model.choosing(self._choices):
            # Absolute vertices are blended, as they are in one pass: the two agree to the last bit.
            motions = [step(stream).cpu() + self._template for stream in self.streams]
        vertices = blend(motions, self.runs, self.model.frame_rate, self.frames)
        self.frames += vertices.shape[1]
        array: npt.NDArray[np.float32] = vertices.numpy()
        return array
