"""Writing the built-in corpus: heads with a rig, performances, and speech of several voices.

The truth of a clip is kept as weights of ARKit's shapes with gaze and head next to them, and each speaker's rig once: a
head is a hundred times as many numbers as its weights. ``facediff.data`` decodes them to vertices as it reads a clip.
Clips that are tested with have their vertices next to them, so that any program can score against them.
"""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from facediff.errors import FaceDiffError, check_known
from facediff.speech.audio import write_wav
from facediff.speech.espeak import SpokenPhoneme, Utterance
from facediff.synthetic.articulation import speech_sounds
from facediff.synthetic.cast import (
    CAST,
    DRAWN,
    KEPT_OUT_PEOPLE,
    RECORDED,
    RECORDED_FROM,
    SEEN,
    UNSEEN,
    CastMember,
    drawn_names,
    member_of,
    recorded_names,
)
from facediff.synthetic.head.mask import N_MASK_VERTICES, build_mask
from facediff.synthetic.head.parts import AROUND_EYE, N_HEAD_VERTICES, build_head
from facediff.synthetic.head.people import Complexion, coloured, dressed
from facediff.synthetic.head.rig import SHAPES, eyelid_pairs, head_shapes, lip_pairs, lip_teeth_pairs
from facediff.synthetic.performance import MOODS, FaceMotion, synthesise_motion
from facediff.synthetic.prosody import analyse
from facediff.synthetic.recordings import recordings_of, state_of
from facediff.synthetic.sentences import GERMAN, SENTENCES, TEST, TRAIN, VALIDATION, WORDS, turn
from facediff.synthetic.voices import Delivery, Flite, coloured_speech, open_voice
from facediff.utils import SAMPLE_RATE
from facediff.utils.batch import do_all
from facediff.utils.checksums import describe_files, same_sizes
from facediff.utils.files import atomic_folder
from facediff.utils.jobs import is_cluster
from facediff.utils.limits import quoted
from facediff.utils.plain_files import read_json, write_json, write_table

CORPUS = "facediff-puppet"
MANIFEST = "manifest.json"
GENERATOR = "3.0"
FRAME_RATE = 25
UNIT = "m"  # Of every length in the corpus
_QUIET_BEFORE, _QUIET_AFTER = 0.10, 0.08
_PEAK = 0.6
_DRAWS = 7  # Performances of a test sentence of which the one of middle liveliness is taken
TRAIN_EACH, REFERENCES_EACH, TEST_EACH, TEST_C_EACH = 32, 24, 10, 5
"""Sentences of each speaker."""


@dataclass(frozen=True)
class PerformedClip:
    """One clip.

    Attributes:
        split: as of a data module, or ``references`` for clips of unseen speakers in no split.
        number: of the sentence in its list, from 1.
        mood: a name in :data:`facediff.synthetic.performance.MOODS`.
        voice: where it is not the speaker's own.
    """

    identity: str
    split: str
    number: int
    text: str
    mood: str
    voice: str = ""

    @property
    def sentence(self) -> str:
        """Name of the sentence, such as ``t07``: e for training and references, c for test C."""
        letter = {"val": "v", "test_a": "t", "test_b": "t", "test_c": "c"}.get(self.split, "e")
        return f"{letter}{self.number:02d}"

    @property
    def name(self) -> str:
        """Name of the clip and stem of its files, such as ``F1_t07``."""
        return f"{self.identity}_{self.sentence}"


def performed_clips(drawn: int = 0, people: Sequence[str] = ()) -> tuple[PerformedClip, ...]:
    """All clips, speaker by speaker; moods take turns, so that every speaker has each of them equally often.

    Every speaker says other sentences in training, so that no sentence can be known by heart. On test A and B all
    speakers have :data:`TEST` sentences outside the training data; on test C the voices are new instead of the faces.
    """
    plan: list[tuple[str, str, list[tuple[int, str]], str]] = []
    for index, identity in enumerate(SEEN):
        plan.append((identity, "train", turn(TRAIN, -6 * index, TRAIN_EACH), ""))
        plan.append((identity, "val", turn(VALIDATION, index, 3), ""))
        plan.append((identity, "test_a", turn(TEST, 3 * index, TEST_EACH), ""))
    for index, identity in enumerate(UNSEEN):
        plan.append((identity, "references", turn(TRAIN, 17 * index, REFERENCES_EACH), ""))
        plan.append((identity, "test_b", turn(TEST, 4 * index + 1, TEST_EACH), ""))
    for identity, voice in zip(SEEN, _voices_of_test_c(), strict=False):
        texts = turn(GERMAN if voice.startswith("espeak:de") else TEST[-6:], 0, TEST_C_EACH)
        plan.append((identity, "test_c", texts, voice))
    moods = tuple(MOODS)
    for index, name in enumerate(drawn_names(drawn)):
        plan.append((name, "train", turn(TRAIN, 5 * index, 24), ""))
    for name in recorded_names(people):  # who say the recorded sentences
        recordings = recordings_of(member_of(name, people).voice.partition(":")[2], REFERENCES_EACH)
        if len(recordings) == 1:  # in another mood, so that it has a style reference
            recordings *= 2
        plan += [(name, "train", [(number, each.text)], each.voice) for number, each in enumerate(recordings, 1)]
    return tuple(
        PerformedClip(identity, split, number, text, moods[(number + index) % len(moods)], voice)
        for index, (identity, split, texts, voice) in enumerate(plan)
        for number, text in texts
    )


def mask_clips() -> tuple[PerformedClip, ...]:
    """All clips of the second corpus, which has sentences and speakers of its own."""
    plan = [(name, "train", range(24)) for name in MASK_SEEN]
    plan += [(name, "val", range(24, 27)) for name in MASK_SEEN]
    plan += [(name, "test_a", range(27, 32)) for name in MASK_SEEN]
    plan += [(name, "references", range(12)) for name in MASK_UNSEEN]
    plan += [(name, "test_b", range(27, 32)) for name in MASK_UNSEEN]
    moods = tuple(MOODS)
    return tuple(
        PerformedClip(identity, split, number + 1, SENTENCES[number], moods[(number + index) % len(moods)])
        for index, (identity, split, numbers) in enumerate(plan)
        for number in numbers
    )


@dataclass(frozen=True)
class CorpusVariant:
    """What differs between the corpora that are made here: of the whole head, and of the mask."""

    corpus: str = CORPUS
    mesh_file: str = "PUPPET.ply"
    frame_rate: int = FRAME_RATE
    mask: bool = False

    @property
    def speakers(self) -> tuple[str, ...]:
        """Who speaks, drawn speakers of the first corpus aside."""
        return (*MASK_SEEN, *MASK_UNSEEN) if self.mask else tuple(CAST)

    def clips(self, drawn: int, people: Sequence[str]) -> tuple[PerformedClip, ...]:
        """All clips."""
        return mask_clips() if self.mask else performed_clips(drawn, people)

    def transfer(self, values: NDArray[np.floating]) -> NDArray[np.float64]:
        """Values (V, …) of the head's vertices at the vertices of this corpus's mesh."""
        precise = np.asarray(values, np.float64)
        return build_mask().transfer(precise) if self.mask else precise

    def colours(self, colours: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Colours (V, 3) of the head at this corpus's mesh."""
        return np.rint(self.transfer(colours.astype(np.float64))).astype(np.uint8)

    def vertices(self, index: NDArray[np.int64], *, region: bool = False) -> NDArray[np.int64]:
        """Vertices of this corpus's mesh at vertices of the head; those between them too if it is a region."""
        if not self.mask:
            return index
        return build_mask().region(index) if region else build_mask().vertex_of[index]

    def rig(self, identity: str) -> NDArray[np.float32]:
        """A speaker's face at rest and the displacements of :data:`SHAPES`, in metres, (55, V, 3)."""
        rig = rig_of(identity)
        return self.transfer(rig.transpose(1, 0, 2)).transpose(1, 0, 2).astype(np.float32) if self.mask else rig


PUPPET = CorpusVariant()
MASK_SEEN = tuple(f"{DRAWN}{number}" for number in range(5001, 5009))
MASK_UNSEEN = tuple(f"{DRAWN}{number}" for number in range(5009, 5013))
"""Speakers of the second corpus: drawn ones that the first does not have."""
MASK = CorpusVariant(f"{CORPUS}_mask", "MASK.ply", 30, mask=True)


def _voices_of_test_c() -> tuple[str, ...]:
    """Voices kept out of training: a variant of espeak-ng, a language, and one of people where it is installed."""
    people = [name for name in KEPT_OUT_PEOPLE if name.partition(":")[2] in Flite.voices()]
    return ("espeak:en+m8", "espeak:de+f3", *people)


def people_voices() -> tuple[str, ...]:
    """Voices made from recordings of people that are installed and may be trained on."""
    names = [f"flite:{voice}" for voice in Flite.voices()]
    return tuple(name for name in names if name not in KEPT_OUT_PEOPLE and not name.endswith("kal"))  # as kal16


def generate(
    root: Path,
    *,
    seed: int = 0,
    drawn: int = 0,
    people: Sequence[str] = (),
    workers: int | None = None,
    scheduler: str | None = "",
    progress: bool = True,
    only: Sequence[str] | None = None,
    variant: CorpusVariant = PUPPET,
) -> None:
    """Write the corpus, unless the folder holds it already; it appears whole or not at all.

    Args:
        root: the folder to make.
        seed: the same seed gives the same bytes.
        drawn: how many drawn speakers say training sentences, besides the cast of ten.
        people: voices of people: recordings of people, each of whom is a speaker more, and others
            (:func:`people_voices`), with which every second drawn speaker speaks.
        workers: by default one, or all of a cluster.
        scheduler: see :func:`facediff.utils.jobs.run_tasks`.
        progress: whether to show a progress bar.
        only: names of clips to write instead of all, for trials; such a corpus never counts as complete.
        variant: the corpus itself, or the second one with the mask.
    """
    facts = _facts(seed, drawn, people, variant)
    if only is None and _is_complete(root, facts):
        return
    _refuse_other(root, facts)
    every = variant.clips(drawn, people)
    clips = [clip for clip in every if only is None or clip.name in only]
    check_known("the built-in corpus", "clip", only or (), [clip.name for clip in clips])
    with atomic_folder(root, replace=True) as folder:
        _write_common(folder, clips, people, variant)
        work = partial(_write_clip, folder, seed=seed, people=tuple(people), variant=variant)
        options = {
            "workers": workers or (None if is_cluster(scheduler) else 1),
            "scheduler": scheduler,
            "writes": folder,
        }
        frames = sum(do_all(work, clips, **options, progress="Puppet corpus" if progress else ""))
        subjects = len(variant.speakers) + drawn + len(recorded_names(people))
        counts = {"subjects": subjects, "vertices": vertex_count(variant), "frames": frames}
        more = {"whole": only is None, "clips": len(clips), **counts, "frame_rate": variant.frame_rate}
        write_json(folder / MANIFEST, {**facts, **more, "files": describe_files(folder)})


def _is_complete(root: Path, facts: dict[str, object]) -> bool:
    """Whether a folder holds the whole corpus of this version, seed and voices; compares sizes, not contents."""
    manifest = read_json(Path(root) / MANIFEST) or {}
    files = manifest.get("files")
    same = all(manifest.get(key) == value for key, value in {**facts, "whole": True}.items())
    return same and isinstance(files, dict) and same_sizes(Path(root), files)


def _facts(seed: int, drawn: int, people: Sequence[str], variant: CorpusVariant) -> dict[str, object]:
    # Without what test C is spoken with: a folder stays whole where flite is installed later, or is missing.
    facts = {"corpus": variant.corpus, "format": 1, "generator": GENERATOR, "seed": seed, "drawn": drawn}
    recordings = state_of(people)
    return {**facts, "people": list(people), **({"recordings": recordings} if recordings else {})}


def resting_head(member: CastMember) -> NDArray[np.float64]:
    """A speaker's head at rest in metres, (V, 3)."""
    return np.asarray(dressed(member.face, build_head(), member.complexion) / 1000.0)


@lru_cache(maxsize=4)
def rig_of(identity: str) -> NDArray[np.float32]:
    """A speaker's head at rest and the displacements of :data:`SHAPES`, in metres, (55, V, 3).

    The average head's poses are sent through the speaker's deformation of space, so that lips that meet on the one meet
    on the other.
    """
    member, mesh, shapes = member_of(identity), build_head(), head_shapes()
    rest = member.face(mesh.vertices)
    rig = np.zeros((1 + len(SHAPES), *rest.shape), np.float32)
    rig[0] = resting_head(member)
    for number, name in enumerate(SHAPES, start=1):
        moved = np.flatnonzero(np.abs(shapes[name]).max(axis=1) > 1e-9)
        posed = member.face(mesh.vertices[moved] + shapes[name][moved])
        rig[number, moved] = (posed - rest[moved]) / 1000.0
    return rig


def vertex_count(variant: CorpusVariant = PUPPET) -> int:
    """Vertices of a corpus's mesh."""
    return N_MASK_VERTICES if variant.mask else N_HEAD_VERTICES


def spoken_words(number: int, identities: Sequence[str], people: Sequence[str] = ()) -> NDArray[np.float32]:
    """Five to eight random words by one of some speakers, (S,) at 16 kHz; the same number gives the same speech."""
    random = np.random.default_rng([number, len(WORDS), 2])
    text = " ".join(random.choice(WORDS, size=random.integers(5, 9)))
    speakers = [name for name in identities if not name.startswith(RECORDED)]  # recordings say their own words only
    identity = speakers[int(random.integers(len(speakers)))]
    return speak_clip(PerformedClip(identity, "train", 1, text, str(random.choice([*MOODS]))), people).samples


def region_vertices() -> dict[str, NDArray[np.int64]]:
    """Vertices of the regions ``lve`` (both lips) and ``fdd`` (forehead, brows and round the eyes)."""
    mesh = build_head()
    x, y, z = mesh.vertices.T
    skin = np.zeros(len(x), dtype=bool)
    skin[mesh.both("skin")] = True
    forehead = np.flatnonzero(skin & (y > 32.0) & (y < 80.0) & (np.abs(x) < 60.0) & (z > 35.0))
    eyes = mesh.both(*AROUND_EYE, "lid_edge", "brow_")
    return {
        "lve": mesh.both("lip_border", "lip_outer", "lip_crest", "lip_front", "lip_inner"),
        "fdd": np.union1d(forehead, eyes),
    }


def speak_clip(clip: PerformedClip, people: Sequence[str] = ()) -> Utterance:
    """The sound of a clip: the speaker's voice, or the clip's own, in the clip's mood, with quiet at both ends.

    The waveform lasts a whole number of frames at 25 a second.
    """
    member, mood = member_of(clip.identity, people), MOODS[clip.mood]
    delivery = Delivery(member.rate * mood.rate, member.pitch + mood.pitch, member.pitch_range * mood.pitch_range)
    utterance = open_voice(clip.voice or member.voice).speak(clip.text, delivery)
    speech = utterance.samples * (_PEAK / max(float(np.abs(utterance.samples).max()), 1e-6))
    speech = np.clip(coloured_speech(speech, mood.loudness, mood.brightness), -1.0, 1.0)
    before, frame = round(_QUIET_BEFORE * SAMPLE_RATE), SAMPLE_RATE // FRAME_RATE
    frames = round((before + len(speech) + round(_QUIET_AFTER * SAMPLE_RATE)) / frame)
    samples = np.zeros(max(frames * frame, before + len(speech)), dtype=np.float32)
    samples[before : before + len(speech)] = speech
    phonemes = _in_quiet(utterance.phonemes, before / SAMPLE_RATE, frames / FRAME_RATE)
    return Utterance(samples[: frames * frame], phonemes)


def perform_clip(
    clip: PerformedClip, speech: Utterance, seed: int = 0, frame_rate: float = FRAME_RATE
) -> tuple[FaceMotion, FaceMotion]:
    """The motion of a clip, and another that its speaker could have made with the same speech.

    Of several performances of a test sentence the one with the median liveliness of the upper face is taken, so that
    the truth of a few sentences is typical of all; the other is the first of those that are left.
    """
    member, sounds = member_of(clip.identity), speech_sounds(speech.phonemes)
    contours = analyse(speech.samples, SAMPLE_RATE)
    frames = round(len(speech.samples) / SAMPLE_RATE * frame_rate)
    everybody = list(CAST)
    number = int(clip.identity[1:]) + (RECORDED_FROM if clip.identity.startswith(RECORDED) else 0)
    invented = len(everybody) - 1 + number if clip.identity not in CAST else 0
    key = [seed, invented or everybody.index(clip.identity), *map(ord, clip.sentence)]
    draws = _DRAWS if clip.split.startswith("test") else 1
    performances = [
        synthesise_motion(
            sounds, contours, frames, frame_rate, member.habits, clip.mood, np.random.default_rng([*key, draw])
        )
        for draw in range(draws)
    ]
    if draws == 1:
        return performances[0], performances[0]
    brows = [SHAPES.index(name) for name in SHAPES if name.startswith(("brow", "eyeBlink"))]
    lively = [float(performance.weights[:, brows].std(axis=0).mean()) for performance in performances]
    middle = int(np.argsort(lively)[draws // 2])
    return performances[middle], performances[0 if middle else 1]


def _write_common(folder: Path, clips: Sequence[PerformedClip], people: Sequence[str], variant: CorpusVariant) -> None:
    """Write everything that is not a clip."""
    arrays = [f"{name}_npy" for name in ("vertices", "weights", "gaze", "head", "another_weights")]
    for name in ("wav", "rigs", "phonemes", "regions", *arrays):
        (folder / name).mkdir()
    mesh = build_head()
    templates = {}
    for identity in dict.fromkeys(clip.identity for clip in clips):
        rig = variant.rig(identity)
        np.save(folder / "rigs" / f"{identity}.npy", rig)
        templates[identity] = rig[0].astype(np.float64)
    with (folder / "templates.pkl").open("wb") as stream:
        pickle.dump(templates, stream, protocol=2)
    complexions: dict[str, Any] = {
        name: variant.colours(coloured(mesh, member_of(name, people).complexion)) for name in templates
    }
    np.savez(folder / "colours.npz", **complexions)
    mean = variant.transfer(np.mean([CAST[name].face(mesh.vertices) for name in SEEN], axis=0) / 1000.0)
    faces = build_mask().faces if variant.mask else mesh.faces
    _write_ply(folder / variant.mesh_file, mean, faces, variant.colours(coloured(mesh, Complexion())))
    for name, index in region_vertices().items():
        vertices = variant.vertices(index, region=True)
        (folder / "regions" / f"{name}.txt").write_text(", ".join(map(str, vertices.tolist())) + "\n")
    pairs = {"inner_lip": lip_pairs(mesh), "eyelid": eyelid_pairs(mesh)}
    if not variant.mask:  # which has no teeth
        pairs["lip_teeth"] = lip_teeth_pairs(mesh)
    for name, sides in pairs.items():
        rows = zip(*(variant.vertices(side).tolist() for side in sides), strict=True)
        (folder / "regions" / f"{name}_pairs.txt").write_text("".join(f"{one}, {other}\n" for one, other in rows))
    write_table(folder / "shapes.csv", [["shape"], *([name] for name in SHAPES)])
    table = [["clip", "subject", "sentence", "split", "mood", "voice", "text"]]
    for clip in clips:
        voice = clip.voice or member_of(clip.identity, people).voice
        table.append([clip.name, clip.identity, clip.sentence, clip.split, clip.mood, voice, clip.text])
    write_table(folder / "clips.csv", table)


def _write_clip(folder: Path, clip: PerformedClip, seed: int, people: Sequence[str], variant: CorpusVariant) -> int:
    """Write sound, motion and phonemes of a clip and return its number of frames."""
    speech = speak_clip(clip, people)
    performance, another = perform_clip(clip, speech, seed, variant.frame_rate)
    samples = np.rint(speech.samples * 32767.0).astype(np.int16)
    write_wav(folder / "wav" / f"{clip.name}.wav", samples, SAMPLE_RATE)
    for name, track in (("weights", performance.weights), ("gaze", performance.gaze), ("head", performance.head)):
        np.save(folder / f"{name}_npy" / f"{clip.name}.npy", track.astype(np.float32))
    if clip.split.startswith("test") and not variant.mask:  # those of the mask would take a gigabyte
        rig = rig_of(clip.identity)
        vertices = rig[0] + np.einsum("tk,kvc->tvc", performance.weights.astype(np.float32), rig[1:])
        np.save(folder / "vertices_npy" / f"{clip.name}.npy", vertices.reshape(len(vertices), -1))
    if clip.split.startswith("test"):
        np.save(folder / "another_weights_npy" / f"{clip.name}.npy", another.weights.astype(np.float32))
    write_table(folder / "phonemes" / f"{clip.name}.csv", [["start", "end", "ipa"], *map(_row, speech.phonemes)])
    return len(performance.weights)


def _row(phoneme: SpokenPhoneme) -> list[str]:
    return [f"{phoneme.start:.4f}", f"{phoneme.end:.4f}", phoneme.ipa]


def _in_quiet(phonemes: tuple[SpokenPhoneme, ...], before: float, end: float) -> tuple[SpokenPhoneme, ...]:
    """Shift phonemes by the quiet before speech and fill up with pauses to the end of the clip."""
    moved = [SpokenPhoneme(p.start + before, min(p.end + before, end), p.ipa) for p in phonemes]
    moved = [p for p in moved if p.end > p.start]
    if moved[0].start > 0.0:
        moved.insert(0, SpokenPhoneme(0.0, moved[0].start, ""))
    if moved[-1].end < end:
        moved.append(SpokenPhoneme(moved[-1].end, end, ""))
    return tuple(moved)


def _refuse_other(root: Path, facts: dict[str, object]) -> None:
    """Never replace a folder that this generator did not write, or a whole corpus of other speakers."""
    if not root.is_dir() or not any(root.iterdir()):
        return
    manifest = read_json(root / MANIFEST) or {}
    faults = [
        f"holds the corpus with {name} {quoted(manifest.get(name))}, not {quoted(facts[name])}; ask for the same,"
        for name in ("seed", "drawn", "people")
        if manifest.get("whole") and manifest.get(name) != facts[name]
    ]
    if manifest.get("corpus") != facts["corpus"]:
        faults = ["is not empty and holds no manifest of the built-in corpus;"]
    if faults:
        raise FaceDiffError(f"{root}: {faults[0]} choose another folder, or remove this one")


def _write_ply(path: Path, vertices: NDArray[np.float64], faces: NDArray[np.int64], colours: NDArray[np.uint8]) -> None:
    """Write a triangle mesh (V, 3), (F, 3) with colours (V, 3) in red, green, blue as binary little-endian PLY."""
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    header += ["property float x", "property float y", "property float z"]
    header += ["property uchar red", "property uchar green", "property uchar blue"]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    points = np.empty(len(vertices), dtype=[("place", "<f4", 3), ("colour", "u1", 3)])
    points["place"], points["colour"] = vertices, colours
    corners = np.empty(len(faces), dtype=[("count", "u1"), ("index", "<i4", 3)])
    corners["count"], corners["index"] = 3, faces
    path.write_bytes(("\n".join(header) + "\n").encode("ascii") + points.tobytes() + corners.tobytes())
