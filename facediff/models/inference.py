"""Inference of a trained model: whole clips, several samples of one clip, sliding windows and streams.

From top to bottom: :class:`Inference`, the methods that every model has; how long speech is cut into windows
(:class:`WindowPlan`) and animated window by window while it arrives (:class:`SpeechStream`); and, for a model that
samples, noise that belongs to a clip or a window, and the blend of windows where they overlap.
"""

from __future__ import annotations

import threading
import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import numpy.typing as npt
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from facediff.data import Assets, Batch, Reference, Sample, collate
from facediff.errors import FaceDiffError, OptionError, check_known, refuse_idle
from facediff.models.audio_encoders import AudioEncoder
from facediff.models.layers import evaluating
from facediff.speech.audio import samples_for
from facediff.speech.windows import LOW_LATENCY, FrameClock, MotionWindow, SpeechWindows, WindowPlan

Progress = Callable[[Iterable[int]], Iterable[int]]
"""Wraps an iteration, e.g. in a progress bar."""

BatchMotion = Float[Tensor, "batch frames points dims"]
"""One motion for each clip of a batch: offsets from the template, zero on padding."""

Motion = Float[Tensor, "seeds frames points dims"]
"""One motion for each seed, of one clip."""

Expressivity = float | Float[Tensor, " vertices"]
"""How far motion goes from the mean prediction (0) to a sample (1) and beyond; one number, or one for each vertex."""


@dataclass(frozen=True)
class Style:
    """A style vector.

    Attributes:
        name: of the clip or clips that it was encoded from.
        vector: as :meth:`AnimationModel.encode_style` gives it.
    """

    name: str
    vector: Float[Tensor, " style_dim"]


def named(style: Reference | Style) -> str:
    """The name of a style; a reference has its clip's name."""
    return style.name if isinstance(style, Style) else style.clip


@dataclass
class Prediction:
    """Predicted motion of one clip; not frozen, since Lightning moves predictions between devices in place.

    Attributes:
        name: the clip.
        identity: the training identity that conditioned it, or ``unknown``.
        reference_name: the clip that gave the style.
        vertices: absolute points: vertices, or the channels of the model's space.
    """

    name: str
    identity: str
    reference_name: str
    vertices: Float[Tensor, "frames points dims"]


_CHOOSING = threading.RLock()  # one model may serve several threads; of no model, since averages copy them


class Inference(ABC):
    """The part of a model that animates.

    A model says how it generates whole clips (:meth:`generate_clips`); the rest follows. A model that samples also says
    how several samples of a clip share computations (:meth:`generate_samples`), and how a window of long speech
    continues the one before it (:meth:`generate_window`).

    Class attributes:
        samples: whether motion depends on random noise, by a sampler that :meth:`choose_sampler` changes.
        counts_own_frames: whether the model counts its frames by itself (:attr:`clock`) and encodes all samples of a
            recording; else speech is cut or filled up to whole frames.
        encodes_whole_clips: whether training encodes a clip's speech as a whole, so that its features can be kept.
        chosen: attributes that the methods ``choose_…`` change, and :meth:`choosing` restores.

    Attributes:
        frame_rate: motion frames a second.
        windows: how speech is cut that is too long for one pass; may be changed at any time.
        expressivity: how far motion goes from the mean prediction to a sample, see :meth:`choose_expressivity`.
        low_latency_steps: denoising steps at low latency; None for a model with the same steps then.
    """

    samples: ClassVar[bool] = False
    encodes_whole_clips: ClassVar[bool] = True
    counts_own_frames: ClassVar[bool] = False
    chosen: ClassVar[tuple[str, ...]] = ("windows", "expressivity")
    frame_rate: float
    windows: WindowPlan
    expressivity: Expressivity = 1.0
    low_latency_steps: int | None = None

    def animate(
        self,
        audio: Float[Tensor, " samples"],
        *,
        identity: str,
        condition: str | None = None,
        style: Reference | Style | None = None,
        seed: int = 0,
        expressivity: Expressivity | None = None,
        progress: Progress | None = None,
    ) -> Prediction:
        """Animate a known face with new speech.

        Args:
            audio: speech at 16 kHz.
            identity: the speaker of face and identity; any speaker of the training corpus, also one not trained on.
            condition: the training identity that the model is conditioned on, where it is not the face's.
            style: reference motion, or a style vector made by this model; the speaker's default one if None.
            seed: seed of the noise; equal seeds give equal motion on one machine.
            expressivity: as :meth:`choose_expressivity` takes it, for this call alone; the model's own if None.
            progress: wraps the iteration over sampling steps, or over the seconds of long speech.

        Example:
            >>> model = facediff.models.load_model(Path("demo/puppet.ckpt"))  # doctest: +SKIP
            >>> speech = torch.from_numpy(facediff.speech.audio.read_speech(Path("speech.wav")))  # doctest: +SKIP
            >>> model.animate(speech, identity="F1", seed=3).vertices.shape  # doctest: +SKIP
            torch.Size([150, 1008, 3])
        """
        return self.animate_samples(
            audio,
            identity=identity,
            condition=condition,
            style=style,
            seeds=[seed],
            expressivity=expressivity,
            progress=progress,
        )[0]

    @torch.inference_mode()
    def animate_samples(
        self,
        audio: Float[Tensor, " samples"],
        *,
        identity: str,
        condition: str | None = None,
        style: Reference | Style | None = None,
        seeds: Sequence[int],
        expressivity: Expressivity | None = None,
        progress: Progress | None = None,
    ) -> list[Prediction]:
        """Several samples for the same speech, one for each seed; the speech is encoded once."""
        clip = self.clip_of(audio, identity, style, condition)
        with self.expressed(expressivity):
            motions = self.sample_clip(clip, seeds, progress=progress)
        trained = self.assets.identities[int(clip.identity[0])] if int(clip.identity[0]) >= 0 else "unknown"
        return [
            Prediction(clip.names[0], trained, clip.reference_names[0], (motion + clip.template).cpu())
            for motion in motions
        ]

    def sample_clip(self, clip: Batch, seeds: Sequence[int], *, progress: Progress | None = None) -> Motion:
        """Several samples of one clip of any length."""
        frames = clip.motion.shape[1]
        # Long speech is a stream that happens to be known: the same windows, the same noise, the same motion.
        if self.windows.in_one_pass(frames, self.frame_rate):
            return self.generate_samples(clip, seeds, progress=progress)
        stream = SpeechStream(self, clip, seeds=seeds)
        return torch.cat(list(stream.parts(clip.audio[0].cpu().numpy(), frames=frames, progress=progress)), 1)

    @property
    def stream_timing(self) -> tuple[float, float] | None:
        """Look-ahead and length in seconds of windows of its own that streams have; None if they follow a plan."""
        return None

    @torch.inference_mode()
    def stream(
        self,
        *,
        identity: str,
        condition: str | None = None,
        style: Reference | Style | None = None,
        seeds: Sequence[int] = (0,),
        plan: WindowPlan | None = None,
        expressivity: Expressivity | None = None,
    ) -> SpeechStream:
        """Animate speech of any length while it arrives, with the options of :meth:`animate`.

        ``plan`` says how speech is cut, :attr:`windows` if None; shorter windows give frames sooner.
        """
        # The speech is not known yet; a clip of one silent frame carries the face and the style.
        frame = torch.zeros(samples_for(1, self.frame_rate), device=self.device)
        with self.expressed(expressivity):
            clip = self.clip_of(frame, identity, style, condition, frames=1)
            return SpeechStream(self, clip, seeds=seeds, plan=plan)

    def generate(
        self,
        batch: Batch,
        *,
        seed: int = 0,
        expressivity: Expressivity | None = None,
        progress: Progress | None = None,
    ) -> BatchMotion:
        """Motion for the batch's speech, identity and reference; its true motion is not used.

        Clips that last longer than ``windows.above`` are generated by windows, all others in one pass.
        """
        lengths = batch.frame_lengths.tolist()
        one_pass = [i for i, frames in enumerate(lengths) if self.windows.in_one_pass(frames, self.frame_rate)]
        if len(one_pass) == len(lengths):
            with self.expressed(expressivity):
                return self.generate_clips(batch, seed=seed, progress=progress)
        motion = torch.zeros_like(batch.motion)
        with torch.no_grad(), self.expressed(expressivity):
            if one_pass:
                together = self.generate_clips(batch.select(one_pass), seed=seed)
                motion[one_pass, : together.shape[1]] = together
            # One by one: windows continue each other, and clips of different lengths would leave rows of a batch idle.
            for i in sorted({*range(len(lengths))} - {*one_pass}):
                clip, start = batch.select([i]), 0
                speech = clip.audio[0, : int(clip.audio_lengths[0])]
                stream = SpeechStream(self, clip, seeds=[seed])
                for part in stream.parts(speech.cpu().numpy(), frames=lengths[i], progress=progress):
                    motion[i, start : start + part.shape[1]] = part[0]
                    start += part.shape[1]
        return motion

    @property
    def clock(self) -> FrameClock:
        """How the model counts its frames."""
        return FrameClock(self.frame_rate)

    def frames_of(self, samples: int) -> int:
        """Frames that the model gives for speech of so many samples at 16 kHz; 0 if it is too short for one."""
        return self.clock.frames(samples)

    def check_condition(self, condition: str | None) -> None:
        """Refuse to be conditioned on a speaker that the model was not trained on."""
        known_identities = self.assets.identities
        check_known("{condition}", "trained identity", [] if condition is None else [condition], known_identities)

    def clip_of(
        self,
        audio: Float[Tensor, " samples"],
        identity: str,
        style: Reference | Style | None,
        condition: str | None = None,
        frames: int | None = None,
    ) -> Batch:
        """Speech, a face and a style as a batch of one clip on the model's device; its motion is zero."""
        template = self.assets.template(identity)
        self.check_condition(condition)
        style = style or self.default_style(identity)
        # A style vector bypasses the style encoder; its reference is then a single frame without effect.
        nothing = template.new_zeros(1, *template.shape)
        reference = style if isinstance(style, Reference) else Reference(style.name, nothing)
        frames = self.frames_of(len(audio)) if frames is None else frames
        if frames < 1:
            raise FaceDiffError(f"the speech is shorter than one frame ({1 / self.frame_rate:.3f} s); give more of it")
        length = len(audio) if self.counts_own_frames else samples_for(frames, self.frame_rate)
        sample = Sample(
            audio=torch.nn.functional.pad(audio[:length], (0, max(0, length - len(audio)))),
            motion=torch.zeros(frames, *template.shape),
            template=template,
            identity=self.assets.identity_index(identity if condition is None else condition),
            reference=reference.motion.float(),
            name="speech",
            identity_name=identity,
            sentence="",
            reference_name=reference.clip,
            style=style.vector if isinstance(style, Style) else None,
        )
        return collate([sample]).to(self.device)

    def default_style(self, identity: str) -> Reference | Style:
        """The stored reference of an identity."""
        if identity not in self.assets.references:
            raise OptionError.naming(
                f"style: the checkpoint holds no reference motion of {identity}; give one with {{style}}"
            )
        return self.assets.references[identity]

    @property
    def animates(self) -> bool:
        """Whether the model makes motion of speech; the first stage of one that is trained in stages may not."""
        return True

    def own_styles(self) -> dict[str, Style]:
        """Styles that the model has by name, in addition to reference motion, for ``--style``; here none."""
        return {}

    def choose_sampler(self, name: str | None = None, steps: int | None = None) -> None:
        """Change the sampler for all that follows; a model that does not sample has none."""
        how = "samples in its own way only" if self.samples else "does not sample"
        raise OptionError.naming(f"{type(self).__name__} {how}: omit {{sampler}} and {{steps}}")

    def has_sampler(self, name: str | None) -> bool:
        """Whether :meth:`choose_sampler` takes this name; a model that samples is asked for registered ones."""
        return self.samples

    def choose_low_latency(self) -> None:
        """Animate with low latency from now on: frame by frame, in few denoising steps where the model samples."""
        self.windows = LOW_LATENCY

    def choose_expressivity(self, expressivity: Expressivity) -> None:
        """Go from the mean prediction (0) to a full sample (1) or beyond, for all that follows.

        Motion is mean + expressivity · (sample − mean). Speech, identity and style determine the mean; the part that
        they leave open, a sample draws at random.

        Args:
            expressivity: from 0 to 2; one number, or one for each vertex.
        """
        differs = isinstance(expressivity, Tensor) or expressivity != 1
        refuse_idle(f"{type(self).__name__} predicts no mean around which samples lie", expressivity=differs)

    @contextmanager
    def expressed(self, expressivity: Expressivity | None) -> Iterator[None]:
        """Within it, motion has another expressivity; None leaves it as it is."""
        with self.choosing():
            if expressivity is not None:
                self.choose_expressivity(expressivity)
            yield

    def choose_guidance(self, scales: Mapping[str, float]) -> None:
        """Follow some conditions more than the model would by itself, for all that follows."""
        refuse_idle(f"{type(self).__name__} cannot be guided", guidance=True)

    def choices(self) -> dict[str, object]:
        """The choices for inference: windows, expressivity, and further ones of the model."""
        return {name: vars(self)[name] for name in self.chosen if name in vars(self)}

    @contextmanager
    def choosing(self, choices: Mapping[str, object] | None = None) -> Iterator[None]:
        """Within it, the model is in evaluation mode and earlier :meth:`choices` hold; choices in it end with it."""
        with _CHOOSING, evaluating(self):  # type: ignore[arg-type] # a module, as all models are
            before = self.choices()
            self._restore(before if choices is None else choices)
            try:
                yield
            finally:
                self._restore(before)

    def _restore(self, choices: Mapping[str, object]) -> None:
        for name in self.chosen:
            if name in choices:
                setattr(self, name, choices[name])
            elif name in vars(self):
                delattr(self, name)

    # How a model generates motion. Only the first method has to be written for every model.

    @abstractmethod
    def generate_clips(self, batch: Batch, *, seed: int = 0, progress: Progress | None = None) -> BatchMotion:
        """Motion of whole clips in one pass; memory may grow with the square of their length."""

    def generate_samples(self, clip: Batch, seeds: Sequence[int], *, progress: Progress | None = None) -> Motion:
        """Several samples for one clip, which share what does not depend on the seed.

        A model without noise gives the same motion for all seeds.
        """
        return self.generate_clips(clip, seed=seeds[0], progress=progress).expand(len(seeds), -1, -1, -1)

    def generate_window(
        self, clip: Batch, window: MotionWindow, seeds: Sequence[int], before: list[Tensor] | None
    ) -> tuple[Motion, list[Tensor]]:
        """Motion of one window of long speech but for its past, which continues the window before it.

        Here for models without noise: where two windows overlap, one motion is crossfaded into the other.

        Args:
            clip: one clip with the window's speech, and some before and after it.
            window: which of its frames are returned.
            seeds: one for each sample.
            before: the window before's result to continue from; None for the first.

        Returns:
            the motion, and what to hand over to the next window.
        """
        samples = self.generate_samples(clip, seeds)
        # The past was animated only so that the network knows it; frames that were given out already must not change
        # any more.
        motion = samples[:, window.context + window.fixed : window.context + window.frames]
        if before is not None:
            motion = crossfaded(before[0], motion)
        return motion, [motion[:, max(0, motion.shape[1] - window.plan.overlap) :]]

    # What inference needs of the model.

    @property
    @abstractmethod
    def assets(self) -> Assets:
        """Templates, faces, regions, references and scale of the training corpus."""

    @property
    @abstractmethod
    def device(self) -> torch.device:
        """Where the model computes; Lightning's modules have it."""

    @property
    @abstractmethod
    def speech_encoder(self) -> AudioEncoder:
        """The audio encoder, which is told how loud a stream is."""

    @abstractmethod
    def encode_style(
        self, reference: BatchMotion, mask: Bool[Tensor, "batch frames"]
    ) -> Float[Tensor, "batch style_dim"]:
        """Style vectors of reference motions, as a batch's ``style`` takes them."""


# Streams: speech of any length, window by window while it arrives.


class SpeechStream(SpeechWindows[Motion]):
    """Animates one clip from speech that arrives in pieces, as :class:`~facediff.speech.windows.SpeechWindows` says.

    The result depends on the speech, the plan and the seeds only. It keeps the expressivity that the model has when it
    is made.

    Args:
        model: the animating model.
        clip: one clip; its identity and style are used, its speech and its motion are not used.
        seeds: one for each sample.
        plan: the windows; the model's own if None.
    """

    def __init__(
        self, model: Inference, clip: Batch, *, seeds: Sequence[int] = (0,), plan: WindowPlan | None = None
    ) -> None:
        super().__init__((plan or model.windows).in_frames(model.frame_rate), model.frame_rate)
        self.model = model
        self.seeds = list(seeds)
        self.expressivity = model.expressivity
        with torch.inference_mode():
            # Encoded once for all windows: a style that is given does not change during a recording.
            style = model.encode_style(clip.reference, clip.reference_mask) if clip.style is None else clip.style
            self.clip = replace(clip, style=style, features=None, feature_lengths=None)
        self._tail: list[Tensor] | None = None  # what the latest window hands over to the next

    def feed(self, samples: Float[Tensor, " samples"] | npt.NDArray[np.float32]) -> Motion:
        """Take more speech at 16 kHz, and return the motion that it makes final; it may have no frames."""
        return super().feed(samples.float().cpu().numpy() if isinstance(samples, Tensor) else samples)

    @torch.inference_mode()
    def generate(
        self, window: MotionWindow, speech: npt.NDArray[np.float32], frames: int, mean: float, deviation: float
    ) -> Motion:
        """By the model, at the level of all speech so far."""
        clip = with_speech(self.clip, torch.from_numpy(speech).to(self.clip.audio), frames)
        # At the level of all speech so far: a window's own level would make a pause as loud as a shout.
        level = self.model.speech_encoder.at_level(mean, deviation)
        with level, self.model.expressed(self.expressivity):
            motion, self._tail = self.model.generate_window(clip, window, self.seeds, self._tail)
        return motion

    @torch.inference_mode()
    def joined(self, parts: Sequence[Motion]) -> Motion:
        """On the model's device."""
        if not parts:
            return self.clip.motion.new_zeros(len(self.seeds), 0, *self.clip.template.shape[1:])
        return torch.cat(list(parts), 1)


def with_speech(clip: Batch, speech: Float[Tensor, " samples"], frames: int) -> Batch:
    """One clip with other speech, and motion of zeros that gives its number of frames."""
    return replace(
        clip,
        audio=speech[None],
        audio_lengths=torch.tensor([len(speech)], device=clip.audio.device),
        # A single zero, expanded: only its shape is used, and a face for every frame would take much memory.
        motion=clip.template.new_zeros(()).expand(1, frames, *clip.template.shape[1:]),
        frame_lengths=torch.tensor([frames], device=clip.audio.device),
    )


# Noise that depends on a clip's name and a seed, not on the other clips nor on how long speech is cut.


def noise_stream(name: str, seed: int, device: torch.device) -> torch.Generator:
    """A stream of random numbers of its own for a name and a seed."""
    # crc32 and not hash(), which is another number in every process.
    return torch.Generator(device).manual_seed(zlib.crc32(name.encode()) + seed)


class ClipNoise:
    """Unit Gaussian noise for a batch of clips, zero on their padding; each has a stream of its own."""

    def __init__(
        self, names: Sequence[str], lengths: Sequence[int], seeds: Sequence[int], device: torch.device
    ) -> None:
        self.lengths = list(lengths)
        self.streams = [noise_stream(name, seed, device) for name, seed in zip(names, seeds, strict=True)]

    def __call__(self, like: Float[Tensor, "batch frames width"]) -> Float[Tensor, "batch frames width"]:
        """The next noise of the shape of ``like``."""
        noise = torch.zeros_like(like)
        for row, stream, frames in zip(noise, self.streams, self.lengths, strict=True):
            row[:frames] = torch.randn((frames, like.shape[2]), device=like.device, dtype=like.dtype, generator=stream)
        return noise


class WindowNoise:
    """Unit Gaussian noise for a window of long speech: of frames shared with the one before, that one's noise."""

    def __init__(self, name: str, window: MotionWindow, seeds: Sequence[int], device: torch.device) -> None:
        self.window = window
        # Each window has a stream of its own for the frames that are new in it, so that later windows can draw the same
        # numbers again without keeping them.
        self.streams = [
            ([noise_stream(f"{name}/{index}", seed, device) for seed in seeds], index, new)
            for index, new in window.origins
        ]

    def __call__(self, like: Float[Tensor, "seeds frames width"]) -> Float[Tensor, "seeds frames width"]:
        """The next noise of the shape of ``like``."""
        return torch.cat([self._draw(streams, index, like)[:, part] for streams, index, part in self.streams], 1)

    def _draw(self, streams: Sequence[torch.Generator], index: int, like: Tensor) -> Tensor:
        """Noise of the frames that are new in a window of an index."""
        # Noise of a full window also where the speech ends earlier: its end must not change the noise of its frames.
        shape = (self.window.plan.hop if index else self.window.plan.frames, like.shape[2])
        return torch.stack([torch.randn(shape, device=like.device, dtype=like.dtype, generator=s) for s in streams])


# The overlap of windows: blended in every denoising step, not afterwards.


class WindowOverlap:
    """Blends, step by step, the features of the shared frames with those that the window before had there.

    Args:
        before: features of the window before in the shared frames, one tensor for each step; None for the first window.
        kept: the frames that the next window will share.
        fixed: shared frames at the start that are given out already.

    Attributes:
        features: features of the kept frames, one tensor for each step; the next window's ``before``.
    """

    def __init__(self, before: Sequence[Tensor] | None, kept: slice, fixed: int = 0) -> None:
        self.before = before
        self.kept = kept
        self.fixed = fixed
        self.features: list[Tensor] = []

    def __call__(self, features: Float[Tensor, "seeds frames dim"]) -> Float[Tensor, "seeds frames dim"]:
        """The features of the next step, blended."""
        # The map from features to clean motion is affine and the shares add up to one, so this is a blend of the two
        # predictions of clean motion, at the width of the model. The first shared frame keeps the old window's
        # predictions and its noise in every step, and so its motion; the network sees the shared frames as they are
        # and continues them. No jump is left at the boundary that would have to be smoothed afterwards.
        if self.before is not None:
            features = crossfaded(self.before[len(self.features)], features, self.fixed)
        self.features.append(features[:, self.kept].clone())
        return features


def crossfaded(
    before: Float[Tensor, "seeds shared *rest"], after: Float[Tensor, "seeds frames *rest"], fixed: int = 0
) -> Float[Tensor, "seeds frames *rest"]:
    """Fade from a window's frames to the next window's in the frames that they share.

    The new window's share is 0 in the ``fixed`` first frames and in the shared one behind them, which is the old
    window's alone, and would be 1 behind the last; it is smooth at both.
    """
    shared = before.shape[1]
    share = (torch.arange(shared, device=after.device, dtype=after.dtype) - fixed).clamp_min(0) / max(1, shared - fixed)
    # Smoothstep: its slope is 0 at both ends, so that velocities have no jump where windows meet.
    smooth = (share * share * (3 - 2 * share)).view(-1, *[1] * (after.dim() - 2))
    return torch.cat([torch.lerp(before, after[:, :shared], smooth), after[:, shared:]], 1)
