"""What every corpus's data module shares; a corpus adds its facts and its splits."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, ClassVar, Literal

import torch
from lightning.pytorch import LightningDataModule
from torch.utils.data import DataLoader

from facediff.data.assets import Assets, Reference
from facediff.data.batch import Batch, Sample, collate
from facediff.data.corpus import Clip, Corpus
from facediff.data.dataset import MotionDataset, ReferenceChoice, ReferencePolicy
from facediff.errors import FaceDiffError
from facediff.hparams import plain

SCALE_FRAMES = 16
"""Frames of each training clip, evenly spread, from which the motion scale is measured."""


class SpeechMotionDataModule(LightningDataModule, ABC):
    """Speech with motion for training, validation and two tests: seen people (test A) and unseen ones (test B).

    A corpus subclasses this, states the facts below and says which clips belong to a split.

    Args:
        root: the corpus folder.
        batch_size: clips a batch.
        num_workers: loader processes.
        window: longest training window in frames; whole clips if None.
        reference: where a training target's style reference comes from: another clip of the same subject, or itself.
        reference_frames: longest style reference, in frames.
        predict_split: the split that ``predict`` runs over.
    """

    corpus_name: ClassVar[str]
    synthetic: ClassVar[bool] = False
    unit: ClassVar[str]
    frame_rate: ClassVar[float]
    n_vertices: ClassVar[int]
    identities: ClassVar[list[str]]
    mesh_file: ClassVar[str]
    region_files: ClassVar[dict[str, str]] = {"lips": "lve.txt", "upper_face": "fdd.txt"}
    reference_attributes: ClassVar[tuple[str, ...]] = ()

    def __init__(
        self,
        *,
        root: str,
        batch_size: int = 1,
        num_workers: int = 0,
        window: int | None = None,
        reference: ReferenceChoice = "same_subject",
        reference_frames: int = 100,
        predict_split: Literal["train", "val", "test_a", "test_b"] = "test_a",
    ) -> None:
        super().__init__()
        self.root = Path(root).expanduser()
        self.batch_size = batch_size
        self.num_workers = num_workers
        self.window = window
        self.reference: ReferenceChoice = reference
        self.reference_frames = reference_frames
        self.predict_split = predict_split
        self._corpus: Corpus | None = None
        self._assets: Assets | None = None

    def remember(self, arguments: dict[str, Any]) -> None:
        """Keep constructor arguments as plain data, so that checkpoints load with ``weights_only=True``."""
        self.save_hyperparameters(plain(arguments))

    @abstractmethod
    def split_of(self, clip: Clip) -> str | None:
        """The split a clip belongs to (``train``, ``val``, ``test_a``, ``test_b``), or None for none of them.

        Clips of no split may serve as style references of their subject; clips of an evaluated split never do.
        """

    @property
    def corpus(self) -> Corpus:
        """The corpus on disk."""
        if self._corpus is None:
            self._corpus = Corpus(self.root, self.n_vertices, self.frame_rate)
        return self._corpus

    @property
    def test_splits(self) -> list[str]:
        """The test splits that have clips, in the order of the test loaders."""
        return [split for split in ("test_a", "test_b") if self.clips(split)]

    def clips(self, split: str) -> list[Clip]:
        """The clips of a split, sorted by name."""
        return [clip for clip in self.corpus.clips.values() if self.split_of(clip) == split]

    def reference_policy(self) -> ReferencePolicy:
        """References come from training clips, and from clips of no split for people who are not trained on."""
        candidates: dict[str, list[Clip]] = {}
        for clip in self.corpus.clips.values():
            if self.split_of(clip) in ("train", None):
                candidates.setdefault(clip.subject, []).append(clip)
        return ReferencePolicy(candidates, self.reference_attributes, self.reference, self.reference_frames)

    def dataset(self, split: str, *, training: bool = False) -> MotionDataset:
        """The samples of a split: whole clips with fixed references, or (``training``) random windows and references.

        Raises:
            FaceDiffError: if the split has no clip.
        """
        clips = self.clips(split)
        if not clips:
            raise FaceDiffError(f"{self.root}: no clip of split {split}; check which files are there")
        return MotionDataset(
            self.corpus,
            clips,
            self.identities,
            self.reference_policy(),
            training=training,
            window=self.window if training else None,
            decoys=split.startswith("test"),
        )

    def assets(self) -> Assets:
        """What a checkpoint keeps of this corpus; the motion scale is left for :meth:`motion_scale` to measure."""
        if self._assets is None:
            corpus = self.corpus
            mesh = corpus.read_mesh(self.mesh_file)
            self._assets = Assets(
                corpus=self.corpus_name,
                synthetic=self.synthetic,
                unit=self.unit,
                frame_rate=self.frame_rate,
                identities=list(self.identities),
                templates=dict(corpus.templates),
                faces=None if mesh is None else torch.from_numpy(mesh.faces),
                colours=None if mesh is None or mesh.colours is None else torch.from_numpy(mesh.colours),
                regions={name: corpus.read_region(file, name).tensor() for name, file in self.region_files.items()},
                inner_lip_pairs=corpus.read_pairs("inner_lip_pairs.txt"),
                references=self._default_references(),
            )
        return self._assets

    def motion_scale(self) -> float:
        """Factor that gives the training motion unit variance: one over the root mean square of its coordinates.

        Offsets from the template are centred near zero. Measured on evenly spread frames of every training clip.
        """
        total, count = 0.0, 0
        for clip in self.clips("train"):
            frames = self.corpus.frames(clip)
            for index in torch.linspace(0, frames - 1, min(frames, SCALE_FRAMES)).long().tolist():
                motion = self.corpus.read_motion(clip, index, index + 1)
                total += float(motion.double().square().sum())
                count += motion.numel()
        if not total:
            raise FaceDiffError(f"{self.root}: the training split holds no motion at all; check vertices_npy/")
        return float((count / total) ** 0.5)

    def _default_references(self) -> dict[str, Reference]:
        references = {}
        for subject, clips in sorted(self.reference_policy().candidates.items()):
            if subject in self.corpus.templates:
                clip = self.default_reference(clips)
                motion = self.corpus.read_motion(clip, 0, self.reference_frames)
                references[subject] = Reference(clip.name, motion.half())
        return references

    def default_reference(self, clips: list[Clip]) -> Clip:
        """The clip whose style stands for a subject when nobody asks for another."""
        return clips[0]

    def train_dataloader(self) -> DataLoader[Sample]:
        """Shuffled training batches."""
        return self._loader("train", training=True)

    def val_dataloader(self) -> DataLoader[Sample]:
        """Validation batches in order."""
        return self._loader("val")

    def test_dataloader(self) -> list[DataLoader[Sample]]:
        """One loader per test split, in the order of :attr:`test_splits`."""
        return [self._loader(split) for split in self.test_splits]

    def predict_dataloader(self) -> DataLoader[Sample]:
        """The clips of ``predict_split`` in order."""
        return self._loader(self.predict_split)

    def _loader(self, split: str, *, training: bool = False) -> DataLoader[Sample]:
        options: dict[str, Any] = {"persistent_workers": True} if self.num_workers else {}
        return DataLoader(
            self.dataset(split, training=training),
            batch_size=self.batch_size,
            shuffle=training,
            num_workers=self.num_workers,
            collate_fn=collate,
            pin_memory=torch.cuda.is_available(),
            **options,
        )

    def transfer_batch_to_device(self, batch: Batch, device: torch.device, dataloader_idx: int) -> Batch:
        """Move every tensor of the batch."""
        return batch.to(device)
