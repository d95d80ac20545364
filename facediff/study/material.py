"""The animations of a study: each method's, the truth's and the references', matched by the names of their clips."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from facediff.animation import Animation, metres_per_unit
from facediff.animation.archives import AnimationFacts, read_animation
from facediff.data.check.findings import few
from facediff.data.corpus import MOTION_FOLDERS
from facediff.errors import FaceDiffError
from facediff.evaluation.figures.gather import gather
from facediff.evaluation.file_pairs import DEFAULT_PATTERNS, OWN, NamePattern
from facediff.mesh import read_mesh
from facediff.speech.audio import CONTAINERS, SUFFIXES, read_recording
from facediff.study.design import STILL, TRUTH
from facediff.utils.paths import find_file, name_of_file

ANIMATIONS = (".npz", ".npy")
UNEQUAL = 0.1
"""Share of a clip's frames by which its animations may differ in length; the rest of the longer ones is not shown."""


@dataclass(frozen=True)
class MotionFile:
    """The file of an animation; picklable, and read where it is drawn."""

    path: Path  # .npz of ``facediff animate``, or .npy of vertices
    facts: AnimationFacts = field(default_factory=AnimationFacts)  # mesh, frame rate and unit of a bare array
    stride: int = 1  # every n-th frame is used

    def read(self) -> Animation:
        """The animation; all of its frames are finite, and it can be drawn."""
        animation = read_animation(self.path, {}, self.facts)
        _ = animation.triangles  # refuses an animation without a mesh
        if self.stride > 1:
            animation = animation.part(slice(None, None, self.stride))
        animation.refuse_not_finite()
        return animation

    def digest(self) -> str:
        """A checksum of the facts that pictures depend on."""
        checksum = hashlib.sha256(str(self.stride).encode())
        for name, value in sorted(self.facts.items()):
            checksum.update(name.encode())
            checksum.update(value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode())
        return checksum.hexdigest()


@dataclass(frozen=True)
class StudyClip:
    """A clip that all methods have."""

    name: str
    subject: str  # who speaks
    motions: Mapping[str, MotionFile]  # by condition: a method, or ``truth``
    sound: Path  # the recording, or an animation (.npz) that holds it
    frames: int  # of every condition, by cutting the longer ones
    frame_rate: float
    templates: tuple[npt.NDArray[np.float32], ...]  # neutral faces in one unit, for a camera that sees them all
    # Vertex colours (V, 3) that all are drawn with; None for the material of the renderer
    colours: npt.NDArray[np.uint8] | None
    reference: str | None = None  # another clip of the speaker's truth; None if there is none

    @property
    def seconds(self) -> float:
        """How long it lasts."""
        return self.frames / self.frame_rate

    def motion(self, condition: str) -> MotionFile:
        """The motion of a condition; a still face is the truth's, or else the first method's."""
        if condition == STILL:
            return self.motions.get(TRUTH) or next(iter(self.motions.values()))
        return self.motions[condition]


class StudyAnimations:
    """The files of a study.

    Args:
        truth: a corpus folder, a folder of animations, or ``puppet``; None for a study without truth.
        references: folder of animations whose speakers' names begin the names of its files; the truth's other clips if
            None.
        identity: the style of the predictions: ``own``, or an identity's name.
        speech: folder of recordings; the corpus's, or those that the animations hold, if None.

    Attributes:
        remark: stands below every video, such as that the corpus is synthetic.
    """

    def __init__(
        self,
        methods: Mapping[str, Path],
        truth: Path | None = None,
        *,
        references: Path | None = None,
        identity: str = OWN,
        speech: Path | None = None,
        mesh: Path | None = None,
        frame_rate: float | None = None,
        unit: str | None = None,
    ) -> None:
        for name in (TRUTH, STILL):
            if name in methods:
                raise FaceDiffError(f'a method cannot be called "{name}"; name it with NAME=FOLDER')
        self.methods = list(methods)
        self.speech = speech
        self.remark = ""
        self._sounds: dict[str, Path] = {} if speech is None else _recordings(speech)
        self._subjects: dict[str, str] = {}
        read = None if mesh is None else read_mesh(mesh)
        stated = {
            "template": None if read is None else read.vertices.astype(np.float32),
            "faces": None if read is None else read.faces,
            "colours": None if read is None else read.colours,
            "frame_rate": frame_rate,
            "unit": unit,
        }
        self._facts: AnimationFacts = _known(stated)
        self._templates: dict[str, AnimationFacts] = {}
        self._files: dict[str, dict[str, MotionFile]] = {}
        if truth is not None:
            self._files[TRUTH] = self._truths(truth, mesh, frame_rate, unit)
        for name, folder in methods.items():
            animations = find_animations(folder, list(self._templates), identity)
            self._files[name] = {clip: MotionFile(path, self.facts_for(clip)) for clip, path in animations.items()}
        self.references = {
            clip: MotionFile(path, self.facts_for(clip))
            for clip, path in ({} if references is None else find_animations(references, list(self._templates))).items()
        } or self._files.get(TRUTH, {})
        sets = [set(files) for files in self._files.values()]
        self.clips = sorted(set.intersection(*sets))
        self.left_out = {name: sorted(set(files) - set(self.clips)) for name, files in self._files.items()}
        if not self.clips:
            clips = "; ".join(f"{name} has {few(sorted(files))}" for name, files in self._files.items())
            raise FaceDiffError(
                f"there is no common clip: {clips}. Name files alike: <clip>.npz, <clip>.npy or "
                f"<clip>_condition_<identity>.npy"
            )

    def _truths(
        self, truth: Path, mesh: Path | None, frame_rate: float | None, unit: str | None
    ) -> dict[str, MotionFile]:
        """The truth's motions by clip; its corpus's faces and sounds serve bare arrays, too."""
        corpus_like = truth == Path("puppet") or any((truth / name).is_dir() for name in MOTION_FOLDERS)
        if not corpus_like and any(truth.glob("*.npz")):
            animations = find_animations(truth)
            return {clip: MotionFile(path, self._facts) for clip, path in animations.items()}
        corpus = gather({}, truth, mesh=mesh, frame_rate=frame_rate, unit=unit)
        self.remark = corpus.remark
        facts = {
            "unit": corpus.unit or "m",
            "frame_rate": None if corpus.frame_rate is None else corpus.rate,
            "faces": corpus.faces,
            "colours": corpus.colours,
            "template": None if corpus.rest is None else corpus.rest.astype(np.float32),
        }
        self._facts = {**_known(facts), **self._facts}
        for subject, template in corpus.templates.items():
            self._templates[subject] = {**self._facts, "template": np.asarray(template, np.float32)}
        for clip, found_truth in corpus.truths.items():
            self._subjects[clip] = found_truth.name.subject
            if self.speech is None and corpus.corpus is not None:
                sound = find_file(corpus.corpus / "wav" / f"{found_truth.path.stem}.wav")
                if sound.is_file():
                    self._sounds[clip] = sound
        return {
            clip: MotionFile(found_truth.path, self.facts_for(clip), corpus.truth_stride)
            for clip, found_truth in corpus.truths.items()
        }

    def subject(self, clip: str) -> str:
        """The speaker of a clip: as the corpus says, else the part of its name before the last underscore."""
        return self._subjects.get(clip) or clip.rpartition("_")[0] or clip

    def facts_for(self, clip: str) -> AnimationFacts:
        """Mesh, frame rate and unit of a bare array of a clip."""
        return self._templates.get(self.subject(clip), self._facts)

    def open(self, name: str) -> StudyClip:
        """Read and check all animations of a clip."""
        motions = {condition: files[name] for condition, files in self._files.items()}
        read = {condition: motion.read() for condition, motion in motions.items()}
        lengths = [len(animation.vertices) for animation in read.values()]
        rates, frames = {animation.frame_rate for animation in read.values()}, min(lengths)
        if len(rates) > 1 or max(lengths) > (1 + UNEQUAL) * frames + 1:
            sizes = ", ".join(
                f"{condition} {len(animation.vertices)} at {animation.frame_rate:g} a second"
                for condition, animation in read.items()
            )
            raise FaceDiffError(f"{name}: differs in frames ({sizes}); expected one recording at one frame rate")
        sound = self._sounds.get(name)
        if sound is None:
            speaking = [c for c, animation in read.items() if animation.speech is not None]
            if not speaking:
                folder = f"{self.speech}: has no recording {name}" if self.speech else f"{name}: comes without speech"
                raise FaceDiffError(f"{folder}; give a folder of recordings named like the clips with --speech")
            sound = motions[speaking[0]].path
        first = next(iter(read.values()))
        templates = tuple(in_unit_of(first, animation).template for animation in read.values())
        colours = next((animation.colours for animation in read.values() if animation.colours is not None), None)
        same_mesh = len({len(template) for template in templates}) == 1
        return StudyClip(
            name,
            self.subject(name),
            motions,
            sound,
            frames,
            first.frame_rate,
            templates,
            colours if same_mesh else None,
        )

    def reference(self, clip: str, trials: Sequence[str], rng: np.random.Generator) -> str | None:
        """Another clip of the same speaker, outside the trials if there is one; None if the speaker has no other."""
        speaker, candidates = self.subject(clip), sorted(set(self.references) - {clip})
        same = [name for name in candidates if self.subject(name) == speaker]
        same = same or [name for name in candidates if name == speaker]
        unused = [name for name in same if name not in trials]
        return str(rng.choice(unused or same)) if same else None

    def sound_of(self, clip: str, motion: MotionFile) -> Path | None:
        """The sound of a reference: its recording, or its own file if that is an archive."""
        return self._sounds.get(clip) or (motion.path if motion.path.suffix == ".npz" else None)


def _known(facts: Mapping[str, Any]) -> AnimationFacts:
    """The facts that are known."""
    return cast(AnimationFacts, {name: value for name, value in facts.items() if value is not None})


def find_animations(folder: Path, subjects: Sequence[str] = (), identity: str = OWN) -> dict[str, Path]:
    """The animations of a folder by clip, as ``facediff animate`` and ``facediff predict`` name them.

    Of several conditions of a clip the one of ``identity`` is taken: ``own``, the speaker's, or an identity's name.
    """
    inside = sorted(folder.iterdir()) if folder.is_dir() else []
    files = [file for file in inside if file.suffix in ANIMATIONS and file.is_file() and file.name[0] != "."]
    if not files:
        raise FaceDiffError(
            f"{folder}: holds no animation; expected a folder of .npz files of `facediff animate --suffix .npz`, or of "
            f".npy files of `facediff predict`"
        )
    pattern = NamePattern(DEFAULT_PATTERNS[0], subjects)
    by_clip: dict[str, dict[str | None, Path]] = {}
    speakers: dict[str, str] = {}
    for file in files:
        read = pattern.match(file.stem)
        clip, condition = (read.clip, read.identity) if read is not None else (name_of_file(file), None)
        conditions = by_clip.setdefault(clip, {})
        if condition in conditions:
            raise FaceDiffError(f"{file}: is of the same clip as {conditions[condition]}; keep one of them")
        conditions[condition] = file
        if read is not None and read.identity == read.subject:
            speakers[clip] = read.subject
    animations = {}
    for clip, conditions in by_clip.items():
        condition = speakers.get(clip) if identity == OWN else identity
        if condition in conditions:
            animations[clip] = conditions[condition]
        elif None in conditions:
            animations[clip] = conditions[None]
        elif identity == OWN and len(conditions) == 1:
            animations[clip] = next(iter(conditions.values()))
    if not animations:
        stored = sorted({str(name) for conditions in by_clip.values() for name in conditions if name})
        raise FaceDiffError(
            f"{folder}: holds no animation under the condition {identity}, but under {', '.join(stored)}; choose one "
            f"with --identity"
        )
    return animations


def _recordings(folder: Path) -> dict[str, Path]:
    """Recordings of a folder by their names without the suffix."""
    inside = sorted(folder.iterdir()) if folder.is_dir() else []
    inside = [file for file in inside if not file.name.startswith(".")]
    recordings = {name_of_file(file): file for file in inside if file.suffix.lower() in SUFFIXES + CONTAINERS}
    if not recordings:
        raise FaceDiffError(
            f"--speech {folder}: holds no recording; expected a folder of {', '.join(SUFFIXES)}, named like the clips"
        )
    return recordings


def in_unit_of(first: Animation, animation: Animation) -> Animation:
    """An animation in the unit of length of the first, so that one camera shows both in their sizes."""
    factor = np.float32(metres_per_unit(animation.unit) / metres_per_unit(first.unit))
    if factor == 1:
        return animation
    vertices, template = animation.vertices * factor, animation.template * factor
    return replace(animation, vertices=vertices, template=template, unit=first.unit)


def read_sound(path: Path, seconds: float) -> tuple[npt.NDArray[np.float32], int]:
    """Speech (S,), cut or padded with silence to so many seconds, and its sample rate; of a recording or archive."""
    if path.suffix == ".npz":
        animation = read_animation(path)
        speech, rate = np.zeros(0) if animation.speech is None else animation.speech, animation.sample_rate
    else:
        recording = read_recording(path)
        speech, rate = recording.sound, recording.rate
    length = round(seconds * rate)
    return np.pad(speech[:length], (0, max(0, length - len(speech)))).astype(np.float32), rate
