"""Correspondences and landmarks on disk."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError
from facediff.files import atomic
from facediff.retarget.correspondence import Correspondence
from facediff.takes.archive import read_entries
from facediff.topology import Similarity

FORMAT = "facediff correspondence 1"
ARRAYS = {
    "corners": ("i", 2),
    "weights": ("f", 2),
    "distances": ("f", 1),
    "trust": ("f", 1),
    "share": ("f", 1),
    "source_vertices": ("f", 2),
    "source_faces": ("i", 2),
    "target_vertices": ("f", 2),
    "target_faces": ("i", 2),
}
SIMILARITY = {"rotation": ("f", 2), "translation": ("f", 1), "scale": ("f", 0)}


def save_correspondence(path: Path, correspondence: Correspondence) -> None:
    """Write a correspondence as .npz, which ``numpy.load`` opens without pickle.

    Raises:
        FaceDiffError: if the suffix is another one or the file cannot be written.
    """
    if path.suffix != ".npz":
        raise FaceDiffError(f'{path}: unknown suffix "{path.suffix}"; expected a correspondence .npz')
    similarity = correspondence.similarity
    with atomic(path) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(
            stream,
            allow_pickle=False,
            format=np.array(FORMAT),
            rotation=similarity.rotation,
            translation=similarity.translation,
            scale=np.array(similarity.scale),
            **{name: getattr(correspondence, name) for name in ARRAYS},
        )


def load_correspondence(path: Path) -> Correspondence:
    """Read what :func:`save_correspondence` wrote.

    Raises:
        FaceDiffError: if the file is missing, broken or something else.
    """
    if not path.is_file():
        raise FaceDiffError(f"{path}: no such file; expected a correspondence that `facediff retarget` wrote")
    held = read_entries(path)
    if "format" not in held or str(held["format"]) != FORMAT:
        raise FaceDiffError(f"{path}: is no correspondence; expected one that `facediff retarget` wrote")
    for name, (kind, axes) in {**ARRAYS, **SIMILARITY}.items():
        if name not in held:
            raise FaceDiffError(f"{path}: has no {name}; make it anew")
        if held[name].dtype.kind != kind or held[name].ndim != axes or not np.isfinite(held[name]).all():
            raise FaceDiffError(f"{path}: its {name} are damaged; make it anew")
    made = Correspondence(
        **{name: held[name] for name in ARRAYS},
        similarity=Similarity(held["rotation"], held["translation"], float(held["scale"])),
    )
    if not _consistent(made):
        raise FaceDiffError(f"{path}: its parts do not fit one another; make it anew")
    return made


def read_landmarks(path: Path) -> npt.NDArray[np.int64]:
    """Pairs (L, 2) of a source and a target vertex from a CSV of two columns, with or without a header.

    Raises:
        FaceDiffError: if the file is missing, or a line holds no two numbers.
    """
    try:
        lines = list(csv.reader(path.read_text(encoding="utf-8-sig").splitlines()))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise FaceDiffError(f"{path}: cannot be read ({error}); expected a CSV of vertex pairs") from error
    pairs = []
    for number, line in enumerate(lines, 1):
        words = [word.strip() for word in line if word.strip()]
        if not words or (number == 1 and not words[0].isdigit()):
            continue
        if len(words) != 2 or not all(word.isdigit() for word in words):
            raise FaceDiffError(
                f"{path}: line {number} is {','.join(line)}; expected two vertices, source and target, counted from 0"
            )
        pairs.append([int(word) for word in words])
    if not pairs:
        raise FaceDiffError(f"{path}: holds no pairs; expected lines `source vertex,target vertex`")
    return np.array(pairs, np.int64)


def _consistent(made: Correspondence) -> bool:
    sources, targets = len(made.source_vertices), len(made.target_vertices)
    return (
        made.corners.shape == made.weights.shape == (targets, 3)
        and made.distances.shape == made.trust.shape == made.share.shape == (targets,)
        and made.similarity.rotation.shape == (3, 3)
        and made.similarity.translation.shape == (3,)
        and made.similarity.scale > 0
        and made.source_vertices.shape == (sources, 3)
        and made.target_vertices.shape == (targets, 3)
        and all(
            faces.shape[1] == 3 and faces.size > 0 and faces.min() >= 0 and faces.max() < count
            for faces, count in ((made.source_faces, sources), (made.corners, sources), (made.target_faces, targets))
        )
    )
