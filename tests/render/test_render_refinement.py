"""Light per vertex of a refined mesh, and drawing in several threads: quick ways to the pictures of the slow ones."""

import threading
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt
import pytest

from facediff.render import Renderer, panels, rasteriser, side_by_side
from facediff.render.refinement import Refinement
from tests.fakes.small_face import CONTROLS, Shape, build_face, build_rig


@pytest.fixture(scope="module")
def talking() -> npt.NDArray[np.float64]:
    """The built-in face, which opens its mouth: (5, V, 3)."""
    weights = np.zeros((5, len(CONTROLS)))
    weights[:, CONTROLS.index("jaw_open")] = np.linspace(0, 1, 5)
    return np.asarray(build_rig(Shape()).pose(weights))


@pytest.mark.slow
def test_light_per_vertex_looks_like_light_of_a_far_finer_mesh(
    talking: npt.NDArray[np.float64], monkeypatch: pytest.MonkeyPatch
) -> None:
    face, pictures = build_face(), []
    for finer in (1, 8):
        monkeypatch.setattr(rasteriser, "EDGE", rasteriser.EDGE / finer)
        monkeypatch.setattr(rasteriser, "SHORTEST_EDGE", rasteriser.SHORTEST_EDGE / finer)
        renderer = Renderer(face.faces, template=talking[0], size=256, colours=face.colours)
        pictures.append(renderer.render(talking[3]).astype(np.float64))
    error = pictures[0] - pictures[1]
    assert 10 * np.log10(255**2 / np.mean(error**2)) > 48
    assert abs(error.mean()) < 0.1


def test_refinement_keeps_surface_winding_and_neighbours() -> None:
    random = np.random.default_rng(0)
    face = build_face()
    finer = Refinement(face.faces, face.vertices, longest=0.004)
    points = finer.values(face.vertices.astype(np.float32))
    assert len(points) == finer.n_vertices
    np.testing.assert_array_equal(points[: len(face.vertices)], face.vertices.astype(np.float32))

    def areas(vertices: npt.NDArray[np.floating], faces: npt.NDArray[np.integer]) -> npt.NDArray[np.float64]:
        a, b, c = (vertices[faces[:, corner]].astype(np.float64) for corner in range(3))
        return np.asarray(np.cross(b - a, c - a))

    # The vector areas tell winding and surface: halves of a triangle add up to it.
    np.testing.assert_allclose(areas(points, finer.faces).sum(axis=0), areas(face.vertices, face.faces).sum(axis=0),
                               atol=1e-8)  # fmt: skip
    assert np.linalg.norm(areas(points, finer.faces), axis=1).sum() == pytest.approx(
        np.linalg.norm(areas(face.vertices, face.faces), axis=1).sum(), rel=1e-4
    )
    corners = points[finer.faces]
    assert np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max() <= 0.004
    # No gap opens: an edge that two triangles shared is still shared by two, all along.
    edges = np.sort(finer.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, counts = np.unique(edges, axis=0, return_counts=True)
    before = np.sort(face.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, counts_before = np.unique(before, axis=0, return_counts=True)
    assert set(counts.tolist()) == set(counts_before.tolist())
    # Values of vertices are interpolated like their places: those of a linear function stay on it.
    slope = random.normal(size=(3, 2)).astype(np.float32)
    values = finer.values(np.concatenate([face.vertices, face.vertices @ slope], axis=1, dtype=np.float32))
    np.testing.assert_allclose(values[:, 3:], values[:, :3] @ slope, atol=1e-6)


def test_refinement_splits_where_normals_turn_and_nothing_that_is_short() -> None:
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    turning = np.array([[0.0, 0, 1], [1, 0, 0], [1, 0, 0], [0, 0, 1]])
    assert len(Refinement(faces, square, 2.0).faces) == 2
    assert len(Refinement(faces, square, 2.0, turning).faces) > 8
    assert len(Refinement(faces, square, 2.0, turning, shortest=1.5).faces) == 2


def test_threads_draw_the_same_pictures_in_order(
    talking: npt.NDArray[np.float64], monkeypatch: pytest.MonkeyPatch
) -> None:
    face = build_face()
    motion = np.concatenate([talking] * 3)
    renderer = Renderer(face.faces, template=talking[0], size=96, colours=face.colours)
    alone = np.stack([renderer.render(frame) for frame in motion])
    for threads in (1, 3):
        monkeypatch.setattr(panels, "processors", lambda threads=threads: threads)
        drawn = np.stack(list(side_by_side(renderer, [motion], [""])))
        np.testing.assert_array_equal(drawn, alone)


def test_pictures_that_nobody_takes_are_not_drawn(
    talking: npt.NDArray[np.float64], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(panels, "processors", lambda: 2)
    started: list[int] = []
    render = Renderer.render

    def counted(self: Renderer, vertices: npt.ArrayLike, *, colours: npt.ArrayLike | None = None) -> object:
        started.append(1)
        return render(self, vertices, colours=colours)

    monkeypatch.setattr(Renderer, "render", counted)
    face = build_face()
    renderer = Renderer(face.faces, template=talking[0], size=32)
    frames: Iterator[object] = side_by_side(renderer, [np.repeat(talking, 40, axis=0)], [""])
    next(frames)
    next(frames)
    assert len(started) <= 5  # two taken, two being drawn, one waiting
    frames.close()  # type: ignore[attr-defined]
    assert len(started) <= 5
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("drawing")]
