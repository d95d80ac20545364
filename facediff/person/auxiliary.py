"""The corpus that a person is to join: what its topology, coordinates and frame rate are."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facediff.data.corpus import MOTION_FOLDERS, read_manifest, read_templates
from facediff.errors import FaceDiffError
from facediff.person.meshes import MESHES, Faces, differing_faces, read_frame_mesh
from facediff.pickles import load_pickle
from facediff.topology import Similarity, face_size, robust_align

Array = npt.NDArray[np.float64]

RESIDUAL_LIMIT = 0.15
"""Largest residual of a face laid onto the corpus's mean face, as a share of its size (root mean squares).

Faces of different people differ by some hundredths; vertices in another order by about 1.
"""
SAME_UNIT = 1.2
"""A person's face and the corpus's mean face differ in size by less than this factor."""


@dataclass(frozen=True)
class Auxiliary:
    """A corpus, as far as a newcomer must fit it.

    Attributes:
        root: its folder.
        mean: (V, 3) mean of its templates.
        faces: (F, 3) triangles; None if it has no mesh file.
        frame_rate: motion frames a second.
        unit: unit of length, as its manifest says; None if it does not.
    """

    root: Path
    mean: Array
    faces: Faces | None
    frame_rate: float
    unit: str | None

    @property
    def n_vertices(self) -> int:
        """Vertices of its topology."""
        return len(self.mean)


def read_auxiliary(root: Path, *, name: str, frame_rate: float | None) -> Auxiliary:
    """Read what a person must fit.

    Args:
        root: the corpus folder.
        name: the person's name, which must be new to the corpus.
        frame_rate: the corpus's frame rate, needed where ``manifest.json`` does not tell it.

    Raises:
        FaceDiffError: if the folder is no corpus, knows the name already, or its frame rate is unknown or contradicted.
    """
    if not root.is_dir():
        raise FaceDiffError(f"--corpus {root}: no such folder; expected one with wav/, vertices_npy/ and templates.pkl")
    templates = _templates(root / "templates.pkl")
    stems = {path.stem for folder in MOTION_FOLDERS for path in (root / folder).glob("*.npy")}
    subjects = {*templates, *(stem.rpartition("_")[0] for stem in stems)}
    if name.casefold() in {subject.casefold() for subject in subjects}:
        raise FaceDiffError(
            f"--name {name}: {root} has a person of that name already; no clip of the new person may be in it"
        )
    manifest = read_manifest(root)
    unit = manifest.get("unit")
    mean = np.mean(list(templates.values()), axis=0)
    return Auxiliary(
        root,
        mean,
        _corpus_faces(root, len(mean)),
        _frame_rate(root, manifest.get("frame_rate"), frame_rate),
        unit if isinstance(unit, str) else None,
    )


def _frame_rate(root: Path, told: object, given: float | None) -> float:
    known = float(told) if isinstance(told, int | float) and math.isfinite(told) and told > 0 else None
    if known is None and given is None:
        raise FaceDiffError(f"{root}: has no manifest.json that tells its frame rate; add --corpus-frame-rate")
    if known is not None and given is not None and abs(known - given) > 1e-6:
        raise FaceDiffError(
            f"--corpus-frame-rate {given:g}: {root / 'manifest.json'} says {known:g}; leave the option away"
        )
    return known if known is not None else float(given or 0)


def _templates(path: Path) -> dict[str, Array]:
    loaded = load_pickle(path)
    first = next(iter(loaded.values()), None) if isinstance(loaded, dict) else None
    size = np.size(first) if isinstance(first, np.ndarray) else 0
    if not size or size % 3:
        raise FaceDiffError(f"{path}: expected a dict from subject to (V, 3) array, as every corpus has it")
    return {name: template.numpy().astype(np.float64) for name, template in read_templates(path, size // 3).items()}


def _corpus_faces(root: Path, n_vertices: int) -> Faces | None:
    """Faces of the first mesh in the folder or in ``templates/`` that has the right vertex count."""
    for folder in (root, root / "templates"):
        for path in sorted(folder.glob("*")):
            if path.suffix.lower() in MESHES and path.is_file():
                mesh = read_frame_mesh(path)
                if len(mesh.vertices) == n_vertices and mesh.faces is not None:
                    return mesh.faces
    return None


def check_faces(path: Path, faces: Faces | None, corpus: Auxiliary) -> bool:
    """Whether faces could be compared with the corpus's.

    Raises:
        FaceDiffError: if they could, and are others.
    """
    if faces is None or corpus.faces is None:
        return False
    differing = differing_faces(faces, corpus.faces)
    if differing:
        raise FaceDiffError(
            f"{path}: {differing} triangles are not those of the mesh in {corpus.root}, so the topology is another; if "
            f"only polygons were cut otherwise, give the motion as a .npy array, which has no faces"
        )
    return True


def lay_onto_corpus(path: Path, face: Array, corpus: Auxiliary) -> tuple[Similarity, float]:
    """The similarity from a face to the corpus's mean face, and what is left as a share of the face's size.

    Raises:
        FaceDiffError: naming ``path``, if so much is left that the vertices cannot be in the corpus's order.
    """
    map_ = robust_align(face, corpus.mean, scale=True)
    residual = relative_residual(map_.apply(face), corpus.mean)
    if not residual < RESIDUAL_LIMIT:
        raise FaceDiffError(
            f"{path}: its face does not lie on those of {corpus.root} (residual {residual:.2f} of its size, expected "
            f"less than {RESIDUAL_LIMIT}), so the order of its vertices or the topology is another, or it is mirrored"
        )
    return map_, residual


def relative_residual(face: Array, target: Array) -> float:
    """Root-mean-square distance of two faces (V, 3), as a share of the target's size."""
    return float(np.sqrt(np.square(face - target).sum(axis=-1).mean())) / face_size(target)


def into_coordinates(face: Array, best: Similarity, given: float | None) -> Similarity:
    """The one similarity that takes a person into the corpus's coordinates.

    Its scale changes the unit and leaves the person's size alone: where the measured scale is near a power of ten
    (millimetres, centimetres, metres), it is that power; else, as with a corpus of normalised size, it is as measured.

    Args:
        face: (V, 3) the person's neutral face.
        best: the similarity that lays it onto the corpus's mean face best; kept but for its scale, about the face's
            centre.
        given: the scale to use instead.
    """
    power = round(math.log10(best.scale))
    is_unit = abs(math.log10(best.scale) - power) < math.log10(SAME_UNIT)
    scale = given if given is not None else 10.0**power if is_unit else best.scale
    centre = face.mean(axis=0)
    return Similarity(best.rotation, best.apply(centre) - scale * best.rotation @ centre, scale)
