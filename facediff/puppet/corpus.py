"""Writing the built-in corpus in the on-disk layout that BIWI's has in circulation."""

from __future__ import annotations

import csv
import pickle
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from facediff.errors import FaceDiffError
from facediff.puppet.coarticulation import segments_of
from facediff.puppet.curves import Array
from facediff.puppet.face import build_face
from facediff.puppet.files import folder_as_a_whole, matches_manifest, read_manifest, write_manifest, write_ply
from facediff.puppet.manner import FRAME_RATE, perform
from facediff.puppet.plan import SEEN_SUBJECTS, UNSEEN_SUBJECTS, Clip, clips
from facediff.puppet.prosody import analyse
from facediff.puppet.rig import Rig, build_rig, lip_pairs
from facediff.puppet.sentences import SENTENCES
from facediff.puppet.speakers import SPEAKERS
from facediff.puppet.speech import SAMPLE_RATE, Phoneme, speak
from facediff.puppet.visemes import visemes_of

FORMAT = 1
GENERATOR = "1.1"
_CORPUS = "facediff-puppet"
_SAMPLES_PER_FRAME = SAMPLE_RATE // FRAME_RATE
_QUIET_BEFORE, _QUIET_AFTER = 0.10, 0.08
_PEAK = 0.6


def generate(
    root: Path,
    *,
    seed: int = 0,
    workers: int | None = None,
    progress: bool = True,
    only: Sequence[str] | None = None,
) -> None:
    """Write the built-in corpus, unless the folder holds it already.

    The corpus is written into a folder beside ``root`` and takes its name when it is whole, so an
    interruption leaves nothing that could pass for a corpus.

    Args:
        root: The folder to make.
        seed: Where the random part (blinks, drift, habits of the brows) starts; the same seed gives the
            same bytes.
        workers: How many processes share the work; by default this one does it alone.
        progress: Whether to show a progress bar.
        only: Names of clips to write instead of all, for trials; such a corpus never counts as complete.

    Raises:
        FaceDiffError: If the folder holds something else, cannot be written, or espeak-ng is missing.
    """
    root = Path(root)
    chosen = _chosen(only)
    if only is None and is_complete(root, seed=seed):
        return
    _refuse_foreign(root)
    try:
        with folder_as_a_whole(root) as folder:
            _write_common(folder, chosen)
            frames = _write_clips(folder, chosen, seed, workers, progress)
            counts = {"subjects": len(SPEAKERS), "vertices": len(build_face().vertices), "frames": frames}
            write_manifest(folder, {**_facts(seed, len(chosen)), **counts})
    except OSError as error:
        raise FaceDiffError(
            f"the built-in corpus could not be written to {root}: {error.strerror or error}; "
            "choose a folder that can be written and has 200 MB free"
        ) from error


def is_complete(root: Path, *, seed: int = 0) -> bool:
    """Say whether a folder holds the whole corpus of this version and seed; looks at sizes, not at contents.

    Args:
        root: The folder.
        seed: The seed that it must have been made with.
    """
    return matches_manifest(Path(root), _facts(seed, len(clips())))


def perform_clip(clip: Clip, seed: int = 0) -> tuple[NDArray[np.int16], Array, tuple[Phoneme, ...]]:
    """Make one clip.

    Args:
        clip: Who says what in which mood.
        seed: The corpus's seed.

    Returns:
        The waveform at 16 kHz, shape (640 T,); rig weights, shape (T, controls); and the phonemes in time.
    """
    speaker = SPEAKERS[clip.subject]
    said = speak(SENTENCES[clip.number - 1], speaker.voice)
    before = round(_QUIET_BEFORE * SAMPLE_RATE)
    length = before + said.samples.size + round(_QUIET_AFTER * SAMPLE_RATE)
    frames = round(length / _SAMPLES_PER_FRAME)
    samples = np.zeros(max(frames * _SAMPLES_PER_FRAME, before + said.samples.size), dtype=np.float32)
    samples[before : before + said.samples.size] = said.samples * (_PEAK / np.abs(said.samples).max())
    samples = samples[: frames * _SAMPLES_PER_FRAME]
    end = frames / FRAME_RATE
    phonemes = _in_quiet(said.phonemes, before / SAMPLE_RATE, end)
    random = np.random.default_rng([seed, list(SPEAKERS).index(clip.subject), clip.number])
    weights = perform(segments_of(phonemes), analyse(samples, SAMPLE_RATE), frames, speaker.manner, clip.mood, random)
    return np.rint(samples * 32767.0).astype(np.int16), weights, phonemes


@lru_cache(maxsize=8)
def rig_of(subject: str) -> Rig:
    """Rig of a speaker, by name."""
    speaker = SPEAKERS[subject]
    return build_rig(speaker.shape, speaker.manner.asymmetry)


def regions() -> dict[str, NDArray[np.int64]]:
    """Vertices of the regions ``lve`` (both lips) and ``fdd`` (forehead, brows and around the eyes)."""
    mesh = build_face()
    x, y, z = (1000.0 * mesh.vertices).T
    skin = np.zeros(len(x), dtype=bool)
    skin[mesh.both("skin")] = True
    above = (y > 32.0) & (y < 84.0) & (np.abs(x) < 62.0) & (z > 30.0)
    upper = np.flatnonzero(skin & above)
    eyes = mesh.both("eye_0", "eye_1", "eye_2", "lid_inner", "brow")
    return {
        "lve": mesh.both("mouth_0", "lip_crest", "lip_front", "lip_inner"),
        "fdd": np.union1d(upper, eyes),
    }


def _facts(seed: int, count: int) -> dict[str, int | str]:
    return {
        "corpus": _CORPUS,
        "format": FORMAT,
        "generator": GENERATOR,
        "seed": seed,
        "clips": count,
    }


def _chosen(only: Sequence[str] | None) -> tuple[Clip, ...]:
    everything = clips()
    if only is None:
        return everything
    known = {clip.name: clip for clip in everything}
    unknown = [name for name in only if name not in known]
    if unknown:
        raise FaceDiffError(f"the built-in corpus has no clip {unknown[0]!r}: clips are named like 'F1_e01'")
    return tuple(known[name] for name in only)


def _refuse_foreign(root: Path) -> None:
    """Never replace a folder that this generator did not write."""
    if not root.exists():
        return
    if not root.is_dir():
        raise FaceDiffError(f"{root} is a file, but the built-in corpus needs a folder there: choose another place")
    if any(root.iterdir()) and read_manifest(root).get("corpus") != _CORPUS:
        raise FaceDiffError(
            f"{root} is not empty and holds no manifest of the built-in corpus: remove it or choose another folder"
        )


def _write_common(folder: Path, chosen: Sequence[Clip]) -> None:
    """Everything that is not a clip."""
    for name in ("wav", "vertices_npy", "phonemes", "regions"):
        (folder / name).mkdir()
    mesh = build_face()
    templates = {subject: np.array(rig_of(subject).neutral) for subject in (*SEEN_SUBJECTS, *UNSEEN_SUBJECTS)}
    with (folder / "templates.pkl").open("wb") as stream:
        pickle.dump(templates, stream, protocol=2)
    mean = np.mean([templates[subject] for subject in SEEN_SUBJECTS], axis=0)
    write_ply(folder / "PUPPET.ply", mean, mesh.faces, mesh.colours)
    for name, index in regions().items():
        (folder / "regions" / f"{name}.txt").write_text(", ".join(map(str, index.tolist())) + "\n")
    pairs = zip(*(side.tolist() for side in lip_pairs(mesh)), strict=True)
    lines = [f"{upper}, {lower}\n" for upper, lower in pairs]
    (folder / "regions" / "inner_lip_pairs.txt").write_text("".join(lines))
    with (folder / "clips.csv").open("w", newline="", encoding="utf-8") as stream:
        table = csv.writer(stream, lineterminator="\n")
        table.writerow(["clip", "subject", "sentence", "mood", "voice", "text"])
        for clip in chosen:
            voice, text = SPEAKERS[clip.subject].voice.name, SENTENCES[clip.number - 1]
            table.writerow([clip.name, clip.subject, clip.sentence, clip.mood, voice, text])


def _write_clips(folder: Path, chosen: Sequence[Clip], seed: int, workers: int | None, progress: bool) -> int:
    """Write all clips and return how many frames they have together."""
    from tqdm import tqdm

    total = 0
    with tqdm(total=len(chosen), desc="Puppet corpus", unit="clip", disable=not progress) as bar:
        for frames in _written(folder, chosen, seed, workers):
            total += frames
            bar.update()
    return total


def _written(folder: Path, chosen: Sequence[Clip], seed: int, workers: int | None) -> Iterator[int]:
    if not workers or workers == 1:
        for clip in chosen:
            yield _write_clip(folder, clip, seed)
        return
    # Spawned and not forked: the caller may have started threads, torch's for instance.
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        count = len(chosen)
        yield from pool.map(_write_clip, [folder] * count, chosen, [seed] * count, chunksize=8)


def _write_clip(folder: Path, clip: Clip, seed: int) -> int:
    """Write sound, motion and phonemes of a clip and return its number of frames."""
    import soundfile

    samples, weights, phonemes = perform_clip(clip, seed)
    soundfile.write(folder / "wav" / f"{clip.name}.wav", samples, SAMPLE_RATE, subtype="PCM_16")
    vertices = rig_of(clip.subject).pose(weights).astype(np.float32)
    np.save(folder / "vertices_npy" / f"{clip.name}.npy", vertices.reshape(len(vertices), -1))
    with (folder / "phonemes" / f"{clip.name}.csv").open("w", newline="", encoding="utf-8") as stream:
        table = csv.writer(stream, lineterminator="\n")
        table.writerow(["start", "end", "ipa", "viseme"])
        for phoneme in phonemes:
            table.writerow(
                [f"{phoneme.start:.4f}", f"{phoneme.end:.4f}", phoneme.ipa, "+".join(visemes_of(phoneme.ipa))]
            )
    return len(vertices)


def _in_quiet(phonemes: tuple[Phoneme, ...], before: float, end: float) -> tuple[Phoneme, ...]:
    """Shift phonemes behind the quiet before speech and fill up with pauses to the end of the clip."""
    moved = [Phoneme(p.start + before, min(p.end + before, end), p.ipa) for p in phonemes]
    moved = [p for p in moved if p.end > p.start]
    if moved[0].start > 0.0:
        moved.insert(0, Phoneme(0.0, moved[0].start, ""))
    if moved[-1].end < end:
        moved.append(Phoneme(moved[-1].end, end, ""))
    return tuple(moved)
