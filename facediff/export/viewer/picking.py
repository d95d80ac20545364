"""A page on which a person names the same places on two faces, and the small server that saves them.

The page shows the animation's mesh and the target at rest, the target as the automatic alignment lays it, so that both
are seen from the front. It sends the places as triangles and weights of the meshes as they are in their files.
"""

from __future__ import annotations

import html
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from facediff.animation import Animation
from facediff.editing.correspondence import placed, run_alike
from facediff.editing.face_features import Features
from facediff.editing.landmarks import (
    FORMAT,
    NAMES,
    Landmarks,
    as_rows,
    known_landmarks,
    known_topology,
    landmarks_by_shape,
    parse_landmarks,
    read_landmarks,
    write_landmarks,
)
from facediff.editing.surface import Surface
from facediff.editing.symmetry import Plane, symmetry_plane
from facediff.errors import FaceDiffError
from facediff.export.format import outward
from facediff.export.viewer.packing import Blobs, bounds, millimetres, pack_mesh
from facediff.export.viewer.page import assemble
from facediff.mesh import Mesh, Similarity
from facediff.mesh.parts import MeshPart
from facediff.utils.files import valid_text
from facediff.utils.server import (
    RefusedError,
    names_of,
    own_page_only,
    read_body,
    require_server,
    run_server,
)

if TYPE_CHECKING:
    from starlette.applications import Starlette
    from starlette.requests import Request
    from starlette.responses import Response

Array = npt.NDArray[np.float64]

MOST_BYTES = 1_000_000  # of a body; a thousand landmarks take a fifth of it
FEWEST = 3  # pairs that determine an alignment
SCRIPTS = ("motion", "surface", "camera", "scene", "dialogs", "report", "picking")


@dataclass(frozen=True, eq=False)
class Picking:
    """Two meshes on which the same places are picked."""

    source: Animation  # its mesh at rest is shown
    target: Mesh
    names: tuple[str, str]  # of both meshes on the page
    file: Path  # where the places are saved
    start: Landmarks | None = None  # first landmarks of the page
    face_triangles: npt.NDArray[np.integer] | None = None  # of the target, to search for the face in; None for all
    parts: Sequence[MeshPart] = ()  # of the target, which the page can hide

    @property
    def counts(self) -> tuple[int, int]:
        """Vertices of both meshes."""
        return len(self.source.template), len(self.target.vertices)

    def save(self, content: dict[str, Any]) -> int:
        """Check and write the landmarks that the page sends; their number."""
        landmarks = parse_landmarks(content, "request", counts=self.counts)
        if len(landmarks) < FEWEST:
            raise FaceDiffError(f"request: holds {len(landmarks)} pairs; expected {FEWEST} or more")
        write_landmarks(self.file, landmarks, *self.counts)
        return len(landmarks)


def picking_page(picking: Picking) -> Iterator[str]:
    """The text of the page in pieces, in order. It loads nothing, and talks to its own server only."""
    source, target = picking.source, picking.target
    rest: Array = np.asarray(source.template, np.float64)
    goal = Surface(rest, outward(source).astype(np.int64))
    moved = run_alike(goal, Surface(target.vertices, target.faces.astype(np.int64)))
    faces = moved.faces if picking.face_triangles is None else moved.faces[picking.face_triangles]
    back, features, target_features = placed(goal, Surface(target.vertices, faces))
    laid = back.apply(target.vertices)
    if features is not None and not _as_wide(features, target_features, laid):
        # No mouth is where the alignment expects it: a person knows best how the mesh lies in its file.
        target_features, laid = None, _as_in_its_file(rest, target.vertices, faces).apply(target.vertices)
    source_landmarks = known_landmarks(rest, goal.faces)
    of_target = known_topology(target.vertices)
    suggested = (
        landmarks_by_shape(laid, faces, target_features) if target_features is not None and of_target is None else {}
    )
    blobs, scale = Blobs(), millimetres(source)
    sides = [
        (picking.names[0], rest, goal.faces, source.colours, features),
        (picking.names[1], laid, moved.faces, target.colours, None if target_features is None else features),
    ]
    facts: dict[str, Any] = {
        "format": FORMAT,
        "fewest": FEWEST,
        "names": [[name, description] for name, description in NAMES.items()],
        "known": {"source": source_landmarks.vertices, "target": {} if of_target is None else of_target.vertices},
        "suggested": suggested,
        "start": [] if picking.start is None else as_rows(picking.start),
        "sides": dict(zip(("source", "target"), [_side(*side, scale, blobs) for side in sides], strict=True)),
    }
    facts["sides"]["target"]["parts"] = _runs(picking.parts)
    return assemble(
        "picking.html",
        ("style.css", "picking.css"),
        SCRIPTS,
        {"title": html.escape(valid_text(f"Pick landmarks: {picking.names[0]} · {picking.names[1]}"))},
        facts,
        blobs,
        loads="img-src data:; connect-src 'self'",
    )


def _runs(parts: Sequence[MeshPart]) -> list[tuple[str, list[tuple[int, int]]]]:
    """The parts by their first names, each with its runs of triangles: the first of them and how many."""
    runs: dict[str, list[tuple[int, int]]] = {}
    for part in parts:
        if part.names and len(part.triangles):
            runs.setdefault(part.names[0], []).append((int(part.triangles[0]), len(part.triangles)))
    return list(runs.items())


ALIKE = 0.4, 2.5  # widths of the mouth of a mesh that is laid well, in the source's


def _as_wide(features: Features, target: Features | None, laid: Array) -> bool:
    # Where it lies now: the alignment may have shrunk the mesh after its mouth was found.
    return target is not None and (
        ALIKE[0] < np.ptp(laid[target.mouth.upper_seeds], axis=0).max() / features.mouth.width < ALIKE[1]
    )


def _as_in_its_file(rest: Array, points: Array, faces: npt.NDArray[np.integer]) -> Similarity:
    """A mesh with its own axes, as large as the source and in its place."""
    low, high = points[np.unique(faces)].min(axis=0), points[np.unique(faces)].max(axis=0)
    scale = float(np.ptp(rest, axis=0).max() / max((high - low).max(), np.finfo(float).tiny))
    middle = 0.5 * (rest.min(axis=0) + rest.max(axis=0))
    return Similarity(np.eye(3), middle - scale * 0.5 * (low + high), scale)


ABOUT = 1.5, 1.9, 0.55
"""Half width and half height of the view of a face, and how far its middle lies above the mouth's; in widths of the
mouth."""


def _side(
    name: str,
    rest: Array,
    triangles: npt.NDArray[np.int64],
    colours: npt.NDArray[np.uint8] | None,
    features: Features | None,
    scale: float,
    blobs: Blobs,
) -> dict[str, Any]:
    """One mesh, laid like the source, in mm; all of it is shown where no face was found."""
    points = rest.astype(np.float32).astype(np.float64) * scale
    whole_centre, whole_extent = bounds(points, triangles)
    centre, extent = whole_centre, whole_extent
    about = points
    if features is not None:
        mouth, width = features.mouth.centre * scale, features.mouth.width * scale
        middle = mouth + [0.0, ABOUT[2] * width, -0.5 * width]
        centre, extent = middle.round(3).tolist(), [ABOUT[0] * width, ABOUT[1] * width, width]
        about = points[(np.abs(points - middle) < 2.0 * width).all(axis=1)]
    about = about if len(about) >= 20 else points
    plane = symmetry_plane(about, Plane(np.array([1.0, 0.0, 0.0]), centre[0]))
    return {
        "name": name,
        "vertices": len(points),
        **pack_mesh(points, triangles, colours, blobs),
        "centre": centre,
        "extent": extent,
        "whole": {"centre": whole_centre, "extent": whole_extent},
        "plane": [*plane.normal.tolist(), plane.offset],
    }


def make_app(picking: Picking, page: str, hosts: tuple[str, ...] | None, stop: Callable[[], None]) -> Starlette:
    """The ASGI application: the page, and an address for its landmarks; ``stop`` is called when they are saved."""
    from starlette.applications import Starlette
    from starlette.background import BackgroundTask
    from starlette.concurrency import run_in_threadpool
    from starlette.responses import HTMLResponse, JSONResponse
    from starlette.routing import Route

    async def show(_: Request) -> Response:
        return HTMLResponse(page, headers={"Cache-Control": "no-store"})

    async def save(request: Request) -> Response:
        try:
            content = await read_body(request, MOST_BYTES)
            pairs = await run_in_threadpool(picking.save, content)
        except RefusedError as error:
            return JSONResponse({"error": str(error)}, error.status)
        except FaceDiffError as error:
            return JSONResponse({"error": str(error)}, 503 if isinstance(error.__cause__, OSError) else 400)
        return JSONResponse({"saved": pairs, "file": picking.file.name}, background=BackgroundTask(stop))

    return Starlette(
        routes=[Route("/", show), Route("/api/landmarks", save, methods=["POST"])],
        middleware=own_page_only(hosts),
    )


def pick_landmarks(
    source: Animation,
    target: Mesh,
    file: Path,
    *,
    names: tuple[str, str],
    start: Path | None = None,
    face_triangles: npt.NDArray[np.integer] | None = None,
    parts: Sequence[MeshPart] = (),
    host: str = "127.0.0.1",
    port: int = 0,
    announce: Callable[[str], object] | None = None,
) -> bool:
    """Let a person pick the same places on two meshes, on a page of a server; whether they were saved.

    Arguments as in :class:`Picking` and :func:`~facediff.utils.server.run_server`; the page begins with the landmarks
    of ``start``, or else of the file if it exists.
    """
    require_server("picking landmarks", extra="serve")
    begin = start if start is not None else file if file.exists() else None
    landmarks = None
    if begin is not None:
        counts = len(source.template), len(target.vertices)
        landmarks = read_landmarks(begin, known_topology(source.template), known_topology(target.vertices), counts)
        landmarks.check(*counts)
    picking = Picking(source, target, names, file, landmarks, face_triangles, parts)
    page = "".join(picking_page(picking))
    return run_server(lambda stop: make_app(picking, page, names_of(host), stop), host=host, port=port, ready=announce)
