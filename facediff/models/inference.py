"""What a model does with speech once it is trained: motion of clips, of long speech, of streams, and takes."""

from __future__ import annotations

import math
import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Protocol

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from facediff.data import Assets, Batch, Reference, Sample, collate
from facediff.data.audio import SAMPLE_RATE, samples_for
from facediff.errors import FaceDiffError
from facediff.models.audio_encoders import AudioEncoder

# What goes into and comes out of animating: a style vector, a sample made of speech, a prediction.

Progress = Callable[[Iterable[int]], Iterable[int]]
"""Wraps an iteration, e.g. in a progress bar."""


@dataclass(frozen=True)
class Style:
    """A style vector.

    Attributes:
        name: what it was made of.
        vector: as :meth:`AnimationModel.encode_style` gives it.
    """

    name: str
    vector: Float[Tensor, " style_dim"]


@dataclass
class Prediction:
    """Predicted motion of one clip; not frozen, since Lightning moves predictions between devices in place.

    Attributes:
        name: the clip.
        identity: whose identity conditioned it: a training identity, or ``unknown``.
        reference_name: the clip that gave the style.
        vertices: absolute vertices.
    """

    name: str
    identity: str
    reference_name: str
    vertices: Float[Tensor, "frames vertices 3"]


def speech_sample(audio: Float[Tensor, " samples"], assets: Assets, identity: str, style: Reference | Style) -> Sample:
    """Speech alone as a sample of the data contract; its motion gives the number of frames only.

    Args:
        audio: speech at 16 kHz.
        assets: of the checkpoint.
        identity: whose face and identity.
        style: whose manner.

    Raises:
        FaceDiffError: if the identity is unknown, the reference does not fit the topology, or the speech is shorter
            than a frame.
    """
    template = assets.template(identity)
    # A vector goes past the style path, which then has nothing to look at.
    nothing = template.new_zeros(1, *template.shape)
    reference = style if isinstance(style, Reference) else Reference(style.name, nothing)
    if reference.motion.shape[1:] != template.shape:
        raise FaceDiffError(
            f"style: the reference {reference.clip} has {reference.motion.shape[1]} vertices, the checkpoint's "
            f"faces have {len(template)}; give a motion of the same topology"
        )
    frames = round(len(audio) * assets.frame_rate / SAMPLE_RATE)
    if frames < 1:
        raise FaceDiffError(f"the speech is shorter than one frame ({1 / assets.frame_rate:.3f} s); give more of it")
    length = samples_for(frames, assets.frame_rate)
    return Sample(
        audio=torch.nn.functional.pad(audio[:length], (0, max(0, length - len(audio)))),
        motion=torch.zeros(frames, *template.shape),
        template=template,
        identity=assets.identity_index(identity),
        reference=reference.motion.float(),
        name="speech",
        identity_name=identity,
        sentence="",
        reference_name=reference.clip,
        style=style.vector if isinstance(style, Style) else None,
    )


# How long speech is cut: windows that overlap, and the speech around each that is heard with it.


@dataclass(frozen=True)
class Window:
    """One window of long speech, in frames.

    Attributes:
        index: how many windows came before it.
        context: frames before the window whose speech is heard with it, but not animated.
        frames: frames of the window.
        shared: its first frames, which the window before it has had as well; 0 for the first.
        kept: its last frames, which the next one will have as well.
        fresh: frames that a full window at its place has and the one before has not.
        fresh_before: the same of the window before it.
    """

    index: int
    context: int
    frames: int
    shared: int
    kept: int
    fresh: int
    fresh_before: int


@dataclass(frozen=True)
class WindowPlan:
    """Lengths in seconds.

    Models of this field learn from sentences of three to five seconds. Windows of that length are what they know; one
    that learnt from longer clips may do better with longer windows, and must be at ease with speech up to ``above``.

    Attributes:
        seconds: length of a window.
        overlap: how much of it the next one has as well; at most half of it.
        before: speech before the window that is heard with it.
        after: speech after the window that is heard with it.
        above: speech that lasts longer than this is animated by windows; shorter speech at once. Infinite: always at
            once.

    Raises:
        FaceDiffError: if a length is impossible.
    """

    seconds: float = 4.0
    overlap: float = 1.0
    before: float = 2.0
    after: float = 0.5
    above: float = 10.0

    def __post_init__(self) -> None:
        if not 0 < self.seconds <= 600:
            raise FaceDiffError(f"window: {self.seconds:g} s is impossible; choose e.g. 4")
        if not 0 < self.overlap <= self.seconds / 2:
            raise FaceDiffError(
                f"overlap: {self.overlap:g} s is impossible with windows of {self.seconds:g} s; choose more than 0, at "
                f"most half of a window"
            )
        if not (0 <= self.before < math.inf and 0 <= self.after < math.inf and self.above >= 0):
            raise FaceDiffError("window: the speech before and after a window cannot last less than 0 s, nor for ever")

    def in_frames(self, frame_rate: float) -> FramePlan:
        """The same in whole frames.

        Raises:
            FaceDiffError: if windows are too short for frames.
        """
        frames = round(self.seconds * frame_rate)
        # Half of a window may be rounded up where the window is rounded down.
        overlap = max(1, min(round(self.overlap * frame_rate), frames // 2))
        if frames < 4:
            raise FaceDiffError(
                f"window: {self.seconds:g} s with an overlap of {self.overlap:g} s are too few frames at "
                f"{frame_rate:g} a second; choose longer windows"
            )
        return FramePlan(frames, overlap, round(self.before * frame_rate), round(self.after * frame_rate))

    def at_once(self, frames: int, frame_rate: float) -> bool:
        """Whether so many frames are short enough to be animated at once."""
        return frames <= self.above * frame_rate

    @property
    def look_ahead(self) -> float:
        """Seconds of speech, at most, that must be heard after an instant before its frame is certain.

        The first frame of a window waits for the whole window and for the speech after it.
        """
        return self.seconds + self.after


@dataclass(frozen=True)
class FramePlan:
    """A :class:`WindowPlan` in frames.

    Attributes:
        frames: of a window.
        overlap: shared by neighbours.
        before: heard before a window.
        after: heard after it.
    """

    frames: int
    overlap: int
    before: int
    after: int

    @property
    def hop(self) -> int:
        """Frames from the start of a window to that of the next."""
        return self.frames - self.overlap

    def window(self, index: int, frames: int) -> Window:
        """The window of an index; ``frames`` long, which is less than usual for the last one."""
        return Window(
            index=index,
            context=min(self.before, index * self.hop),
            frames=frames,
            shared=self.overlap if index else 0,
            kept=self.overlap,
            fresh=self.hop if index else self.frames,
            fresh_before=self.hop if index > 1 else self.frames,
        )


# Speech of any length, in pieces as they come: windows whose seams are closed while they are made.

QUIETEST = 0.003
"""Standard deviation below which speech is not taken to be louder than it is: noise of a microphone, not speech."""


class WindowedModel(Protocol):
    """What a model must have to animate long speech; :class:`facediff.models.inference.Inference` has it."""

    frame_rate: float
    windows: WindowPlan

    @property
    def speech_encoder(self) -> AudioEncoder:
        """The part that hears."""
        ...

    def style_of(self, batch: Batch) -> Tensor:
        """Style vectors (batch, style_dim)."""
        ...

    def generate_clips(self, batch: Batch, *, seed: int = 0) -> Tensor:
        """Motion (batch, frames, vertices, 3) of whole clips."""
        ...

    def generate_window(
        self, clip: Batch, window: Window, seeds: Sequence[int], before: list[Tensor] | None
    ) -> tuple[Tensor, list[Tensor]]:
        """Motion (takes, frames, vertices, 3) of a window, and what the next one is handed."""
        ...


class SpeechStream:
    """Animates one clip from speech that comes bit by bit; memory does not grow with its length.

    Frame t is certain once the window that it lies in, but for the frames that this window shares with the next, and
    the speech after that window have been heard: :attr:`WindowPlan.look_ahead` seconds later at most. The result
    depends on the speech, the plan and the seeds only, not on how the speech was cut into pieces, and not on what comes
    after the look-ahead: it is the same for a file and for a microphone.

    Each window's speech is standardised by mean and deviation of all speech heard up to the end of that window.

    Args:
        model: the animating model.
        clip: one clip; its speech and its motion are not looked at, its identity and style are.
        seeds: one for each take.
        plan: the windows; the model's own if None.

    Attributes:
        frames: how many have been given out so far.

    Raises:
        FaceDiffError: if the plan does not fit the frame rate.
    """

    def __init__(
        self, model: WindowedModel, clip: Batch, *, seeds: Sequence[int] = (0,), plan: WindowPlan | None = None
    ) -> None:
        self.model = model
        self.seeds = list(seeds)
        self.plan = (plan or model.windows).in_frames(model.frame_rate)
        with torch.inference_mode():
            # Once for all windows: the style does not change while somebody speaks.
            self.clip = replace(clip, style=model.style_of(clip), features=None, feature_lengths=None)
        self._speech = clip.audio.new_zeros(0)
        self._dropped = 0  # samples that are not needed any more
        self._index = 0
        self._tail: list[Tensor] | None = None
        self._held: Tensor | None = None  # frames that the next window will make certain
        self._level = Level()
        self._finished = False
        self.frames = 0

    @torch.inference_mode()
    def feed(self, samples: Float[Tensor, " samples"]) -> Float[Tensor, "takes frames vertices 3"]:
        """Hear more speech at 16 kHz, and give the motion (offsets from the template) that has become certain.

        Raises:
            FaceDiffError: if the stream was finished.
        """
        self._refuse_finished()
        self._speech = torch.cat([self._speech, samples.to(self._speech)])
        made = []
        while self._dropped + len(self._speech) >= self._sample(self._end + self.plan.after):
            motion = self._perform(self._end, self._end + self.plan.after)
            made.append(motion[:, : self.plan.hop])
            self._forget()
        return self._together(made)

    @torch.inference_mode()
    def finish(self, frames: int | None = None) -> Float[Tensor, "takes frames vertices 3"]:
        """Give all that is left.

        Args:
            frames: how many frames the speech lasts in all; as many as fit its length if None.

        Raises:
            FaceDiffError: if the speech was shorter than a frame, more frames than wanted were given out already, or
                the stream was finished.
        """
        self._refuse_finished()
        self._finished = True
        heard = self._dropped + len(self._speech)
        total = round(heard * self.model.frame_rate / SAMPLE_RATE) if frames is None else frames
        if total < 1:
            raise FaceDiffError(f"the speech is shorter than one frame ({1 / self.model.frame_rate:.3f} s)")
        if total < self.frames:
            raise FaceDiffError(f"frames: {total} are fewer than the {self.frames} that have been given out already")
        missing = self._sample(total) - heard
        self._speech = torch.nn.functional.pad(self._speech, (0, max(0, missing)))
        made = []
        while self._end < total:
            made.append(self._perform(self._end, min(total, self._end + self.plan.after))[:, : self.plan.hop])
            self._forget()
        left = total - self._index * self.plan.hop
        if self._held is not None and left <= self.plan.overlap:
            made.append(self._held[:, :left])
        else:
            made.append(self._perform(total, total))
        return self._together(made)

    def over(
        self, speech: Float[Tensor, " samples"], *, frames: int | None = None, progress: Progress | None = None
    ) -> Iterator[Float[Tensor, "takes frames vertices 3"]]:
        """All motion for a recording, part by part.

        Args:
            speech: at 16 kHz.
            frames: how many frames it lasts; as many as fit its length if None.
            progress: wraps the iteration over its seconds.
        """
        last = max(0, math.ceil(len(speech) / SAMPLE_RATE) - 1)
        seconds = range(last + 1)
        for second in progress(seconds) if progress is not None else seconds:
            parts = [self.feed(speech[second * SAMPLE_RATE : (second + 1) * SAMPLE_RATE])]
            parts += [self.finish(frames)] if second == last else []
            yield from (part for part in parts if part.shape[1])

    @property
    def _start(self) -> int:
        return self._index * self.plan.hop

    @property
    def _end(self) -> int:
        return self._start + self.plan.frames

    def _sample(self, frame: int) -> int:
        return samples_for(frame, self.model.frame_rate)

    def _perform(self, end: int, heard: int) -> Tensor:
        """The present window up to frame ``end``, with the speech up to frame ``heard``."""
        window = self.plan.window(self._index, end - self._start)
        first, last = self._sample(self._start - window.context), self._sample(heard)
        self._level.hear(self._speech[max(0, self._level.count - self._dropped) : last - self._dropped])
        speech = self._speech[first - self._dropped : last - self._dropped]
        clip = with_speech(self.clip, speech, heard - self._start + window.context)
        with self.model.speech_encoder.at_level(self._level.mean, max(self._level.deviation, QUIETEST)):
            motion, self._tail = self.model.generate_window(clip, window, self.seeds, self._tail)
        self._held = motion[:, -self.plan.overlap :]
        return motion

    def _forget(self) -> None:
        """Go to the next window, and drop the speech that no window will hear again."""
        self._index += 1
        needed = self._sample(self._start - min(self.plan.before, self._start))
        drop = max(0, min(needed, self._level.count) - self._dropped)
        self._speech = self._speech[drop:]
        self._dropped += drop

    def _together(self, parts: list[Tensor]) -> Tensor:
        if not parts:
            return self.clip.motion.new_zeros(len(self.seeds), 0, *self.clip.template.shape[1:])
        self.frames += sum(part.shape[1] for part in parts)
        return torch.cat(parts, 1)

    def _refuse_finished(self) -> None:
        if self._finished:
            raise FaceDiffError("the stream is finished; start another one for more speech")


class Level:
    """Mean and standard deviation of all samples so far."""

    def __init__(self) -> None:
        self.count = 0
        self._sum = 0.0
        self._squares = 0.0

    def hear(self, samples: Float[Tensor, " samples"]) -> None:
        """Count more samples in."""
        wide = samples.cpu().double()  # not every accelerator knows float64
        self.count += len(samples)
        self._sum += float(wide.sum())
        self._squares += float(wide.square().sum())

    @property
    def mean(self) -> float:
        """0 before there is a sample."""
        return self._sum / max(self.count, 1)

    @property
    def deviation(self) -> float:
        """0 before there is a sample."""
        return math.sqrt(max(0.0, self._squares / max(self.count, 1) - self.mean**2))


def with_speech(clip: Batch, speech: Float[Tensor, " samples"], frames: int) -> Batch:
    """One clip with other speech, and motion of zeros that says how many frames it lasts."""
    return replace(
        clip,
        audio=speech[None],
        audio_lengths=torch.tensor([len(speech)], device=clip.audio.device),
        # One number that is shown everywhere: nobody reads it, and a face of it for each frame would be large.
        motion=clip.template.new_zeros(()).expand(1, frames, *clip.template.shape[1:]),
        frame_lengths=torch.tensor([frames], device=clip.audio.device),
    )


def windowed(model: WindowedModel, batch: Batch, seed: int, progress: Progress | None) -> Tensor:
    """Motion of a batch in which some clips are too long to be made at once; the others are made as ever."""
    motion = torch.zeros_like(batch.motion)
    lengths = batch.frame_lengths.tolist()
    short = [i for i, frames in enumerate(lengths) if model.windows.at_once(frames, model.frame_rate)]
    if short:
        made = model.generate_clips(batch.select(short), seed=seed)
        motion[short, : made.shape[1]] = made
    for i, frames in enumerate(lengths):
        if i not in short:
            clip = batch.select([i])
            start = 0
            for part in SpeechStream(model, clip, seeds=[seed]).over(
                clip.audio[0, : int(clip.audio_lengths[0])], frames=frames, progress=progress
            ):
                motion[i, start : start + part.shape[1]] = part[0]
                start += part.shape[1]
    return motion


def crossfaded(
    before: Float[Tensor, "takes shared *rest"], now: Float[Tensor, "takes frames *rest"]
) -> Float[Tensor, "takes frames *rest"]:
    """Go over from what a window had in the shared frames to what the next one has there, evenly.

    The first shared frame is the old window's alone.
    """
    shared = before.shape[1]
    weight = ramp(shared, now)
    weight = weight.view(-1, *[1] * (now.dim() - 2))
    return torch.cat([torch.lerp(before, now[:, :shared], weight), now[:, shared:]], 1)


def ramp(frames: int, like: Tensor) -> Float[Tensor, " frames"]:
    """Share of the new window in each shared frame: 0 at the first, 1 behind the last, smooth at both."""
    share = torch.arange(frames, device=like.device, dtype=like.dtype) / frames
    return share * share * (3 - 2 * share)


# Noise that depends on a clip's name and a seed, not on the clips beside it nor on how long speech is cut.


class ClipNoise:
    """Unit Gaussian noise for clips that are made at once, zero on their padding; each has a stream of its own.

    Args:
        names: of the clips.
        lengths: their frames.
        seeds: one for each.
        device: where the noise is drawn.
    """

    def __init__(
        self, names: Sequence[str], lengths: Sequence[int], seeds: Sequence[int], device: torch.device
    ) -> None:
        self.lengths = list(lengths)
        self.streams = [
            torch.Generator(device).manual_seed(zlib.crc32(name.encode()) + seed)
            for name, seed in zip(names, seeds, strict=True)
        ]

    def __call__(self, like: Float[Tensor, "batch frames width"]) -> Float[Tensor, "batch frames width"]:
        """The next noise of the shape of ``like``."""
        noise = torch.zeros_like(like)
        for i, (stream, frames) in enumerate(zip(self.streams, self.lengths, strict=True)):
            noise[i, :frames] = torch.randn(
                (frames, like.shape[2]), device=like.device, dtype=like.dtype, generator=stream
            )
        return noise


class WindowNoise:
    """Unit Gaussian noise for a window of long speech: in the frames it shares with the one before, that one's noise.

    Args:
        name: of the clip.
        window: which window.
        seeds: one for each take.
        device: where the noise is drawn.
    """

    def __init__(self, name: str, window: Window, seeds: Sequence[int], device: torch.device) -> None:
        self.window = window
        self.streams = [[self._stream(name, seed, window.index, device) for seed in seeds]]
        if window.shared:
            self.streams.insert(0, [self._stream(name, seed, window.index - 1, device) for seed in seeds])

    def __call__(self, like: Float[Tensor, "takes frames width"]) -> Float[Tensor, "takes frames width"]:
        """The next noise of the shape of ``like``."""
        window = self.window
        fresh = self._draw(self.streams[-1], window.fresh, like)[:, : window.frames - window.shared]
        if not window.shared:
            return fresh
        return torch.cat([self._draw(self.streams[0], window.fresh_before, like)[:, -window.shared :], fresh], 1)

    @staticmethod
    def _stream(name: str, seed: int, index: int, device: torch.device) -> torch.Generator:
        return torch.Generator(device).manual_seed(zlib.crc32(f"{name}/{index}".encode()) + seed)

    @staticmethod
    def _draw(streams: Sequence[torch.Generator], frames: int, like: Tensor) -> Tensor:
        # All of a full window's, also for the last one: where speech ends does not change the noise of its frames.
        shape = (frames, like.shape[2])
        return torch.stack([torch.randn(shape, device=like.device, dtype=like.dtype, generator=s) for s in streams])


# How windows of long speech are joined: in every denoising step, not afterwards.


class WindowOverlap:
    """Blends, step by step, the features of the shared frames with those that the window before had there.

    The map from features to clean motion is affine and the shares add up to one, so this is a blend of the two
    predictions of clean motion, at the width of the model. The first shared frame keeps the old window's predictions
    and its noise in every step, and so the old window's motion; the network sees the shared frames as they are and
    continues them. So the motion has no joint that would have to be smoothed afterwards.

    Args:
        before: features of the window before in the shared frames, one tensor for each step; None for the first window.
        kept: frames at the end that the next window will share.
    """

    def __init__(self, before: Sequence[Tensor] | None, kept: int) -> None:
        self.before = before
        self.kept = kept
        self.features: list[Tensor] = []

    def __call__(self, features: Float[Tensor, "takes frames dim"]) -> Float[Tensor, "takes frames dim"]:
        """The features of the next step, blended."""
        if self.before is not None:
            features = crossfaded(self.before[len(self.features)], features)
        self.features.append(features[:, -self.kept :].clone())
        return features


class Inference(ABC):
    """The part of a model that animates.

    A model says how it makes motion of whole clips (:meth:`perform`); the rest follows. One that draws its motion also
    says how takes share what they can, and how a window continues the one before it.

    Class attributes:
        samples: whether motion is drawn by a sampler, which :meth:`choose_sampler` changes.

    Attributes:
        frame_rate: motion frames a second.
        windows: how speech is cut that is too long to be animated at once; may be changed at any time.
    """

    samples: ClassVar[bool] = False
    frame_rate: float
    windows: WindowPlan

    @property
    @abstractmethod
    def assets(self) -> Assets:
        """Templates, faces, regions, references and scale of the training corpus."""

    @property
    @abstractmethod
    def device(self) -> torch.device:
        """Where the model computes; Lightning's modules know."""

    @property
    @abstractmethod
    def speech_encoder(self) -> AudioEncoder:
        """The part that hears: its frozen part may be computed once per clip."""

    @abstractmethod
    def encode_style(
        self, reference: Float[Tensor, "batch frames vertices 3"], mask: Bool[Tensor, "batch frames"]
    ) -> Float[Tensor, "batch style_dim"]:
        """Style vectors of reference motions, as a batch's ``style`` takes them.

        Args:
            reference: offsets from the template.
            mask: True on valid frames.

        Raises:
            FaceDiffError: if the model was made without a style.
        """

    def style_of(self, batch: Batch) -> Float[Tensor, "batch style_dim"]:
        """A batch's own style vectors, or else those of its references."""
        return self.encode_style(batch.reference, batch.reference_mask) if batch.style is None else batch.style

    @abstractmethod
    def generate_clips(
        self, batch: Batch, *, seed: int = 0, progress: Progress | None = None
    ) -> Float[Tensor, "batch frames vertices 3"]:
        """Motion of whole clips at once; memory may grow with the square of their length.

        Args:
            batch: clips; ``motion`` gives the number of frames only.
            seed: seed of the noise; a clip's noise depends on it and on the clip's name, not on the clips beside it.
            progress: wraps the iteration over steps, e.g. in a progress bar.
        """

    def generate_samples(
        self, clip: Batch, seeds: Sequence[int], *, progress: Progress | None = None
    ) -> Float[Tensor, "takes frames vertices 3"]:
        """Several motions for one clip, which share what does not depend on the seed.

        A model that draws nothing gives the same motion for all seeds.
        """
        return self.generate_clips(clip, seed=seeds[0], progress=progress).expand(len(seeds), -1, -1, -1)

    def generate_window(
        self, clip: Batch, window: Window, seeds: Sequence[int], before: list[Tensor] | None
    ) -> tuple[Float[Tensor, "takes frames vertices 3"], list[Tensor]]:
        """Motion of one window of long speech, which continues the window before it without a joint.

        Here for models that draw nothing: where two windows overlap, one motion goes over into the other.

        Args:
            clip: one clip with the window's speech, and some before and after it.
            window: which of its frames are wanted.
            seeds: one for each take.
            before: what the window before handed over; None for the first.

        Returns:
            the motion, and what to hand over to the next window.
        """
        motion = self.generate_samples(clip, seeds)[:, window.context : window.context + window.frames]
        if before is not None:
            motion = crossfaded(before[0], motion)
        return motion, [motion[:, -window.kept :]]

    def generate(
        self, batch: Batch, *, seed: int = 0, progress: Progress | None = None
    ) -> Float[Tensor, "batch frames vertices 3"]:
        """Motion for the batch's speech, identity and reference; its true motion is not looked at.

        Clips that last longer than ``windows.above`` are made by windows, all others at once.

        Args:
            batch: clips; ``motion`` gives the number of frames only.
            seed: seed of the noise; a clip's noise depends on it and on the clip's name, not on the clips beside it.
            progress: wraps the iteration over steps, or over the seconds of long speech, e.g. in a progress bar.
        """
        if self.windows.at_once(int(batch.frame_lengths.max()), self.frame_rate):
            return self.generate_clips(batch, seed=seed, progress=progress)
        with torch.no_grad():
            return windowed(self, batch, seed, progress)

    @torch.inference_mode()
    def animate(
        self,
        audio: Float[Tensor, " samples"],
        *,
        identity: str,
        style: Reference | Style | None = None,
        seed: int = 0,
        progress: Progress | None = None,
    ) -> Prediction:
        """Animate a known face with new speech.

        Args:
            audio: speech at 16 kHz.
            identity: whose face and identity; any speaker of the training corpus, also one not trained on.
            style: reference motion, or a style vector made by this model; the speaker's default one if None.
            seed: seed of the noise; equal seeds give equal motion on one machine.
            progress: wraps the iteration over sampling steps, or over the seconds of long speech.

        Raises:
            FaceDiffError: if the identity is unknown, the reference does not fit the topology, or the speech is
                shorter than a frame.
        """
        return self.animate_samples(audio, identity=identity, style=style, seeds=[seed], progress=progress)[0]

    @torch.inference_mode()
    def animate_samples(
        self,
        audio: Float[Tensor, " samples"],
        *,
        identity: str,
        style: Reference | Style | None = None,
        seeds: Sequence[int],
        progress: Progress | None = None,
    ) -> list[Prediction]:
        """Several takes of the same speech, one for each seed; the speech is encoded once.

        Args:
            audio: speech at 16 kHz.
            identity: as :meth:`animate` takes it.
            style: as :meth:`animate` takes it.
            seeds: one for each take.
            progress: as :meth:`animate` takes it.

        Raises:
            FaceDiffError: as :meth:`animate`.
        """
        clip = self.clip_of(audio, identity, style)
        if self.windows.at_once(clip.motion.shape[1], self.frame_rate):
            takes = self.generate_samples(clip, seeds, progress=progress)
        else:
            takes = torch.cat(list(SpeechStream(self, clip, seeds=seeds).over(clip.audio[0], progress=progress)), 1)
        trained = identity if int(clip.identity[0]) >= 0 else "unknown"
        return [
            Prediction(clip.names[0], trained, clip.reference_names[0], (motion + clip.template).cpu())
            for motion in takes
        ]

    @torch.inference_mode()
    def stream(
        self,
        *,
        identity: str,
        style: Reference | Style | None = None,
        seeds: Sequence[int] = (0,),
        plan: WindowPlan | None = None,
    ) -> SpeechStream:
        """Animate speech of any length, in pieces as they come.

        Args:
            identity: as :meth:`animate` takes it.
            style: as :meth:`animate` takes it.
            seeds: one for each take.
            plan: how speech is cut; shorter windows give frames sooner. :attr:`windows` if None.

        Raises:
            FaceDiffError: as :meth:`animate`.
        """
        frame = torch.zeros(samples_for(1, self.frame_rate), device=self.device)
        return SpeechStream(self, self.clip_of(frame, identity, style), seeds=seeds, plan=plan)

    def clip_of(self, audio: Float[Tensor, " samples"], identity: str, style: Reference | Style | None) -> Batch:
        """Speech, a face and a style as a batch of one clip on the model's device.

        Raises:
            FaceDiffError: as :meth:`animate`.
        """
        self.assets.template(identity)  # who is not known at all has no style either
        sample = speech_sample(audio, self.assets, identity, style or self.default_style(identity))
        return collate([sample]).to(self.device)

    def choose_sampler(self, name: str | None = None, steps: int | None = None) -> None:
        """Sample in another way from now on; a model that does not sample has no choice.

        Args:
            name: the sampler's registered name; the present one if None.
            steps: its denoising steps; its own default if None.

        Raises:
            FaceDiffError: if the model does not sample, or there is no such sampler.
        """
        raise FaceDiffError(f"{type(self).__name__} does not sample: leave --sampler and --steps away")

    def default_style(self, identity: str) -> Reference:
        """The stored reference of an identity.

        Raises:
            FaceDiffError: if it has none.
        """
        if identity not in self.assets.references:
            raise FaceDiffError(f"style: the checkpoint holds no reference motion of {identity}; give one with --style")
        return self.assets.references[identity]
