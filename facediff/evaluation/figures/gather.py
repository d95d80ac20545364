"""Finds the templates, mesh, frame rate, sound and phonemes of figures."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.data import SpeechMotionDataModule
from facediff.data.check.layouts import by_name, instance, list_folder, recognise
from facediff.data.corpus import read_manifest, read_templates
from facediff.data.puppet import cache_root, made_root
from facediff.errors import FaceDiffError
from facediff.evaluation.figures.material import FigureData, find_clips
from facediff.evaluation.file_pairs import DEFAULT_PATTERNS, OWN, TRUTH_PATTERN, count_vertices, find_truths
from facediff.mesh.mesh import Mesh
from facediff.mesh.mesh_files import SUFFIXES, read_mesh
from facediff.speech.audio import read_speech
from facediff.speech.phonemes import TimedPhoneme, phonemes_file, read_phonemes
from facediff.utils import ranges
from facediff.utils.paths import find_file


@ranges.checked
def gather(
    methods: Mapping[str, Path],
    truth: Path,
    *,
    patterns: Sequence[str] = DEFAULT_PATTERNS,
    truth_pattern: str = TRUTH_PATTERN,
    identity: str = OWN,
    topology: str | None = None,
    templates: Path | None = None,
    mesh: Path | None = None,
    frame_rate: ranges.FrameRate | None = None,
    truth_stride: ranges.Stride | None = None,
    unit: str | None = None,
) -> FigureData:
    """Find truth, methods and their mesh; where an option is None, the corpus says it.

    ``truth`` is a corpus folder, any folder of .npy files, or ``puppet``, the built-in corpus in the user's cache
    folder, of which every ``truth_stride``-th frame is used; ``identity`` is the style of the predictions.
    """
    if truth == Path("puppet") and not truth.is_dir():
        built_in = made_root()
        if built_in is None:
            raise FaceDiffError(f"{cache_root()}: the built-in corpus does not exist yet; `facediff demo` makes it")
        truth = built_in
    folder, corpus = find_truths(truth)
    manifest = read_manifest(corpus) if corpus else {}
    module = _recognise(topology, corpus or folder, manifest)
    if templates is None and corpus is not None and (corpus / "templates.pkl").is_file():
        templates = corpus / "templates.pkl"
    n_vertices = module.n_vertices if module else count_vertices(None, templates, folder)
    faces = {} if templates is None else read_templates(templates, n_vertices)
    found_mesh = _find_mesh(mesh, corpus or folder, module, n_vertices)
    rate, stride = _rates(frame_rate, truth_stride, manifest, module)
    truths, predictions = find_clips(
        methods, folder, subjects=list(faces), patterns=patterns, truth_pattern=truth_pattern, identity=identity
    )
    return FigureData(
        truths,
        predictions,
        n_vertices,
        rate,
        stride,
        unit or str(manifest.get("unit") or getattr(module, "unit", "")),
        faces,
        None if found_mesh is None else found_mesh.faces,
        None if found_mesh is None else found_mesh.vertices,
        None if found_mesh is None else found_mesh.colours,
        corpus,
        f"{module.corpus_name}: synthetic corpus" if module and module.synthetic else "",
    )


def sound_of(material: FigureData, clip: str, file: Path | None = None) -> npt.NDArray[np.float32] | None:
    """Speech (S,) of a clip at 16 kHz: from the file given, else the corpus's; None if there is none."""
    if file is None and material.corpus is not None:
        file = find_file(material.corpus / "wav" / f"{material.truths[clip].path.stem}.wav")
        file = file if file.is_file() else None
    return None if file is None else read_speech(file)


def phonemes_of(material: FigureData, clip: str, file: Path | None = None) -> list[TimedPhoneme]:
    """Phonemes of a clip: from the table given, else the corpus's; none if there is no table."""
    path = file or phonemes_file(material.corpus, material.truths[clip].path.stem)
    return read_phonemes(path) if path else []


def _recognise(name: str | None, root: Path, manifest: dict[str, Any]) -> SpeechMotionDataModule | None:
    """The data module of this topology; None if it is not recognised. The folder decides between several."""
    folder = list_folder(root)
    if name is not None:
        if "." in name:
            sys.path.append(os.getcwd())  # a data module of the user's own may be in the working folder
        return instance(by_name(name, folder.n_vertices), root, None)
    if not folder.motions or isinstance(manifest.get("person"), str):
        return None
    kind = recognise(folder, manifest.get("corpus"))
    module = None if kind is None else instance(kind, root, None)
    return module if module is not None and module.n_vertices == folder.n_vertices else None


def _find_mesh(path: Path | None, root: Path, module: SpeechMotionDataModule | None, n_vertices: int) -> Mesh | None:
    """The mesh given, else the one in the corpus folder; None without one."""
    if path is not None:
        mesh = read_mesh(path)
        if len(mesh.vertices) != n_vertices:
            raise FaceDiffError(f"{path}: has {len(mesh.vertices)} vertices, the motion {n_vertices}; give its mesh")
        return mesh
    folders = [root, root / "templates"]
    files = [folder / file for file in (module.mesh_files if module else ()) for folder in folders]
    files += [file for folder in folders for file in sorted(folder.glob("*")) if file.suffix.lower() in SUFFIXES]
    for file in files:
        if file.is_file() and len((mesh := read_mesh(file)).vertices) == n_vertices:
            return mesh
    return None


def _rates(
    frame_rate: float | None, truth_stride: int | None, manifest: dict[str, Any], module: SpeechMotionDataModule | None
) -> tuple[float | None, int]:
    """Frames a second of the predictions, and the step between the frames of the truth that belong to them."""
    stated = manifest.get("frame_rate") or (module and (module.stored_frame_rate or module.frame_rate))
    stored = float(stated) if isinstance(stated, int | float) else None
    rate = frame_rate if frame_rate is not None else module.frame_rate if module else stored
    if truth_stride is not None:
        return rate, truth_stride
    if rate is None or stored is None:
        return rate, 1
    stride = round(stored / rate)
    if stride < 1 or abs(stride * rate - stored) > 1e-6:
        raise FaceDiffError(
            f"the truth has {stored:g} frames a second, no whole multiple of the predictions' {rate:g}; give "
            f"--frame-rate and --truth-stride"
        )
    return rate, stride
