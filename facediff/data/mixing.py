"""Several corpora that a model of many faces is trained on together: batches of one corpus each, in one order."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, cast

from torch.utils.data import DataLoader, Dataset

from facediff.data.batch import Batch, Sample, collate
from facediff.data.dataset import BatchDataset, ClipBatches, Pick, ResumableBatches, ResumableLoader


class MixedBatches(ResumableBatches[tuple[str, list[Pick]]]):
    """The batches of several corpora in one order, each batch of one of them.

    An epoch has all batches of all corpora; each corpus is spread evenly over it. All processes therefore train on the
    same corpus in a step.

    Args:
        parts: the batches of each corpus by its name.
    """

    def __init__(self, parts: Mapping[str, ClipBatches]) -> None:
        first = next(iter(parts.values()))
        everything: Any = range(sum(map(len, parts.values())))  # only its length is used
        super().__init__(everything, num_replicas=first.num_replicas, rank=first.rank, seed=first.seed)
        self.parts = dict(parts)

    def __len__(self) -> int:
        """Number of batches of this process; the same in every epoch."""
        return sum(map(len, self.parts.values()))

    def __iter__(self) -> Iterator[tuple[str, list[Pick]]]:
        """This process's batches of the current epoch, with the corpus of each."""
        counts = {name: len(part) for name, part in self.parts.items()}
        # The k-th of a corpus's n batches stands at (k + ½) / n of the epoch, independently of the others.
        positions = [((k + 0.5) / count, name) for name, count in counts.items() for k in range(count)]
        order = [name for _, name in sorted(positions)]
        for name, part in self.parts.items():
            part.seed = self.seed
            part.resume(self.epoch, order[: self.done].count(name))
        remaining = {name: iter(part) for name, part in self.parts.items()}
        for name in order[self.done :]:
            yield name, next(remaining[name])


class MixedDataset(Dataset[tuple[str, list[Sample]]]):
    """The batches that :class:`MixedBatches` picks, with the corpus of each.

    Args:
        parts: the batches of each corpus by its name.
    """

    def __init__(self, parts: Mapping[str, BatchDataset]) -> None:
        self.parts = dict(parts)

    def __len__(self) -> int:
        """Number of clips of all corpora."""
        return sum(map(len, self.parts.values()))

    def __getitem__(self, picks: tuple[str, list[Pick]] | int) -> tuple[str, list[Sample]]:
        """The picked clips; a bare number, which Lightning asks for in a rehearsal, is one clip of the first corpus."""
        name, clips = (next(iter(self.parts)), picks) if isinstance(picks, int) else picks
        return name, self.parts[name][clips]


def collate_with_face(batch: Any) -> Batch:  # noqa: ANN401 - what a MixedDataset gives; a loader's type says nothing
    """Pad the samples of a batch to one that names their corpus."""
    name, samples = batch
    return replace(collate(samples), face=name)


def mixed_loader(loaders: Mapping[str, DataLoader[Any]], **options: Any) -> ResumableLoader:  # noqa: ANN401
    """One loader for several corpora.

    Args:
        loaders: one for each corpus, of a :class:`BatchDataset` and :class:`ClipBatches`, by the corpus's name.
        options: further ones of the loader.
    """
    samples: Any = MixedDataset({name: cast(BatchDataset, loader.dataset) for name, loader in loaders.items()})
    batches: Any = MixedBatches({name: cast(ClipBatches, loader.sampler) for name, loader in loaders.items()})
    return ResumableLoader(samples, sampler=batches, batch_size=None, collate_fn=collate_with_face, **options)
