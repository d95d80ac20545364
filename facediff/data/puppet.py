"""The built-in synthetic corpus as a data module."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

from facediff import registry
from facediff import synthetic as puppet
from facediff.data.corpus import Clip
from facediff.data.datamodule import SpeechMotionDataModule, Split
from facediff.data.dataset import ReferenceChoice
from facediff.mesh import Mesh
from facediff.synthetic.face import build_face
from facediff.utils.files import cache_dir


def cache_root(seed: int) -> Path:
    """Where the corpus of a seed is kept: below ``$FACEDIFF_CACHE``, else ``~/.cache/facediff``."""
    return cache_dir() / f"puppet-{puppet.GENERATOR}-seed{seed}"


def built_in_mesh() -> Mesh:
    """The mesh of the built-in corpus, with its colours."""
    face = build_face()
    return Mesh(face.vertices, face.faces.astype("int32"), face.colours)


@registry.corpus.register("Puppet")
class Puppet(SpeechMotionDataModule):
    """The built-in corpus: a face made by code that speaks with a real speech synthesiser; made on first use.

    Synthetic: figures on it say nothing about real people. Eight speakers, 25 frames a second, metres; sentences
    1–24 train, 25–27 validate, 28–32 test six seen speakers (test A) and two unseen ones (test B).

    Args:
        root: the corpus folder; the user's cache folder if None.
        seed: seed of the corpus; another seed makes another corpus.
        batch_size: clips a batch; looked at where no frame budget is given.
        max_frames_per_batch: frame budget of a batch of clips of like length, counted with their padding.
        num_workers: loader processes.
        window: longest training window in frames; whole clips if None.
        reference: where a training target's style reference comes from: another clip of the same speaker and mood,
            or itself.
        reference_frames: longest style reference, in frames.
        predict_split: the split that ``predict`` runs over; test A if None.
        people: folders of further people with this face's topology to train on.
        extra_identities: further identities of the corpus to train on, with their clips of no split.
        train_identities: train on the clips of these people only; of all if None.
        lips: file that says which vertices are the lips, or ``all``; the corpus's own if None.
        upper_face: the same for the upper face.
    """

    corpus_name: ClassVar[str] = "puppet"
    synthetic: ClassVar[bool] = True
    unit = puppet.UNIT
    frame_rate: ClassVar[float] = float(puppet.FRAME_RATE)
    n_vertices = puppet.N_VERTICES
    identities = list(puppet.SEEN_IDENTITIES)
    mesh_files: ClassVar[tuple[str, ...]] = ("PUPPET.ply",)
    reference_attributes: ClassVar[tuple[str, ...]] = ("mood",)

    def __init__(
        self,
        *,
        root: str | None = None,
        seed: int = 0,
        batch_size: int = 8,
        max_frames_per_batch: int | None = None,
        num_workers: int = 0,
        window: int | None = None,
        reference: ReferenceChoice = "same_subject",
        reference_frames: int = 100,
        predict_split: Split | None = None,
        people: list[str] | None = None,
        extra_identities: list[str] | None = None,
        train_identities: list[str] | None = None,
        lips: str | None = None,
        upper_face: str | None = None,
    ) -> None:
        arguments = {k: v for k, v in locals().items() if k not in ("self", "__class__")}
        super().__init__(
            root=str(cache_root(seed)) if root is None else root,
            **{name: value for name, value in arguments.items() if name not in ("root", "seed")},
        )
        self.seed = seed
        self.remember(arguments)

    def prepare_data(self) -> None:
        """Make the corpus if it is not there; called on one process only."""
        if not puppet.is_complete(self.root, seed=self.seed):
            puppet.generate(self.root, seed=self.seed)

    def split_of(self, clip: Clip) -> str | None:
        """BIWI's way: by speaker and sentence number."""
        seen = clip.identity in puppet.SEEN_IDENTITIES
        if clip.number in puppet.TEST_SENTENCES:
            return "test_a" if seen else "test_b"
        if not seen:
            return None
        return "train" if clip.number in puppet.TRAIN_SENTENCES else "val"

    def default_reference(self, clips: list[Clip]) -> Clip:
        """A clip in neutral mood."""
        return next((clip for clip in clips if clip.attributes.get("mood") == "neutral"), clips[0])
