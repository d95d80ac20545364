"""Pictures for checking a result: faces next to each other, with numbers at vertices as colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facediff.animation import Animation, metres_per_unit
from facediff.editing.blendshapes import Weights
from facediff.editing.correspondence import Correspondence
from facediff.editing.shapes import ShapeSet
from facediff.render import Camera, Renderer, contact_sheet, heat_colours, save_image


@dataclass(frozen=True)
class Panel:
    """A face to draw."""

    label: str
    vertices: npt.NDArray[np.floating]  # (V, 3), y up, z to the viewer
    faces: npt.NDArray[np.integer]  # (F, 3)
    colours: npt.NDArray[np.uint8] | None = None  # (V, 3) sRGB; plain material if None


def draw_worst_frame(path: Path, animation: Animation, shapes: ShapeSet, weights: Weights) -> None:
    """Draw the frame that blendshapes fit worst: the original, the sum of the weighted shapes, and their difference.

    Args:
        path: the picture (.png).
        animation: what the weights were solved for.
        shapes: the blendshapes.
        weights: the solution.
    """
    frame = int(weights.residual_rms_mm.argmax())
    truth = np.asarray(animation.vertices[frame], np.float64)
    built = animation.template + np.einsum("k,kvc->vc", weights.values[frame], shapes.deltas)
    millimetres = 1000 * metres_per_unit(animation.unit)
    label, colours = heat(np.linalg.norm(truth - built, axis=1) * millimetres, "residual")
    _draw(
        path,
        [
            Panel(f"{animation.name}, frame {frame}", truth, animation.triangles, animation.colours),
            Panel("from the weights", built, animation.triangles, animation.colours),
            Panel(label, built, animation.triangles, colours),
        ],
    )


def draw_correspondence(path: Path, animation: Animation, made: Animation, found: Correspondence) -> None:
    """Draw both meshes with the mouth most open, how far each target vertex moves, and the distance of the meshes.

    Args:
        path: the picture (.png).
        animation: on the source mesh.
        made: the same on the target mesh.
        found: the correspondence between them.
    """
    frame, millimetres = widest_frame(animation), 1000 * metres_per_unit(made.unit)
    # In the source's axes and unit, so that one camera shows both.
    back = found.similarity.inverse()
    posed = back.apply(made.vertices[frame])
    source = np.asarray(animation.vertices[frame])
    moved, moves = heat(np.linalg.norm(made.vertices[frame] - made.template, axis=1) * millimetres, "motion")
    apart, distances = heat(found.distances * millimetres, "distance of the meshes")
    _draw(
        path,
        [
            Panel(f"{animation.name}, frame {frame}", source, animation.triangles, animation.colours),
            Panel("on the target mesh", posed, made.triangles, made.colours),
            Panel(moved, posed, made.triangles, moves),
            Panel(apart, back.apply(made.template), made.triangles, distances),
        ],
    )


def heat(values_mm: npt.NDArray[np.floating], label: str) -> tuple[str, npt.NDArray[np.uint8]]:
    """A label with the scale, and the colours of numbers at vertices (V,) from 0 to their greatest."""
    highest = max(float(values_mm.max()), 1e-6)
    return f"{label}, 0 to {highest:.2g} mm", heat_colours(values_mm, highest)


def widest_frame(animation: Animation) -> int:
    """The frame in which the mouth is most open; without known lips, the frame furthest from the neutral face."""
    pairs = animation.inner_lip_pairs

    def opening(frame: npt.NDArray[np.floating]) -> float:
        if pairs is not None and len(pairs):
            return float(np.linalg.norm(frame[pairs[:, 0]] - frame[pairs[:, 1]], axis=1).mean())
        return float(np.square(frame - animation.template).sum())

    return int(np.argmax([opening(frame) for frame in animation.vertices]))


def _draw(path: Path, panels: Sequence[Panel], size: int = 272) -> None:
    """Draw faces of one unit next to each other at one scale."""
    camera = Camera.framing([panel.vertices for panel in panels])
    drawn = [
        Renderer(panel.faces, template=panel.vertices, size=size, camera=camera, colours=panel.colours).render(
            panel.vertices
        )
        for panel in panels
    ]
    save_image(path, contact_sheet(drawn, len(drawn), labels=[panel.label for panel in panels]))
