"""Writing the built-in corpus in the layout of BIWI's circulating copies."""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from facediff.errors import FaceDiffError
from facediff.speech.audio import write_wav
from facediff.speech.espeak import SpokenPhoneme, speak
from facediff.synthetic.face import build_face
from facediff.synthetic.geometry import Array
from facediff.synthetic.motion import FRAME_RATE, analyse, generate_weights, segments_of, visemes_of
from facediff.synthetic.rig import Rig, build_rig, eyelid_pairs, lip_pairs
from facediff.synthetic.sentences import SENTENCES
from facediff.synthetic.speakers import MOST_DRAWN, SPEAKERS, drawn_names, speaker_of
from facediff.utils import SAMPLE_RATE
from facediff.utils.checksums import describe_files, same_sizes
from facediff.utils.files import atomic_folder
from facediff.utils.jobs import in_order, is_cluster, run_tasks
from facediff.utils.plain_files import read_json, write_json, write_table

FORMAT = 1
GENERATOR = "1.1"
MANIFEST = "manifest.json"
CORPUS = "facediff-puppet"
_SAMPLES_PER_FRAME = SAMPLE_RATE // FRAME_RATE
_QUIET_BEFORE, _QUIET_AFTER = 0.10, 0.08
_PEAK = 0.6

# Who speaks what in which mood: the clips and their splits.

SEEN_IDENTITIES = ("F1", "F2", "F3", "M1", "M2", "M3")
UNSEEN_IDENTITIES = ("F4", "M4")
MOODS = ("flat", "neutral", "lively")
TRAIN_SENTENCES = tuple(range(1, 25))
VAL_SENTENCES = tuple(range(25, 28))
TEST_SENTENCES = tuple(range(28, 33))
#: Sentences of the unseen speakers that belong to no split, about a minute each: style references, and what a trained
#: model is adapted with.
REFERENCE_SENTENCES = tuple(range(1, 25))


@dataclass(frozen=True)
class SyntheticClip:
    """One clip of the corpus."""

    identity: str  # Who speaks
    number: int  # Which sentence, from 1
    mood: str  # One of `MOODS`

    @property
    def sentence(self) -> str:
        """Name of the sentence, such as ``"e01"``."""
        return f"e{self.number:02d}"

    @property
    def name(self) -> str:
        """Name of the clip and stem of its files, such as ``"F1_e01"``."""
        return f"{self.identity}_{self.sentence}"

    def __str__(self) -> str:
        return self.name


def clips(drawn: int = 0) -> tuple[SyntheticClip, ...]:
    """All clips, speaker by speaker.

    Moods take turns, shifted by one from speaker to speaker, so that every speaker has every mood equally
    often in training and every sentence is spoken in every mood.

    Args:
        drawn: How many drawn speakers there are besides the eight. They say the training sentences only.
    """
    everything = (*TRAIN_SENTENCES, *VAL_SENTENCES, *TEST_SENTENCES)
    plan = [(identity, everything) for identity in SEEN_IDENTITIES]
    plan += [(identity, (*REFERENCE_SENTENCES, *TEST_SENTENCES)) for identity in UNSEEN_IDENTITIES]
    plan += [(identity, TRAIN_SENTENCES) for identity in drawn_names(drawn)]
    return tuple(
        SyntheticClip(identity, number, MOODS[(number + turn) % len(MOODS)])
        for turn, (identity, numbers) in enumerate(plan)
        for number in numbers
    )


def generate(
    root: Path,
    *,
    seed: int = 0,
    workers: int | None = None,
    scheduler: str | None = "",
    progress: bool = True,
    only: Sequence[str] | None = None,
    drawn: int = 0,
) -> None:
    """Write the built-in corpus, unless the folder holds it already.

    The corpus is written into a folder next to ``root`` and takes its name when it is whole, so an interruption leaves
    nothing that could pass for a corpus.

    Args:
        root: The folder to make.
        seed: Seed of the random part (blinks, drift, habits of the brows); the same seed gives the same bytes.
        workers: How many workers share the work; by default one, or all of a cluster.
        scheduler: Where; see :func:`facediff.utils.jobs.run_tasks`.
        progress: Whether to show a progress bar.
        only: Names of clips to write instead of all, for trials; such a corpus never counts as complete.
        drawn: How many drawn speakers say the training sentences, besides the eight.
    """
    root = Path(root)
    chosen = _chosen(only, drawn)
    if only is None and is_complete(root, seed=seed, drawn=drawn):
        return
    refuse_foreign(root)
    with atomic_folder(root, replace=True) as folder:
        _write_common(folder, chosen)
        frames = _write_clips(folder, chosen, seed, workers, scheduler, progress)
        counts = {"subjects": len(SPEAKERS) + drawn, "vertices": len(build_face().vertices), "frames": frames}
        files = describe_files(folder)
        write_json(folder / MANIFEST, {**_facts(seed, len(chosen), drawn), **counts, "files": files})


def is_complete(root: Path, *, seed: int = 0, drawn: int = 0) -> bool:
    """Whether a folder holds the whole corpus of this version and seed; compares sizes, not contents.

    Args:
        root: The folder.
        seed: The seed that it must have been made with.
        drawn: How many drawn speakers it must have.
    """
    manifest = read_json(Path(root) / MANIFEST) or {}
    facts, files = _facts(seed, len(clips(drawn)), drawn), manifest.get("files")
    same = all(manifest.get(key) == value for key, value in facts.items())
    return same and isinstance(files, dict) and same_sizes(Path(root), files)


def generate_clip(clip: SyntheticClip, seed: int = 0) -> tuple[NDArray[np.int16], Array, tuple[SpokenPhoneme, ...]]:
    """One clip's waveform (640 T,) at 16 kHz, rig weights (T, controls), and phonemes in time."""
    speaker = speaker_of(clip.identity)
    spoken = speak(SENTENCES[clip.number - 1], speaker.voice)
    before = round(_QUIET_BEFORE * SAMPLE_RATE)
    length = before + spoken.samples.size + round(_QUIET_AFTER * SAMPLE_RATE)
    frames = round(length / _SAMPLES_PER_FRAME)
    samples = np.zeros(max(frames * _SAMPLES_PER_FRAME, before + spoken.samples.size), dtype=np.float32)
    samples[before : before + spoken.samples.size] = spoken.samples * (_PEAK / np.abs(spoken.samples).max())
    samples = samples[: frames * _SAMPLES_PER_FRAME]
    end = frames / FRAME_RATE
    phonemes = in_quiet(spoken.phonemes, before / SAMPLE_RATE, end)
    # The index of a speaker seeds the random part, so it must not depend on how many speakers are drawn.
    speakers = (*SPEAKERS, *drawn_names(MOST_DRAWN))
    random = np.random.default_rng([seed, speakers.index(clip.identity), clip.number])
    weights = generate_weights(
        segments_of(phonemes), analyse(samples, SAMPLE_RATE), frames, speaker.style, clip.mood, random
    )
    return np.rint(samples * 32767.0).astype(np.int16), weights, phonemes


def in_quiet(phonemes: tuple[SpokenPhoneme, ...], before: float, end: float) -> tuple[SpokenPhoneme, ...]:
    """Shift phonemes by the quiet before speech and fill up with pauses to the end of the clip."""
    moved = [SpokenPhoneme(p.start + before, min(p.end + before, end), p.ipa) for p in phonemes]
    moved = [p for p in moved if p.end > p.start]
    if moved[0].start > 0.0:
        moved.insert(0, SpokenPhoneme(0.0, moved[0].start, ""))
    if moved[-1].end < end:
        moved.append(SpokenPhoneme(moved[-1].end, end, ""))
    return tuple(moved)


@lru_cache(maxsize=8)
def rig_of(identity: str) -> Rig:
    """Rig of a speaker, by name."""
    speaker = speaker_of(identity)
    return build_rig(speaker.shape, speaker.style.asymmetry)


def regions() -> dict[str, NDArray[np.int64]]:
    """Vertices of the regions ``lve`` (both lips) and ``fdd`` (forehead, brows and around the eyes)."""
    mesh = build_face()
    x, y, z = (1000.0 * mesh.vertices).T
    skin = np.zeros(len(x), dtype=bool)
    skin[mesh.both("skin")] = True
    above = (y > 32.0) & (y < 84.0) & (np.abs(x) < 62.0) & (z > 30.0)
    upper = np.flatnonzero(skin & above)
    eyes = mesh.both("eye_0", "eye_1", "eye_2", "lid_inner", "brow")
    return {"lve": mesh.both("mouth_0", "lip_crest", "lip_front", "lip_inner"), "fdd": np.union1d(upper, eyes)}


def _facts(seed: int, count: int, drawn: int) -> dict[str, int | str]:
    facts: dict[str, int | str] = {"corpus": CORPUS, "format": FORMAT, "generator": GENERATOR, "seed": seed}
    return {**facts, "clips": count, **({"drawn": drawn} if drawn else {})}


def _chosen(only: Sequence[str] | None, drawn: int) -> tuple[SyntheticClip, ...]:
    everything = clips(drawn)
    if only is None:
        return everything
    clips_by_name = {clip.name: clip for clip in everything}
    unknown = [name for name in only if name not in clips_by_name]
    if unknown:
        raise FaceDiffError(f"the built-in corpus has no clip {unknown[0]!r}; clips are named like 'F1_e01'")
    return tuple(clips_by_name[name] for name in only)


def refuse_foreign(root: Path, corpus: str = CORPUS) -> None:
    """Never replace a folder that this generator did not write."""
    if root.is_dir() and any(root.iterdir()) and (read_json(root / MANIFEST) or {}).get("corpus") != corpus:
        raise FaceDiffError(
            f"{root}: is not empty and holds no manifest of the built-in corpus; choose another folder, or remove it"
        )


def _write_common(folder: Path, chosen: Sequence[SyntheticClip]) -> None:
    """Write everything that is not a clip."""
    for name in ("wav", "vertices_npy", "phonemes", "regions"):
        (folder / name).mkdir()
    mesh = build_face()
    speakers = dict.fromkeys((*SEEN_IDENTITIES, *UNSEEN_IDENTITIES, *(clip.identity for clip in chosen)))
    templates = {identity: np.array(rig_of(identity).neutral) for identity in speakers}
    with (folder / "templates.pkl").open("wb") as stream:
        pickle.dump(templates, stream, protocol=2)
    mean = np.mean([templates[identity] for identity in SEEN_IDENTITIES], axis=0)
    write_ply(folder / "PUPPET.ply", mean, mesh.faces, mesh.colours)
    for name, index in regions().items():
        (folder / "regions" / f"{name}.txt").write_text(", ".join(map(str, index.tolist())) + "\n")
    for file, sides in (("inner_lip_pairs.txt", lip_pairs(mesh)), ("eyelid_pairs.txt", eyelid_pairs(mesh))):
        pairs = zip(*(side.tolist() for side in sides), strict=True)
        (folder / "regions" / file).write_text("".join(f"{upper}, {lower}\n" for upper, lower in pairs))
    table = [["clip", "subject", "sentence", "mood", "voice", "text"]]
    for clip in chosen:
        voice, text = speaker_of(clip.identity).voice.name, SENTENCES[clip.number - 1]
        table.append([clip.name, clip.identity, clip.sentence, clip.mood, voice, text])
    write_table(folder / "clips.csv", table)


def _write_clips(
    folder: Path, chosen: Sequence[SyntheticClip], seed: int, workers: int | None, scheduler: str | None, progress: bool
) -> int:
    """Write all clips and return how many frames they have together."""
    results = run_tasks(
        partial(_write_clip, folder, seed=seed),
        chosen,
        workers=workers or (None if is_cluster(scheduler) else 1),
        scheduler=scheduler,
        writes=folder,
        progress="Puppet corpus" if progress else "",
    )
    with closing(results):
        return sum(frames for _, frames in in_order(results, chosen))


def _write_clip(folder: Path, clip: SyntheticClip, seed: int) -> int:
    """Write sound, motion and phonemes of a clip and return its number of frames."""
    samples, weights, phonemes = generate_clip(clip, seed)
    write_wav(folder / "wav" / f"{clip.name}.wav", samples, SAMPLE_RATE)
    vertices = rig_of(clip.identity).pose(weights).astype(np.float32)
    np.save(folder / "vertices_npy" / f"{clip.name}.npy", vertices.reshape(len(vertices), -1))
    table = [["start", "end", "ipa", "viseme"]]
    for phoneme in phonemes:
        visemes = "+".join(visemes_of(phoneme.ipa))
        table.append([f"{phoneme.start:.4f}", f"{phoneme.end:.4f}", phoneme.ipa, visemes])
    write_table(folder / "phonemes" / f"{clip.name}.csv", table)
    return len(vertices)


def write_ply(path: Path, vertices: NDArray[np.float64], faces: NDArray[np.int64], colours: NDArray[np.uint8]) -> None:
    """Write a triangle mesh (V, 3), (F, 3) with colours (V, 3) in red, green, blue as binary little-endian PLY."""
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(vertices)}",
        *(f"property float {axis}" for axis in "xyz"),
        *(f"property uchar {colour}" for colour in ("red", "green", "blue")),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    points = np.empty(len(vertices), dtype=[("place", "<f4", 3), ("colour", "u1", 3)])
    points["place"], points["colour"] = vertices, colours
    corners = np.empty(len(faces), dtype=[("count", "u1"), ("index", "<i4", 3)])
    corners["count"], corners["index"] = 3, faces
    path.write_bytes(("\n".join(header) + "\n").encode("ascii") + points.tobytes() + corners.tobytes())
