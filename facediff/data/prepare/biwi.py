"""BIWI, the 3D Audiovisual Corpus of Affective Communication (B3D(AC)^2), from its raw distribution.

Source of the data: Fanelli et al., IEEE Transactions on Multimedia 12(6), 2010. The raw folder holds
``faces/<S>/<eNN>/frame_XXX.vl``, ``rigid_scans/<S>.obj``, and the sound as wav files or in ``videos/<S>_<eNN>.flv``.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from facediff.data.prepare.motion import codetalker
from facediff.data.prepare.runner import (
    Job,
    Plan,
    Precision,
    bases,
    copy_files,
    find_regions,
    folders_in,
    motion_file,
    region_files,
    speech_file,
    write_motion,
    write_speech,
    write_templates,
)
from facediff.errors import FaceDiffError, MissingExtraError, choices
from facediff.mesh import read_mesh
from facediff.utils.files import atomic

# The ``.vl`` files of BIWI: one frame each, a count of vertices and then float32 x, y, z for each.

FRAME_NAME = re.compile(r"frame_(\d+)\.vl", re.IGNORECASE)
HEADERS = (4, 8)
"""Bytes of the count: the authors wrote an "unsigned long", whose width is the platform's."""


def read_vl(path: Path) -> npt.NDArray[np.float32]:
    """Vertices (V, 3) of one frame, in mm.

    The width of the count is told by the file's size.

    Raises:
        FaceDiffError: if the file is missing, or its size does not fit its count: bytes found and expected are named.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise FaceDiffError(f"{path}: cannot be read ({error.strerror}); expected a frame of BIWI") from error
    for header in HEADERS:
        count, rest = divmod(len(data) - header, 12)
        if count > 0 and rest == 0 and int.from_bytes(data[:header], "little") == count:
            return np.frombuffer(data, "<f4", offset=header).reshape(count, 3)
    told = int.from_bytes(data[:4], "little")
    raise FaceDiffError(
        f"{path}: has {len(data)} bytes, but its header tells {told} vertices, for which "
        f"{told * 12 + 4} or {told * 12 + 8} bytes are expected; it is truncated or damaged, copy it anew"
    )


def frame_files(folder: Path) -> dict[int, Path]:
    """The frames of a sequence by number, in numeric order.

    Raises:
        FaceDiffError: if the folder cannot be read, or two files claim the same number.
    """
    found: dict[int, Path] = {}
    try:
        names = os.listdir(folder)
    except OSError as error:
        raise FaceDiffError(f"{folder}: cannot be read ({error.strerror}); check its permissions") from error
    for name in names:
        match = FRAME_NAME.fullmatch(name)
        if match is None:
            continue
        number, path = int(match[1]), folder / name
        if number in found:
            raise FaceDiffError(f"{path}: has the same frame number as {found[number].name}; remove one of them")
        found[number] = path
    return dict(sorted(found.items()))


def gaps(numbers: list[int]) -> list[str]:
    """What is not there in a numbering that should begin with 1 (or 0), e.g. ``["5", "9 to 12"]``."""
    missing = []
    for before, after in zip([0, *numbers], numbers, strict=False):
        if after - before > 1:
            first, last = before + 1, after - 1
            missing.append(f"{first}" if first == last else f"{first} to {last}")
    return missing


def check_sizes(files: list[Path]) -> None:
    """All frames of a sequence must be of one size, or a truncated file could pass for one with a shorter header.

    Raises:
        FaceDiffError: naming the first file that is not as large as most are.
    """
    sizes = [path.stat().st_size for path in files]
    usual = max(set(sizes), key=lambda size: (sizes.count(size), size))
    for path, size in zip(files, sizes, strict=True):
        if size != usual:
            raise FaceDiffError(
                f"{path}: has {size} bytes, expected {usual} as in the sequence's other frames; it is truncated or "
                f"from another mesh, copy it anew"
            )


SUBJECTS = [*(f"F{i}" for i in range(1, 9)), *(f"M{i}" for i in range(1, 7))]
TRAINING_SUBJECTS = ["F2", "F3", "F4", "M3", "M4", "M5"]
SENTENCES = [f"e{i:02d}" for i in range(1, 41)]
"""The emotional half. The neutral one, 01 to 40, is left out by all published work on this corpus."""
FRAME_RATE = 25.0
MESH_FILE = "BIWI.ply"
REGION_FILES = ("lve.txt", "fdd.txt")

Normalisation = Literal["codetalker", "none"]
UNITS: dict[Normalisation, str] = {
    "codetalker": "normalised (the square root of a face's surface area is 1, about 185 mm)",
    "none": "mm",
}

SOUND_NAME = re.compile(r"([FM]\d)_(e\d\d)(_cut)?")
SOUND_SUFFIXES = (".wav", ".flac", ".flv", ".mp4", ".avi", ".mov", ".mkv", ".webm")
SOUND_DEPTH = 4

Array = npt.NDArray[np.float64]


def plan(
    raw: Path,
    *,
    normalise: Normalisation = "codetalker",
    dtype: Precision = "float32",
    subjects: Sequence[str] | None = None,
    regions: Path | None = None,
) -> Plan:
    """Scan a raw folder of BIWI.

    Args:
        raw: the folder, or the folder above the one that the archives unpacked to.
        normalise: ``codetalker``: turned, centred and scaled frame by frame, as published work has it; ``none``: as it
            is in the raw files, in mm
        dtype: of the motion on disk; ``float64`` is what CodeTalker writes and takes twice the space
        subjects: only these, e.g. F2,F3,M5; all that are there if not given
        regions: folder with lve.txt and fdd.txt; regions/ of the raw folder if not given

    Raises:
        FaceDiffError: if there is no usable sequence, a subject is unknown, or the templates do not fit together.
    """
    chosen = _chosen(subjects)
    missing: dict[str, str] = {}
    found_regions = find_regions(raw, regions)
    _miss_regions(found_regions, missing)
    sequences, neutral = _find_sequences(raw, chosen)
    meshes = _find_meshes(raw, chosen, {subject for subject, _ in sequences}, missing)
    sounds = _find_sounds(raw)
    notes: list[str] = []
    if neutral:
        notes.append(f"{neutral} neutral sequences (01 to 40 without an e) are left out, as in all published work")
    jobs = []
    for name, folder in _complete(raw, chosen, sequences, sounds, missing):
        mesh = meshes.get(name.partition("_")[0])
        if mesh is not None:
            work = partial(write_clip, name, folder, sounds[name], mesh, normalise, dtype)
            jobs.append(Job(name, work, _count(name, folder, notes)))
    if not jobs:
        reasons = "; ".join(f"{name}: {text}" for name, text in list(missing.items())[:3])
        raise FaceDiffError(f"{raw}: no sequence of BIWI can be prepared ({reasons})")
    templates = {subject: _template(path, normalise) for subject, path in meshes.items()}
    return Plan(
        corpus="biwi",
        frame_rate=FRAME_RATE,
        unit=UNITS[normalise],
        n_vertices=_n_vertices(meshes),
        options={"normalise": normalise, "dtype": dtype, "subjects": "all" if subjects is None else chosen},
        jobs=jobs,
        shared=partial(_write_shared, templates, meshes, found_regions),
        missing=missing,
        notes=notes,
    )


def write_clip(
    name: str, folder: Path, sound: Path, mesh: Path, normalise: Normalisation, dtype: Precision, out: Path
) -> int:
    """Write one sequence and return its number of frames.

    Args:
        name: the clip's name.
        folder: where its frames lie.
        sound: its sound, alone or in a video.
        mesh: the subject's personal template, for the faces.
        normalise: what is done to each frame.
        dtype: of the motion on disk.
        out: the corpus folder.

    Raises:
        FaceDiffError: if a frame or the sound cannot be used; the file is named.
    """
    from facediff.data.audio import read_speech

    template, faces = read_template(mesh)
    files = list(frame_files(folder).values())
    if not files:
        raise FaceDiffError(f"{folder}: holds no frame_XXX.vl; copy the sequence anew")
    check_sizes(files)
    vertices = np.empty((len(files), *template.shape), dtype)
    for target, file in zip(vertices, files, strict=True):
        frame = read_vl(file)
        if frame.shape != template.shape:
            raise FaceDiffError(f"{file}: has {len(frame)} vertices, expected {len(template)} as in {mesh}")
        if not np.isfinite(frame).all():
            raise FaceDiffError(
                f"{file}: holds NaN or infinity; copy it anew, or take the sequence out of {folder.parent}"
            )
        target[:] = _normalised(frame, faces, normalise, file)
    speech = read_speech(sound)
    write_motion(motion_file(out, name), vertices, dtype)
    write_speech(speech_file(out, name), speech)
    return len(vertices)


@lru_cache(maxsize=2 * len(SUBJECTS))
def read_template(path: Path) -> tuple[Array, npt.NDArray[np.int32]]:
    """Vertices (V, 3) in mm and faces (F, 3) of a personal template, vertices in the order of the file."""
    mesh = read_mesh(path)
    if not np.isfinite(mesh.vertices).all():
        raise FaceDiffError(f"{path}: holds NaN or infinity; copy it again")
    return mesh.vertices, mesh.faces


def _normalised(
    vertices: npt.NDArray[np.floating], faces: npt.NDArray[np.int32], how: Normalisation, file: Path
) -> npt.NDArray[np.floating]:
    if how == "none":
        return vertices
    try:
        return codetalker(vertices, faces)
    except ValueError as error:
        raise FaceDiffError(f"{file}: cannot be normalised ({error}); copy it anew") from error


def _template(path: Path, how: Normalisation) -> Array:
    template, faces = read_template(path)
    return np.asarray(_normalised(template, faces, how, path), np.float64)


def _chosen(subjects: Sequence[str] | None) -> list[str]:
    for subject in subjects or ():
        if subject not in SUBJECTS:
            raise FaceDiffError(f'--subjects: BIWI has no "{subject}": {choices(subject, SUBJECTS)}')
    return [subject for subject in SUBJECTS if subjects is None or subject in subjects]


def _find_sequences(raw: Path, chosen: Sequence[str]) -> tuple[dict[tuple[str, str], Path], int]:
    """Folder of every emotional sequence, by subject and sentence; and how many neutral ones there are."""
    found: dict[tuple[str, str], Path] = {}
    neutral = 0
    for base in bases(raw):
        for subject in chosen:
            folder = base / "faces" / subject
            for path in folders_in(folder) if folder.is_dir() else ():
                if path.name in SENTENCES and _numbers(path):
                    found.setdefault((subject, path.name), path)
                neutral += f"e{path.name}" in SENTENCES
    return found, neutral


def _numbers(folder: Path) -> list[int]:
    """Frame numbers of a sequence; what is wrong with them is for the clip itself to say."""
    try:
        return list(frame_files(folder))
    except FaceDiffError:
        return [1]


def _complete(
    raw: Path,
    chosen: Sequence[str],
    sequences: dict[tuple[str, str], Path],
    sounds: dict[str, Path],
    missing: dict[str, str],
) -> Iterator[tuple[str, Path]]:
    """Name and folder of every sequence that has a sound; the others go to ``missing``."""
    for subject in chosen:
        if not any(key[0] == subject for key in sequences):
            missing[subject] = f"expected frames in {raw / 'faces' / subject / 'e01'} … e40"
            continue
        for sentence in SENTENCES:
            name, folder = f"{subject}_{sentence}", sequences.get((subject, sentence))
            if folder is None:
                missing[name] = f"expected frames in {raw / 'faces' / subject / sentence}"
            elif name not in sounds:
                missing[name] = f"expected its sound, {raw / 'audio' / name}.wav or {raw / 'videos' / name}.flv"
            else:
                yield name, folder


def _count(name: str, folder: Path, notes: list[str]) -> int:
    """Frames of a sequence; gaps in their numbers are noted."""
    numbers = _numbers(folder)
    if lost := gaps(numbers):
        notes.append(
            f"{name}: frames {', '.join(lost)} are not in {folder}; it is written without them, so that speech and "
            f"motion part company there"
        )
    return len(numbers)


def _find_meshes(raw: Path, chosen: Sequence[str], needed: set[str], missing: dict[str, str]) -> dict[str, Path]:
    found = {}
    for subject in (subject for subject in chosen if subject in needed):
        name = f"{subject}.obj"
        path = next((path for base in bases(raw) if (path := base / "rigid_scans" / name).is_file()), None)
        if path is None:
            missing[f"template of {subject}"] = (
                f"expected {raw / 'rigid_scans' / name}; no clip of {subject} is written without it"
            )
        else:
            found[subject] = path
    return found


def _n_vertices(meshes: dict[str, Path]) -> int:
    counts = {subject: len(read_template(path)[0]) for subject, path in meshes.items()}
    first, *others = counts
    for subject in others:
        if counts[subject] != counts[first]:
            raise FaceDiffError(
                f"{meshes[subject]}: has {counts[subject]} vertices, but {meshes[first].name} has {counts[first]}; "
                f"expected the same mesh for all subjects"
            )
    return counts[first]


def _find_sounds(raw: Path) -> dict[str, Path]:
    """Sound of every clip. A recording cut to the motion comes first, then any other recording, then a video."""
    ranked: dict[str, tuple[tuple[int, int, str], Path]] = {}
    for folder, folders, files in os.walk(raw, followlinks=True):
        place = Path(folder)
        deep = len(place.relative_to(raw).parts) >= SOUND_DEPTH
        folders[:] = [] if deep else sorted(name for name in folders if name not in ("faces", "rigid_scans"))
        for file in files:
            path = place / file
            if path.suffix.lower() not in SOUND_SUFFIXES or file.startswith("."):
                continue
            match = SOUND_NAME.fullmatch(path.stem) or SOUND_NAME.fullmatch(f"{place.name}_{path.stem}")
            if match:
                rank = (SOUND_SUFFIXES.index(path.suffix.lower()), 0 if match[3] else 1, str(path))
                name = f"{match[1]}_{match[2]}"
                ranked[name] = min(ranked.get(name, (rank, path)), (rank, path))
    return {name: path for name, (_, path) in ranked.items()}


def _miss_regions(folder: Path | None, missing: dict[str, str]) -> None:
    there = {path.name for path in region_files(folder)}
    for name in REGION_FILES:
        if name not in there:
            missing[f"regions/{name}"] = (
                f"expected in a folder given by --regions; the CodeTalker repository has it as BIWI/regions/{name} and "
                f"it may not be shipped with facediff"
            )


def _write_shared(templates: dict[str, Array], meshes: dict[str, Path], regions: Path | None, out: Path) -> list[str]:
    try:
        import trimesh
    except ImportError as error:
        raise MissingExtraError("trimesh", "prepare", "writing a mesh") from error
    write_templates(out / "templates.pkl", templates)
    drawn = next((subject for subject in TRAINING_SUBJECTS if subject in templates), next(iter(templates)))
    mesh = trimesh.Trimesh(templates[drawn], read_template(meshes[drawn])[1], process=False)
    with atomic(out / MESH_FILE) as temporary:
        temporary.write_bytes(mesh.export(file_type="ply"))
    return ["templates.pkl", MESH_FILE, *copy_files(region_files(regions), out, "regions")]
