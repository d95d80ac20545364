"""The built-in synthetic corpus as a data module."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from facediff import registry
from facediff.data.corpus import Clip, Corpus
from facediff.data.datamodule import Count, SpeechMotionDataModule, person_name, split_in_table
from facediff.data.manifest import read_manifest
from facediff.data.storage import RIGS_FOLDER, WEIGHTS_FOLDER, ChannelFolder, ClipStorage
from facediff.errors import FaceDiffError
from facediff.spaces import Rotation, Space
from facediff.synthetic import corpus as puppet
from facediff.synthetic.cast import ALIGNED, MOST_DRAWN, SEEN, UNSEEN, drawn_names, recorded_names
from facediff.synthetic.head.rig import SHAPES
from facediff.synthetic.known_faces import built_in_rig as built_in_rig
from facediff.synthetic.recordings import speakers_of, state_of
from facediff.utils.arrays import open_array, open_vertices
from facediff.utils.files import cache_dir
from facediff.utils.licences import Commercial
from facediff.utils.ranges import Range
from facediff.utils.workers import processors

TURNS = ("Head", "LeftEye", "RightEye")
"""What turns as a whole in the corpus's channels, by yaw, pitch and roll each, as in Live Link Face."""


def channel_space() -> Space:
    """The space of the corpus's channels: ARKit's shapes and two of the tongue, head and gaze in radians.

    Yaw is to the face's left, pitch down, roll towards its right shoulder: turns about y, x and z, as facediff.spaces
    takes Euler angles.
    """
    angles = tuple(f"{turn}{angle}" for turn in TURNS for angle in ("Yaw", "Pitch", "Roll"))
    identity = f"{puppet.CORPUS} {puppet.GENERATOR} {' '.join(SHAPES)}"
    first = len(SHAPES)
    return Space(
        "arkit",
        (*SHAPES, *angles),
        version="arkit",
        rig=puppet.CORPUS,
        # The shapes follow from the generator, to the last digit only on one machine.
        rig_hash=hashlib.sha256(identity.encode()).hexdigest()[:16],
        rotations=(
            Rotation("head", first, "euler"),
            Rotation("left_eye", first + 3, "euler"),
            Rotation("right_eye", first + 6, "euler"),
        ),
        valid_range=(0.0, 1.0),
        identity="rigs of speakers",
    )


class PuppetChannels(ChannelFolder):
    """Weights, head and gaze as channels of :func:`channel_space`."""

    folder = WEIGHTS_FOLDER

    def values(self, name: str) -> npt.NDArray[np.floating]:
        """Weights, then yaw, pitch and roll of the head and of both eyes, which turn alike; (frames, 63)."""
        weights, gaze, head = (
            open_array(self.root / folder / f"{name}.npy", kinds="f")
            for folder in (WEIGHTS_FOLDER, "gaze_npy", "head_npy")
        )
        pitch, yaw, roll = np.deg2rad(np.asarray(head, np.float64)).T
        left, up = np.deg2rad(np.asarray(gaze, np.float64)).T
        eye = (left, -up, np.zeros_like(up))
        turns = np.stack([yaw, pitch, -roll, *eye, *eye], axis=1)
        return np.concatenate([weights, turns], axis=1).astype(np.float32)


def cache_root(seed: int = 0, drawn_speakers: int = 0, people: Sequence[str] = ()) -> Path:
    """The corpus's folder: below ``$FACEDIFF_CACHE``, else ``~/.cache/facediff``."""
    more = f"-drawn{drawn_speakers}" if drawn_speakers else ""
    more += f"-people{len(people)}" if people else ""
    # Two folders of recordings may have equally many speakers, and a TextGrid may be corrected.
    if recorded_names(people):
        more += "-" + hashlib.sha256("\n".join([*people, state_of(people)]).encode()).hexdigest()[:8]
    return cache_dir() / f"puppet-{puppet.GENERATOR}-seed{seed}{more}"


def made_root() -> Path | None:
    """An existing folder of :func:`cache_root`, of seed 0; None if there is none."""
    root = cache_root(0)
    return next((folder for folder in (root, *sorted(root.parent.glob(f"{root.name}-*"))) if folder.is_dir()), None)


@registry.corpus.register("Puppet")
class Puppet(SpeechMotionDataModule):
    """The built-in corpus: a head made by code that speaks with real speech synthesisers; made on first use.

    Synthetic: scores on it say nothing about real people. 25 frames per second, metres. Six seen speakers say 32
    sentences in training and 10 on test A, four unseen ones 10 on test B, and test C has voices outside the training
    data.

    Args:
        root: the corpus folder; the user's cache folder if None.
        seed: seed of the corpus; another seed makes another corpus.
        drawn_speakers: how many speakers with random voice, face and speaking style also say training sentences.
            The test splits do not change.
        people_voices: let every second drawn speaker speak with a voice made from recordings of people, if flite is
            installed.
        recordings: folder of people's recordings as `facediff data align` writes them, ``SPEAKER/NAME.wav`` or
            ``.flac`` with ``NAME.TextGrid``: each person is a speaker more, with a drawn face and speaking style.
        motion: ``vertices``, or ``arkit`` for the truth as it is kept: ARKit's 52 shapes and two of
            the tongue, the turns of head and eyes; see docs/parameters.md.
        batch_size: clips a batch; used where no frame budget is given.
        options: as for every data module.
    """

    corpus_name: ClassVar[str] = "puppet"
    synthetic: ClassVar[bool] = True
    makes_itself: ClassVar[bool] = True
    unit = puppet.UNIT
    frame_rate: ClassVar[float] = float(puppet.FRAME_RATE)
    n_vertices = puppet.vertex_count()
    identities = list(SEEN)
    mesh_files: ClassVar[tuple[str, ...]] = ("PUPPET.ply",)
    reference_attributes: ClassVar[tuple[str, ...]] = ("mood",)
    # Face and motion come from this package's code. The program espeak-ng, which speaks, is under the GPL 3; its
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
        people_voices: bool = False,
        recordings: str | None = None,
        motion: Literal["vertices", "arkit"] = "vertices",
        batch_size: Count = 8,
        extra_identities: list[str] | None = None,
        **options: Any,  # noqa: ANN401
    ) -> None:
        people = puppet.people_voices() if people_voices else ()
        if recordings is not None:
            speakers = speakers_of(Path(recordings).expanduser().absolute())
            people = (*people, *(f"{ALIGNED}:{speaker}" for speaker in speakers))
        invented = (*drawn_names(drawn_speakers), *recorded_names(people))
        super().__init__(
            root=str(cache_root(seed, drawn_speakers, people)) if root is None else root,
            batch_size=batch_size,
            extra_identities=[*(extra_identities or []), *invented],
            **options,
        )
        if str(read_manifest(self.root).get("generator", "")).startswith("1."):
            raise FaceDiffError(
                f"{self.root}: holds the first edition of the built-in corpus, which 1.1 was the last to read; choose "
                f"another folder, or remove it"
            )
        self.seed, self.drawn, self.invented, self.voices = seed, drawn_speakers, invented, people
        if motion != "vertices":
            self.space = channel_space()
            self.n_vertices = len(self.space.channels)
        self.compared_speakers = (*SEEN, *UNSEEN)
        # The first identity is animated unless another is named, so it is one of the cast, not a drawn one.
        self.identities = [*(name for name in self.identities if name not in invented), *invented]

    def prepare_data(self) -> None:
        """Make the corpus if it does not exist; called on one process only."""
        if self.packed is None:
            workers = min(4, processors()) if self.invented else 1
            puppet.generate(self.root, seed=self.seed, drawn=self.drawn, people=self.voices, workers=workers)
        super().prepare_data()

    def channel_folder(self) -> ClipStorage:
        """Weights, head and gaze."""
        return PuppetChannels(self.root, self.space)

    @cached_property
    def mesh_corpus(self) -> Corpus | None:
        """The corpus as vertices."""
        if self.space.is_vertices:
            return self.corpus
        return Corpus(self.root, type(self).n_vertices, self.frame_rate, parse=self.parse_name)

    def deltas(self) -> dict[str, Tensor]:
        """The shapes of the cast; drawn speakers have theirs in the corpus's folder only."""
        files = {name: self.root / RIGS_FOLDER / f"{name}.npy" for name in sorted(self.corpus.templates)}
        return {
            name: torch.from_numpy(np.array(open_vertices(file, type(self).n_vertices)[1:], np.float32))
            for name, file in files.items()
            # An imported speaker has no shapes: the mean of all others' moves their face.
            if self.stores_reference(name) and (file.is_file() or name not in map(person_name, self.people))
        }

    def split_of(self, clip: Clip) -> str | None:
        """By the table of clips."""
        return split_in_table(clip) if clip.attributes else None

    def further_speech(self) -> Callable[[int], npt.NDArray[np.float32]]:
        """Random words by the training speakers."""
        return partial(puppet.spoken_words, identities=tuple(self.identities), people=self.voices)

    def stores_reference(self, identity: str) -> bool:
        """True for the cast: drawn speakers are there to learn from, and 42 of their clips take 90 MB."""
        return identity not in self.invented

    def default_reference(self, clips: list[Clip]) -> Clip:
        """A clip in neutral mood."""
        return next((clip for clip in clips if clip.attributes.get("mood") == "neutral"), clips[0])


@registry.corpus.register("PuppetMask")
class PuppetMask(SpeechMotionDataModule):
    """A second corpus by the same code, to try models on another one: a mask of 23 550 vertices, 30 frames a second.

    Synthetic. Eight seen speakers and four unseen ones, whom the first corpus does not have, say 32 other sentences:
    1–24 train, 25–27 validate, 28–32 test A and B. Metres.

    Args:
        root: the corpus folder; the user's cache folder if None.
        seed: seed of the corpus; another seed makes another corpus.
        batch_size: clips a batch; used where no frame budget is given.
        options: as for every data module.
    """

    corpus_name: ClassVar[str] = "puppet_mask"
    synthetic: ClassVar[bool] = True
    makes_itself: ClassVar[bool] = True
    unit = puppet.UNIT
    frame_rate: ClassVar[float] = float(puppet.MASK.frame_rate)
    n_vertices = puppet.vertex_count(puppet.MASK)
    identities = list(puppet.MASK_SEEN)
    mesh_files: ClassVar[tuple[str, ...]] = (puppet.MASK.mesh_file,)
    reference_attributes: ClassVar[tuple[str, ...]] = ("mood",)
    licence: ClassVar[str] = Puppet.licence
    languages: ClassVar[tuple[str, ...]] = ("en",)
    commercial_use: ClassVar[Commercial] = "allowed"
    licence_source: ClassVar[str] = Puppet.licence_source

    def __init__(
        self,
        *,
        root: str | None = None,
        seed: Annotated[int, Range(0, 2**32 - 1)] = 0,
        batch_size: Count = 8,
        **options: Any,  # noqa: ANN401
    ) -> None:
        folder = cache_dir() / f"puppet-mask-{puppet.GENERATOR}-seed{seed}"
        super().__init__(root=str(folder) if root is None else root, batch_size=batch_size, **options)
        self.seed = seed

    def prepare_data(self) -> None:
        """Make the corpus if it does not exist; called on one process only."""
        if self.packed is None:
            puppet.generate(self.root, seed=self.seed, workers=min(4, processors()), variant=puppet.MASK)
        super().prepare_data()

    def split_of(self, clip: Clip) -> str | None:
        """By the table of clips."""
        return split_in_table(clip) if clip.attributes else None

    def default_reference(self, clips: list[Clip]) -> Clip:
        """A clip in neutral mood."""
        return next((clip for clip in clips if clip.attributes.get("mood") == "neutral"), clips[0])
