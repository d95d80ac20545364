"""The base of all corpora's data modules: options, splits, style references, loaders, and a checkpoint's part of it.

A corpus adds its facts (class attributes) and decides which clip belongs to which split.
"""

from __future__ import annotations

import hashlib
import math
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import IO, TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self, get_args

import numpy as np
import numpy.typing as npt
import torch
from lightning.pytorch import LightningDataModule
from torch import Tensor
from torch.utils.data import DataLoader

from facediff.data.augmentation import Augmenter, read_augmentations
from facediff.data.batch import Assets, Reference, Rig, Sample, collate
from facediff.data.corpus import (
    EYELID_PAIRS,
    LIP_PAIRS,
    Circulating,
    Clip,
    Corpus,
    find_region,
    parse_name,
    read_manifest,
)
from facediff.data.dataset import (
    Aligner,
    BatchDataset,
    ClipBatches,
    FeatureSlot,
    MotionDataset,
    ProjectionSlot,
    ReferenceChoice,
    ReferencePolicy,
    ResumableLoader,
)
from facediff.data.measuring import measure_components, measure_scale, measure_windows
from facediff.data.mixing import mixed_loader
from facediff.data.packed.stores import address_of, is_packed
from facediff.data.storage import ChannelFolder, ClipStorage
from facediff.errors import ArgumentError, FaceDiffError, check_known, counted, damaged, note
from facediff.hyperparameters import keeps_arguments, plain, read_options
from facediff.registry import corpus as corpora
from facediff.registry import find_class
from facediff.spaces import VERTICES, Space
from facediff.utils.hints import defaults, is_name, options_of
from facediff.utils.licences import Commercial, Licence, merged, read_licences
from facediff.utils.ranges import Range
from facediff.utils.torch_files import load_tensors

if TYPE_CHECKING:
    from facediff.data.packed.reader import PackedCorpus

Count = Annotated[int, Range(1, 10**9)]
"""Clips or frames."""

Split = Literal["train", "val", "test_a", "test_b", "test_c"]


class SpeechMotionDataModule(LightningDataModule, ABC):
    """Speech with motion for training, validation and tests: seen speakers (A), unseen ones (B), unseen voices (C).

    A corpus subclasses this, states the facts below and decides which clips belong to a split. Options of its own go
    into a constructor that passes the others on::

        def __init__(self, *, seed: int = 0, **options: Any) -> None:
            super().__init__(**options)

    All options, also of this class, are kept as hyper-parameters.

    Class attributes:
        corpus_name: name of the corpus in tables and checkpoints.
        synthetic: whether it is synthetic.
        unit: unit of length; ``unit`` in a prepared folder's ``manifest.json`` overrides it.
        frame_rate: motion frames per second that the models see.
        stored_frame_rate: motion frames per second of circulating copies, where that differs.
        n_vertices: vertices of its topology, or channels of its space.
        space: meaning of the numbers of its motion.
        identities: speakers of the training split, in the order of the identity index.
        mesh_files: files with the faces, in order of preference.
        region_sources: files that list the vertices of the regions, in order of preference.
        region_help: where to get such files.
        reference_attributes: attributes that a style reference shares with its target where possible.
        score_attributes: columns of the table of test scores of single clips; ``reference_attributes`` unless stated.
        compared_speakers: speakers among whom the generation metrics look for the nearest speaker and for references
            of another speaker; all with a template if None.
        licence: the terms under which the corpus is distributed.
        commercial_use: whether these terms allow it: ``allowed``, ``forbidden`` or ``unknown``.
        licence_source: where the terms stand, without ``https://``.
        obtain: how to obtain the corpus.
        circulating: facts about the copies that circulate.
        makes_itself: whether ``prepare_data`` makes the corpus where it is missing.
        languages: codes of the languages that are spoken in it.

    Attributes:
        pair_sentences: whether neighbours in training batches speak the same sentence; a model that learns from such
            pairs sets it in its ``setup``.
        window_context: frames before and after a training window that samples come with; a model that sees further
            than the window sets it in its ``setup``.
        aligner: lets the windows of two neighbours that speak the same sentence begin at the same sound; a model sets
            it in its ``setup``, too.
        training_state: where in which epoch the next training loader continues, as a checkpoint holds it.

    Args:
        root: the corpus folder; or a packed corpus, its folder or an address such as ``s3://bucket/corpus.zarr``.
        batch_size: clips a batch; used where no frame budget is given.
        max_frames_per_batch: frame budget: training and evaluation batches hold clips of similar length that fit into
            this many frames once they are padded.
        num_workers: loader processes.
        window: longest training window in frames; whole clips if None.
        windows_per_clip: how many windows an epoch takes of each clip; None for as many as fill the clip.
        reference: where a training target's style reference comes from: another clip of the same speaker, where
            possible with the same attributes (such as the mood), or the target itself.
        reference_frames: longest style reference, in frames.
        predict_split: the split that ``predict`` runs over; the first test split if None.
        test_share: share of the clips of each test split that are tested, the same ones in every run, by a hash of
            their names; tables of such a test say so.
        augmentations: changes of training speech by name with their options, such as ``[voice:semitones=4, room,
            noise]``, in this order; see docs/voices.md.
        augmented_share: share of the training clips to which they are applied; the others stay as recorded.
        augmented_clips: only clips with an attribute that fits a pattern are changed, such as ``{voice: "flite:*"}``;
            attributes are the further columns of ``clips.csv``.
        people: folders of further speakers to train on, as ``facediff data import-person`` writes them; they come first
            in the order of the identity index.
        extra_identities: further identities of the corpus to train on, with their clips that belong to no
            split; they come next in the order of the identity index.
        train_identities: train on the clips of these identities only; of all if None.
        lips: file that lists the vertices of the lips, e.g. ``regions/lve.txt`` or ``FLAME_masks.pkl:lips``, or
            ``all``; the corpus's usual one if None.
        upper_face: the same for the upper face.
        eyelid_pairs: file that lists pairs of an upper and a lower eyelid vertex, for blinks;
            ``regions/eyelid_pairs.txt`` if None.
        face: the same for the face, to which a model can be restricted, e.g. ``FLAME_masks.pkl:face``; the corpus has
            no such region if None.
        further_corpora: corpora of other faces to train on in addition, for a model of many faces: options of their
            data modules by a name for the face, with the corpus under ``corpus``, such as ``{mask: {corpus: PuppetMask,
            batch_size: 8}}``. Each batch is of one corpus, and an epoch has all batches of all of them.
    """

    corpus_name: ClassVar[str]
    synthetic: ClassVar[bool] = False
    unit: str
    frame_rate: ClassVar[float]
    stored_frame_rate: ClassVar[float | None] = None
    n_vertices: int
    space: Space = VERTICES
    identities: list[str]
    mesh_files: ClassVar[tuple[str, ...]] = ()
    region_sources: ClassVar[dict[str, tuple[str, ...]]] = {
        "lips": ("regions/lve.txt",),
        "upper_face": ("regions/fdd.txt",),
    }
    region_help: ClassVar[str] = ""
    reference_attributes: ClassVar[tuple[str, ...]] = ()
    score_attributes: ClassVar[tuple[str, ...]] = ()
    compared_speakers: tuple[str, ...] | None = None
    licence: ClassVar[str] = "unknown"
    commercial_use: ClassVar[Commercial] = "unknown"
    licence_source: ClassVar[str] = ""
    obtain: ClassVar[str] = ""
    circulating: ClassVar[Circulating] = Circulating()
    makes_itself: ClassVar[bool] = False
    languages: ClassVar[tuple[str, ...]] = ()

    @keeps_arguments
    def __init__(
        self,
        *,
        root: str,
        batch_size: Count = 1,
        max_frames_per_batch: Count | None = None,
        num_workers: Annotated[int, Range(0, 256)] = 0,
        window: Count | None = None,
        windows_per_clip: Count | None = 1,
        reference: ReferenceChoice = "same_subject",
        reference_frames: Count = 100,
        predict_split: Split | None = None,
        test_share: Annotated[float, Range(0, 1, above=True)] = 1.0,
        augmentations: list[str] | None = None,
        augmented_share: Annotated[float, Range(0, 1)] = 1.0,
        augmented_clips: dict[str, str] | None = None,
        people: list[str] | None = None,
        extra_identities: list[str] | None = None,
        train_identities: Annotated[list[str], Range(items=(1, 1_000_000))] | None = None,
        lips: str | None = None,
        upper_face: str | None = None,
        eyelid_pairs: str | None = None,
        face: str | None = None,
        further_corpora: dict[str, dict[str, Any]] | None = None,
    ) -> None:
        super().__init__()
        names = ("corpus_name", "unit", "frame_rate", "n_vertices", "identities")
        if undefined := [name for name in names if not hasattr(self, name)]:
            raise FaceDiffError(f"{type(self).__name__}: the class states no {' and no '.join(undefined)}")
        self.source = address_of(root) or str(root)
        self.batch_size = batch_size
        self.max_frames_per_batch = max_frames_per_batch
        self.num_workers = num_workers
        self.window = window
        self.windows_per_clip = windows_per_clip
        self.reference: ReferenceChoice = reference
        self.reference_frames = reference_frames
        self.predict_split = predict_split
        self.test_share = test_share
        self.augmenter: Augmenter | None = None
        if augmentations:
            self.augmenter = Augmenter(read_augmentations(augmentations), augmented_share)
        self.augmented_clips = augmented_clips or {}
        self.people = [Path(folder).expanduser() for folder in people or []]
        files = {"lips": lips, "upper_face": upper_face, "face": face}
        self.regions = {**self.region_sources, **{name: (file,) for name, file in files.items() if file is not None}}
        self.eyelid_file = eyelid_pairs
        self.extra_identities = list(extra_identities or [])
        self.train_identities = None if train_identities is None else list(train_identities)
        self.identities = [*map(person_name, self.people), *self.extra_identities, *type(self).identities]
        if duplicates := [name for name in self.identities if self.identities.count(name) > 1]:
            raise FaceDiffError(
                f"data.people: {duplicates[0]} occurs more than once among the corpus's identities, imported speakers "
                f"and data.extra_identities; import the speaker under a new name, or omit one"
            )
        check_known("data.train_identities", "identity", self.train_identities or (), self.identities)
        self.features = FeatureSlot()
        self.projection = ProjectionSlot()  # a model's choice, see its training_projection
        self.pair_sentences = False
        self.window_context = (0, 0)
        self.aligner: Aligner | None = None
        self.further = {name: further_corpus(name, options) for name, options in (further_corpora or {}).items()}
        self.training_state: dict[str, int] | None = None
        self._assets: Assets | None = None

    options_path = "data"

    def __init_subclass__(cls, **options: Any) -> None:  # noqa: ANN401
        """Let every corpus keep its constructor's arguments."""
        super().__init_subclass__(**options)
        if "score_attributes" not in vars(cls) and "reference_attributes" in vars(cls):
            cls.score_attributes = cls.reference_attributes
        if "__init__" in vars(cls):
            cls.__init__ = keeps_arguments(cls.__init__)  # type: ignore[method-assign]

    def keep_hyperparameters(self, arguments: dict[str, Any]) -> None:
        """Save the constructor's arguments as plain data, so that checkpoints load with ``weights_only=True``."""
        self.save_hyperparameters(plain({**defaults(type(self)), **arguments}))

    @classmethod
    def load_from_checkpoint(
        cls,
        checkpoint_path: str | Path | IO[bytes],
        *arguments: Any,  # noqa: ANN401
        **options: Any,  # noqa: ANN401
    ) -> Self:
        """Lightning's method, after the checks that every checkpoint goes through; the arguments are Lightning's."""
        with damaged(checkpoint_path, "expected a file of `facediff fit`"):
            hyperparameters = load_tensors(checkpoint_path)["datamodule_hyper_parameters"]
            read_options(str(checkpoint_path), cls, hyperparameters, {})
        if not isinstance(checkpoint_path, str | Path):
            checkpoint_path.seek(0)
        data: Self = super().load_from_checkpoint(checkpoint_path, *arguments, **{**options, "weights_only": True})
        return data

    @classmethod
    def corpus_licence(cls) -> Licence:
        """The label of the corpus's own terms."""
        return Licence(f"corpus {cls.corpus_name}", cls.licence, cls.commercial_use, cls.licence_source)

    def licences(self) -> tuple[Licence, ...]:
        """The labels of everything that is trained on: the corpus, and every imported speaker."""
        labels = (data.licences() for data in self.further.values())
        return merged([self.corpus_licence()], map(person_licence, self.people), *labels)

    # Methods that a corpus overrides.

    @abstractmethod
    def split_of(self, clip: Clip) -> str | None:
        """The split a clip belongs to (a name of :data:`Split`), or None for none of them.

        Clips of no split may serve as style references of their speaker; clips of an evaluated split only where their
        speaker has no others. The clips of imported speakers are not passed to this method.
        """

    @classmethod
    def parse_name(cls, name: str) -> Clip | None:
        """Identity and sentence of a clip's name; None for a file that is no clip of the corpus."""
        return parse_name(name)

    @classmethod
    def name_attributes(cls, name: str) -> Mapping[str, str]:
        """The attributes that a clip's name holds, such as the emotion; empty for names of another form."""
        clip = cls.parse_name(name)
        return {} if clip is None else clip.attributes

    @classmethod
    def expected_clips(cls) -> dict[str, list[str]]:
        """The clips of a complete corpus by split; empty where the corpus has no fixed list."""
        return {}

    def words_of(self, clip: Clip) -> str:
        """The text of a clip; clips with equal text have the same words and can be aligned in time."""
        return clip.name if self.only_numbers(clip) and not clip.attributes.get("text") else clip.words

    def only_numbers(self, clip: Clip) -> bool:
        """Whether equal sentences of clips such as this one, by their names, are not equal words."""
        return clip.root in self.people

    def further_speech(self) -> Callable[[int], npt.NDArray[np.float32]] | None:
        """A function that returns further speech (S,) at 16 kHz by number, without motion; None if there is no more.

        The audio encoder can be distilled on it, which needs more speech than the corpus's sentences
        (:mod:`facediff.models.audio_distillation`).
        """
        return None

    def default_reference(self, clips: list[Clip]) -> Clip:
        """The clip that gives an identity's style when no other is chosen."""
        return clips[0]

    def stores_reference(self, identity: str) -> bool:
        """Whether checkpoints keep a clip of an identity, as its style when no other is chosen."""
        return True

    def prepare_data(self) -> None:
        """Report the clips that a complete corpus has and this folder has not; called on one process only.

        A corpus that makes its folder does so before it calls this.
        """
        counts = ", ".join(f"{len(names)} of {split}" for split, names in self.missing_clips().items() if names)
        if counts:
            print(f"{self.corpus_name}: missing clips, which are left out: {counts}", flush=True)
        for data in self.further.values():
            data.prepare_data()

    def setup(self, stage: str) -> None:
        """Begin a run: models that were trained before asked for other samples."""
        for data in (self, *self.further.values()):
            data.features.reader, data.pair_sentences, data.aligner, data.window_context = None, False, None, (0, 0)
            data.projection.choose(None)

    # The clips.

    @cached_property
    def packed(self) -> PackedCorpus | None:
        """The packed corpus that ``data.root`` names; None if it names a folder of files."""
        if not is_packed(self.source):
            return None
        from facediff.data.packed.reader import PackedCorpus

        return PackedCorpus(self.source)

    @cached_property
    def root(self) -> Path:
        """The corpus folder; of a packed corpus, a folder on this machine with all files but motion and speech."""
        return Path(self.source).expanduser() if self.packed is None else self.packed.folder

    @classmethod
    def missing(cls, root: Path) -> FaceDiffError:
        """The error for a corpus that is not in its folder, with the way to obtain it."""
        advice = "set data.root to your copy (--data.root, or --data-root where a command has that)"
        return FaceDiffError(f"{no_such_folder(root)}; {advice}. {cls.obtain}".rstrip())

    @classmethod
    def check_root(cls, root: str | Path) -> None:
        """Refuse a folder that there is nothing to train on in, before a data module and a model are built.

        Args:
            root: the folder, or an address of a packed corpus, which is not looked at.
        """
        # A corpus that says how it is obtained is there before a run; others may be made by their data module.
        folder = Path(root).expanduser()
        if cls.obtain and address_of(root) is None and not folder.exists():
            raise cls.missing(folder)

    @cached_property
    def corpus(self) -> Corpus:
        """The corpus on disk."""
        if not self.root.is_dir():
            raise self.missing(self.root)
        return Corpus(
            self.root,
            self.n_vertices,
            self.frame_rate,
            stored_frame_rate=self.stored_frame_rate,
            parse=self.parse_name,
            people=self.people,
            storage=self.packed if self.space.is_vertices else self.channel_folder(),
            space=self.space,
        )

    def channel_folder(self) -> ClipStorage:
        """Where the channels of a parametric space lie."""
        return ChannelFolder(self.root, self.space)

    def rig(self, assets: Assets) -> Rig | None:
        """What turns channels into vertices, given the assets without it; None where that is not known.

        One rig for all speakers is :meth:`facediff.data.batch.Rig.of` a linear rig.
        """
        mesh = self.mesh_corpus
        if mesh is None:
            return None
        # A speaker who was imported in channels has no face of their own: the mean one is shown.
        mean = torch.stack([*mesh.templates.values()]).mean(0)
        templates = {**dict.fromkeys(map(person_name, self.people), mean), **mesh.templates}
        neutral = replace(assets, templates=templates, references={}, space=VERTICES)
        return Rig(self._with_mesh(neutral, mesh), self.deltas())

    @property
    def mesh_corpus(self) -> Corpus | None:
        """The corpus as vertices: itself, or of channels what their rig makes of them; None where that is not known."""
        return self.corpus if self.space.is_vertices else None

    def deltas(self) -> dict[str, Tensor]:
        """Displacements of the vertices by the face's channels at 1, (K, V, 3) by speaker; of channels only."""
        return {}

    @property
    def test_splits(self) -> list[str]:
        """The test splits that have clips, in the order of the test loaders."""
        return [split for split in get_args(Split)[2:] if self.clips(split)]

    def clips(self, split: str) -> list[Clip]:
        """The clips of a split, sorted by name; of a test split, those of its ``test_share``."""
        clips = [clip for clip in self.corpus.clips.values() if self.find_split(clip) == split]
        if split == "train" and self.train_identities is not None:
            clips = [clip for clip in clips if clip.identity in self.train_identities]
        if split.startswith("test") and self.test_share < 1:
            clips.sort(key=lambda clip: hashlib.sha256(clip.name.encode()).digest())
            clips = sorted(clips[: math.ceil(self.test_share * len(clips))], key=lambda clip: clip.name)
        return clips

    def find_split(self, clip: Clip) -> str | None:
        """The split of any clip.

        An imported speaker's ``clips.csv`` decides for their clips, :meth:`split_of` for all others; clips of no split
        are trained on where they belong to ``extra_identities``.
        """
        if clip.root in self.people:
            return split_in_table(clip)
        split = self.split_of(clip)
        return "train" if split is None and clip.identity in self.extra_identities else split

    def missing_clips(self) -> dict[str, list[str]]:
        """Clips of a complete corpus that are missing in this copy, by split."""
        present = self.corpus.clips
        expected = self.expected_clips()
        return {split: [name for name in names if name not in present] for split, names in expected.items()}

    def reference_policy(self) -> ReferencePolicy:
        """References come from training clips, and from clips of no split for speakers who are not trained on.

        A speaker with clips in evaluated splits only is given another of these clips, never the target itself.
        """
        candidates = {**by_speaker(self.corpus.clips.values()), **self.known_clips()}
        return ReferencePolicy(candidates, self.reference_attributes, self.reference, self.reference_frames)

    def known_clips(self) -> dict[str, list[Clip]]:
        """Each speaker's clips outside the evaluated splits, by speaker; speakers who have none are left out."""
        return by_speaker(clip for clip in self.corpus.clips.values() if self.find_split(clip) in ("train", None))

    def dataset(self, split: str, *, training: bool = False) -> MotionDataset:
        """Samples of a split: whole clips with fixed references, or in training random windows and references."""
        clips = self.clips(split)
        if not clips:
            hint = "; trainer.limit_val_batches=0 trains without validation" if split == "val" else ""
            raise FaceDiffError(
                f"{self.root}: no clip of split {split}; `facediff data check {self.root}` lists what is missing{hint}"
            )
        policy = self.reference_policy()
        if split.startswith("test"):
            if self.test_share < 1:
                note(f"{self.corpus_name}: a sub-sample of {split}, {counted(len(clips), 'clip')} by data.test_share")
            clips = self._with_reference(clips, policy)
        elif not training or self.reference != "self":
            policy.check(clips)
        if training and self.augmenter and self.features.reader is not None:
            raise FaceDiffError("data.augmentations: cached speech features are not augmented; omit one of them")
        if training and self.augmenter and clips and not any(clip.fits(self.augmented_clips) for clip in clips):
            raise FaceDiffError(
                f"data.augmented_clips: {self.augmented_clips} fits none of the {len(clips)} clips; expected "
                f"attributes with a pattern each, and the first clip's are {clips[0].attributes}"
            )
        return MotionDataset(
            self.corpus,
            clips,
            self.identities,
            policy,
            training=training,
            window=self.window if training else None,
            decoys=split.startswith("test"),
            features=self.features,
            texts=[self.words_of(clip) for clip in clips],
            context=self.window_context if training and self.window is not None else (0, 0),
            aligner=self.aligner if training and self.pair_sentences else None,
            augmenter=self.augmenter if training else None,
            augmented_clips=self.augmented_clips,
            projection=self.projection if training else ProjectionSlot(),
        )

    def _with_reference(self, clips: list[Clip], policy: ReferencePolicy) -> list[Clip]:
        """The clips that have a style reference; a person who is not trained on may have a single clip."""
        alone = [clip.name for clip in clips if policy.candidates.get(clip.identity, []) == [clip]]
        if len(alone) == len(clips):
            policy.check(clips)
        if alone:
            print(f"{self.corpus_name}: left out of the test, being their speakers' only clips: {', '.join(alone)}")
        return [clip for clip in clips if clip.name not in alone]

    def assets(self) -> Assets:
        """The part of a checkpoint that describes this corpus, still without :meth:`motion_scale`."""
        if self._assets is None:
            corpus = self.corpus
            references = {}
            for identity, clips in sorted(self.reference_policy().candidates.items()):
                if identity in corpus.templates and self.stores_reference(identity):
                    clip = self.default_reference(clips)
                    references[identity] = Reference(
                        clip.name, corpus.read_motion(clip, 0, self.reference_frames).half()
                    )
            # Where no channel is named after a region, as in FLAME's expressions, all of them are of it.
            assets = Assets(
                corpus=self.corpus_name,
                synthetic=self.synthetic,
                unit=str(read_manifest(self.root).get("unit") or self.unit),
                frame_rate=self.frame_rate,
                identities=list(self.identities),
                templates=dict(corpus.templates),
                faces=None,
                regions=channel_regions(self.space),
                references=references,
                space=self.space,
            )
            vertices = self.space.is_vertices
            self._assets = self._with_mesh(assets, corpus) if vertices else replace(assets, rig=self.rig(assets))
        return self._assets

    def _with_mesh(self, assets: Assets, corpus: Corpus) -> Assets:
        """The same with the triangles, colours, regions and inner lips of a corpus of vertices."""
        mesh = corpus.read_mesh(self.mesh_files)
        return replace(
            assets,
            faces=None if mesh is None else torch.from_numpy(mesh.faces),
            colours=None if mesh is None or mesh.colours is None else torch.from_numpy(mesh.colours),
            regions={
                name: find_region(self.root, sources, name, corpus.n_vertices, self.region_help).tensor()
                for name, sources in self.regions.items()
            },
            inner_lip_pairs=corpus.read_pairs(LIP_PAIRS),
            identity_colours=corpus.read_colours(),
        )

    def eyelid_pairs(self) -> Tensor | None:
        """Pairs of an upper and a lower eyelid vertex (P, 2), to detect blinks; None if the corpus has no list."""
        file = self.eyelid_file or EYELID_PAIRS
        pairs = None if self.mesh_corpus is None else self.mesh_corpus.read_pairs(file)
        if pairs is None and self.eyelid_file is not None:
            raise FaceDiffError(f"data.eyelid_pairs: {self.root / file}: no such file; expected pairs of vertices")
        return pairs

    # Statistics of the training motion, computed before training: see facediff.data.measuring.

    def motion_scale(self) -> float:
        """Factor that gives the training motion unit variance: one over the root mean square of its coordinates.

        The mean is not subtracted, since offsets from the template are centred near zero.
        """
        return measure_scale(self.corpus, self.clips("train"), self.trainer)

    def principal_motion(self, count: int, weights: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Mean and principal components of the training motion, in the corpus's unit.

        Args:
            count: components.
            weights: factors on the coordinates (n,) before the decomposition, or a matrix (n, n); None for equal
                weights.

        Returns:
            the mean (n,) of all coordinates, and components (at most ``count``, n), each as long as its standard
            deviation, the largest first.
        """
        return measure_components(self.corpus, self.clips("train"), self.trainer, count, weights)

    def covariance_over_time(self, project: Callable[[Tensor], Tensor], frames: int) -> Tensor:
        """Covariance of projections of the training motion over the frames of a window, (K, frames, frames).

        Args:
            project: from motion in the corpus's unit (1, T, V, dims) to the projections (1, T, K), linear.
            frames: length of the window.
        """
        return measure_windows(self.corpus, self.clips("train"), self.trainer, project, frames)

    # The loaders.

    @property
    def faces(self) -> dict[str, dict[str, Any]]:
        """The numbers that determine a model's sizes, for every corpus of :attr:`further`, as plain data."""
        return {
            name: {
                "n_vertices": data.n_vertices,
                "identities": data.identities,
                "frame_rate": data.frame_rate,
                "space": None if data.space.is_vertices else data.space.state(),
            }
            for name, data in self.further.items()
        }

    def train_dataloader(self) -> DataLoader[Any]:
        """Shuffled training batches, each process its own; the rest of an epoch that is resumed."""
        loader = self._mixed("train", training=True)
        if self.training_state is not None:
            loader.load_state_dict(self.training_state)
        return loader

    def val_dataloader(self) -> DataLoader[Any]:
        """Validation batches."""
        return self._mixed("val")

    def _mixed(self, split: str, *, training: bool = False) -> ResumableLoader:
        """A loader of this corpus, or of this and all further ones."""
        loaders = {"": self._loader(split, training=training)}
        if not self.further:
            return loaders[""]
        for name, data in self.further.items():
            data.trainer = self.trainer
            loaders[name] = data._loader(split, training=training)
        mixed = mixed_loader(loaders, **self._loader_options())
        mixed.progress = self._progress
        return mixed

    def test_dataloader(self) -> list[DataLoader[list[Sample]]]:
        """One loader per test split, in the order of :attr:`test_splits`."""
        return [self._loader(split) for split in self.test_splits]

    def predict_dataloader(self) -> DataLoader[Sample]:
        """The clips of ``predict_split`` in order."""
        split: str = self.predict_split or [*self.test_splits, "test_a"][0]
        return DataLoader(self.dataset(split), batch_size=self.batch_size, collate_fn=collate, **self._loader_options())

    def _loader(self, split: str, *, training: bool = False) -> ResumableLoader:
        samples = self.dataset(split, training=training)
        trainer = self.trainer
        batches = ClipBatches(
            samples.frames() if self.max_frames_per_batch is not None else [0] * len(samples),
            batch_size=self.batch_size,
            max_frames=self.max_frames_per_batch,
            training=training,
            seed=int(os.environ.get("PL_GLOBAL_SEED", "0")),
            rank=trainer.global_rank if trainer is not None else 0,
            world_size=trainer.world_size if trainer is not None else 1,
            groups=[self.words_of(clip) for clip in samples.clips] if self.pair_sentences else None,
            copies=self._copies(samples) if training else None,
        )
        # The sampler yields whole batches, so the loader must not batch again.
        loader = ResumableLoader(
            BatchDataset(samples),
            sampler=batches,
            batch_size=None,
            collate_fn=collate,
            **self._loader_options(),
        )
        loader.progress = self._progress
        return loader

    def _copies(self, samples: MotionDataset) -> list[int]:
        """How often an epoch takes each clip, each time another window of it."""
        if self.window is None:
            return [1] * len(samples)
        if self.windows_per_clip is not None:
            return [self.windows_per_clip] * len(samples)
        return [-(-self.corpus.frames(clip) // self.window) for clip in samples.clips]

    def _progress(self) -> tuple[int, int]:
        """Epoch and completed batches of the training that is running."""
        trainer = self.trainer
        if trainer is None:
            return 0, 0
        epochs: Any = trainer.fit_loop.epoch_progress.current
        batches: Any = trainer.fit_loop.epoch_loop.batch_progress.current
        if epochs.started <= epochs.processed:  # between two epochs
            return epochs.processed, 0
        # Not `completed`, which a checkpoint at the end of a batch is written before.
        at_end = batches.processed >= trainer.num_training_batches
        return (epochs.processed + 1, 0) if at_end else (epochs.processed, batches.processed)

    def _loader_options(self) -> dict[str, Any]:
        return {
            "num_workers": self.num_workers,
            # Otherwise every new iterator would draw from the global generator, and a resumed run other noise.
            "generator": torch.Generator(),
            "pin_memory": torch.cuda.is_available(),
            "persistent_workers": self.num_workers > 0,
        }


def further_corpus(name: str, options: dict[str, Any]) -> SpeechMotionDataModule:
    """The data module of another face, from its options."""
    corpus = options.get("corpus")
    # A checkpoint states these options too: as anywhere in it, a class must be registered, or imported already.
    path = f"facediff.registry.corpus.{corpus}" if corpus in corpora.names() else corpus
    module = find_class(corpora, path, SpeechMotionDataModule)
    arguments = {key: value for key, value in options.items() if key != "corpus"}
    unknown = arguments.keys() - (options_of(module) if module is not None else {})
    named = is_name(name) and "." not in name and not hasattr(torch.nn.ModuleDict(), name)
    if not named or module is None or "further_corpora" in options or unknown:
        raise ArgumentError(
            {f"further_corpora.{name}": options},
            f"expected a name that a part of a model can have, and options of a data module with corpus=NAME, one of "
            f"{', '.join(corpora.names())}",
        )
    data: SpeechMotionDataModule = module(**arguments)
    return data


def by_speaker(clips: Iterable[Clip]) -> dict[str, list[Clip]]:
    """Clips by the name of their speaker."""
    speakers: dict[str, list[Clip]] = {}
    for clip in clips:
        speakers.setdefault(clip.identity, []).append(clip)
    return speakers


def split_in_table(clip: Clip) -> str | None:
    """The split that ``clips.csv`` states for a clip; ``test`` is test A, ``none`` and ``references`` are no split."""
    splits: dict[str, str | None] = {"test": "test_a", "none": None, "references": None}
    splits |= {split: split for split in get_args(Split)}
    split = clip.attributes.get("split", "")
    check_known(f"{clip.root / 'clips.csv'}: {clip.name}", "split", [split], splits)
    return splits[split]


def channel_regions(space: Space) -> dict[str, Tensor]:
    """Channels by region; all of them where none is named after it, as in FLAME's expressions. Vertices have none."""
    if space.is_vertices:
        return {}
    return {name: torch.tensor(space.region(name) or range(len(space.channels))) for name in ("lips", "upper_face")}


def no_such_folder(folder: Path) -> str:
    """That a folder is missing, and where it was looked for."""
    relative = "" if folder.is_absolute() else f"; it is relative to the working folder, {Path.cwd()}"
    return f"{folder}: no such folder{relative}"


def person_name(folder: Path) -> str:
    """The speaker of a folder, as ``facediff data import-person`` wrote it."""
    name = read_manifest(folder).get("person")
    if not isinstance(name, str):
        fault = f"{folder}: no manifest.json there names a speaker" if folder.is_dir() else no_such_folder(folder)
        raise FaceDiffError(f"data.people: {fault}; expected a folder of `facediff data import-person`")
    return name


def person_licence(folder: Path) -> Licence:
    """The terms of an imported speaker's recordings, as ``manifest.json`` of their folder states them."""
    manifest = read_manifest(folder)
    terms = manifest.get("licence") or Licence("speaker").state()
    (label,) = read_licences(folder / "manifest.json", [terms])
    return replace(label, of=f"speaker {manifest.get('person')}")
