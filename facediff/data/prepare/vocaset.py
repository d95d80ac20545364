"""VOCASET from its raw distribution.

Source of the data: Cudeiro et al., "Capture, Learning, and Synthesis of 3D Speaking Styles", CVPR 2019. The raw folder
holds ``data_verts.npy`` (frames of all clips, 60 a second, in metres), ``subj_seq_to_idx.pkl`` (which row is which
frame), ``raw_audio_fixed.pkl`` and ``templates.pkl``.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from operator import index
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from facediff.data.corpus import as_template, load_template_dict
from facediff.data.preparation import (
    Job,
    PreparationPlan,
    copy_files,
    find_file,
    find_regions,
    refuse_empty,
    write_clip,
    write_templates,
)
from facediff.errors import FaceDiffError, damaged
from facediff.utils.arrays import open_vertices
from facediff.utils.pickles import load_pickle

RAW_RATE = 60
SUBJECTS = 12
SENTENCES = [f"sentence{i:02d}" for i in range(1, 41)]
VERTICES, ROWS, AUDIO, TEMPLATES = "data_verts.npy", "subj_seq_to_idx.pkl", "raw_audio_fixed.pkl", "templates.pkl"
OPTIONAL = {
    "FLAME_sample.ply": "the mesh, for drawing; the VOCA repository has it in template/",
    "FLAME_masks.pkl": "lips and upper face; from flame.is.tue.mpg.de (FLAME vertex masks)",
}
LISTS = "not needed in addition to FLAME_masks.pkl; the FaceDiffuser repository has it in data/vocaset/regions/"
REGION_FILES = ("lve.txt", "fdd.txt")
FULL_SCALE = 32768.0  # of 16-bit samples
SAMPLE_RATES = (8_000, 192_000)

Array = npt.NDArray[np.float64]


class VocasetRecording(NamedTuple):
    """One clip: row of every frame in ``data_verts.npy``, entry of ``raw_audio_fixed.pkl``, name in messages."""

    rows: npt.NDArray[np.int64]
    audio: object
    where: str


def plan(
    raw: Path,
    *,
    frame_rate: Literal[30, 60] = 30,
    regions: Path | None = None,
) -> PreparationPlan:
    """Scan a raw folder of VOCASET. The sound of all clips is read into memory, once.

    Args:
        raw: the folder, or the folder above it.
        frame_rate: 30, every second frame, which every published model uses; or 60, for other projects' loaders
        regions: folder with lists of vertices; regions/ of the raw folder if not given
    """
    vertices, templates_file = _need(raw, VERTICES), _need(raw, TEMPLATES)
    row_map, sounds = _nested(_need(raw, ROWS)), _nested(_need(raw, AUDIO))
    n_vertices = open_vertices(vertices).shape[1]
    templates: dict[str, Array] = {
        str(name): as_template(templates_file, name, face, n_vertices, np.float64)
        for name, face in load_template_dict(templates_file).items()
    }
    extras = [path for name in OPTIONAL if (path := find_file(raw, name)) is not None]
    region_files = find_regions(raw, regions)
    gaps = _missing_extras([*extras, *region_files])
    notes: list[str] = []
    jobs = []
    for subject in sorted({*row_map, *sounds}):
        if subject not in templates:
            gaps[f"template of {subject}"] = f"expected in {TEMPLATES}; no clip of {subject} is written without it"
            continue
        rows_of, sound_of = row_map.get(subject, {}), sounds.get(subject, {})
        for sentence in sorted({*SENTENCES, *rows_of, *sound_of}):
            name = f"{subject}_{sentence}"
            files = [file for file, entries in ((ROWS, rows_of), (AUDIO, sound_of)) if entries.get(sentence) is None]
            if files:
                gaps[name] = f"not in {' nor in '.join(files)}; the distribution lacks some"
                continue
            recording = VocasetRecording(
                _rows(rows_of[sentence], name, notes), sound_of[sentence], f"{subject} {sentence}"
            )
            jobs.append(Job(name, partial(prepare_clip, name, recording, vertices, RAW_RATE // frame_rate)))
    if len(row_map) < SUBJECTS:
        notes.append(f"{ROWS} has {len(row_map)} of the {SUBJECTS} subjects")
    refuse_empty(raw, "VOCASET", jobs, gaps)
    return PreparationPlan(
        corpus="vocaset",
        frame_rate=float(frame_rate),
        unit="m",
        n_vertices=n_vertices,
        options={"frame_rate": frame_rate, "decimate": "every_second", "dtype": "float32"},
        jobs=jobs,
        shared=partial(_write_shared, templates, extras, region_files),
        missing=gaps,
        notes=notes,
    )


def prepare_clip(name: str, recording: VocasetRecording, vertices: Path, stride: int, out: Path) -> int:
    """Write every ``stride``-th frame of a clip, beginning with the first, and return their number.

    As many frames are used as both the map and the sound have, as in VOCA.
    """
    from facediff.speech.audio import to_speech

    samples, rate = read_samples(recording.audio, recording.where)
    frames = min(len(recording.rows), round(len(samples) / rate * RAW_RATE))
    rows = recording.rows[:frames]
    store = open_vertices(vertices)
    wrong = (rows < 0) | (rows >= len(store))
    if wrong.any():
        frame = int(np.argmax(wrong))
        raise FaceDiffError(
            f"{recording.where}: frame {frame} is row {rows[frame]} in {ROWS}, but {vertices} has {len(store)} rows; "
            f"the files belong to different releases or one is truncated"
        )
    return write_clip(out, name, np.asarray(store[rows[::stride]]), to_speech(samples, rate, recording.where))


def read_samples(entry: object, where: str) -> tuple[npt.NDArray[np.float32], float]:
    """Samples (S,) or (S, channels) in -1 … 1 and sample rate of an entry ``{"audio": …, "sample_rate": …}``.

    Whole numbers of any type, and floats beyond -1 … 1, are 16-bit samples.
    """
    with damaged(f"{where}: its sound in {AUDIO}", "expected an array of numbers with a rate"):
        rate, samples = float(entry["sample_rate"]), np.squeeze(np.asarray(entry["audio"]))  # type: ignore[index]
        peak = float(np.abs(samples.astype(np.float64)).max())
    channels = min(samples.shape) if samples.ndim == 2 else 1
    signed = samples.ndim in (1, 2) and channels <= 2 and samples.dtype.kind in "if" and peak <= FULL_SCALE
    if not signed or not SAMPLE_RATES[0] <= rate <= SAMPLE_RATES[1]:
        raise FaceDiffError(
            f"{where}: its sound in {AUDIO} is {samples.dtype} {samples.shape} up to {peak:g} at {rate:g} Hz; expected "
            f"one row of signed 16-bit samples, or two, at {SAMPLE_RATES[0]} to {SAMPLE_RATES[1]} Hz"
        )
    if samples.ndim == 2 and samples.shape[0] < samples.shape[1]:
        samples = samples.T
    full = 1.0 if samples.dtype.kind == "f" and not peak > 1.0 else FULL_SCALE
    return (samples / full).astype(np.float32), rate


def _need(raw: Path, name: str) -> Path:
    path = find_file(raw, name)
    if path is None:
        raise FaceDiffError(
            f"{raw / name}: no such file; expected {VERTICES}, {ROWS}, {AUDIO} and {TEMPLATES} as voca.is.tue.mpg.de "
            f"distributes them"
        )
    return path


def _nested(path: Path) -> dict[str, dict[str, Any]]:
    """A pickle with a dict from subject to a dict by sentence."""
    loaded = load_pickle(path)
    with damaged(path, "expected a dict from subject to a dict by sentence; get the file again"):
        return {str(subject): {str(key): value for key, value in inner.items()} for subject, inner in loaded.items()}


def _rows(frames: object, name: str, notes: list[str]) -> npt.NDArray[np.int64]:
    """Rows of a clip in the order of its frames."""
    with damaged(f"{ROWS}: {name}", "expected a dict from frame to row"):
        # An index that has been a float would be rounded silently.
        pairs = sorted((index(frame), index(row)) for frame, row in dict(frames).items())  # type: ignore[call-overload]
    if pairs and pairs[-1][0] != len(pairs) - 1:
        notes.append(f"{name}: {ROWS} leaves out some of the frames up to {pairs[-1][0]}; it is written without them")
    return np.array([row for _, row in pairs], np.int64)


def _missing_extras(files: Sequence[Path]) -> dict[str, str]:
    names = {path.name for path in files}
    advice = {**OPTIONAL, **({} if "FLAME_masks.pkl" in names else {f"regions/{name}": LISTS for name in REGION_FILES})}
    return {
        name: f"no such file in the raw folder: {text}"
        for name, text in advice.items()
        if name.removeprefix("regions/") not in names
    }


def _write_shared(
    templates: dict[str, Array], extras: Sequence[Path], region_files: Sequence[Path], out: Path
) -> list[str]:
    write_templates(out / "templates.pkl", templates)
    return ["templates.pkl", *copy_files(extras, out), *copy_files(region_files, out, "regions")]
