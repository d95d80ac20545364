"""Where lids and eyeballs are: known for the built-in puppet, from the user's file for any other topology."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facediff.errors import FaceDiffError

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from facediff.editing.procedural import Eyes

    Vertices = npt.NDArray[np.floating]
    Indices = npt.NDArray[np.int64]


KEYS = ("neutral", "blinks", "lids", "eyeballs")
PLAUSIBLE = (0.002, 0.2)
"""The largest way of a lid, as a share of the face's size (the diagonal of its box)."""
SAME_FACE = 1e-3
"""Metres that a face may differ from a puppet's to be taken for that puppet's."""


def eyes_for(template: Vertices, faces: npt.NDArray[np.integer] | None, file: Path | None) -> Eyes | None:
    """The eyes of a face: from the file if there is one, else the puppet's if it is a puppet, else None.

    Raises:
        FaceDiffError: if the file is not what it should be, or belongs to another topology.
    """
    return read_eyes(file, template) if file is not None else puppet_eyes(template, faces)


def puppet_eyes(template: Vertices, faces: npt.NDArray[np.integer] | None) -> Eyes | None:
    """The eyes of a face (V, 3) of the built-in corpus, by the rig that its blinks are made with; None for others."""
    import numpy as np

    from facediff.editing.procedural import Eyes
    from facediff.synthetic import N_VERTICES
    from facediff.synthetic.corpus import rig_of
    from facediff.synthetic.face import build_face
    from facediff.synthetic.rig import LINEAR_FIELDS
    from facediff.synthetic.speakers import SPEAKERS

    if len(template) != N_VERTICES or faces is None:
        return None
    mesh = build_face()  # takes a second or two
    if not np.array_equal(np.asarray(faces), mesh.faces):
        return None
    distances = {
        name: float(np.abs(speaker.shape(mesh.vertices) - template).max()) for name, speaker in SPEAKERS.items()
    }
    nearest = min(distances, key=lambda name: distances[name])
    left = np.concatenate([mesh.groups[name] for name in mesh.groups if name.startswith("eyeball") or name == "pupil"])
    balls = (np.sort(left), np.sort(mesh.mirror[left]))
    closing = rig_of(nearest).fields[LINEAR_FIELDS.index("lids_close")]
    if distances[nearest] > SAME_FACE:  # somebody's face on the puppet's mesh: its own lids' edges say how they shut
        closing = _shut_by_edges(template, balls)
    return Eyes(closing.astype(np.float32), balls, "the built-in puppet")


def _shut_by_edges(template: Vertices, balls: tuple[Indices, Indices]) -> Vertices:
    """The closing of lids on the puppet's mesh, for a face that no rig was made for."""
    import numpy as np

    from facediff.editing.procedural import closing_of_lids
    from facediff.synthetic.face import build_face

    mesh = build_face()
    ring = mesh.groups["eye_0"]  # from the inner corner over the upper lid to the outer one, and back below
    upper, lower = ring[:9], np.concatenate([ring[:1], ring[:7:-1]])
    return closing_of_lids(template, [(upper, lower), (mesh.mirror[upper], mesh.mirror[lower])], np.concatenate(balls))


def read_eyes(path: Path, template: Vertices) -> Eyes:
    """The eyes of a face (V, 3) from a file.

    ``.json`` names shapes of shut eyes or lists the lids' edges, and lists the eyeballs::

        {"neutral": "neutral.obj", "blinks": ["eyeBlinkLeft.obj", "eyeBlinkRight.obj"],
         "eyeballs": ["FLAME_masks.pkl:left_eyeball", "FLAME_masks.pkl:right_eyeball"]}

    ``.npz`` holds the same as arrays: ``closing`` (V, 3), ``neutral`` (V, 3) and any ``eyeball…`` with indices.

    Raises:
        FaceDiffError: naming the file and what is wrong with it.
    """
    import numpy as np

    from facediff.editing.procedural import Eyes

    if not path.is_file():
        raise FaceDiffError(
            f"--eyes {path}: no such file; expected .json or .npz that says where lids and eyeballs are"
        )
    if path.suffix.lower() == ".npz":
        found = _read_npz(path)
        balls = tuple(
            _checked(path, found[name], len(template)) for name in sorted(found) if name.startswith("eyeball")
        )
        closing, neutral = found.get("closing"), found.get("neutral")
    elif path.suffix.lower() == ".json":
        told = _read_json(path)
        balls = tuple(_indices(path, listed, len(template)) for listed in told.get("eyeballs", []))
        neutral = _read_shape(path, told["neutral"]) if "neutral" in told else None
        closing = _closing(path, told, template, neutral, balls)
    else:
        raise FaceDiffError(f"--eyes {path}: expected .json or .npz")
    if closing is not None:
        closing = _fitted(path, np.asarray(closing), template, neutral)
    if closing is None and not balls:
        raise FaceDiffError(f"--eyes {path}: says nothing of lids or eyeballs; known are {', '.join(KEYS)}")
    return Eyes(closing, balls, f"--eyes {path}")


def _read_npz(path: Path) -> dict[str, npt.NDArray[Any]]:
    import numpy as np

    try:
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, KeyError) as error:
        raise FaceDiffError(f"--eyes {path}: not a readable .npz file ({error})") from error


def _read_json(path: Path) -> Mapping[str, Any]:
    try:
        told = json.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError) as error:
        raise FaceDiffError(f"--eyes {path}: not a readable JSON file ({error})") from error
    fit = isinstance(told, dict) and all(isinstance(told.get(key, []), list) for key in KEYS[1:])
    unknown = [key for key in told if key not in KEYS] if fit else []
    if not fit or unknown or not isinstance(told.get("neutral", ""), str):
        raise FaceDiffError(
            f"--eyes {path}: expected an object with {', '.join(KEYS)}, the last three of them lists"
            + (f', not "{unknown[0]}"' if unknown else "")
        )
    return told


def _closing(
    path: Path,
    told: Mapping[str, Any],
    template: Vertices,
    neutral: Vertices | None,
    balls: tuple[Indices, ...],
) -> Vertices | None:
    """How the lids shut, by shapes or by edges; None if the file does not say."""
    import numpy as np

    from facediff.editing.procedural import closing_of_lids

    if told.get("blinks"):
        total: Vertices = np.zeros((len(template), 3))
        for name in told["blinks"]:
            shape = _read_shape(path, name)
            absolute = Path(str(name)).suffix.lower() != ".npy"
            if absolute and neutral is None:
                raise FaceDiffError(f'--eyes {path}: "{name}" is a whole face; give the open one as "neutral" as well')
            if len(shape) != len(template) or (neutral is not None and len(neutral) != len(template)):
                raise FaceDiffError(f'--eyes {path}: "{name}" has {len(shape)} vertices, the face {len(template)}')
            total = total + (shape - neutral if absolute and neutral is not None else shape)
        return total
    if told.get("lids"):
        try:
            edges = [
                tuple(_indices(path, lid[side], len(template)) for side in ("upper", "lower")) for lid in told["lids"]
            ]
        except (TypeError, KeyError) as error:
            raise FaceDiffError(f'--eyes {path}: expected "lids" as a list of {{"upper": …, "lower": …}}') from error
        rigid = np.concatenate(balls) if balls else None
        return closing_of_lids(template, [(upper, lower) for upper, lower in edges], rigid)
    return None


def _fitted(path: Path, closing: Vertices, template: Vertices, neutral: Vertices | None) -> npt.NDArray[np.float32]:
    """The closing in the face's unit."""
    import numpy as np

    size = float(np.linalg.norm(np.ptp(template, axis=0)))
    if closing.shape != template.shape or (neutral is not None and neutral.shape != template.shape):
        raise FaceDiffError(f"--eyes {path}: its blink has shape {closing.shape}; the face has {template.shape}")
    scale = 1.0 if neutral is None else size / max(float(np.linalg.norm(np.ptp(neutral, axis=0))), 1e-12)
    way = scale * float(np.linalg.norm(closing, axis=-1).max())
    if not PLAUSIBLE[0] * size < way < PLAUSIBLE[1] * size:
        raise FaceDiffError(
            f"--eyes {path}: its blink moves a lid by {way:.3g} on a face of size {size:.3g}; give the shape of shut "
            f'eyes, and as "neutral" the open face in the same unit'
        )
    return np.asarray(scale * closing, np.float32)


def _read_shape(path: Path, name: object) -> Vertices:
    """Vertices of a mesh, or displacements (V, 3) of a .npy file, that the eyes' file names."""
    import numpy as np

    from facediff.mesh import read_mesh

    file = path.parent / str(name)
    if file.suffix.lower() != ".npy":
        return read_mesh(file).vertices
    try:
        array = np.load(file, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise FaceDiffError(f"--eyes {path}: {file} is not a readable NumPy array ({error})") from error
    if array.size % 3 or not np.issubdtype(array.dtype, np.floating):
        raise FaceDiffError(f"--eyes {path}: {file} has shape {array.shape}; expected displacements (V, 3)")
    return np.asarray(array.reshape(-1, 3), np.float64)


def _indices(path: Path, listed: object, n_vertices: int) -> Indices:
    """Indices in their order: a list of them, a text file, or a mask of a pickle (``FLAME_masks.pkl:left_eyeball``)."""
    import numpy as np

    from facediff.data.corpus import read_masks
    from facediff.metrics.regions import read_indices

    if not isinstance(listed, str):
        return _checked(path, np.asarray(listed), n_vertices)
    file, _, mask = listed.partition(":") if ".pkl:" in listed else (listed, "", "")
    try:
        read = read_masks(path.parent / file, mask) if file.endswith(".pkl") else read_indices(path.parent / file)
    except ValueError as error:
        raise FaceDiffError(f"--eyes {path}: {error}") from error
    return _checked(path, np.asarray(read), n_vertices)


def _checked(path: Path, indices: npt.NDArray[Any], n_vertices: int) -> Indices:
    import numpy as np

    fit = indices.ndim == 1 and len(indices) and np.issubdtype(indices.dtype, np.integer)
    if not fit or not 0 <= indices.min() <= indices.max() < n_vertices:
        raise FaceDiffError(f"--eyes {path}: expected lists of vertex indices from 0 to {n_vertices - 1}")
    return indices.astype(np.int64)
