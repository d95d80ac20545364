"""What a system does with speech once it is trained: motion of clips, of long speech, of streams, and takes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from facediff.components.audio_encoder import AudioEncoder
from facediff.data import Assets, Batch, Reference, collate
from facediff.data.audio import samples_for
from facediff.errors import FaceDiffError
from facediff.systems.animation import Prediction, Progress, Style, speech_sample
from facediff.systems.long_speech import SpeechStream, crossfaded, windowed
from facediff.systems.windows import Window, WindowPlan


class Performing(ABC):
    """The part of a system that animates.

    A system says how it makes motion of whole clips (:meth:`perform`); the rest follows. One that draws its motion also
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
        """Where the system computes; Lightning's modules know."""

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
            FaceDiffError: if the system was made without a style.
        """

    def style_of(self, batch: Batch) -> Float[Tensor, "batch style_dim"]:
        """A batch's own style vectors, or else those of its references."""
        return self.encode_style(batch.reference, batch.reference_mask) if batch.style is None else batch.style

    @abstractmethod
    def perform(
        self, batch: Batch, *, seed: int = 0, progress: Progress | None = None
    ) -> Float[Tensor, "batch frames vertices 3"]:
        """Motion of whole clips at once; memory may grow with the square of their length.

        Args:
            batch: clips; ``motion`` gives the number of frames only.
            seed: seed of the noise; a clip's noise depends on it and on the clip's name, not on the clips beside it.
            progress: wraps the iteration over steps, e.g. in a progress bar.
        """

    def perform_takes(
        self, clip: Batch, seeds: Sequence[int], *, progress: Progress | None = None
    ) -> Float[Tensor, "takes frames vertices 3"]:
        """Several motions for one clip, which share what does not depend on the seed.

        A system that draws nothing gives the same motion for all seeds.
        """
        return self.perform(clip, seed=seeds[0], progress=progress).expand(len(seeds), -1, -1, -1)

    def perform_window(
        self, clip: Batch, window: Window, seeds: Sequence[int], before: list[Tensor] | None
    ) -> tuple[Float[Tensor, "takes frames vertices 3"], list[Tensor]]:
        """Motion of one window of long speech, which continues the window before it without a joint.

        Here for systems that draw nothing: where two windows overlap, one motion goes over into the other.

        Args:
            clip: one clip with the window's speech, and some before and after it.
            window: which of its frames are wanted.
            seeds: one for each take.
            before: what the window before handed over; None for the first.

        Returns:
            the motion, and what to hand over to the next window.
        """
        motion = self.perform_takes(clip, seeds)[:, window.context : window.context + window.frames]
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
            return self.perform(batch, seed=seed, progress=progress)
        with torch.no_grad():
            return windowed(self, batch, seed, progress)

    @torch.inference_mode()
    def animate(
        self,
        audio: Float[Tensor, " samples"],
        *,
        subject: str,
        style: Reference | Style | None = None,
        seed: int = 0,
        progress: Progress | None = None,
    ) -> Prediction:
        """Animate a known face with new speech.

        Args:
            audio: speech at 16 kHz.
            subject: whose face and identity; any subject of the training corpus, also one not trained on.
            style: reference motion, or a style vector made by this system; the subject's default one if None.
            seed: seed of the noise; equal seeds give equal motion on one machine.
            progress: wraps the iteration over sampling steps, or over the seconds of long speech.

        Raises:
            FaceDiffError: if the subject is unknown, the reference does not fit the topology, or the speech is
                shorter than a frame.
        """
        return self.animate_takes(audio, subject=subject, style=style, seeds=[seed], progress=progress)[0]

    @torch.inference_mode()
    def animate_takes(
        self,
        audio: Float[Tensor, " samples"],
        *,
        subject: str,
        style: Reference | Style | None = None,
        seeds: Sequence[int],
        progress: Progress | None = None,
    ) -> list[Prediction]:
        """Several takes of the same speech, one for each seed; the speech is encoded once.

        Args:
            audio: speech at 16 kHz.
            subject: as :meth:`animate` takes it.
            style: as :meth:`animate` takes it.
            seeds: one for each take.
            progress: as :meth:`animate` takes it.

        Raises:
            FaceDiffError: as :meth:`animate`.
        """
        clip = self.clip_of(audio, subject, style)
        if self.windows.at_once(clip.motion.shape[1], self.frame_rate):
            takes = self.perform_takes(clip, seeds, progress=progress)
        else:
            takes = torch.cat(list(SpeechStream(self, clip, seeds=seeds).over(clip.audio[0], progress=progress)), 1)
        identity = subject if int(clip.identity[0]) >= 0 else "unknown"
        return [
            Prediction(clip.names[0], identity, clip.reference_names[0], (motion + clip.template).cpu())
            for motion in takes
        ]

    @torch.inference_mode()
    def stream(
        self,
        *,
        subject: str,
        style: Reference | Style | None = None,
        seeds: Sequence[int] = (0,),
        plan: WindowPlan | None = None,
    ) -> SpeechStream:
        """Animate speech of any length, in pieces as they come.

        Args:
            subject: as :meth:`animate` takes it.
            style: as :meth:`animate` takes it.
            seeds: one for each take.
            plan: how speech is cut; shorter windows give frames sooner. :attr:`windows` if None.

        Raises:
            FaceDiffError: as :meth:`animate`.
        """
        frame = torch.zeros(samples_for(1, self.frame_rate), device=self.device)
        return SpeechStream(self, self.clip_of(frame, subject, style), seeds=seeds, plan=plan)

    def clip_of(self, audio: Float[Tensor, " samples"], subject: str, style: Reference | Style | None) -> Batch:
        """Speech, a face and a style as a batch of one clip on the system's device.

        Raises:
            FaceDiffError: as :meth:`animate`.
        """
        self.assets.template(subject)  # who is not known at all has no style either
        sample = speech_sample(audio, self.assets, subject, style or self.default_style(subject))
        return collate([sample]).to(self.device)

    def choose_sampler(self, name: str | None = None, steps: int | None = None) -> None:
        """Sample in another way from now on; a system that does not sample has no choice.

        Args:
            name: the sampler's registered name; the present one if None.
            steps: its denoising steps; its own default if None.

        Raises:
            FaceDiffError: if the system does not sample, or there is no such sampler.
        """
        raise FaceDiffError(f"{type(self).__name__} does not sample: leave --sampler and --steps away")

    def default_style(self, subject: str) -> Reference:
        """The stored reference of a subject.

        Raises:
            FaceDiffError: if the subject has none.
        """
        if subject not in self.assets.references:
            raise FaceDiffError(f"style: the checkpoint holds no reference motion of {subject}; give one with --style")
        return self.assets.references[subject]
