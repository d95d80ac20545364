"""BIWI, the 3D Audiovisual Corpus of Affective Communication (B3D(AC)^2), from its raw distribution.

Source of the data: Fanelli et al., IEEE Transactions on Multimedia 12(6), 2010. The raw folder holds
``faces/<S>/<eNN>/frame_XXX.vl``, ``rigid_scans/<S>.obj``, and the sound as wav files or in ``videos/<S>_<eNN>.flv``.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Sequence
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facediff.data.preparation import (
    Job,
    PreparationPlan,
    bases,
    choose_subjects,
    copy_files,
    find_file,
    find_regions,
    folders_in,
    refuse_empty,
    write_clip,
    write_mesh,
    write_templates,
)
from facediff.errors import FaceDiffError
from facediff.mesh.mesh import surface_area
from facediff.mesh.mesh_files import read_mesh

SUBJECTS = [*(f"F{i}" for i in range(1, 9)), *(f"M{i}" for i in range(1, 7))]
SEEN = ("F2", "F3", "F4", "M3", "M4", "M5")
SENTENCES = [f"e{i:02d}" for i in range(1, 41)]
"""The emotional half. The neutral one, 01 to 40, is left out by all published work on this corpus."""
FRAME_RATE = 25.0
MESH_FILE = "BIWI.ply"
REGION_FILES = ("lve.txt", "fdd.txt")

UNIT = "normalised (the square root of a face's surface area is 1, about 185 mm)"

SOUND_NAME = re.compile(r"([FM]\d)_(e\d\d)(_cut)?")
SOUND_SUFFIXES = (".wav", ".flac", ".flv", ".mp4", ".avi", ".mov", ".mkv", ".webm")  # the first that is there is used
SOUND_DEPTH = 4  # levels of folders that are searched

FRAME_NAME = re.compile(r"frame_(\d+)\.vl", re.IGNORECASE)
HEADERS = (4, 8)
"""Bytes of the count in a frame's file: the authors wrote an "unsigned long", as wide as on their platform."""

Array = npt.NDArray[np.float64]


def plan(
    raw: Path,
    *,
    subjects: Sequence[str] | None = None,
    regions: Path | None = None,
) -> PreparationPlan:
    """Scan a raw folder of BIWI; its frames are turned, centred and scaled one by one, as in published work.

    Args:
        raw: the folder, or the folder above the one that the archives unpacked to.
        subjects: only these, e.g. F2,F3,M5; all that are there if not given
        regions: folder with lve.txt and fdd.txt; regions/ of the raw folder if not given
    """
    selected = choose_subjects(subjects, SUBJECTS, "BIWI")
    region_files = find_regions(raw, regions)
    gaps = {
        f"regions/{name}": f"expected in a folder given by --regions; the CodeTalker repository has it as "
        f"BIWI/regions/{name}, and facediff may not distribute it"
        for name in REGION_FILES
        if name not in {path.name for path in region_files}
    }
    notes: list[str] = []
    sequences, sounds = _find_sequences(raw, selected, notes), _find_sounds(raw)
    templates: dict[str, Path] = {}
    jobs = []
    for subject in selected:
        template = find_file(raw, f"rigid_scans/{subject}.obj")
        if not sequences[subject]:
            gaps[subject] = f"expected frames in {raw / 'faces' / subject / 'e01'} … e40"
            continue
        if template is None:
            expected = raw / "rigid_scans" / f"{subject}.obj"
            gaps[f"template of {subject}"] = f"expected {expected}; no clip of {subject} is written without it"
        else:
            templates[subject] = template
        for sentence in SENTENCES:
            name, folder = f"{subject}_{sentence}", sequences[subject].get(sentence)
            if folder is None:
                gaps[name] = f"expected frames in {raw / 'faces' / subject / sentence}"
            elif name not in sounds:
                gaps[name] = f"expected its sound, {raw / 'audio' / name}.wav or {raw / 'videos' / name}.flv"
            elif template is not None:
                jobs.append(Job(name, partial(prepare_clip, name, folder, sounds[name], template)))
                if frames := gaps_in(list(frame_files(folder))):
                    notes.append(
                        f"{name}: frames {', '.join(frames)} are not in {folder}; it is written without them, so that "
                        f"speech and motion are no longer synchronous from there on"
                    )
    refuse_empty(raw, "BIWI", jobs, gaps)
    return PreparationPlan(
        corpus="biwi",
        frame_rate=FRAME_RATE,
        unit=UNIT,
        n_vertices=len(read_template(next(iter(templates.values())))[0]),
        options={"normalise": "codetalker", "dtype": "float32", "subjects": "all" if subjects is None else selected},
        jobs=jobs,
        shared=partial(_write_shared, templates, region_files),
        missing=gaps,
        notes=notes,
    )


def prepare_clip(name: str, folder: Path, sound: Path, template_file: Path, out: Path) -> int:
    """Write one sequence and return its number of frames."""
    from facediff.speech.audio import read_speech

    template, faces = read_template(template_file)
    files = list(frame_files(folder).values())
    check_sizes(files)
    vertices = np.empty((len(files), *template.shape), np.float32)
    for target, file in zip(vertices, files, strict=True):
        frame = read_vl(file)
        if frame.shape != template.shape or not np.isfinite(frame).all():
            raise FaceDiffError(
                f"{file}: has {len(frame)} vertices, or NaN among them; expected {len(template)} finite ones as in "
                f"{template_file}; copy it again, or remove the sequence from {folder.parent}"
            )
        with np.errstate(all="ignore"):  # NaN is refused when the clip is written
            target[:] = codetalker(frame, faces)
    return write_clip(out, name, vertices, read_speech(sound))


def codetalker(vertices: npt.NDArray[np.floating], faces: npt.NDArray[np.integer]) -> Array:
    """Turn a frame (V, 3) by pi about x, centre it on its own mean vertex, scale it to a surface area of one.

    Mean and area are the frame's own. An opening jaw moves the mean and enlarges the area, so a part of its motion
    becomes a shift and a scale of the whole face; results published on BIWI contain this, and so must this.

    Source: the preprocessing published with CodeTalker (Xing et al., CVPR 2023; repository Doubiiu/CodeTalker), which
    most later work adopts.
    """
    turned = np.asarray(vertices, np.float64) * (1.0, -1.0, -1.0)
    centred = turned - turned.mean(axis=0)
    return centred / np.sqrt(surface_area(centred, faces))


def _write_shared(templates: dict[str, Path], region_files: Sequence[Path], out: Path) -> list[str]:
    neutral = {subject: codetalker(*read_template(path)) for subject, path in templates.items()}
    write_templates(out / "templates.pkl", neutral)
    speaker = next((subject for subject in SEEN if subject in neutral), next(iter(neutral)))
    write_mesh(out / MESH_FILE, neutral[speaker], read_template(templates[speaker])[1])
    return ["templates.pkl", MESH_FILE, *copy_files(region_files, out, "regions")]


# Finding sequences, templates and sound in the raw folder.


def _find_sequences(raw: Path, subjects: Sequence[str], notes: list[str]) -> dict[str, dict[str, Path]]:
    """Folder of every emotional sequence, by subject and sentence."""
    sequences: dict[str, dict[str, Path]] = {subject: {} for subject in subjects}
    neutral = 0
    for base in bases(raw):
        for subject in subjects:
            folder = base / "faces" / subject
            for path in folders_in(folder) if folder.is_dir() else ():
                if path.name in SENTENCES and frame_files(path):
                    sequences[subject].setdefault(path.name, path)
                neutral += f"e{path.name}" in SENTENCES
    if neutral:
        notes.append(f"{neutral} neutral sequences (01 to 40 without an e) are left out, as in all published work")
    return sequences


def _find_sounds(raw: Path) -> dict[str, Path]:
    """Sound of every clip. A recording cut to the motion is preferred, then any other recording, then a video."""
    ranked: dict[str, tuple[tuple[int, bool, bool, str], Path]] = {}
    for path_text, folders, files in os.walk(raw, followlinks=True):
        folder = Path(path_text)
        deep = len(folder.relative_to(raw).parts) >= SOUND_DEPTH
        folders[:] = [] if deep else sorted(name for name in folders if name not in ("faces", "rigid_scans"))
        for path in (folder / file for file in files if not file.startswith(".")):
            match = SOUND_NAME.fullmatch(path.stem) or SOUND_NAME.fullmatch(f"{folder.name}_{path.stem}")
            if match and path.suffix.lower() in SOUND_SUFFIXES:
                rank = (SOUND_SUFFIXES.index(path.suffix.lower()), not match[3], "audio" not in path.parts, str(path))
                name = f"{match[1]}_{match[2]}"
                ranked[name] = min(ranked.get(name, (rank, path)), (rank, path))
    return {name: path for name, (_, path) in ranked.items()}


# Reading frames (one ``.vl`` file each: a count of vertices, then float32 x, y, z for each) and templates.


def frame_files(folder: Path) -> dict[int, Path]:
    """The frames of a sequence by number, in numeric order."""
    paths = ((FRAME_NAME.fullmatch(path.name), path) for path in folder.iterdir())
    return dict(sorted((int(match[1]), path) for match, path in paths if match))


def gaps_in(numbers: list[int]) -> list[str]:
    """The gaps in a numbering that should begin with 1 (or 0), e.g. ``["5", "9 to 12"]``."""
    spans = [(a + 1, b - 1) for a, b in zip([0, *numbers], numbers, strict=False) if b - a > 1]
    return [f"{first}" if first == last else f"{first} to {last}" for first, last in spans]


def check_sizes(files: Sequence[Path]) -> None:
    """Four bytes off a file with a long header look like a short header's file: only the other frames can tell."""
    sizes = Counter(path.stat().st_size for path in files)
    if len(sizes) > 1:
        odd = next(path for path in files if path.stat().st_size != sizes.most_common(1)[0][0])
        raise FaceDiffError(f"{odd}: has {odd.stat().st_size} bytes, unlike the sequence's other frames; copy it again")


def read_vl(path: Path) -> npt.NDArray[np.float32]:
    """Vertices (V, 3) of one frame, in mm. The width of the count follows from the file's size."""
    data = path.read_bytes()
    for header in HEADERS:
        count, rest = divmod(len(data) - header, 12)
        if count > 0 and rest == 0 and int.from_bytes(data[:header], "little") == count:
            return np.frombuffer(data, "<f4", offset=header).reshape(count, 3)
    count = int.from_bytes(data[:4], "little")
    raise FaceDiffError(
        f"{path}: has {len(data)} bytes, but its header announces {count} vertices, for which {count * 12 + 4} or "
        f"{count * 12 + 8} bytes are expected; it is truncated or damaged, copy it again"
    )


@lru_cache(maxsize=2 * len(SUBJECTS))
def read_template(path: Path) -> tuple[Array, npt.NDArray[np.int32]]:
    """Vertices (V, 3) in mm and faces (F, 3) of a personal template, vertices in the order of the file."""
    mesh = read_mesh(path)
    return mesh.vertices, mesh.faces.astype(np.int32)
