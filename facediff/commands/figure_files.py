"""What lies beside the files that ``facediff figure`` draws: templates, mesh, frame rate, sound."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facediff.errors import FaceDiffError

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from facediff.data import SpeechMotionDataModule
    from facediff.figures import Material
    from facediff.topology.mesh import Mesh

    Module = type[SpeechMotionDataModule]

PUPPET = Path("puppet")
"""Stands for the built-in corpus where it lies in the user's cache folder."""


def named_folders(words: Sequence[str], name_of: Callable[[Path], str]) -> dict[str, Path]:
    """Folders by name, from words NAME=FOLDER or FOLDER.

    Args:
        words: what the user gave.
        name_of: names a folder that was given without a name.

    Raises:
        FaceDiffError: if a word is neither, or two folders have one name.
    """
    found: dict[str, Path] = {}
    for word in words:
        name, equals, folder = word.partition("=")
        if not equals or Path(word).exists():
            name, folder = name_of(Path(word)), word
        if not name or not folder:
            raise FaceDiffError(f"{word}: expected NAME=FOLDER")
        if name in found:
            raise FaceDiffError(f'{word}: there is already one called "{name}"; name it with NAME=FOLDER')
        found[name] = Path(folder)
    return found


def gather(args: argparse.Namespace) -> Material:
    """Find truth, methods and what is known about their mesh.

    Raises:
        FaceDiffError: if a folder or a file is missing, damaged, or does not fit the others.
    """
    from facediff.data.corpus import read_manifest, read_templates
    from facediff.evaluate import DEFAULT_PATTERNS, TRUTH_PATTERN
    from facediff.evaluate.inputs import find_truths
    from facediff.figures import Material, find_clips

    methods = named_folders([args.predictions, *args.method], lambda path: path.resolve().name)
    truth, corpus = find_truths(_truth_folder(args.truth))
    if not truth.is_dir():
        raise FaceDiffError(f"{args.truth}: no such folder; expected a corpus, a folder of .npy files, or puppet")
    manifest = read_manifest(corpus) if corpus else {}
    module = _recognise(args.topology, corpus or truth, manifest)
    templates_file = args.templates or (corpus / "templates.pkl" if corpus else None)
    if templates_file is not None and args.templates is None and not templates_file.is_file():
        templates_file = None
    n_vertices = module.n_vertices if module else _count_vertices(templates_file, truth)
    templates = {} if templates_file is None else read_templates(templates_file, n_vertices)
    mesh = _find_mesh(args.mesh, corpus or truth, module, n_vertices)
    rate, stride = _rates(args, manifest, module)
    truths, found = find_clips(
        methods,
        truth,
        subjects=list(templates),
        patterns=args.pattern or DEFAULT_PATTERNS,
        truth_pattern=args.truth_pattern or TRUTH_PATTERN,
        identity=args.identity,
    )
    return Material(
        truths,
        found,
        n_vertices,
        rate,
        stride,
        args.unit or str(manifest.get("unit") or getattr(module, "unit", "")),
        templates,
        None if mesh is None else mesh.faces,
        None if mesh is None else mesh.vertices,
        None if mesh is None else mesh.colours,
        corpus,
        f"{module.corpus_name}: synthetic corpus" if module and module.synthetic else "",
    )


def read_sound(given: Path | None, material: Material, clip: str) -> npt.NDArray[np.float32] | None:
    """Speech (S,) of a clip at 16 kHz: the file given, else the corpus's; None if there is none.

    Raises:
        FaceDiffError: if the file given is missing or unreadable.
    """
    from facediff.data.audio import read_speech

    path = given
    if path is None and material.corpus is not None:
        path = material.corpus / "wav" / f"{material.truths[clip].path.stem}.wav"
        path = path if path.is_file() else None
    return None if path is None else read_speech(path)


def _truth_folder(truth: Path) -> Path:
    if truth != PUPPET or truth.is_dir():
        return truth
    from facediff.data.puppet import cache_root

    root = cache_root(0)
    if not root.is_dir():
        raise FaceDiffError(f"{root}: the built-in corpus is not there yet; `facediff demo` makes it")
    return root


def _recognise(name: str | None, root: Path, manifest: dict[str, Any]) -> Module | None:
    """The data module whose topology this is; None if that cannot be told."""
    import os
    import sys

    import facediff.data  # noqa: F401 - the data modules are known once they are imported
    from facediff.data.corpus import MOTION_FOLDERS
    from facediff.doctor.corpora import by_name, recognise
    from facediff.doctor.folder import list_folder

    folder = list_folder(root, MOTION_FOLDERS)
    if name is not None:
        if "." in name:
            sys.path.append(os.getcwd())  # a data module of one's own may lie in the working folder
        return by_name(name, folder.n_vertices())
    if not folder.motions or isinstance(manifest.get("person"), str):
        return None
    module = recognise(folder, manifest.get("corpus"), folder.n_vertices())
    return module if module is not None and module.n_vertices == folder.n_vertices() else None


def _count_vertices(templates_file: Path | None, truth: Path) -> int:
    """Vertices of the mesh where no data module tells: as the templates have it, else the first readable truth."""
    from facediff.evaluate.inputs import count_vertices

    if templates_file is None and not any(truth.glob("**/*.npy")):
        raise FaceDiffError(f"{truth}: holds no .npy file; expected files of vertices (frames, 3V) or (frames, V, 3)")
    return count_vertices(None, templates_file, truth)


def _find_mesh(given: Path | None, root: Path, module: Module | None, n_vertices: int) -> Mesh | None:
    """The mesh given, else the one that lies in the corpus folder, else the built-in corpus's own; None without one."""
    from facediff.topology.mesh import SUFFIXES, read_mesh

    if given is not None:
        mesh = read_mesh(given)
        if len(mesh.vertices) != n_vertices:
            raise FaceDiffError(f"{given}: has {len(mesh.vertices)} vertices, the motion {n_vertices}; give its mesh")
        return mesh
    places = [root, root / "templates"]
    files = [place / file for file in (module.mesh_files if module else ()) for place in places]
    files += [file for place in places for file in sorted(place.glob("*")) if file.suffix.lower() in SUFFIXES]
    for file in files:
        if file.is_file() and len((mesh := read_mesh(file)).vertices) == n_vertices:
            return mesh
    if module is not None and module.corpus_name == "puppet":
        from facediff.puppet.face import build_face
        from facediff.topology.mesh import Mesh

        face = build_face()
        return Mesh(face.vertices, face.faces.astype("int32"), face.colours)
    return None


def _rates(args: argparse.Namespace, manifest: dict[str, Any], module: Module | None) -> tuple[float | None, int]:
    """Frames a second of the predictions, and every how many-th frame of the truth belongs to them."""
    said = manifest.get("frame_rate") or (module and (module.stored_frame_rate or module.frame_rate))
    stored = float(said) if isinstance(said, int | float) else None
    rate = args.frame_rate if args.frame_rate is not None else module.frame_rate if module else stored
    if rate is not None and not 0 < rate < 10_000:
        raise FaceDiffError(f"--frame-rate {rate:g}: expected frames a second, e.g. 25")
    if args.truth_stride is not None:
        if args.truth_stride < 1:
            raise FaceDiffError(f"--truth-stride {args.truth_stride}: expected a number from 1")
        return rate, args.truth_stride
    if rate is None or stored is None:
        return rate, 1
    stride = round(stored / rate)
    if stride < 1 or abs(stride * rate - stored) > 1e-6:
        raise FaceDiffError(
            f"the truth has {stored:g} frames a second, no whole multiple of the predictions' {rate:g}; say what is "
            f"so with --frame-rate and --truth-stride"
        )
    return rate, stride
