"""Which clips make a batch, on which process, with which random draws."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch.utils.data import DistributedSampler

BUCKETS = 32
"""Into how many lengths a frame budget is divided for bucketing."""


@dataclass(frozen=True)
class Pick:
    """One clip of a batch.

    Attributes:
        index: which clip.
        seed: seed of its random draws (window, style reference).
        repeated: whether another process has the same clip, so that it must not be scored here.
    """

    index: int
    seed: int
    repeated: bool = False


class ClipBatches(DistributedSampler[list[Pick]]):
    """Batches of clips, the same for a seed and an epoch however many workers read them.

    Either ``batch_size`` clips a batch, or, with ``max_frames``, as many clips of like length as fit into that many
    frames once they are padded to the longest. The draws of a clip follow from seed, epoch and clip alone.

    It is a ``DistributedSampler`` in the sense that each process iterates over its own share of the same batches, so
    Lightning leaves it as it is. All processes get equally many batches, for they wait for one another at each. In
    training that may repeat some batches of an epoch's last step. In evaluation every clip is scored once: batches are
    split until their number goes up in the processes; where all are single clips, a process that would be idle in the
    last step gets a clip that is marked as repeated.

    With ``groups``, training batches are made of pairs of neighbours: clips 2k and 2k + 1 of a batch are of one group
    (one sentence, say) as far as there are such clips. A clip that is left over is paired with one that already has a
    partner.

    Args:
        lengths: frames of every clip; looked at with ``max_frames`` only.
        batch_size: clips a batch.
        max_frames: padded frames a batch; a longer clip is a batch of its own.
        training: shuffle, and let every process have equally many batches.
        seed: of order and draws.
        rank: this process.
        world_size: number of processes.
        groups: per clip what pairs have in common; None for no pairs.
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
    ) -> None:
        clips: Any = range(len(lengths))  # only its length is looked at
        super().__init__(clips, num_replicas=world_size, rank=rank, shuffle=training, seed=seed)
        self.lengths = list(lengths)
        self.batch_size = batch_size
        self.max_frames = max_frames
        self.training = training
        self.groups = list(groups) if groups is not None and training else None

    def __len__(self) -> int:
        """Number of batches of this process; the same in every epoch."""
        return -(-len(self._all(torch.Generator())) // self.num_replicas)

    def __iter__(self) -> Iterator[list[Pick]]:
        """This process's batches of the present epoch."""
        batches = self._all(torch.Generator().manual_seed(self._hash("order")))
        for place in range(self.rank, len(batches), self.num_replicas):
            # Where clips are repeated every batch is one clip, and those behind the last clip are the repeated ones.
            repeated = not self.training and place >= len(self.lengths)
            yield [Pick(i, self._hash(i) if self.training else 0, repeated) for i in batches[place]]

    def _hash(self, what: object) -> int:
        return zlib.crc32(f"{self.seed}:{self.epoch}:{what}".encode())

    def _batches(self, generator: torch.Generator) -> list[list[int]]:
        count = len(self.lengths)
        order = torch.randperm(count, generator=generator).tolist() if self.training else list(range(count))
        units = [[index] for index in order] if self.groups is None else paired(order, self.groups, generator)
        if self.max_frames is None:
            each = max(1, self.batch_size // (1 if self.groups is None else 2))
            return [sum(units[i : i + each], []) for i in range(0, len(units), each)]
        # Rounded up to a bucket, lengths give equally many batches in every epoch, whoever shares a bucket.
        width = max(1, self.max_frames // BUCKETS)
        rounded = [-(-max(self.lengths[i] for i in unit) // width) * width for unit in units]
        batches: list[list[int]] = []
        for place in sorted(range(len(units)), key=lambda k: rounded[k]):  # stable: random within a bucket
            if batches and rounded[place] * (len(batches[-1]) + len(units[place])) <= self.max_frames:
                batches[-1] += units[place]
            else:
                batches.append(list(units[place]))
        return batches

    def _all(self, generator: torch.Generator) -> list[list[int]]:
        """The batches of all processes, in turn.

        In training, batches of one step are neighbours in length, and steps are shuffled.
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


def paired(order: Sequence[int], groups: Sequence[str], generator: torch.Generator) -> list[list[int]]:
    """Clips in pairs of one group, in random order; always equally many pairs.

    Args:
        order: the clips, shuffled.
        groups: the group of every clip.
        generator: shuffles the pairs.
    """
    members: dict[str, list[int]] = {}
    for index in order:
        members.setdefault(groups[index], []).append(index)
    # Those that are alone in their group are paired with one another.
    alone = [clips[0] for clips in members.values() if len(clips) == 1]
    pools = [clips for clips in members.values() if len(clips) > 1] + ([alone] if alone else [])
    pairs = []
    for clips in pools:
        pairs += [clips[i : i + 2] for i in range(0, len(clips) - 1, 2)]
        if len(clips) % 2:
            others = clips[:-1] or [index for index in order if index != clips[-1]] or clips
            pairs.append([clips[-1], others[0]])
    return [pairs[i] for i in torch.randperm(len(pairs), generator=generator).tolist()]


def evened(batches: list[list[int]], world_size: int) -> list[list[int]]:
    """The same clips in a number of batches that ``world_size`` divides, some repeated if too few to split."""
    batches = list(batches)
    clips = sum(map(len, batches))
    if not clips:
        return batches
    up = -(-len(batches) // world_size) * world_size
    if clips >= up:
        while len(batches) < up:
            largest = max(batches, key=len)
            place, half = batches.index(largest), len(largest) // 2
            batches[place : place + 1] = [largest[:half], largest[half:]]
    else:
        singles = [[index] for batch in batches for index in batch]
        batches = [singles[i % clips] for i in range(-(-clips // world_size) * world_size)]
    return batches
