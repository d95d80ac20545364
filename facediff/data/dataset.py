"""The clips of one split as samples: cached features, windows, style references, and how clips make batches."""

from __future__ import annotations

import hashlib
import math
import warnings
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import Any, Literal, TypeVar

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, DistributedSampler

from facediff.data.augmentation import Augmenter
from facediff.data.batch import UNKNOWN_IDENTITY, Sample
from facediff.data.corpus import Clip, Corpus
from facediff.errors import FaceDiffError
from facediff.speech.audio import samples_for
from facediff.utils.arrays import ArrayStore

B = TypeVar("B", covariant=True)
"""What an order of batches gives for each of them."""

# Features of an audio encoder's frozen part, kept on disk, one array for each clip.


class FeatureSlot:
    """Where a data set looks for cached features; its reader may be set after the loaders were made."""

    def __init__(self) -> None:
        self.reader: Callable[[Clip], Tensor | None] | None = None

    def __call__(self, clip: Clip) -> Tensor | None:
        """The features of a clip, if there are any."""
        return None if self.reader is None else self.reader(clip)


class ProjectionSlot:
    """A projection of training motion, chosen by the model when the loaders have been made already."""

    def __init__(self) -> None:
        self.project: Callable[[Tensor], Tensor] | None = None
        self._components: dict[str, Tensor] = {}
        self._shapes: dict[str, Tensor] = {}

    def choose(self, project: Callable[[Tensor], Tensor] | None) -> None:
        """Make components (T, K) of a clip's offsets (T, V, 3) from now on; None leaves them as they are."""
        self.project = project
        self._components.clear()
        self._shapes.clear()

    def read(self, corpus: Corpus, clip: Clip, start: int, stop: int) -> Tensor:
        """Some frames of a clip in the chosen form."""
        if self.project is None:
            return corpus.read_motion(clip, start, stop)
        if clip.name not in self._components:
            # By whole clips, so that a frame's components do not depend on the window in which it was read first.
            self._components[clip.name] = corpus.read_projected(clip, self.project, self._shapes)
        return self._components[clip.name][start:stop]


class CachedFeatures:
    """Reads features of speech that was encoded before training.

    Args:
        store: the folder that holds them.
        encoder_key: what decides the features in addition to the speech: weights, layer, precision.
    """

    def __init__(self, store: ArrayStore, encoder_key: str) -> None:
        self.store = store
        self.encoder_key = encoder_key
        self._keys: dict[str, str] = {}

    def add(self, corpus: Corpus, clip: Clip) -> Tensor | None:
        """Register a clip; returns its whole speech (samples,) if it must be encoded, None if it is cached."""
        audio = corpus.read_audio(clip, 0, corpus.frames(clip))
        key = self.store.key(self.encoder_key, hashlib.sha256(audio.numpy().tobytes()).hexdigest())
        self._keys[clip.name] = key
        return audio if self.store.get(key) is None else None

    def put(self, clip: Clip, features: Tensor) -> None:
        """Store the features (steps, channels) of a registered clip."""
        self.store.put(self._keys[clip.name], features.detach().float().cpu().numpy())

    def __call__(self, clip: Clip) -> Tensor | None:
        """The features (steps, channels) of a clip's whole speech; None for a clip that was not registered."""
        key = self._keys.get(clip.name)
        stored = None if key is None else self.store.get(key)
        return None if stored is None else torch.from_numpy(np.array(stored, np.float32))


# Batching: which clips form a batch, on which process, with which random numbers.

BUCKETS = 32
"""Number of length buckets that a frame budget is divided into."""


@dataclass(frozen=True)
class Pick:
    """One clip of a batch."""

    index: int
    seed: int  # of its random choices: window, style reference
    repeated: bool = False  # whether another process has the same clip, so that it must not be scored here


class ResumableBatches(DistributedSampler[B]):
    """An order of batches that can be continued in the middle of an epoch: see :attr:`done`."""

    resume_epoch = resume_batch = 0

    def resume(self, epoch: int, batch: int) -> None:
        """Continue in an epoch after some of its batches; later epochs are complete."""
        self.set_epoch(epoch)  # worker processes begin to read before Lightning sets the epoch
        self.resume_epoch, self.resume_batch = epoch, batch

    @property
    def done(self) -> int:
        """Batches of the present epoch that were taken before it was continued."""
        return self.resume_batch if self.epoch == self.resume_epoch else 0


class ClipBatches(ResumableBatches[list[Pick]]):
    """Batches of clips, which depend on seed and epoch but not on the number of loader processes.

    A batch has ``batch_size`` clips or, with ``max_frames``, as many clips of similar length as fit into that many
    frames once they are padded to the longest. Window and style reference of a clip follow from seed, epoch and clip.

    It is a ``DistributedSampler``, so that Lightning does not replace it: each process iterates over its own share of
    the same batches. All processes get equally many batches, since they wait for one another at each. In training this
    may repeat some batches in an epoch's last step. In evaluation every clip is scored once: batches are split until
    their number is a multiple of the number of processes; where all batches are single clips, a process that would be
    idle in the last step gets a clip that is marked as repeated.

    With ``groups``, training batches are made of pairs of neighbours: clips 2k and 2k + 1 of a batch are of one group
    (for example one sentence) as far as there are such clips. A clip that is left over is paired with one that already
    has a partner. With ``copies``, an epoch takes a clip several times, with other random choices each time; no pair
    has a clip twice.

    Args:
        lengths: frames of every clip; used with ``max_frames`` only.
        batch_size: clips a batch.
        max_frames: padded frames a batch; a longer clip is a batch of its own.
        training: shuffle, and repeat batches where processes would get unequally many.
        seed: seed of the order and of the clips' random choices.
        rank: this process.
        world_size: number of processes.
        groups: for each clip what pairs have in common; None for no pairs.
        copies: how often an epoch of training takes each clip; once if None.
    """

    def __init__(
        self,
        lengths: Sequence[int],
        *,
        batch_size: int,
        max_frames: int | None = None,
        training: bool = False,
        seed: int = 0,
        rank: int = 0,
        world_size: int = 1,
        groups: Sequence[str] | None = None,
        copies: Sequence[int] | None = None,
    ) -> None:
        clips: Any = range(len(lengths))  # only its length is used
        super().__init__(clips, num_replicas=world_size, rank=rank, shuffle=training, seed=seed)
        self.lengths = list(lengths)
        self.batch_size = batch_size
        self.max_frames = max_frames
        self.training = training
        self.groups = list(groups) if groups is not None and training else None
        self.copies = list(copies) if copies is not None and training else [1] * len(lengths)

    def __len__(self) -> int:
        """Number of batches of this process; the same in every epoch."""
        return -(-len(self._all(torch.Generator())) // self.num_replicas)

    def __iter__(self) -> Iterator[list[Pick]]:
        """This process's batches of the current epoch."""
        # Every process computes the batches of all and takes its share: the seed alone keeps them in agreement.
        batches = self._all(torch.Generator().manual_seed(self._hash("order")))
        for number in range(self.rank + self.done * self.num_replicas, len(batches), self.num_replicas):
            # Clips are repeated only where every batch is a single clip, so numbers past the last clip repeat one.
            repeated = not self.training and number >= len(self.lengths)
            yield [Pick(*self._pick(unit), repeated) for unit in batches[number]]

    def _hash(self, subject: object) -> int:
        return zlib.crc32(f"{self.seed}:{self.epoch}:{subject}".encode())

    def _pick(self, number: int) -> tuple[int, int]:
        """A clip and the seed of its random choices; number i + n · clips is the n-th copy of clip i."""
        copy, index = divmod(number, len(self.lengths))
        return index, self._hash(f"{index}:{copy}" if copy else index) if self.training else 0

    def _units(self, generator: torch.Generator) -> list[list[int]]:
        """Clips, or pairs of them, in the order in which batches are filled; each copy of a clip has its own place."""
        count = len(self.lengths)
        if not self.training:
            return [[index] for index in range(count)]
        units: list[list[int]] = []
        for copy in range(max(self.copies, default=1)):
            order = torch.randperm(count, generator=generator).tolist()
            clips = [index for index in order if self.copies[index] > copy]
            members = [[index] for index in clips] if self.groups is None else paired(clips, self.groups, generator)
            units += [[copy * count + index for index in unit] for unit in members]
        if max(self.copies, default=1) > 1:
            units = [units[i] for i in torch.randperm(len(units), generator=generator).tolist()]
        return units

    def _batches(self, generator: torch.Generator) -> list[list[int]]:
        units = self._units(generator)
        if self.max_frames is None:
            per_batch = max(1, self.batch_size // (1 if self.groups is None else 2))
            return [sum(units[i : i + per_batch], []) for i in range(0, len(units), per_batch)]
        # Lengths are rounded up to buckets. Otherwise the number of batches would depend on which clips the shuffle
        # puts together, and the length of an epoch would change.
        width = max(1, self.max_frames // BUCKETS)
        count = len(self.lengths)
        rounded = [-(-max(self.lengths[i % count] for i in unit) // width) * width for unit in units]
        batches: list[list[int]] = []
        for number in sorted(range(len(units)), key=lambda k: rounded[k]):  # stable: random within a bucket
            if batches and rounded[number] * (len(batches[-1]) + len(units[number])) <= self.max_frames:
                batches[-1] += units[number]
            else:
                batches.append(list(units[number]))
        return batches

    def _all(self, generator: torch.Generator) -> list[list[int]]:
        """The batches of all processes, in turn.

        In training, the batches of one step are neighbours in length, so that no process waits long for another; the
        steps are shuffled.
        """
        world, batches = self.num_replicas, self._batches(generator)
        if not self.training:
            return evened(batches, world)
        steps = [batches[i : i + world] for i in range(0, len(batches), world)]
        if steps and len(steps[-1]) < world:
            steps[-1] = [*steps[-1], *(batches * world)[: world - len(steps[-1])]]
        if self.max_frames is not None:
            steps = [steps[i] for i in torch.randperm(len(steps), generator=generator).tolist()]
        return [batch for step in steps for batch in step]


class ResumableLoader(DataLoader[list[Sample]]):
    """A loader over :class:`ResumableBatches` that continues in the middle of an epoch.

    Attributes:
        progress: gives the epoch and the number of its batches that are completed.
    """

    progress: Callable[[], tuple[int, int]] = staticmethod(lambda: (0, 0))

    def state_dict(self) -> dict[str, int]:
        """What Lightning stores in a checkpoint."""
        epoch, batches = self.progress()
        return {"epoch": epoch, "batches": batches, "of": len(self), "seed": getattr(self.sampler, "seed", 0)}

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Continue there."""
        if state["batches"] and state.get("of", len(self)) != len(self):
            warnings.warn(
                f"the checkpoint is of the middle of an epoch of {state['of']} batches, now of {len(self)}: clips are "
                "repeated or left out in the rest of it",
                stacklevel=2,
            )
        if isinstance(self.sampler, ResumableBatches):
            self.sampler.seed = state["seed"]  # a config may leave the seed to chance
            self.sampler.resume(state["epoch"], state["batches"])


def paired(order: Sequence[int], groups: Sequence[str], generator: torch.Generator) -> list[list[int]]:
    """The shuffled clips in pairs of one group, in random order; the number of pairs is always the same."""
    members: dict[str, list[int]] = {}
    for index in order:
        members.setdefault(groups[index], []).append(index)
    # Clips that are alone in their group are paired with one another.
    singles = [clips[0] for clips in members.values() if len(clips) == 1]
    pools = [clips for clips in members.values() if len(clips) > 1] + ([singles] if singles else [])
    pairs = []
    for clips in pools:
        pairs += [clips[i : i + 2] for i in range(0, len(clips) - 1, 2)]
        if len(clips) % 2:
            # Left over: it joins a clip that has a partner already; if it is alone in its pool, any other clip of the
            # epoch; if the epoch has no other clip, itself.
            partners = clips[:-1] or [index for index in order if index != clips[-1]] or clips
            pairs.append([clips[-1], partners[0]])
    return [pairs[i] for i in torch.randperm(len(pairs), generator=generator).tolist()]


def evened(batches: list[list[int]], world_size: int) -> list[list[int]]:
    """The same clips in a number of batches that ``world_size`` divides; some clips repeat if there are too few."""
    batches = list(batches)
    clips = sum(map(len, batches))
    if not clips:
        return batches
    up = -(-len(batches) // world_size) * world_size
    if clips >= up:
        # Halving the largest batch costs least: no clip is scored twice, and memory never grows.
        while len(batches) < up:
            largest = max(batches, key=len)
            number, half = batches.index(largest), len(largest) // 2
            batches[number : number + 1] = [largest[:half], largest[half:]]
    else:
        singles = [[index] for batch in batches for index in batch]
        batches = [singles[i % clips] for i in range(-(-clips // world_size) * world_size)]
    return batches


ReferenceChoice = Literal["same_subject", "any_mood", "self"]


@dataclass(frozen=True)
class ReferencePolicy:
    """Chooses the clip that a target takes its style reference from."""

    # possible references by identity; never a clip of an evaluated split where there are others
    candidates: dict[str, list[Clip]]
    same: tuple[str, ...]  # clip attributes that target and reference share where possible, e.g. the mood
    # another clip of the same speaker (same_subject); in training also such a clip of any mood (any_mood), or the
    # target itself (self)
    choice: ReferenceChoice
    max_frames: int  # longest reference; longer clips are cut to a window

    def check(self, targets: Sequence[Clip]) -> None:
        """Fail before training if a clip has no style reference."""
        for clip in targets:
            if len(self.candidates.get(clip.identity, [])) < 2:
                self.eligible(clip)

    def eligible(self, target: Clip, *, any_mood: bool = False) -> list[Clip]:
        """Possible references of ``target``, never ``target`` itself; those that match best unless ``any_mood``."""
        clips = [clip for clip in self.candidates.get(target.identity, []) if clip.name != target.name]
        if not clips:
            raise FaceDiffError(
                f"clip {target.name}: {target.identity} has no other clip that could be its style reference; add clips "
                f"outside the test sentences, or train with data.reference=self"
            )
        if any_mood:
            return clips
        alike = [c for c in clips if all(c.attributes.get(k) == target.attributes.get(k) for k in self.same)]
        return alike or clips

    def evaluated(self, target: Clip) -> Clip:
        """The reference of ``target`` in evaluation; it depends on the target's name only."""
        eligible = self.eligible(target)
        return eligible[zlib.crc32(target.name.encode()) % len(eligible)]


Aligner = Callable[[Tensor, int, Tensor, int], Tensor]
"""Aligns two recordings of the same words: from speech (samples,) and number of frames of both, it returns for each
frame of the first the corresponding frame of the second, indices (frames,)."""


FeatureReader = Callable[[Clip], Tensor | None]
"""Returns the cached features (steps, channels) of a whole clip's speech, or None."""


@dataclass(eq=False, repr=False)
class MotionDataset(Dataset[Sample]):
    """Samples of one split.

    Training samples have a random window and a random reference; evaluation samples are whole clips with a
    reference that follows from the clip's name.

    Args:
        corpus: the corpus that holds the clips.
        clips: the clips of the split, in order.
        identities: training identities in the order of the identity index.
        policy: how style references are chosen.
        training: random windows and references.
        window: longest training window in frames; whole clips if None.
        decoys: add the speech of another sentence to every clip, for the evaluation with shuffled audio.
        features: returns cached features of the speech, if there are any.
        texts: what each clip says, where that is not its sentence; clips of equal text can be aligned.
        context: frames before and after a training window that are read with it.
        aligner: lets the windows of two clips that say the same begin at the same sound; None leaves them to chance.
        augmenter: changes training speech; None leaves it as it was recorded.
        augmented_clips: patterns of attributes, of which the augmenter changes only clips that fit them.
        projection: may make components (T, K) of motion (T, V, 3), which are kept in memory.
    """

    corpus: Corpus
    clips: list[Clip]
    identities: list[str]
    policy: ReferencePolicy
    _: KW_ONLY
    training: bool
    window: int | None = None
    decoys: bool = False
    features: FeatureReader | None = None
    texts: list[str] | None = None
    context: tuple[int, int] = (0, 0)
    aligner: Aligner | None = None
    augmenter: Augmenter | None = None
    augmented_clips: Mapping[str, str] = field(default_factory=dict)
    projection: ProjectionSlot = field(default_factory=ProjectionSlot)
    _alignments: dict[tuple[int, int], Tensor] = field(default_factory=dict)

    def __len__(self) -> int:
        """Number of clips."""
        return len(self.clips)

    def __getitem__(self, index: int) -> Sample:
        """Read one clip from disk; in training, window and reference depend on torch's global generator."""
        return self.sample(Pick(index, int(torch.randint(2**31, ())) if self.training else 0))

    def sample(self, pick: Pick, begin: int | None = None) -> Sample:
        """Read one clip from disk, with a window and a reference that follow from a seed.

        Args:
            pick: the clip and the seed.
            begin: where the window begins, if that is known already.
        """
        index, clip = pick.index, self.clips[pick.index]
        frames, random = self.corpus.frames(clip), torch.Generator().manual_seed(pick.seed)
        start, stop = self._window(frames, self.window, random)
        if begin is not None:
            start, stop = begin, begin + stop - start
        source = self._reference(clip, random)
        earliest, latest = self._window(self.corpus.frames(source), self.policy.max_frames, random)
        # A training window comes with the frames around it, as far as the clip has them.
        first, last = max(0, start - self.context[0]), min(frames, stop + self.context[1])
        audio = self.corpus.read_audio(clip, first, last)
        motion = self.projection.read(self.corpus, clip, first, last)
        if self.augmenter is not None and clip.fits(self.augmented_clips):
            audio = torch.from_numpy(self.augmenter(audio.numpy(), pick.seed))
        return Sample(
            audio=audio,
            motion=motion,
            template=self.corpus.template(clip),
            identity=self.identities.index(clip.identity) if clip.identity in self.identities else UNKNOWN_IDENTITY,
            reference=self.projection.read(self.corpus, source, earliest, latest),
            name=clip.name,
            identity_name=clip.identity,
            sentence=self.says(index),
            reference_name=source.name,
            decoy_audio=self._decoy(index, last - first) if self.decoys else None,
            features=self._features(clip, first, last, frames),
            repeated=pick.repeated,
            window=(start - first, stop - first) if any(self.context) else None,
        )

    def says(self, index: int) -> str:
        """The text of a clip, or its sentence: clips for which it is equal have the same words and can be aligned."""
        return self.clips[index].sentence if self.texts is None else self.texts[index]

    def pair(self, first: Pick, second: Pick) -> list[Sample]:
        """Two neighbours of a batch; if they say the same, their windows begin at the same sound.

        The first clip's window is random, the second one's begins at the frame that goes with the first one's.
        """
        picks, indices = (first, second), (first.index, second.index)
        alike = first.index != second.index and self.says(first.index) == self.says(second.index)
        if self.aligner is None or self.window is None or not alike:
            return [self.sample(pick) for pick in picks]
        counts = [self.corpus.frames(self.clips[index]) for index in indices]
        paths = [self._path(self.aligner, *indices), self._path(self.aligner, *reversed(indices))]
        start, _ = self._window(counts[0], self.window, torch.Generator().manual_seed(first.seed))
        # A window near the end of the second clip is moved back, so that it has its full length.
        begins = [start, max(0, min(int(paths[0][start]), counts[1] - self.window))]
        samples = [self.sample(pick, begin) for pick, begin in zip(picks, begins, strict=True)]
        # Where each sample begins in its clip: before its window, if it comes with the frames around it.
        firsts = [
            begin - (0 if sample.window is None else sample.window[0])
            for begin, sample in zip(begins, samples, strict=True)
        ]
        for sample, partner in ((0, 1), (1, 0)):
            begin, count = firsts[sample], len(samples[sample].motion)
            frames = paths[sample][begin : begin + count] - firsts[partner]
            outside = (frames < 0) | (frames >= len(samples[partner].motion))
            samples[sample] = replace(samples[sample], partner_frames=frames.masked_fill(outside, -1))
        return samples

    def _path(self, aligner: Aligner, first: int, second: int) -> Tensor:
        """For each frame of a whole clip the frame of another one that says the same; computed once."""
        if (first, second) not in self._alignments:
            clips = [self.clips[first], self.clips[second]]
            counts = [self.corpus.frames(clip) for clip in clips]
            audio = [self.corpus.read_audio(clip, 0, count) for clip, count in zip(clips, counts, strict=True)]
            self._alignments[first, second] = aligner(audio[0], counts[0], audio[1], counts[1])
        return self._alignments[first, second]

    def frames(self) -> list[int]:
        """Frames of every sample."""
        counts = [self.corpus.frames(clip) for clip in self.clips]
        if self.window is None:
            return counts
        longest = self.window + sum(self.context)
        return [min(count, longest) for count in counts]

    def _window(self, frames: int, longest: int | None, random: torch.Generator) -> tuple[int, int]:
        if longest is None or frames <= longest:
            return 0, frames
        start = int(torch.randint(frames - longest + 1, (), generator=random)) if self.training else 0
        return start, start + longest

    def _reference(self, clip: Clip, random: torch.Generator) -> Clip:
        if not self.training:
            return self.policy.evaluated(clip)
        if self.policy.choice == "self":
            return clip
        eligible = self.policy.eligible(clip, any_mood=self.policy.choice == "any_mood")
        return eligible[int(torch.randint(len(eligible), (), generator=random))]

    def _features(self, clip: Clip, start: int, stop: int, frames: int) -> Tensor | None:
        """The steps of the whole clip's features that lie in frames ``start`` to ``stop``."""
        features = self.features(clip) if self.features is not None else None
        if features is None:
            return None
        per_frame = len(features) / frames
        first = min(round(start * per_frame), len(features) - 1)
        return features[first : max(first + 1, math.ceil(stop * per_frame))].float()

    def _decoy(self, index: int, frames: int) -> Tensor | None:
        """Speech of the next clip with another sentence, repeated or cut to ``frames``; None if there is none.

        Neither the sentence's name nor its text, where that is known, may be the same.
        """
        order = [*range(index + 1, len(self.clips)), *range(index)]
        sentence, text = self.clips[index].sentence, self.says(index)
        other = next((k for k in order if self.clips[k].sentence != sentence and self.says(k) != text), None)
        if other is None:
            return None
        clip = self.clips[other]
        audio = self.corpus.read_audio(clip, 0, self.corpus.frames(clip))
        length = samples_for(frames, self.corpus.frame_rate)
        return audio.repeat(-(-length // len(audio)))[:length]


class BatchDataset(Dataset[list[Sample]]):
    """The batches that :class:`~facediff.data.dataset.ClipBatches` picks from a data set.

    Args:
        samples: the data set.
    """

    def __init__(self, samples: MotionDataset) -> None:
        self.samples = samples

    def __len__(self) -> int:
        """Number of clips."""
        return len(self.samples)

    def __getitem__(self, picks: list[Pick] | int) -> list[Sample]:
        """The picked clips; a bare number, which Lightning asks for when it overfits on a few batches, is one clip."""
        if isinstance(picks, int):
            return [self.samples[picks]]
        if self.samples.aligner is None:
            return [self.samples.sample(pick) for pick in picks]
        pairs = [self.samples.pair(*picks[i : i + 2]) for i in range(0, len(picks) - 1, 2)]
        return [*sum(pairs, []), *(self.samples.sample(pick) for pick in picks[2 * len(pairs) :])]
