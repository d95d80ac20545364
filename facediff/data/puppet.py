"""The built-in synthetic corpus as a data module."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from facediff import registry
from facediff import synthetic as puppet
from facediff.data.corpus import Clip
from facediff.data.datamodule import Count, SpeechMotionDataModule
from facediff.errors import FaceDiffError
from facediff.mesh import Mesh
from facediff.synthetic import second_edition
from facediff.synthetic.face import build_face
from facediff.synthetic.further_speech import further_speech
from facediff.synthetic.rig import eyelid_pairs
from facediff.synthetic.speakers import MOST_DRAWN, drawn_names
from facediff.utils.files import cache_dir
from facediff.utils.licences import Commercial
from facediff.utils.ranges import Range
from facediff.utils.workers import processors


def cache_root(seed: int, drawn_speakers: int = 0, edition: int = 1, people: Sequence[str] = ()) -> Path:
    """Where the corpus of a seed is kept: below ``$FACEDIFF_CACHE``, else ``~/.cache/facediff``."""
    more = f"-drawn{drawn_speakers}" if drawn_speakers else ""
    more += f"-people{len(people)}" if people else ""
    generator = puppet.GENERATOR if edition == 1 else second_edition.GENERATOR
    return cache_dir() / f"puppet-{generator}-seed{seed}{more}"


def made_root(seed: int) -> Path | None:
    """An existing folder of :func:`cache_root`, with or without drawn speakers; None if there is none."""
    usual = cache_root(seed)
    folders = [usual, *sorted(usual.parent.glob(f"{usual.name}-drawn*"))]
    return next((folder for folder in folders if folder.is_dir()), None)


def built_in_mesh() -> Mesh:
    """The mesh of the built-in corpus, with its colours."""
    face = build_face()
    return Mesh(face.vertices, face.faces.astype("int32"), face.colours)


@registry.corpus.register("Puppet")
class Puppet(SpeechMotionDataModule):
    """The built-in corpus: a face made by code that speaks with a real speech synthesiser; made on first use.

    Synthetic: scores on it say nothing about real people. 25 frames per second, metres. In the first edition six seen
    speakers (test A) and two unseen ones (test B) have a face of 1 008 vertices; sentences 1–24 train, 25–27 validate,
    28–32 test. In the second one, six and four have a head of 5 875 vertices that ARKit's 52 shapes move; 32 sentences
    of each train, 10 test, and the voices of test C are kept out of training.

    Args:
        root: the corpus folder; the user's cache folder if None.
        seed: seed of the corpus; another seed makes another corpus.
        drawn_speakers: how many speakers with random voice, face and speaking style also say the training sentences.
            The test splits do not change.
        edition: 1 or 2.
        people_voices: let every second drawn speaker of the second edition speak with a voice made from recordings of
            people, as far as flite and Festival are installed.
        batch_size: clips a batch; used where no frame budget is given.
        options: those of every data module.
    """

    corpus_name: ClassVar[str] = "puppet"
    synthetic: ClassVar[bool] = True
    unit = puppet.UNIT
    frame_rate: ClassVar[float] = float(puppet.FRAME_RATE)
    n_vertices = puppet.N_VERTICES
    identities = list(puppet.SEEN_IDENTITIES)
    mesh_files: ClassVar[tuple[str, ...]] = ("PUPPET.ply",)
    reference_attributes: ClassVar[tuple[str, ...]] = ("mood",)
    compared_speakers: ClassVar[tuple[str, ...] | None] = (*puppet.SEEN_IDENTITIES, *puppet.UNSEEN_IDENTITIES)
    # Face and motion come from this package's code. The program espeak-ng, which speaks, is under the GPL 3, whose
    # terms cover the program and not its output (gnu.org/licenses/gpl-faq.html#GPLOutput).
    licence: ClassVar[str] = "Apache-2.0"
    languages: ClassVar[tuple[str, ...]] = ("en",)
    commercial_use: ClassVar[Commercial] = "allowed"
    licence_source: ClassVar[str] = "LICENSE of facediff, which makes it; gnu.org/licenses/gpl-faq.html#GPLOutput"

    def __init__(
        self,
        *,
        root: str | None = None,
        seed: Annotated[int, Range(0, 2**32 - 1)] = 0,
        drawn_speakers: Annotated[int, Range(0, MOST_DRAWN)] = 0,
        edition: Literal[1, 2] = 1,
        people_voices: bool = False,
        batch_size: Count = 8,
        extra_identities: list[str] | None = None,
        **options: Any,  # noqa: ANN401
    ) -> None:
        if people_voices and edition == 1:
            raise FaceDiffError("data.people_voices: belongs to the second edition; set data.edition=2 as well")
        self.edition = edition
        self.voices = second_edition.people_voices() if people_voices else ()
        super().__init__(
            root=str(cache_root(seed, drawn_speakers, edition, self.voices)) if root is None else root,
            batch_size=batch_size,
            extra_identities=[*(extra_identities or []), *drawn_names(drawn_speakers)],
            **options,
        )
        self.seed = seed
        self.drawn_speakers = drawn_speakers
        # The first identity is animated unless another is named, so it is one of the eight, not a drawn one.
        drawn = drawn_names(drawn_speakers)
        if edition == 2:  # its six seen speakers have the names of the first edition's
            self.n_vertices = second_edition.vertex_count()
        self.identities = [*(name for name in self.identities if name not in drawn), *drawn]

    def prepare_data(self) -> None:
        """Make the corpus if it does not exist; called on one process only."""
        if self.packed is not None:
            return
        if self.edition == 2:
            second_edition.generate_second(
                self.root, seed=self.seed, drawn=self.drawn_speakers, people=self.voices, workers=min(4, processors())
            )
        elif not puppet.is_complete(self.root, seed=self.seed, drawn=self.drawn_speakers):
            workers = min(4, processors()) if self.drawn_speakers else 1
            puppet.generate(self.root, seed=self.seed, drawn=self.drawn_speakers, workers=workers)

    def eyelid_pairs(self) -> Tensor | None:
        """The corpus folder's pairs, or the mesh's own where the folder comes from a version without such a file."""
        pairs = super().eyelid_pairs()
        if self.edition == 2:
            return pairs
        return torch.from_numpy(np.stack(eyelid_pairs(build_face()), 1)) if pairs is None else pairs

    def split_of(self, clip: Clip) -> str | None:
        """By speaker and sentence number, like BIWI; the second edition's table of clips says it."""
        if self.edition == 2:
            split = clip.attributes.get("split")
            return split if split in ("train", "val", "test_a", "test_b") else None
        seen = clip.identity in puppet.SEEN_IDENTITIES
        if clip.number in puppet.TEST_SENTENCES:
            return "test_a" if seen else "test_b"
        if not seen:
            return None
        return "train" if clip.number in puppet.TRAIN_SENTENCES else "val"

    def further_speech(self) -> Callable[[int], npt.NDArray[np.float32]]:
        """Random words by the training speakers."""
        if self.edition == 2:
            return partial(second_edition.spoken_words, identities=tuple(self.identities), people=self.voices)
        return partial(further_speech, identities=tuple(self.identities))

    def default_reference(self, clips: list[Clip]) -> Clip:
        """A clip in neutral mood."""
        return next((clip for clip in clips if clip.attributes.get("mood") == "neutral"), clips[0])
