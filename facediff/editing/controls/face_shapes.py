"""ARKit's shapes of a face, for keys over time: the built-in puppet's own, carried over to any other face."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from facediff.animation.animation import metres_per_unit
from facediff.utils.numerics import Floats, Integers

Fields = Mapping[str, npt.NDArray[np.float32]]


def own_shapes(template: Floats, faces: Integers | None) -> Fields | None:
    """Displacements (V, 3) by ARKit's names of a built-in face in metres; None for any other face."""
    from facediff.synthetic.known_faces import built_in_rig, known_face

    puppet = known_face(template, faces)
    if puppet is None:
        return None
    rig = built_in_rig(puppet.speaker)
    return dict(zip(rig.names, rig.deltas.astype(np.float32), strict=True))


def shapes_of(template: Floats, faces: Integers | None, unit: str, names: Sequence[str]) -> Fields:
    """Displacements (V, 3) of a face (V, 3), in its unit, for names of ARKit's shapes."""
    fields = own_shapes(template, faces)
    if fields is not None:
        return {name: fields[name] / np.float32(metres_per_unit(unit)) for name in names}
    from facediff.editing.controls.brows import carried
    from facediff.synthetic.known_faces import built_in_rig

    rig = built_in_rig("F1")
    assert rig.faces is not None  # noqa: S101 - for type checkers
    deltas = np.stack([rig.deltas[rig.names.index(name)] for name in names])
    moved = carried("shape", rig.neutral, rig.faces, deltas, template, faces)
    return dict(zip(names, np.asarray(moved, np.float32), strict=True))


def add_shapes(
    vertices: npt.NDArray[np.float32], fields: Fields, weights: Mapping[str, Floats]
) -> npt.NDArray[np.float32]:
    """Vertices (T, V, 3) with each shape's displacements times its weight (T,) added."""
    for name, field in fields.items():
        for index in np.flatnonzero(weights[name]):
            vertices[index] += np.float32(weights[name][index]) * field
    return vertices
