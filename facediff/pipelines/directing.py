"""Keys over time of a model's own options: style, condition, guidance and expressivity.

A model generates with one style from beginning to end. Where keys change it, the same speech is generated once for each
value with the same random numbers, and the motions are blended frame by frame by the keys' shares. That works for every
model, in one pass, by windows and in streams, and a value that never changes is the plain option to the last bit.

From top to bottom: :func:`plan_runs`, which finds out what must be generated; :func:`blend`; and
:class:`DirectedStream`, which does it while speech arrives.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import reduce
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from facediff.editing.controls.direction import Direction, Key, curve, text_shares
from facediff.editing.controls.expressiveness import ALL, region_weights
from facediff.errors import FaceDiffError, located
from facediff.models.inference import Progress, SpeechStream
from facediff.models.styles import style_from
from facediff.speech.windows import in_parts

if TYPE_CHECKING:
    import numpy.typing as npt

    from facediff.data import Reference
    from facediff.editing.controls.eyelids import Array
    from facediff.models import AnimationModel, Style

MOST_RUNS = 32
"""Combinations of values that are generated at most."""


@dataclass(frozen=True, eq=False)
class ConditionedRun:
    """One way of generating a recording.

    Attributes:
        style: the style; the identity's own one if None.
        condition: the training identity that conditions the model; the face's if None.
        choices: settings of the model, as :meth:`facediff.models.inference.Inference.choices` gives it.
        shares: what its share of a frame is the product of, see :class:`Share`.
    """

    style: Reference | Style | None
    condition: str | None
    choices: dict[str, object]
    shares: tuple[Share, ...] = ()

    def share(self, times: npt.NDArray[np.floating]) -> Array:
        """Its share at times: (T, 1), or (T, V) where it differs between vertices."""
        return reduce(np.multiply, (share.at(times) for share in self.shares), np.ones((len(times), 1)))


@dataclass(frozen=True, eq=False)
class Share:
    """How much one value of a channel counts over time.

    Attributes:
        keys: of the channel.
        value: the text, or the number.
        values: all numbers of the channel in rising order; empty for texts.
    """

    keys: tuple[Key, ...]
    value: float | str
    values: tuple[float, ...] = ()

    def at(self, times: npt.NDArray[np.floating]) -> Array:
        """The share (T, 1): of a number, how near the curve is to it, on the way to its neighbours."""
        if not self.values:
            return text_shares(self.keys, times, eased=True)[str(self.value)][:, None]
        unit = [float(value == self.value) for value in self.values]
        return np.interp(curve(self.keys, times, eased=True), self.values, unit)[:, None]


@dataclass(frozen=True, eq=False)
class ExpressivityShare(Share):
    """How much a sample counts in motion = (1 − e) mean + e sample, or the mean, where e changes over time.

    Attributes:
        channels: keys by region, ``all`` for every other vertex.
        weights: of the regions at each vertex.
    """

    channels: tuple[tuple[str, tuple[Key, ...]], ...] = ()
    weights: Any = None

    def at(self, times: npt.NDArray[np.floating]) -> Array:
        """The share (T, V)."""
        curves = {name: curve(keys, times, eased=True) for name, keys in self.channels}
        rows = [
            self.weights.factors({name: float(factors[frame]) for name, factors in curves.items()})
            for frame in range(len(times))
        ]
        sample = np.stack(rows)
        return sample if self.value else 1 - sample


def plan_runs(
    direction: Direction,
    model: AnimationModel,
    identity: str,
    style: Reference | Style | None,
    condition: str | None,
    style_template: str | Path | None = None,
) -> list[ConditionedRun]:
    """What must be generated.

    Args:
        direction: keys over time.
        model: set to what holds where there are no keys.
        identity: the animated face.
        style: what holds without keys of style.
        condition: what holds without keys of condition.
        style_template: as ``--style-template`` takes it.
    """
    channels = [name for name in direction.channels if name in ("style", "condition") or name.startswith("guidance.")]
    alternatives: list[list[tuple[str, float | str, Share]]] = []
    for name in channels:
        keys = direction.channels[name]
        numbers = tuple(sorted({float(key.value) for key in keys})) if name.startswith("guidance.") else ()
        values: Sequence[float | str] = numbers or list(dict.fromkeys(str(key.value) for key in keys))
        alternatives.append([(name, value, Share(keys, value, numbers)) for value in values])
    expressive = _expressivity(direction, model, identity)
    alternatives += [expressive] if expressive else []
    styles = {}
    for text in dict.fromkeys(str(key.value) for key in direction.channels.get("style", ())):
        with located(f"{direction.source}: channel style"):
            styles[text] = style_from(text, identity, model, template=style_template)
    last = max(key.time for key in direction.keys)
    times = np.arange(int(np.ceil(last * model.frame_rate)) + 2) / model.frame_rate
    runs: list[ConditionedRun] = []
    for combination in product(*alternatives):
        # Shares of an alternative that is alone are 1 at all times; without them the motion stays as it is.
        shares = tuple(
            share
            for values_of_channel, (_, _, share) in zip(alternatives, combination, strict=True)
            if len(values_of_channel) > 1
        )
        run = ConditionedRun(style, condition, {}, shares)
        if shares and not run.share(times).any():
            continue  # these values never meet
        if len(runs) == MOST_RUNS:
            raise FaceDiffError(
                f"{direction.source}: more than {MOST_RUNS} combinations of style, condition and guidance would have "
                f"to be generated; use fewer different values"
            )
        with model.choosing():
            settings: dict[str, Any] = {name: value for name, value, _ in combination}
            for name, value in settings.items():
                with located(f"{direction.source}: channel {name}"):
                    if name.startswith("guidance."):
                        model.choose_guidance({name.partition(".")[2]: float(value)})
                    elif name == "expressivity":
                        model.choose_expressivity(value)
            run_condition = str(settings["condition"]) if "condition" in settings else condition
            with located(f"{direction.source}: channel condition"):
                model.check_condition(run_condition)
            runs.append(
                ConditionedRun(styles.get(str(settings.get("style")), style), run_condition, model.choices(), shares)
            )
    return runs


def _expressivity(
    direction: Direction, model: AnimationModel, identity: str
) -> list[tuple[str, float | str | Any, Share]]:
    """The values of expressivity to generate with: the keys' if it never changes, else the mean and a sample."""
    channels = direction.under("expressivity")
    if not channels:
        return []
    constants = {name.partition(".")[2] or ALL: direction.constant(name) for name in channels}
    keys = next(iter(channels.values()))
    template = model.assets.template(identity).numpy()
    regions = {name: np.asarray(indices, np.int64) for name, indices in model.assets.regions.items()}
    with located(f"{direction.source}: channel expressivity"):
        weights = region_weights(template, regions, list(constants), f"the checkpoint's corpus {model.assets.corpus}")
    if None not in constants.values():
        factors = {name: float(value) for name, value in constants.items() if value is not None}
        is_uniform = {*factors} == {ALL}
        value = factors[ALL] if is_uniform else torch.from_numpy(weights.factors(factors)).float()
        if not model.samples and {*factors.values()} == {1.0}:
            value = 1.0
        return [("expressivity", value, Share(keys, 1.0))]
    curves = tuple((name.partition(".")[2] or ALL, keys) for name, keys in channels.items())
    return [("expressivity", value, ExpressivityShare(keys, value, (), curves, weights)) for value in (0.0, 1.0)]


def blend(motions: Sequence[Tensor], runs: Sequence[ConditionedRun], frame_rate: float, start: int = 0) -> Tensor:
    """Motions (seeds, T, V, 3) of the runs, blended by their shares in each frame.

    Args:
        motions: one for each run.
        runs: of these motions.
        frame_rate: frames a second.
        start: the number of the first frame.
    """
    count = motions[0].shape[1]
    if len(runs) == 1 or not count:
        return motions[0]
    times = (start + np.arange(count)) / frame_rate
    blended = torch.zeros_like(motions[0])
    for motion, run in zip(motions, runs, strict=True):
        share = torch.from_numpy(run.share(times)).to(motion)
        counting = share.any(dim=1)
        # A frame that is one run's alone stays as it is to the last bit: 0 + 1 · x.
        blended[:, counting] += share[counting][None, :, :, None] * motion[:, counting]
    return blended


class DirectedStream:
    """Animates speech while it arrives, as :class:`facediff.models.inference.SpeechStream` does, along keys over time.

    It gives absolute vertices (seeds, m, V, 3) as arrays.

    Args:
        model: the animating model.
        runs: to generate.
        identity: the animated face.
        seeds: one for each sample.
        precision: makes a context within which the network computes; the style is encoded within it as well, as it is
            for a file.

    Attributes:
        frames: how many have been given out so far.
    """

    def __init__(
        self,
        model: AnimationModel,
        runs: Sequence[ConditionedRun],
        *,
        identity: str,
        seeds: Sequence[int],
        precision: Callable[[], AbstractContextManager[object]] = nullcontext,
    ) -> None:
        self.model, self.runs, self._precision = model, list(runs), precision
        self.streams: list[SpeechStream] = []
        self.frames = 0
        self._template = model.assets.template(identity)
        for run in self.runs:
            with precision(), model.choosing(run.choices):
                stream = model.stream(identity=identity, condition=run.condition, style=run.style, seeds=seeds)
            self.streams.append(stream)

    @property
    def style_names(self) -> list[str]:
        """Names of the styles of the runs, each once."""
        return list(dict.fromkeys(stream.clip.reference_names[0] for stream in self.streams))

    def feed(self, samples: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Take more speech (n,) at 16 kHz, and give the vertices (seeds, m, V, 3) that have become certain."""
        return self._blended([self._of(run, stream.feed, samples) for run, stream in self._pairs()])

    def finish(self, frames: int | None = None) -> npt.NDArray[np.float32]:
        """Give the vertices that are left; of so many frames in all, if they are given."""
        return self._blended([self._of(run, stream.finish, frames) for run, stream in self._pairs()])

    def parts(
        self, speech: npt.NDArray[np.float32], *, progress: Progress | None = None
    ) -> Iterator[npt.NDArray[np.float32]]:
        """All vertices for a recording, part by part."""
        return in_parts(self, speech, progress=progress)

    def _pairs(self) -> Iterator[tuple[ConditionedRun, SpeechStream]]:
        return zip(self.runs, self.streams, strict=True)

    def _of(self, run: ConditionedRun, step: Any, argument: Any) -> Tensor:  # noqa: ANN401
        with self._precision(), self.model.choosing(run.choices):
            offsets: Tensor = step(argument)
        # Absolute vertices are blended, as they are in one pass: the two agree to the last bit.
        return offsets.cpu() + self._template

    def _blended(self, motions: Sequence[Tensor]) -> npt.NDArray[np.float32]:
        vertices = blend(motions, self.runs, self.model.frame_rate, self.frames)
        self.frames += vertices.shape[1]
        array: npt.NDArray[np.float32] = vertices.numpy()
        return array
