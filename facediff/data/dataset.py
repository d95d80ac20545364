"""Clips of one split as samples: windows, style references, decoy speech."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor
from torch.utils.data import Dataset

from facediff.data.audio import samples_for
from facediff.data.batch import UNKNOWN_IDENTITY, Sample
from facediff.data.corpus import Clip, Corpus
from facediff.data.sampling import Pick
from facediff.errors import FaceDiffError

ReferenceChoice = Literal["same_subject", "self"]


@dataclass(frozen=True)
class ReferencePolicy:
    """Which clip gives a target its style reference.

    Attributes:
        candidates: clips that may serve, by subject; never a clip of an evaluated split.
        same: clip attributes that target and reference share where possible, e.g. the mood.
        choice: another clip of the same subject, or (in training only) the target itself.
        max_frames: longest reference; longer clips are cut to a window.
    """

    candidates: dict[str, list[Clip]]
    same: tuple[str, ...]
    choice: ReferenceChoice
    max_frames: int

    def check(self, targets: Sequence[Clip]) -> None:
        """Find out before training that a clip has nothing to take a style from.

        Raises:
            FaceDiffError: as :meth:`eligible`.
        """
        for clip in targets:
            if len(self.candidates.get(clip.subject, [])) < 2:
                self.eligible(clip)

    def eligible(self, target: Clip) -> list[Clip]:
        """The clips that may serve ``target``, the best matching ones, never ``target`` itself.

        Raises:
            FaceDiffError: if the subject has no other clip outside the evaluated splits.
        """
        others = [clip for clip in self.candidates.get(target.subject, []) if clip.name != target.name]
        if not others:
            raise FaceDiffError(
                f"clip {target.name}: subject {target.subject} has no other clip to take a style reference from; "
                f"add clips outside the test sentences, or train with data.reference=self"
            )
        alike = [c for c in others if all(c.attributes.get(k) == target.attributes.get(k) for k in self.same)]
        return alike or others


FeatureReader = Callable[[Clip], Tensor | None]
"""Gives the cached features (steps, channels) of a whole clip's speech, or None."""


class MotionDataset(Dataset[Sample]):
    """Samples of one split.

    Training samples draw their window and their reference at random; evaluation samples are whole clips with a
    reference fixed by the clip's name.

    Args:
        corpus: where the clips are.
        clips: the clips of the split, in order.
        identities: training identities in the order of the identity index.
        policy: how style references are chosen.
        training: random windows and references.
        window: longest training window in frames; whole clips if None.
        decoys: give every clip the speech of another sentence beside its own.
        features: gives cached features of the speech, if there are any.
    """

    def __init__(
        self,
        corpus: Corpus,
        clips: Sequence[Clip],
        identities: Sequence[str],
        policy: ReferencePolicy,
        *,
        training: bool,
        window: int | None = None,
        decoys: bool = False,
        features: FeatureReader | None = None,
    ) -> None:
        self.corpus = corpus
        self.clips = list(clips)
        self.identities = list(identities)
        self.policy = policy
        self.training = training
        self.window = window
        self.decoys = decoys
        self.features = features

    def __len__(self) -> int:
        """Number of clips."""
        return len(self.clips)

    def __getitem__(self, index: int) -> Sample:
        """Read one clip from disk; training samples are drawn with torch's global generator."""
        return self.sample(Pick(index, int(torch.randint(2**31, ())) if self.training else 0))

    def sample(self, pick: Pick) -> Sample:
        """Read one clip from disk, with the draws of a seed."""
        index, draw = pick.index, torch.Generator().manual_seed(pick.seed)
        clip = self.clips[index]
        frames = self.corpus.frames(clip)
        start, stop = self._window(frames, self.window, draw)
        reference, reference_name = self._reference(clip, draw)
        return Sample(
            audio=self.corpus.read_audio(clip, start, stop),
            motion=self.corpus.read_motion(clip, start, stop),
            template=self.corpus.template(clip),
            identity=self.identities.index(clip.subject) if clip.subject in self.identities else UNKNOWN_IDENTITY,
            reference=reference,
            name=clip.name,
            subject=clip.subject,
            sentence=clip.sentence,
            reference_name=reference_name,
            decoy_audio=self._decoy(index, stop - start) if self.decoys else None,
            features=self._features(clip, start, stop, frames),
            repeated=pick.repeated,
        )

    def frames(self) -> list[int]:
        """Frames of every sample."""
        counts = [self.corpus.frames(clip) for clip in self.clips]
        return counts if self.window is None else [min(count, self.window) for count in counts]

    def _window(self, frames: int, longest: int | None, draw: torch.Generator) -> tuple[int, int]:
        if longest is None or frames <= longest:
            return 0, frames
        start = int(torch.randint(frames - longest + 1, (), generator=draw)) if self.training else 0
        return start, start + longest

    def _reference(self, clip: Clip, draw: torch.Generator) -> tuple[Tensor, str]:
        if self.training and self.policy.choice == "self":
            source = clip
        else:
            eligible = self.policy.eligible(clip)
            pick = (
                int(torch.randint(len(eligible), (), generator=draw))
                if self.training
                else zlib.crc32(clip.name.encode()) % len(eligible)
            )
            source = eligible[pick]
        start, stop = self._window(self.corpus.frames(source), self.policy.max_frames, draw)
        return self.corpus.read_motion(source, start, stop), source.name

    def _features(self, clip: Clip, start: int, stop: int, frames: int) -> Tensor | None:
        """The steps of the whole clip's features that lie in frames ``start`` to ``stop``."""
        whole = self.features(clip) if self.features is not None else None
        if whole is None:
            return None
        per_frame = len(whole) / frames
        first = min(round(start * per_frame), len(whole) - 1)
        return whole[first : max(first + 1, math.ceil(stop * per_frame))].float()

    def _decoy(self, index: int, frames: int) -> Tensor | None:
        """The next clip of the split that says something else, repeated or cut to ``frames``; None if there is none."""
        own = self.clips[index]
        order = self.clips[index + 1 :] + self.clips[:index]
        others = [clip for clip in order if clip.sentence != own.sentence]
        if not others:
            return None
        audio = self.corpus.read_audio(others[0], 0, self.corpus.frames(others[0]))
        length = samples_for(frames, self.corpus.frame_rate)
        return audio.repeat(-(-length // len(audio)))[:length]


class BatchDataset(Dataset[list[Sample]]):
    """What :class:`~facediff.data.sampling.ClipBatches` picks from a dataset, a batch at a time."""

    def __init__(self, samples: MotionDataset) -> None:
        self.samples = samples

    def __len__(self) -> int:
        """Number of clips."""
        return len(self.samples)

    def __getitem__(self, picks: list[Pick] | int) -> list[Sample]:
        """The picked clips; a bare number, which Lightning asks for when it overfits on a few batches, is one clip."""
        if isinstance(picks, int):
            return [self.samples[picks]]
        return [self.samples.sample(pick) for pick in picks]
