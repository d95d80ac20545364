"""The stages from speech to a finished animation, in the order in which they run.

A whole recording and a stream go through the same list: each stage has a form for either.

============  ==========================================  ==================================================
stage         whole recording                             stream
============  ==========================================  ==================================================
Denoise       cleans the speech, shifts its pitch         none: needs all of the speech
Generate      one pass, or windows one by one             windows, as the speech arrives
Rest          the mouth rests in pauses                   the same, once the voice gate has decided
Act           gestures from the speech                    the same, once the speech after a frame is known
Decode        points of the model to vertices             the same
CloseLips     lips touch at p, b, m                       none: learns from the whole motion
Direct        controls and keys                           the same, without blinks, gaze and sway
Retarget      the motion on another mesh                  none: is judged by the whole motion
============  ==========================================  ==================================================

Frames move on in stretches, so that memory does not grow with the recording. All frames of a long one
lie in a file for stages that need them at once.
"""

from __future__ import annotations

import secrets
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt

from facediff.animation import Animation
from facediff.animation.animation import MotionMap, stretches_of
from facediff.errors import FaceDiffError
from facediff.speech.audio import resampler
from facediff.utils import SAMPLE_RATE
from facediff.utils.arrays import ArrayWriter, open_array

if TYPE_CHECKING:
    from facediff.editing.acting import Acting
    from facediff.editing.controls.controlled_face import Amounts, ControlledFace
    from facediff.editing.correspondence import Correspondence
    from facediff.editing.fit_check import FitReport
    from facediff.spaces.decoding import ChannelDecoder
    from facediff.speech.audio import SpeechRecording
    from facediff.speech.voice_activity import MouthAtRest

Array = npt.NDArray[np.float32]
Array64 = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Stretch:
    """Consecutive frames on their way through the stages."""

    start: int
    points: Array  # (m, points, dims) as the model moves them: vertices, or channels
    gestures: Array64 | None = None  # (m, 5) of acting
    turns: Array64 | None = None  # (m, 3) of the head, axis-angle in radians, where channels say it
    animation: Animation | None = None  # of the frames, once they are decoded

    def __len__(self) -> int:
        return len(self.points)

    @property
    def vertices(self) -> Array:
        """Absolute positions (m, V, 3); the points where nothing has decoded them."""
        return self.points if self.animation is None else self.animation.vertices


class Spool:
    """Consecutive frames that come one stretch after the other: in memory, or in a file."""

    def __init__(self, folder: Path | None) -> None:
        self._parts: list[Array] = []
        self._file = None if folder is None else folder / f"{secrets.token_hex(8)}.npy"
        self._writer: ArrayWriter | None = None

    def write(self, part: Array) -> None:
        """Add frames (m, points, dims)."""
        if self._file is None:
            self._parts.append(part)
            return
        if self._writer is None:
            self._writer = ArrayWriter(self._file, part.shape[1:])
        self._writer.write(part)

    def array(self) -> Array:
        """All of them (T, points, dims); a memory map of the file."""
        if self._writer is None or self._file is None:
            return self._parts[0] if len(self._parts) == 1 else np.concatenate(self._parts)
        self._writer.close()
        array = open_array(self._file).view(MotionMap)
        with suppress(OSError):  # Windows keeps a file that is in use
            self._file.unlink()
        return array


@dataclass(eq=False)
class SampleMotion:
    """One sample of a recording: its frames, still to come in stretches, or all of them as an animation."""

    seed: int
    name: str
    folder: Path | None  # for motion that is too long for memory
    stretches: Iterator[Stretch] | None = None  # None once they are an animation
    gestures: Array64 | None = None  # (T, 5) of acting
    _animation: Animation | None = None
    _turns: Array64 | None = None

    def change(self, step: Callable[[Stretch], Stretch]) -> None:
        """Let every stretch go through a stage."""
        self.stretches = map(step, self._cut(self.animation()) if self.stretches is None else self.stretches)

    def animation(self) -> Animation:
        """All decoded frames."""
        if self.stretches is None:
            assert self._animation is not None  # noqa: S101 - frames are either of the two
            return self._animation
        spool, first = Spool(self.folder), None
        small = []  # enough to stay in memory: channels and the head's motion
        for stretch in self.stretches:
            part = stretch.animation
            assert part is not None  # noqa: S101 - decoded
            first = part if first is None else first  # whose speech is all of it
            spool.write(part.vertices)
            small.append((part.head, part.values, stretch.turns))
        assert first is not None  # noqa: S101 - a recording has frames
        head, values, self._turns = (
            None if any(row[column] is None for row in small) else np.concatenate([row[column] for row in small])
            for column in range(3)
        )
        animation = replace(first, vertices=spool.array(), head=head, channels=None)
        self.settle(animation if values is None else animation.made_of(first.space, values, first.deltas))
        return self.animation()

    def settle(self, animation: Animation) -> None:
        """Take an animation in place of the stretches."""
        self.stretches, self._animation = None, animation

    def _cut(self, animation: Animation) -> Iterator[Stretch]:
        for frames, _ in stretches_of(animation.vertices):
            part = animation.part(frames)
            turns = None if self._turns is None else self._turns[frames]
            yield Stretch(frames.start, part.vertices, turns=turns, animation=part)


@dataclass(eq=False)
class Take:
    """A recording on its way through the stages."""

    recording: SpeechRecording
    speech: Array  # (S,) at 16 kHz as the model hears it
    samples: list[SampleMotion]
    frames: int = 0  # of every sample, once they are generated


class Step(Protocol):
    """A stage of a stream. Frames may wait in it until more speech has arrived."""

    def feed(self, speech: Array, stretch: Stretch, /) -> Stretch:
        """The frames that are certain after more speech (n,) at 16 kHz and more frames."""

    def finish(self, frames: int, stretch: Stretch, /) -> Stretch:
        """The frames that are left, of so many in all."""


class Stage(ABC):
    """One stage.

    Attributes:
        look_ahead: seconds of speech after a frame that it waits for in a stream, at most.
    """

    look_ahead: float = 0.0

    @abstractmethod
    def whole(self, take: Take) -> None:
        """Let all samples of a recording go through it."""

    def stream(self, seed: int) -> Step | None:
        """The stage at the beginning of a stream with a seed; None where streams do without it."""
        return None


class Each:
    """A step that changes every stretch by itself."""

    def __init__(self, change: Callable[[Stretch], Stretch]) -> None:
        self._change = change

    def feed(self, speech: Array, stretch: Stretch) -> Stretch:
        """The frames at once."""
        return self._change(stretch)

    def finish(self, frames: int, stretch: Stretch) -> Stretch:
        """The frames at once."""
        return self._change(stretch)


class Follower(Protocol):
    """Gives values (m, …) of frames for speech that arrives, such as the openness of a mouth."""

    def feed(self, speech: Array, /) -> npt.NDArray[np.floating]:
        """The values that are certain after more speech (n,)."""

    def finish(self, frames: int, /) -> npt.NDArray[np.floating]:
        """The values that are left, of so many frames in all."""


class Follow:
    """A step that gives each frame the value of a follower, and holds the frames until it is certain."""

    def __init__(self, follower: Follower, apply: Callable[[Stretch, npt.NDArray[Any]], Stretch]) -> None:
        self._follower, self._apply = follower, apply
        self._stretch: Stretch | None = None
        self._values: npt.NDArray[Any] | None = None

    def feed(self, speech: Array, stretch: Stretch) -> Stretch:
        """The frames of which the follower is certain."""
        return self._certain(stretch, self._follower.feed(speech))

    def finish(self, frames: int, stretch: Stretch) -> Stretch:
        """All that are left."""
        return self._certain(stretch, self._follower.finish(frames))

    def _certain(self, stretch: Stretch, values: npt.NDArray[Any]) -> Stretch:
        if self._stretch is not None and len(self._stretch):
            stretch = replace(self._stretch, points=np.concatenate([self._stretch.points, stretch.points]))
        if self._values is not None:
            values = np.concatenate([self._values, values])
        count = min(len(stretch), len(values))
        self._stretch = replace(stretch, start=stretch.start + count, points=stretch.points[count:])
        self._values = values[count:]
        return self._apply(replace(stretch, points=stretch.points[:count]), values[:count])


class Denoise(Stage):
    """Steady noise is taken out of the speech, and its pitch is shifted, for the model alone."""

    def __init__(self, *, noise: bool, semitones: float) -> None:
        self.noise, self.semitones = noise, semitones

    def whole(self, take: Take) -> None:
        """Change the speech that the model hears."""
        if self.noise:
            from facediff.speech.audio import denoised

            take.speech = denoised(take.speech)
        if self.semitones:
            from facediff.speech.pitch import shifted_by_pieces

            take.speech = shifted_by_pieces(take.speech, 2 ** (self.semitones / 12))


class VertexGenerator(Protocol):
    """A model that generates absolute points of one sample while speech arrives: vertices, or channels."""

    @property
    def frames(self) -> int:
        """Frames that have been generated so far."""

    def feed(self, samples: Array, /) -> Array:
        """Take speech (n,) at 16 kHz, and give the frames (m, points, dims) that it makes certain."""

    def finish(self) -> Array:
        """The frames (m, points, dims) that are left."""


class SpeechModel(Protocol):
    """A model with its choices made."""

    def generate(self, speech: Array, seeds: Sequence[int]) -> tuple[int, Iterator[Sequence[Array]]]:
        """Frames for some speech (S,), and their absolute points part by part, for each sample (T, V, dims)."""

    def generator(self, seed: int) -> VertexGenerator:
        """The model at the beginning of a stream."""


class Generate(Stage):
    """The model's motion; a stream begins with its :class:`VertexGenerator`."""

    def __init__(self, model: SpeechModel) -> None:
        self.model = model

    def whole(self, take: Take) -> None:
        """Generate all samples; of a single one window by window, as the frames are asked for."""
        take.frames, parts = self.model.generate(take.speech, [sample.seed for sample in take.samples])
        if len(take.samples) == 1:
            take.samples[0].stretches = numbered(part for (part,) in parts)
            return
        spools = [Spool(sample.folder) for sample in take.samples]
        for motions in parts:
            for spool, motion in zip(spools, motions, strict=True):
                spool.write(motion)
        for sample, spool in zip(take.samples, spools, strict=True):
            sample.stretches = numbered(part for _, part in stretches_of(spool.array()))


def numbered(parts: Iterable[Array]) -> Iterator[Stretch]:
    """Consecutive points (m, points, dims) as stretches."""
    start = 0
    for part in parts:
        yield Stretch(start, np.asarray(part))
        start += len(part)


class Rest(Stage):
    """The mouth comes to rest in pauses."""

    def __init__(self, mouth: MouthAtRest) -> None:
        self.mouth = mouth

    @property
    def look_ahead(self) -> float:  # type: ignore[override]
        """Look-ahead of the voice gate."""
        return self.mouth.openness().look_ahead

    def apply(self, stretch: Stretch, openness: Array) -> Stretch:
        """Frames with mouths as far open as a number for each (m,) says."""
        return replace(stretch, points=self.mouth.apply(stretch.points, openness))

    def whole(self, take: Take) -> None:
        """By the pauses of the model's speech."""
        openness = self.mouth.openness_of(take.speech, take.frames)
        for sample in take.samples:
            sample.change(lambda some: self.apply(some, openness[some.start : some.start + len(some)]))

    def stream(self, seed: int) -> Step:
        """Frames wait for the voice gate."""
        return Follow(self.mouth.openness(), self.apply)


class Act(Stage):
    """Brows, head and lids move with the speech; :class:`Direct` applies it."""

    def __init__(self, acting: Acting, frame_rate: float, seed: int | None) -> None:
        self.acting, self.frame_rate, self.seed = acting, frame_rate, seed
        self.look_ahead = acting.look_ahead

    def whole(self, take: Take) -> None:
        """By the speech as it was recorded."""
        from facediff.editing.acting import acted

        for sample in take.samples:
            seed = sample.seed if self.seed is None else self.seed
            sample.gestures = acted(self.acting, take.recording.speech, take.frames, self.frame_rate, seed)

    def stream(self, seed: int) -> Step:
        """Frames wait for their gestures."""
        performer = self.acting.performer(self.frame_rate, seed if self.seed is None else self.seed)
        return Follow(performer, lambda stretch, gestures: replace(stretch, gestures=gestures))


class Decode(Stage):
    """The model's points become an animation of the face."""

    def __init__(self, animation: Callable[[SampleMotion | None], Animation], decoder: ChannelDecoder | None) -> None:
        self.animation, self.decoder = animation, decoder

    def apply(self, stretch: Stretch, still: Animation) -> Stretch:
        """Decoded frames of the face of another animation."""
        points, decoder = stretch.points, self.decoder
        if decoder is None:
            return replace(stretch, animation=replace(still, vertices=points))
        decoded = replace(still, vertices=decoder.vertices(points))
        return replace(stretch, turns=decoder.head_turns(points), animation=decoded)

    def _with_channels(self, stretch: Stretch) -> Stretch:
        decoder, animation = self.decoder, stretch.animation
        if decoder is None or animation is None:
            return stretch
        values = decoder.values(stretch.points)
        return replace(stretch, animation=animation.made_of(decoder.space, values, decoder.deltas))

    def whole(self, take: Take) -> None:
        """With everything that the metadata says."""
        for sample in take.samples:
            still = self.animation(sample)
            sample.change(partial(self.apply, still=still))
            sample.change(self._with_channels)

    def stream(self, seed: int) -> Step:
        """Without metadata and channels."""
        still = self.animation(None)
        nothing = np.zeros((0, *still.template.shape), np.float32)
        return Each(lambda some: self.apply(some, still) if len(some) else replace(some, points=nothing))


MOST_BEYOND = 0.5
"""Seconds by which an alignment may be longer than the speech."""


class CloseLips(Stage):
    """Lips touch where the phonemes of an alignment have them touch."""

    def __init__(self, alignment: str | Path, budget: float | None) -> None:
        self.alignment, self.budget = Path(alignment), budget

    def whole(self, take: Take) -> None:
        """Learn from all frames how the face opens its mouth, and close it."""
        from facediff.animation.animation import PHONEMES
        from facediff.editing.controls.closures import BUDGET, close_lips
        from facediff.speech.phonemes import closed_times, phonemes_text, read_alignment

        phonemes = read_alignment(self.alignment)
        end = max((phoneme.end for phoneme in phonemes if phoneme.ipa), default=0.0)
        if end > take.recording.seconds + MOST_BEYOND:
            raise FaceDiffError(
                f"{self.alignment}: its last phoneme ends at {end:.1f} s and the speech at "
                f"{take.recording.seconds:.1f} s; give this recording's alignment"
            )
        for sample in take.samples:
            budget = BUDGET if self.budget is None else self.budget
            closed = close_lips(sample.animation(), closed_times(phonemes), budget)
            sample.settle(replace(closed, metadata={**closed.metadata, PHONEMES: phonemes_text(phonemes)}))


class Direct(Stage):
    """Animation controls, keys over time and gestures; and the head turns as channels say."""

    def __init__(self, face: ControlledFace | None, frame_rate: float) -> None:
        self.face, self.frame_rate = face, frame_rate

    def apply(self, stretch: Stretch, amounts: Amounts | None) -> Stretch:
        """Frames with the amounts of them; None where nothing is controlled."""
        from facediff.editing.controls.procedural import move_head, moves_head

        animation, turns = stretch.animation, stretch.turns
        assert animation is not None  # noqa: S101 - decoded
        if self.face is not None and amounts is not None:
            animation = self.face.apply(animation, amounts)
        if turns is not None and not moves_head(animation):
            values, space, deltas = animation.values, animation.space, animation.deltas
            animation = move_head(animation, turns, 0 * turns)
            animation = animation if values is None else animation.made_of(space, values, deltas)
        return replace(stretch, animation=animation)

    def whole(self, take: Take) -> None:
        """Draw random numbers for all frames at once."""
        for sample in take.samples:
            amounts = self._amounts(sample.seed, 0, take.frames, sample.gestures)
            sample.change(
                lambda some, amounts=amounts: self.apply(  # type: ignore[misc]
                    some, None if amounts is None else amounts.part(slice(some.start, some.start + len(some)))
                )
            )

    def stream(self, seed: int) -> Step:
        """Only what does not depend on where the animation ends."""
        if self.face is not None:
            self.face.refuse_whole_animation()

        def apply(stretch: Stretch) -> Stretch:
            if not len(stretch):
                return stretch
            return self.apply(stretch, self._amounts(seed, stretch.start, len(stretch), stretch.gestures))

        return Each(apply)

    def _amounts(self, seed: int, start: int, frames: int, gestures: Array64 | None) -> Amounts | None:
        if self.face is None:
            return None
        return self.face.amounts(frames, self.frame_rate, seed=seed, start=start, acting=gestures)


class Retarget(Stage):
    """The motion on another mesh. All samples have one face, so that one correspondence serves all.

    Attributes:
        correspondence: between both meshes, once it is known.
        notes: about a correspondence that was fitted anew.
    """

    def __init__(self, mesh: Path, file: Path | None, *, own_shapes: bool) -> None:
        self.mesh, self.file, self.own_shapes = mesh, file, own_shapes
        self.correspondence: Correspondence | None = None
        self.notes: list[str] = []

    @property
    def z_up(self) -> bool:
        """Whether z points up in the file of the mesh."""
        from facediff.editing.retargeting import has_z_up

        return self.correspondence is not None and has_z_up(self.correspondence)

    def whole(self, take: Take) -> None:
        """Fit the first motion, and judge it by all of its frames."""
        from facediff.editing.blendshapes import has_arkit_weights

        for sample in take.samples:
            animation = sample.animation()
            if not (self.own_shapes and has_arkit_weights(animation)):
                sample.settle(self._retargeted(animation))

    def _retargeted(self, animation: Animation) -> Animation:
        from facediff.editing.retargeting import retarget, to_y_up, transfer
        from facediff.mesh import read_mesh

        if self.correspondence is not None:
            carried = transfer(animation, self.correspondence, read_mesh(self.mesh), self.own_shapes)
            return to_y_up(carried, self.correspondence)
        is_known = self.file is not None and self.file.exists()
        carried, self.correspondence = retarget(
            animation,
            self.mesh,
            self.file,
            check=None if is_known else self._judge,
            whole_head=self.own_shapes,
        )
        return carried

    def _judge(self, animation: Animation, transfer: Correspondence, report: FitReport) -> None:
        from facediff.editing.fit_check import refuse_poor

        refuse_poor(self.mesh, report)
        self.notes = [report.summary, *(f"note: {remark}" for remark in report.remarks)]


class AnimationStream:
    """Animates speech of any length and any sample rate while it arrives; memory does not grow with its length.

    The frames equal the whole recording's, however the speech is cut into pieces.

    Attributes:
        heads: how the head moved as a whole in the frames that were given last (m, 6); None if nothing moves it.
    """

    heads: Array64 | None = None

    def __init__(self, generator: VertexGenerator, steps: Sequence[Step] = (), rate: int = SAMPLE_RATE) -> None:
        self.generator, self.steps = generator, steps
        self._convert = None if rate == SAMPLE_RATE else resampler(rate)

    @property
    def made(self) -> int:
        """Frames that the model has generated so far; some of them may wait in later steps."""
        return self.generator.frames

    def feed(self, samples: Array) -> Array:
        """Take samples (n,), and give the frames (m, V, 3) that are certain now; m may be 0."""
        return self._joined([self._feed(samples if self._convert is None else self._convert(samples, False))])

    def finish(self) -> Array:
        """The frames (m, V, 3) that are left."""
        parts = [] if self._convert is None else [self._feed(self._convert(np.zeros(0, np.float32), True))]
        stretch = Stretch(self.made, self.generator.finish())
        for step in self.steps:
            stretch = step.finish(self.made, stretch)
        return self._joined([*parts, stretch])

    def _feed(self, speech: Array) -> Stretch:
        stretch = Stretch(self.made, self.generator.feed(speech))
        for step in self.steps:
            stretch = step.feed(speech, stretch)
        return stretch

    def _joined(self, parts: Sequence[Stretch]) -> Array:
        heads = [part.animation.head for part in parts if part.animation is not None]
        moving = [head for head in heads if head is not None]  # a piece without a frame has none
        self.heads = np.concatenate(moving) if moving else None
        return parts[0].vertices if len(parts) == 1 else np.concatenate([part.vertices for part in parts])
