"""Speech of any length, in pieces as they come: windows whose seams are closed while they are made."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Protocol

import torch
from jaxtyping import Float
from torch import Tensor

from facediff.components.audio_encoder import AudioEncoder
from facediff.data import Batch
from facediff.data.audio import SAMPLE_RATE, samples_for
from facediff.errors import FaceDiffError
from facediff.systems.animation import Progress
from facediff.systems.windows import Window, WindowPlan

QUIETEST = 0.003
"""Standard deviation below which speech is not taken to be louder than it is: noise of a microphone, not speech."""


class WindowedSystem(Protocol):
    """What a system must have to animate long speech; :class:`facediff.systems.performing.Performing` has it."""

    frame_rate: float
    windows: WindowPlan

    @property
    def speech_encoder(self) -> AudioEncoder:
        """The part that hears."""
        ...

    def style_of(self, batch: Batch) -> Tensor:
        """Style vectors (batch, style_dim)."""
        ...

    def perform(self, batch: Batch, *, seed: int = 0) -> Tensor:
        """Motion (batch, frames, vertices, 3) of whole clips."""
        ...

    def perform_window(
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
        system: the animating system.
        clip: one clip; its speech and its motion are not looked at, its identity and style are.
        seeds: one for each take.
        plan: the windows; the system's own if None.

    Attributes:
        frames: how many have been given out so far.

    Raises:
        FaceDiffError: if the plan does not fit the frame rate.
    """

    def __init__(
        self, system: WindowedSystem, clip: Batch, *, seeds: Sequence[int] = (0,), plan: WindowPlan | None = None
    ) -> None:
        self.system = system
        self.seeds = list(seeds)
        self.plan = (plan or system.windows).in_frames(system.frame_rate)
        with torch.inference_mode():
            # Once for all windows: the style does not change while somebody speaks.
            self.clip = replace(clip, style=system.style_of(clip), features=None, feature_lengths=None)
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
        total = round(heard * self.system.frame_rate / SAMPLE_RATE) if frames is None else frames
        if total < 1:
            raise FaceDiffError(f"the speech is shorter than one frame ({1 / self.system.frame_rate:.3f} s)")
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
        return samples_for(frame, self.system.frame_rate)

    def _perform(self, end: int, heard: int) -> Tensor:
        """The present window up to frame ``end``, with the speech up to frame ``heard``."""
        window = self.plan.window(self._index, end - self._start)
        first, last = self._sample(self._start - window.context), self._sample(heard)
        self._level.hear(self._speech[max(0, self._level.count - self._dropped) : last - self._dropped])
        speech = self._speech[first - self._dropped : last - self._dropped]
        clip = with_speech(self.clip, speech, heard - self._start + window.context)
        with self.system.speech_encoder.at_level(self._level.mean, max(self._level.deviation, QUIETEST)):
            motion, self._tail = self.system.perform_window(clip, window, self.seeds, self._tail)
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


def windowed(system: WindowedSystem, batch: Batch, seed: int, progress: Progress | None) -> Tensor:
    """Motion of a batch in which some clips are too long to be made at once; the others are made as ever."""
    motion = torch.zeros_like(batch.motion)
    lengths = batch.frame_lengths.tolist()
    short = [i for i, frames in enumerate(lengths) if system.windows.at_once(frames, system.frame_rate)]
    if short:
        made = system.perform(batch.select(short), seed=seed)
        motion[short, : made.shape[1]] = made
    for i, frames in enumerate(lengths):
        if i not in short:
            clip = batch.select([i])
            start = 0
            for part in SpeechStream(system, clip, seeds=[seed]).over(
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
