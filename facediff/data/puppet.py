"""The built-in synthetic corpus as a data module."""

from __future__ import annotations

import os
from pathlib import Path
from typing import ClassVar, Literal

from facediff import puppet
from facediff.data.base import SpeechMotionDataModule
from facediff.data.corpus import Clip
from facediff.data.dataset import ReferenceChoice


def cache_root(seed: int) -> Path:
    """Where the corpus of a seed is kept: below ``$FACEDIFF_CACHE``, else ``~/.cache/facediff``."""
    cache = os.environ.get("FACEDIFF_CACHE") or Path.home() / ".cache" / "facediff"
    return Path(cache) / f"puppet-{puppet.GENERATOR}-seed{seed}"


class Puppet(SpeechMotionDataModule):
    """The built-in corpus: a face made by code that speaks with a real speech synthesiser; made on first use.

    Synthetic: figures on it say nothing about real people. Eight speakers, 25 frames a second, metres; sentences
    1–24 train, 25–27 validate, 28–32 test six seen speakers (test A) and two unseen ones (test B).

    Args:
        root: the corpus folder; the user's cache folder if None.
        seed: seed of the corpus; another seed makes another corpus.
        batch_size: clips a batch.
        num_workers: loader processes.
        window: longest training window in frames; whole clips if None.
        reference: where a training target's style reference comes from: another clip of the same subject and mood,
            or itself.
        reference_frames: longest style reference, in frames.
        predict_split: the split that ``predict`` runs over.
    """

    corpus_name: ClassVar[str] = "puppet"
    synthetic: ClassVar[bool] = True
    unit: ClassVar[str] = puppet.UNIT
    frame_rate: ClassVar[float] = float(puppet.FRAME_RATE)
    n_vertices: ClassVar[int] = puppet.N_VERTICES
    identities: ClassVar[list[str]] = list(puppet.SEEN_SUBJECTS)
    mesh_file: ClassVar[str] = "PUPPET.ply"
    reference_attributes: ClassVar[tuple[str, ...]] = ("mood",)

    def __init__(
        self,
        *,
        root: str | None = None,
        seed: int = 0,
        batch_size: int = 8,
        num_workers: int = 0,
        window: int | None = None,
        reference: ReferenceChoice = "same_subject",
        reference_frames: int = 100,
        predict_split: Literal["train", "val", "test_a", "test_b"] = "test_a",
    ) -> None:
        arguments = {k: v for k, v in locals().items() if k not in ("self", "__class__")}
        super().__init__(
            root=str(cache_root(seed)) if root is None else root,
            batch_size=batch_size,
            num_workers=num_workers,
            window=window,
            reference=reference,
            reference_frames=reference_frames,
            predict_split=predict_split,
        )
        self.seed = seed
        self.remember(arguments)

    def prepare_data(self) -> None:
        """Make the corpus if it is not there; called on one process only."""
        if not puppet.is_complete(self.root, seed=self.seed):
            puppet.generate(self.root, seed=self.seed)

    def split_of(self, clip: Clip) -> str | None:
        """BIWI's way: by speaker and sentence number."""
        seen = clip.subject in puppet.SEEN_SUBJECTS
        if clip.number in puppet.TEST_SENTENCES:
            return "test_a" if seen else "test_b"
        if not seen:
            return None
        return "train" if clip.number in puppet.TRAIN_SENTENCES else "val"

    def default_reference(self, clips: list[Clip]) -> Clip:
        """A clip in neutral mood."""
        return next((clip for clip in clips if clip.attributes.get("mood") == "neutral"), clips[0])
