"""3DMEAD from its raw distribution: FLAME parameters to vertices, through the user's own FLAME model.

Source of the data: the videos of MEAD (Wang et al., ECCV 2020) as reconstructed for EMOTE (Daněček et al., SIGGRAPH
Asia 2023). The raw folder holds EMOTE's ``<speaker>/front/<emotion>/level_<k>/<number>/shape_pose_cam.hdf5``, with
MEAD's own sound in the same folders or elsewhere; or ProbTalk3D's ``param/<clip>.npy`` and ``wav/<clip>.wav``.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from typing import NoReturn

import numpy as np
import numpy.typing as npt

from facediff.data.preparation import (
    Job,
    PreparationPlan,
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
from facediff.data.reconstructions import read_parameters
from facediff.errors import FaceDiffError, MissingExtraError
from facediff.mesh.flame import SHAPES, Flame
from facediff.utils.checksums import sha256
from facediff.utils.pickles import load_pickle
from facediff.utils.plain_files import write_rows
from facediff.utils.progress import track

LEVELS = (1, 2, 3)
RECONSTRUCTION = "shape_pose_cam.hdf5"
# The first that is there is used, converted files before MEAD's own.
SOUND_SUFFIXES = (".wav", ".flac", ".m4a", ".mp4", ".aac", ".mp3", ".ogg")
DEPTH = 3  # levels of folders that are searched, as processed/reconstructions/EMICA-MEAD_flame2020 of inferno

SPEAKER = re.compile(r"[MW]\d{3}")
NUMBER = re.compile(r"\d{1,3}")
CLIP = re.compile(r"([MW]\d{3})_(\d{3})_([0-7])_([0-2])")

FRAME_RATE = 25.0
MESH_FILE = "FLAME.ply"
MASKS_FILE = "FLAME_masks.pkl"
REGION_FILES = ("lve.txt", "fdd.txt")
MISSING_REGION = (
    "expected in a folder given by --regions; the ProbTalk3D repository has it in datasets/regions; not needed in "
    "addition to FLAME_masks.pkl"
)
MISSING_MASKS = "expected in the raw folder or next to the FLAME model; from flame.is.tue.mpg.de (FLAME vertex masks)"

Array = npt.NDArray[np.float64]


def plan(
    raw: Path,
    *,
    flame: Path,
    audio: Path | None = None,
    subjects: Sequence[str] | None = None,
    regions: Path | None = None,
    quiet: bool = True,
) -> PreparationPlan:
    """Scan a raw folder of 3DMEAD. Every clip's parameters are read once, for the speakers' mean shapes.

    Vertices have the mean shape of their speaker, as the template, so that offsets from it are motion alone.

    Args:
        raw: EMOTE's or ProbTalk3D's folder, or a folder above it.
        flame: the user's own FLAME model file; FLAME 2020's, as the parameters are for that model.
        audio: folder with MEAD's sound; the raw folder if None.
        subjects: only these speakers; all that are there if None.
        regions: folder with ``lve.txt`` and ``fdd.txt``; ``regions/`` of the raw folder if None.
        quiet: no progress bar.
    """
    model = load_flame(flame)
    region_files = find_regions(raw, regions)
    distribution = find_recordings(raw)
    speakers = sorted({name[:4] for name in distribution.recordings})
    selected = choose_subjects(subjects, speakers, "the raw folder")
    recordings = {name: file for name, file in distribution.recordings.items() if name[:4] in selected}
    gaps = {name: text for name, text in distribution.without_parameters.items() if name[:4] in selected}
    sounds = find_sounds(raw if audio is None else audio)
    shapes, problems = _survey(recordings, quiet)
    jobs = []
    for name, file in recordings.items():
        if name not in sounds:
            gaps[name] = (
                f"expected its sound, {name}.wav or {name[:4]}/audio/…/{name[5:8]}.m4a, in {audio or raw}; --audio "
                f"names another folder"
            )
        elif name in problems:
            jobs.append(Job(name, partial(refuse, problems[name])))
        else:
            jobs.append(Job(name, partial(prepare_clip, name, file, sounds[name], flame, shapes[name[:4]])))
    refuse_empty(raw, "3DMEAD", jobs, gaps)
    masks = [path for path in (find_file(raw, MASKS_FILE), flame.parent / MASKS_FILE) if path and path.is_file()][:1]
    if not masks:
        names = {path.name for path in region_files}
        gaps |= {f"regions/{name}": MISSING_REGION for name in REGION_FILES if name not in names}
        gaps[MASKS_FILE] = MISSING_MASKS
    digest = f"a model with SHA-256 {sha256(flame)[:16]}"
    return PreparationPlan(
        corpus="mead3d",
        frame_rate=FRAME_RATE,
        unit="m",
        n_vertices=model.n_vertices,
        options={"shape": "subject", "dtype": "float32", "subjects": selected if subjects else "all", "flame": digest},
        jobs=jobs,
        shared=partial(_write_shared, flame, list(recordings), shapes, masks, region_files),
        missing=gaps,
        notes=_compare_speakers(speakers, distribution.base, gaps) if subjects is None else [],
    )


def prepare_clip(name: str, file: Path, sound: Path, model: Path, shape: Array, out: Path) -> int:
    """Write one clip with its speaker's shape, and return its number of frames."""
    from facediff.speech.audio import read_speech

    parameters = read_parameters(file)
    vertices = load_flame(model).vertices(shape, parameters.expression, parameters.jaw)
    return write_clip(out, name, vertices, read_speech(sound))


def refuse(problem: str, out: Path) -> NoReturn:
    """The job of a clip with unreadable parameters: it fails when the clips are written, like any other."""
    raise FaceDiffError(problem)


@lru_cache(maxsize=1)
def load_flame(path: Path) -> Flame:
    """The FLAME model, read once in each process."""
    return Flame.read(path)


def _survey(recordings: Mapping[str, Path], quiet: bool) -> tuple[dict[str, Array], dict[str, str]]:
    """Every speaker's mean shape over all frames, and why clips cannot be read."""
    problems: dict[str, str] = {}
    sums: dict[str, Array] = {}
    counts: Counter[str] = Counter()
    for name in track(recordings, "shapes", shown=not quiet):
        try:
            parameters = read_parameters(recordings[name])
        except MissingExtraError:
            raise
        except FaceDiffError as error:
            problems[name] = str(error)
            continue
        frames = len(parameters.jaw)
        total = sums.setdefault(name[:4], np.zeros(SHAPES))
        total[: len(parameters.shape)] += frames * parameters.shape
        counts[name[:4]] += frames
    return {subject: total / counts[subject] for subject, total in sums.items()}, problems


def _compare_speakers(speakers: list[str], base: Path, gaps: dict[str, str]) -> list[str]:
    """Record which speakers of the data set are missing; returns a note on speakers of no published split."""
    from facediff.data.mead3d import TEST, TRAIN, VALIDATION

    published = sorted((*TRAIN, *VALIDATION, *TEST))
    gaps.update({subject: f"no clip of this speaker in {base}" for subject in published if subject not in speakers})
    foreign = [subject for subject in speakers if subject not in published]
    return [f"{', '.join(foreign)}: in no published split; prepared all the same"] if foreign else []


def _write_shared(
    model: Path,
    names: Collection[str],
    shapes: dict[str, Array],
    masks: Sequence[Path],
    region_files: Sequence[Path],
    out: Path,
) -> list[str]:
    from facediff.data.mead3d import Mead3D

    flame = load_flame(model)
    templates = {subject: flame.shaped(shape) for subject, shape in shapes.items()}
    _refuse_other_templates(templates, out)
    write_templates(out / "templates.pkl", templates)
    write_mesh(out / MESH_FILE, flame.template, flame.faces)
    clips = [clip for name in names if (clip := Mead3D.parse_name(name)) is not None]
    rows = [
        {"clip": clip.name, "subject": clip.identity, "sentence": clip.sentence, **clip.attributes} for clip in clips
    ]
    write_rows(out / "clips.csv", rows, line_end="\n")
    written = ["templates.pkl", MESH_FILE, "clips.csv"]
    return [*written, *copy_files(masks, out), *copy_files(region_files, out, "regions")]


def _refuse_other_templates(templates: dict[str, Array], out: Path) -> None:
    """Refuse templates of another mean shape than the clips that are there: more raw clips change the mean."""
    if not (out / "templates.pkl").is_file():
        return
    before = load_pickle(out / "templates.pkl")
    for subject, template in templates.items():
        old = before.get(subject) if isinstance(before, dict) else None
        same = old is not None and np.shape(old) == template.shape and np.allclose(old, template, rtol=0, atol=1e-9)
        if not same and any(out.glob(f"vertices_npy/{subject}_*.npy")):
            raise FaceDiffError(
                f"{out}: clips of {subject} were written when the raw folder had other clips of {subject}, so their "
                f"mean shape has changed; remove vertices_npy/{subject}_* there, or choose another folder"
            )


# Finding clips and sound in the raw folders.


@dataclass
class RawDistribution:
    """The clips of a raw folder, those without parameters, and the folder above the speakers or ``param/``."""

    base: Path
    recordings: dict[str, Path] = field(default_factory=dict)
    without_parameters: dict[str, str] = field(default_factory=dict)


def find_recordings(raw: Path) -> RawDistribution:
    """Every clip of a raw folder, which holds EMOTE's distribution or ProbTalk3D's; the folder's layout says which."""
    bases = [
        folder
        for folder in _folders(raw)
        if _is_probtalk3d(folder) or any((speaker / "front").is_dir() for speaker in _speakers(folder))
    ]
    if len(bases) != 1:
        raise FaceDiffError(
            f"{raw}: holds {' and '.join(map(str, bases)) or 'no'} reconstructions of MEAD; expected one folder with "
            f"<speaker>/front/<emotion>/level_<k>/<number>/{RECONSTRUCTION} as EMOTE's authors distribute them, or "
            f"param/<speaker>_<number>_<emotion>_<intensity>.npy of ProbTalk3D"
        )
    distribution = RawDistribution(bases[0])
    if _is_probtalk3d(distribution.base):
        files = (path for path in distribution.base.glob("param/*.npy") if CLIP.fullmatch(path.stem) and path.is_file())
        distribution.recordings = {path.stem: path for path in files}
    else:
        for speaker in _speakers(distribution.base):
            for name, folder in _numbered(speaker / "front", speaker.name):
                file = folder / RECONSTRUCTION
                if file.is_file():
                    distribution.recordings[name] = file
                elif folder.is_dir():
                    distribution.without_parameters[name] = f"expected {file}"
    distribution.recordings = dict(sorted(distribution.recordings.items()))
    return distribution


def find_sounds(root: Path) -> dict[str, Path]:
    """Sound of every clip below a folder, by the clip's name.

    MEAD has it in ``<speaker>/audio/<emotion>/level_<k>/<number>.m4a``; converted files may lie in the same place, in
    ``<speaker>/<emotion>/level_<k>/``, or under the clip's name in one folder.
    """
    best: dict[str, tuple[int, Path]] = {}
    for folder in _folders(root):
        files = [(path.stem, path) for path in sorted(folder.iterdir()) if CLIP.fullmatch(path.stem)]
        for speaker in _speakers(folder):
            for inner in (speaker / "audio", speaker):
                files += _numbered(inner, speaker.name)
        for name, path in files:
            suffix = path.suffix.lower()
            if suffix in SOUND_SUFFIXES and path.is_file():
                best[name] = min(best.get(name, (len(SOUND_SUFFIXES), path)), (SOUND_SUFFIXES.index(suffix), path))
    return {name: path for name, (_, path) in best.items()}


def _folders(root: Path, depth: int = DEPTH) -> Iterator[Path]:
    """A folder and its folders, but neither speakers' folders nor hidden ones."""
    inner = folders_in(root)
    yield root
    for folder in inner if depth else ():
        if not SPEAKER.fullmatch(folder.name):
            yield from _folders(folder, depth - 1)


def _speakers(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if SPEAKER.fullmatch(path.name) and path.is_dir())


def _is_probtalk3d(folder: Path) -> bool:
    return any(CLIP.fullmatch(path.stem) for path in folder.glob("param/*.npy"))


def _numbered(folder: Path, speaker: str) -> Iterator[tuple[str, Path]]:
    """The clip's name and path of everything with a number for a name in ``<emotion>/level_<k>/`` below a folder."""
    from facediff.data.mead3d import EMOTIONS

    for index, emotion in enumerate(EMOTIONS):
        for level in LEVELS:
            inner = folder / emotion / f"level_{level}"
            for path in sorted(inner.iterdir()) if inner.is_dir() else ():
                if NUMBER.fullmatch(path.stem):
                    yield f"{speaker}_{int(path.stem):03d}_{index}_{level - 1}", path
