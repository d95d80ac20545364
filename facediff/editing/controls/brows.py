"""Brows of a face and their rise: known for the built-in puppet, carried over or given for any other face."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from facediff.animation import Animation
from facediff.animation.animation import metres_per_unit
from facediff.editing.controls.expressiveness import ALL, region_factors
from facediff.editing.controls.eyelids import Eyes
from facediff.editing.controls.procedural import copied
from facediff.errors import OptionError
from facediff.utils.numerics import Array, Floats, Integers

REGION = "brows"
"""Name of the region with the vertices of the brows."""


@dataclass(frozen=True, eq=False)
class Brows:
    """Displacements of a face by its raised and by its lowered brows, of which the largest is one millimetre."""

    up: npt.NDArray[np.float32]  # (V, 3) in the face's unit
    down: npt.NDArray[np.float32]  # (V, 3)


def brows_of(
    template: Floats, faces: Integers | None, regions: Mapping[str, Integers], unit: str, eyes: Eyes | None = None
) -> Brows:
    """The brows of a face (V, 3).

    ``eyes`` or a region "brows" lists their vertices; without either, the brows of the built-in face are carried over.
    """
    vertices = eyes.brows if eyes is not None and eyes.brows is not None else regions.get(REGION)
    if vertices is not None and len(vertices):
        weights = region_factors(template, {REGION: vertices}, {REGION: 1.0, ALL: 0.0})
        up = weights[:, None] * np.array([0.0, 1.0, 0.0])
        return Brows(_one_millimetre(up, unit), _one_millimetre(-up, unit))
    from facediff.synthetic.known_faces import built_in_shapes, known_face

    face = known_face(template, faces)
    if face is None:
        neutral, triangles, _ = built_in_shapes("F1")
        lender = known_face(neutral, triangles)
        assert lender is not None  # noqa: S101 - for type checkers
        fields = carried("brows", neutral, triangles, np.stack([lender.brows_up, lender.brows_down]), template, faces)
    else:
        fields = np.stack([face.brows_up, face.brows_down])
    return Brows(*(_one_millimetre(field, unit) for field in fields))


def carried(
    name: str, neutral: Array, triangles: Integers, fields: Array, template: Floats, faces: Integers | None
) -> Array:
    """Displacements (K, V, 3) of a built-in face on another one, in its unit; refused if no face is found in it."""
    from facediff.editing.correspondence import correspond
    from facediff.editing.face_features import find_features
    from facediff.editing.retargeting import transfer_displacements

    if faces is not None and len(faces):
        correspondence = correspond(neutral, triangles, template, faces)
        laid = correspondence.similarity.inverse().apply(correspondence.target_vertices)
        features = find_features(
            laid,
            correspondence.target_faces,
            find_features(correspondence.source_vertices, correspondence.source_faces),
        )
        if features is not None and not correspondence.fits_badly:
            moved = transfer_displacements(correspondence, fields)
            if moved.any():
                return moved
    raise OptionError.naming(
        f"{name}: no face is found in this mesh, so that the built-in face's cannot be carried to it; give a mesh with "
        f"triangles and an open line between the lips, list brows in the file of {{eyes}}, or omit the keys"
    )


def _one_millimetre(field: npt.ArrayLike, unit: str) -> npt.NDArray[np.float32]:
    """Displacements (V, 3) scaled so that the largest is one millimetre."""
    displacements = np.asarray(field, np.float64)
    largest = float(np.linalg.norm(displacements, axis=-1).max(initial=0.0))
    return np.asarray(displacements * (0.001 / metres_per_unit(unit) / largest), np.float32)


def raise_brows(animation: Animation, brows: Brows, curve: Floats) -> npt.NDArray[np.float32]:
    """Vertices (T, V, 3) with brows raised by millimetres (T,), or lowered where these are negative."""
    vertices = copied(animation.vertices)
    for index in np.flatnonzero(curve):
        vertices[index] += np.float32(abs(curve[index])) * (brows.up if curve[index] > 0 else brows.down)
    return vertices
