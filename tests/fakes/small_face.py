"""A face of 1 008 vertices with a rig, for tests of geometry that would take long on the built-in head of 5 875.

``small_face.npz`` holds the face at rest, ARKit's shapes, the displacements of 20 controls and how the lips touch. Both
kinds of displacements are in micrometres.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from facediff.synthetic.head.people import Face

FILE = Path(__file__).with_suffix(".npz")
SOFT_CONTACT = 0.0004  # Metres by half of which the lips press into one another


class Shape(Face):
    """How a person's head differs from the average one, for points in metres."""

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Where points (..., 3) of the average head lie in this person's."""
        return super().__call__(1000.0 * points) / 1000.0


F1 = Shape(width=-0.4, jaw=-0.2, neck=-0.7, nose_width=-0.5, nose_up=0.6, eye_size=0.5, brow_height=0.4, lips=0.5)
M2 = Shape(width=0.8, length=-0.3, depth=0.4, jaw=0.4, chin=-0.4, neck=1.0, nose_width=1.0, lips=0.8, cheeks=1.0)


@dataclass(frozen=True)
class SmallFace:
    """The face at rest in metres, with named vertices of its left half, as :class:`QuadMesh` has them."""

    vertices: np.ndarray  # (V, 3)
    faces: np.ndarray  # (F, 3)
    colours: np.ndarray  # (V, 3)
    mirror: np.ndarray  # (V,)
    groups: dict[str, np.ndarray]
    regions: dict[str, np.ndarray]  # lve: the lips; fdd: the upper face

    def both(self, *prefixes: str) -> np.ndarray:
        """Sorted vertices on both sides of all groups whose names start with one of these."""
        left = np.concatenate([index for name, index in self.groups.items() if name.startswith(prefixes)])
        return np.unique(np.concatenate([left, self.mirror[left]]))


@lru_cache(maxsize=1)
def stored() -> dict[str, np.ndarray]:
    """The arrays of the file, indices as 64-bit integers."""
    with np.load(FILE) as file:
        return {name: file[name].astype(np.int64) if file[name].dtype == np.int16 else file[name] for name in file}


@lru_cache(maxsize=1)
def build_face() -> SmallFace:
    """The face at rest."""
    arrays = stored()
    groups, regions = (
        {name.removeprefix(kind): index for name, index in arrays.items() if name.startswith(kind)}
        for kind in ("group_", "region_")
    )
    return SmallFace(*(arrays[name] for name in ("vertices", "faces", "colours", "mirror")), groups, regions)


def lip_pairs() -> tuple[np.ndarray, np.ndarray]:
    """Facing vertices of the inner lips, (upper, lower), from right to left without the corners."""
    return stored()["upper"], stored()["lower"]


def eyelid_pairs() -> tuple[np.ndarray, np.ndarray]:
    """Facing vertices of the lids' edges, (upper, lower), of both eyes without the corners."""
    mesh = build_face()
    ring = mesh.groups["eye_0"]  # from the inner corner over the upper lid to the outer one, and back below
    upper, lower = ring[1:8], ring[:8:-1]
    return np.concatenate([upper, mesh.mirror[upper]]), np.concatenate([lower, mesh.mirror[lower]])


CONTROLS = (*stored()["controls"].tolist(), "lip_closure")


@dataclass(frozen=True)
class Rig:
    """A person's face that can be posed."""

    neutral: np.ndarray  # (V, 3)
    fields: np.ndarray  # (20, V, 3)

    def pose(self, weights: np.ndarray) -> np.ndarray:
        """Vertices (T, V, 3) for weights (T, 21) of :data:`CONTROLS`; the lips touch and never cross."""
        vertices = self.neutral + np.tensordot(weights[:, :-1], self.fields, 1)
        upper, lower = lip_pairs()
        gap = vertices[:, upper, 1:] - vertices[:, lower, 1:]
        left = gap * (1.0 - np.clip(weights[:, -1], 0.0, 1.0))[:, None, None]
        height = left[..., 0]
        left[..., 0] = 0.5 * (height + np.sqrt(height**2 + SOFT_CONTACT**2) - SOFT_CONTACT)
        vertices[..., 1:] += np.einsum("vc,tcd->tvd", stored()["contact"], gap - left)
        return vertices


@lru_cache(maxsize=8)
def build_rig(shape: Shape = Shape()) -> Rig:  # noqa: B008 - frozen
    """A person's rig."""
    mesh = build_face()
    neutral = shape(mesh.vertices)
    return Rig(neutral, np.stack([shape(mesh.vertices + 1e-6 * move) - neutral for move in stored()["fields"]]))


def small_shapes(shape: Shape = Shape()) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:  # noqa: B008 - frozen
    """A person's face at rest (V, 3), its triangles, and its shapes by ARKit's names, each (V, 3)."""
    mesh, arrays, rig = build_face(), stored(), build_rig(shape)
    shapes = {
        str(name): shape(mesh.vertices + 1e-6 * move)
        for name, move in zip(arrays["names"], arrays["shapes"], strict=True)
    }
    both = np.zeros((1, len(CONTROLS)))
    both[0, [CONTROLS.index("jaw_open"), CONTROLS.index("lip_closure")]] = 1.0
    shapes["mouthClose"] = rig.neutral + rig.pose(both)[0] - shapes["jawOpen"]
    return rig.neutral, np.asarray(mesh.faces, np.int64), shapes


def write_small_shapes(folder: Path) -> None:
    """The average face at rest and its shapes as OBJ files."""
    neutral, faces, shapes = small_shapes()
    triangles = "".join(f"f {a} {b} {c}\n" for a, b, c in faces + 1)
    folder.mkdir()
    for name, vertices in {"neutral": neutral, **shapes}.items():
        points = "".join(f"v {x:.9f} {y:.9f} {z:.9f}\n" for x, y, z in vertices)
        (folder / f"{name}.obj").write_text(points + triangles, encoding="ascii")


LANDMARKS = {
    "nose_tip": 124,
    "chin": 159,
    "mouth_corner_left": 7,
    "mouth_corner_right": 538,
    "eye_outer_left": 53,
    "eye_outer_right": 579,
    "eye_inner_left": 45,
    "eye_inner_right": 571,
    "nose_bridge": 112,
    "nose_base": 140,
    "upper_lip_top": 0,
    "lower_lip_bottom": 14,
    "upper_lip_middle": 351,
    "lower_lip_middle": 365,
}
"""Vertices of the landmarks of :data:`facediff.editing.landmarks.NAMES`, in its order."""
