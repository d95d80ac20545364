"""Pictures for checking a result: faces next to each other, with numbers at vertices as colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facediff.animation import Animation
from facediff.editing.blendshapes import Weights
from facediff.editing.correspondence import Correspondence
from facediff.editing.fit_check import telling_frames
from facediff.editing.shapes import ShapeSet
from facediff.export.viewer.packing import millimetres, mouth_opening
from facediff.render import Camera, Renderer, contact_sheet, heat_colours, save_image


@dataclass(frozen=True)
class DrawnFace:
    """A face to draw."""

    label: str
    vertices: npt.NDArray[np.floating]  # (V, 3), y up, z to the viewer
    faces: npt.NDArray[np.integer]  # (F, 3)
    colours: npt.NDArray[np.uint8] | None = None  # (V, 3) sRGB; plain material if None
    focus: Sequence[npt.NDArray[np.floating]] | None = None  # points that are in view; those of all faces if None


def draw_worst_frame(path: Path, animation: Animation, shapes: ShapeSet, weights: Weights) -> None:
    """Draw the frame that blendshapes fit worst: the original, the sum of the weighted shapes, and their difference."""
    frame = int(weights.residual_rms_mm.argmax())
    animation = animation.part([frame]).still()  # the shapes leave the head's motion out
    truth = np.asarray(animation.vertices[0], np.float64)
    built = animation.template + np.einsum("k,kvc->vc", weights.values[frame], shapes.deltas)
    label, colours = heat(np.linalg.norm(truth - built, axis=1) * millimetres(animation), "residual")
    _draw(
        path,
        [
            DrawnFace(f"{animation.name}, frame {frame}", truth, animation.triangles, animation.colours),
            DrawnFace("from the weights", built, animation.triangles, animation.colours),
            DrawnFace(label, built, animation.triangles, colours),
        ],
    )


def draw_correspondence(path: Path, animation: Animation, carried: Animation, correspondence: Correspondence) -> None:
    """Draw both meshes with the widest mouth, a full blink and raised brows, and how far each target vertex moves.

    The last column shows how far the meshes lie apart at rest, and the eyes of the target from near.
    """
    frames = telling_frames(animation.still(), correspondence)
    opening = mouth_opening(animation)
    if opening is not None:
        frames["widest mouth"] = int(opening.argmax())
    if not frames:  # without a face that is recognised, the frame furthest from the neutral one
        frames["frame"] = int(np.argmax([np.square(frame - animation.template).sum() for frame in animation.vertices]))
    # In the source's axes and unit, so that one camera shows both; a whole figure would show its face in a few pixels.
    back = correspondence.similarity.inverse()
    face = [animation.template, *(animation.vertices[frame] for frame in frames.values())]
    source = correspondence.features[0]
    openings = [] if source is None else [eye for eye in source.eyes if eye is not None]
    eyes = [np.concatenate([eye.upper, eye.lower]) for eye in openings]
    apart, distances = heat(
        correspondence.distances * (correspondence.share > 0) * millimetres(carried), "distance of the meshes"
    )
    panels = []
    for row, (name, frame) in enumerate(frames.items()):
        posed = back.apply(carried.vertices[frame])
        moved, moves = heat(
            np.linalg.norm(carried.vertices[frame] - carried.template, axis=1) * millimetres(carried), "motion"
        )
        panels += [
            DrawnFace(
                f"{animation.name}, {name}, frame {frame}",
                np.asarray(animation.vertices[frame]),
                animation.triangles,
                animation.colours,
            ),
            DrawnFace("on the target mesh", posed, carried.triangles, carried.colours),
            DrawnFace(moved, posed, carried.triangles, moves),
            DrawnFace(apart, back.apply(carried.template), carried.triangles, distances)
            if row == 0 or not eyes
            else DrawnFace("its eyes", posed, carried.triangles, carried.colours, focus=eyes),
        ]
    _draw(path, panels, focus=face, columns=4)


def heat(values_mm: npt.NDArray[np.floating], label: str) -> tuple[str, npt.NDArray[np.uint8]]:
    """A label with the scale, and the colours of numbers at vertices (V,) from 0 to their greatest."""
    highest = max(float(values_mm.max()), 1e-6)
    return f"{label}, 0 to {highest:.2g} mm", heat_colours(values_mm, highest)


def _draw(
    path: Path,
    panels: Sequence[DrawnFace],
    *,
    focus: Sequence[npt.NDArray[np.floating]] | None = None,
    columns: int | None = None,
) -> None:
    """Draw faces of one unit next to each other at one scale; the points in ``focus`` are in view, all if None."""
    camera = Camera.framing(focus or [panel.vertices for panel in panels])
    pictures = [
        Renderer(
            panel.faces,
            template=panel.vertices,
            size=272,
            camera=camera if panel.focus is None else Camera.framing(panel.focus),
            colours=panel.colours,
        ).render(panel.vertices)
        for panel in panels
    ]
    save_image(path, contact_sheet(pictures, columns or len(pictures), labels=[panel.label for panel in panels]))
