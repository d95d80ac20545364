"""A motion carried to resampled, moved, scaled and reordered copies of its own mesh, where the truth is known."""

from __future__ import annotations

from dataclasses import replace

import fast_simplification
import numpy as np
import pytest

from facediff.animation import Animation
from facediff.editing.correspondence import Correspondence, correspond
from facediff.editing.retargeting import transfer, transfer_displacements, unit_of
from facediff.errors import FaceDiffError
from facediff.mesh import Mesh
from tests.fakes.small_face import CONTROLS, Rig, Shape, build_face, build_rig, lip_pairs

Arrays = tuple[np.ndarray, np.ndarray, np.ndarray]
LIMIT = 0.02


def turned(degrees: float) -> np.ndarray:
    a = np.deg2rad(degrees)
    about_z = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    return about_z @ np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])


def error(found: np.ndarray, truth: np.ndarray) -> float:
    """Root mean square over frames and moving vertices, as a share of the motion's own over the same."""
    far = np.linalg.norm(truth, axis=2)
    moving = far.max(axis=0) > 1e-3 * far.max()
    left = np.linalg.norm(found - truth, axis=2)[:, moving]
    return float(np.sqrt(np.square(left).mean() / np.square(far[:, moving]).mean()))


@pytest.fixture(scope="module")
def rig() -> Rig:
    return build_rig(Shape())


@pytest.fixture(scope="module")
def faces() -> np.ndarray:
    return np.asarray(build_face().faces, np.int32)


@pytest.fixture(scope="module")
def motion(rig: Rig) -> np.ndarray:
    """Displacements (4, V, 3): a jaw that opens, lips, brows, lids."""
    weights = np.random.default_rng(0).uniform(0, 0.4, (4, len(CONTROLS)))
    weights[:, CONTROLS.index("jaw_open")] = [0.2, 1.0, 0.6, 0.0]
    weights[:, CONTROLS.index("lip_closure")] = 0
    return rig.pose(weights) - rig.neutral


@pytest.fixture(scope="module")
def animation(rig: Rig, faces: np.ndarray, motion: np.ndarray) -> Animation:
    upper, lower = lip_pairs()
    return Animation(
        "a",
        (rig.neutral + motion).astype(np.float32),
        rig.neutral.astype(np.float32),
        25.0,
        faces=faces,
        regions={"lips": np.unique(np.concatenate([upper, lower]))},
        inner_lip_pairs=np.stack([upper, lower], axis=1),
        metadata={"identity": "X"},
    )


def finer(vertices: np.ndarray, faces: np.ndarray, motion: np.ndarray) -> Arrays:
    """Every triangle cut into four at its edges' middles, where the motion is the mean of the ends'."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    ends, place = np.unique(edges, axis=0, return_inverse=True)
    ab, bc, ca = place.reshape(3, -1) + len(vertices)
    a, b, c = faces.T
    cut = np.concatenate([np.stack(t, axis=1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
    return (
        np.concatenate([vertices, vertices[ends].mean(axis=1)]),
        cut,
        np.concatenate([motion, motion[:, ends].mean(axis=2)], axis=1),
    )


def reordered(vertices: np.ndarray, faces: np.ndarray, motion: np.ndarray) -> Arrays:
    order = np.random.default_rng(1).permutation(len(vertices))
    return vertices[order], np.argsort(order)[faces], motion[:, order]


@pytest.fixture(scope="module")
def copy(rig: Rig, faces: np.ndarray, motion: np.ndarray) -> Arrays:
    """Another topology of the same face: finer, and in another order."""
    return reordered(*finer(rig.neutral, faces, motion))


@pytest.fixture(scope="module")
def far_copy(copy: Arrays) -> Arrays:
    """The same, a thousand times as large, turned and elsewhere."""
    vertices, faces, motion = copy
    return 1000 * vertices @ turned(10).T + [30, -500, 7], faces, 1000 * motion @ turned(10).T


@pytest.fixture(scope="module")
def found(rig: Rig, faces: np.ndarray, far_copy: Arrays) -> Correspondence:
    return correspond(rig.neutral, faces, far_copy[0], far_copy[1])


def test_one_mesh_corresponds_to_itself_exactly(animation: Animation) -> None:
    same = correspond(animation.template, animation.triangles, animation.template, animation.triangles)
    assert not same.distances.any()
    made = transfer(animation, same, Mesh(animation.template.astype(np.float64), animation.triangles))
    assert np.array_equal(made.vertices, animation.vertices)
    assert np.array_equal(made.template, animation.template)
    assert np.array_equal(made.regions["lips"], animation.regions["lips"])
    assert made.inner_lip_pairs is not None
    assert {tuple(pair) for pair in made.inner_lip_pairs} == {tuple(pair) for pair in animation.inner_lip_pairs}  # type: ignore[union-attr]
    assert made.unit == "m"


def test_a_resampled_copy_far_away_and_in_another_order(
    motion: np.ndarray, far_copy: Arrays, found: Correspondence
) -> None:
    assert found.similarity.scale == pytest.approx(1000, rel=1e-6)
    assert found.similarity.rotation == pytest.approx(turned(10), abs=1e-6)
    assert error(transfer_displacements(found, motion), far_copy[2]) < LIMIT
    assert found.distances.max() < 1.0  # millimetres
    assert found.weights.min() >= 0
    assert found.weights.sum(axis=1) == pytest.approx(1)
    assert not found.fits_badly


@pytest.mark.slow
def test_a_coarser_copy_with_vertices_of_its_own(rig: Rig, faces: np.ndarray) -> None:
    """Decimation moves vertices, so the truth is a motion given as a function of place, sampled on both meshes."""

    def field(points: np.ndarray) -> np.ndarray:
        x, y, z = points.T
        bump = np.exp(-np.square((points - [0, -0.05, 0.08]) / 0.06).sum(axis=1))
        return np.stack([[0 * x, -0.02 * bump, 0.01 * bump], [0.01 * np.sin(15 * y), 0.01 * bump, 0.02 * z]]).swapaxes(
            1, 2
        )

    vertices, triangles, _ = finer(rig.neutral, faces, np.zeros((1, len(rig.neutral), 3)))
    vertices, triangles, _ = finer(vertices, triangles, np.zeros((1, len(vertices), 3)))
    coarse, cut = fast_simplification.simplify(vertices, triangles.astype(np.int32), 0.92)
    coarse = coarse.astype(np.float64)
    source, corners, _ = finer(rig.neutral, faces, np.zeros((1, len(rig.neutral), 3)))
    found = correspond(source, corners, coarse, cut)
    assert len(coarse) < len(source)
    assert error(transfer_displacements(found, field(source)), field(coarse)) < LIMIT


@pytest.mark.slow
def test_another_speakers_face_moves_its_own_lips(rig: Rig, faces: np.ndarray, motion: np.ndarray) -> None:
    """Without knowing that the topology is the same, each vertex moves about as its own counterpart does."""
    other = build_rig(Shape(width=0.5, lips=0.7, nose_width=0.6, jaw=0.5, mouth_width=0.5, cheeks=0.5)).neutral
    known = transfer_displacements(correspond(rig.neutral, faces, other, faces), motion)
    vertices, triangles, truth = reordered(other, faces, known)
    found = correspond(rig.neutral, faces, vertices, triangles)
    assert error(transfer_displacements(found, motion), truth) < 0.1


@pytest.mark.slow
def test_what_lies_far_away_stands_still(rig: Rig, faces: np.ndarray, motion: np.ndarray) -> None:
    """A hat a metre above the head, and triangles the other way round."""
    hat = rig.neutral[:50] * 0.2 + [0, 1.0, 0]
    vertices = np.concatenate([rig.neutral, hat])
    flipped = np.concatenate([faces, [[1008, 1009, 1010]]])[:, ::-1]
    found = correspond(rig.neutral, faces, vertices, flipped)
    moved = transfer_displacements(found, motion)
    assert not moved[:, 1008:].any()
    assert error(moved[:, :1008], motion) < 1e-5
    assert np.array_equal(found.target_faces, flipped)


def test_landmarks_lay_a_part_of_a_face_onto_the_whole(rig: Rig, faces: np.ndarray, motion: np.ndarray) -> None:
    """A mask of the lower face, whose size says nothing of the head's."""
    kept = np.flatnonzero((rig.neutral[:, 1] < -0.005) & (rig.neutral[:, 1] > -0.1) & (rig.neutral[:, 2] > 0.03))
    place = np.full(len(rig.neutral), -1)
    place[kept] = np.arange(len(kept))
    cut = place[faces]
    cut = cut[(cut >= 0).all(axis=1)]
    mask = 3 * rig.neutral[kept] @ turned(30).T + 5
    some = kept[np.linspace(0, len(kept) - 1, 12).astype(int)]
    pairs = np.stack([some, place[some]], axis=1)
    found = correspond(rig.neutral, faces, mask, cut, landmarks=pairs)
    assert error(transfer_displacements(found, motion), 3 * motion[:, kept] @ turned(30).T) < LIMIT
    with pytest.raises(FaceDiffError, match=r"landmarks: name source vertex 5000 of 1008"):
        correspond(rig.neutral, faces, mask, cut, landmarks=np.array([[5000, 0]]))


def test_carried_animation_has_unit_regions_and_metadata(
    animation: Animation, far_copy: Arrays, found: Correspondence
) -> None:
    colours = np.zeros((len(far_copy[0]), 3), np.uint8)
    made = transfer(animation, found, Mesh(far_copy[0], far_copy[1].astype(np.int32), colours))
    assert made.unit == "mm"
    assert made.vertices.dtype == np.float32
    assert error(made.vertices - made.template.astype(np.float64), far_copy[2]) < LIMIT
    assert made.colours is colours
    assert made.metadata["identity"] == "X"
    assert "1008 vertices" in made.metadata["carried"]
    # The correspondence can be used for another identity's animation as well.
    wide = replace(animation, template=animation.template * [1.1, 1, 1], vertices=animation.vertices * [1.1, 1, 1])
    assert transfer(wide, found, Mesh(far_copy[0], far_copy[1].astype(np.int32))).unit == "mm"
    # Lips open as far as those of the source do.
    assert made.inner_lip_pairs is not None
    gaps = [
        np.linalg.norm(one.vertices[1][one.inner_lip_pairs[:, 0]] - one.vertices[1][one.inner_lip_pairs[:, 1]], axis=1)
        for one in (animation, made)
    ]
    assert gaps[1].mean() == pytest.approx(1000 * gaps[0].mean(), rel=0.02)
    # The region's vertices are in it, and what is far from it is not.
    lips = 1000 * animation.template[animation.regions["lips"]] @ turned(10).T + [30, -500, 7]
    away = np.linalg.norm(made.template[made.regions["lips"]][:, None] - lips[None], axis=2).min(axis=1)
    assert len(made.regions["lips"]) >= len(lips)
    assert away.max() < 5


@pytest.mark.parametrize(
    ("unit", "scale", "expected"),
    [("m", 1000.0, "mm"), ("m", 1.1, "m"), ("mm", 0.00095, "m"), ("cm", 0.4, "in"), ("m", 20.0, "0.05")],
)
def test_units_follow_from_sizes(unit: str, scale: float, expected: str) -> None:
    assert unit_of(unit, scale) == expected
