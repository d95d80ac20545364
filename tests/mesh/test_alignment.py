"""Alignment of faces, with and without vertices that move, and removal of the head's motion."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from facediff.errors import FaceDiffError
from facediff.mesh import Similarity, align, face_size, median_face, remove_rigid_motion, robust_align, stable_vertices
from tests.fakes.person import face, lower_face, person, turn

Array = npt.NDArray[np.float64]


def cost(map_: Similarity, source: Array, target: Array, weights: Array) -> float:
    moved = map_.scale * source @ map_.rotation.T + map_.translation
    return float((weights * ((moved - target) ** 2).sum(-1)).sum())


@pytest.mark.parametrize("scale", [False, True])
def test_a_known_map_is_found_again(scale: bool) -> None:
    random = np.random.default_rng(0)
    source = random.normal(size=(30, 3)) + [5, -3, 400]
    known = Similarity(turn([0.4, -2.0, 0.7]), np.array([1.0, -20.0, 3.0]), 0.37 if scale else 1.0)
    target = known.scale * source @ known.rotation.T + known.translation
    for found in (align(source, target, scale=scale), robust_align(source, target, scale=scale)):
        np.testing.assert_allclose(found.rotation, known.rotation, atol=1e-10)
        np.testing.assert_allclose(found.translation, known.translation, atol=1e-8)
        assert found.scale == pytest.approx(known.scale, abs=1e-12)
        np.testing.assert_allclose(found.inverse().apply(target), source, atol=1e-8)
        np.testing.assert_allclose(found.then(found.inverse()).apply(source), source, atol=1e-8)


@pytest.mark.parametrize("scale", [False, True])
def test_least_squares_cannot_be_improved_by_a_nudge(scale: bool) -> None:
    random = np.random.default_rng(1)
    source, target, weights = random.normal(size=(40, 3)), random.normal(size=(40, 3)), random.uniform(0, 2, 40)
    found = align(source, target, weights=weights, scale=scale)
    best = cost(found, source, target, weights)
    assert best < cost(align(source, target, scale=scale), source, target, weights)
    for _ in range(200):
        nudged = Similarity(
            turn(random.normal(0, 1e-2, 3)) @ found.rotation,
            found.translation + random.normal(0, 1e-2, 3),
            found.scale * (1 + random.normal(0, 1e-2) * scale),
        )
        assert cost(nudged, source, target, weights) > best


def test_points_of_no_weight_do_not_count() -> None:
    source = np.random.default_rng(2).normal(size=(20, 3))
    target = source @ turn([0, 0, 1.0]).T
    target[:5] += 100
    weights = np.r_[np.zeros(5), np.ones(15)]
    for found in (align(source, target, weights=weights), robust_align(source, target, weights=weights)):
        np.testing.assert_allclose(found.rotation, turn([0, 0, 1.0]), atol=1e-12)


def test_the_rotation_is_proper_even_for_a_mirror_image() -> None:
    source = face()
    found = align(source, source * [-1, 1, 1], scale=True)
    assert np.linalg.det(found.rotation) == pytest.approx(1)
    np.testing.assert_allclose(found.rotation @ found.rotation.T, np.eye(3), atol=1e-12)
    flat = source * [1, 1, 0]
    np.testing.assert_allclose(align(flat, flat @ turn([1.0, 2, 3]).T).rotation, turn([1.0, 2, 3]), atol=1e-12)


@pytest.mark.parametrize("points", [np.linspace(0, 1, 9)[:, None] * [1.0, 2, 3], np.ones((9, 3)), np.eye(3)[:2]])
def test_points_that_determine_nothing(points: Array) -> None:
    for how in (align, robust_align):
        with pytest.raises(FaceDiffError, match="do not determine a rotation"):
            how(points, points)


def angle(rotation: Array) -> float:
    """Degrees."""
    return float(np.degrees(np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1))))


@pytest.mark.parametrize("scale", [False, True])
@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("kind", ["drop", "hinge", "collapse"])
def test_two_fifths_of_the_face_that_move_as_one_do_not_count(kind: str, axis: int, scale: bool) -> None:
    """Re-weighting that starts from least squares ends far off in most of these cases: the start must be robust too."""
    rest = 1000 * face()
    gone = np.argsort(rest[:, axis])[: round(0.42 * len(rest))]
    moved, hinge = rest.copy(), np.array([0.0, 10.0, -60.0])
    if kind == "drop":
        moved[gone] += [0, -60, 18]
    elif kind == "hinge":
        moved[gone] = (moved[gone] - hinge) @ turn([np.radians(40), 0, 0]).T + hinge
    else:
        moved[gone] = [200, -300, 100]
    found = robust_align(moved, rest, scale=scale)
    np.testing.assert_allclose(found.rotation, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(found.translation, 0, atol=1e-7)
    assert found.scale == pytest.approx(1, abs=1e-9)


def test_gross_errors_and_noise() -> None:
    random = np.random.default_rng(4)
    rest = 1000 * face()
    seen = rest + random.normal(0, 0.3, rest.shape)
    wrong = random.permutation(len(rest))[: len(rest) * 2 // 5]
    seen[wrong] += random.normal(0, 80, (len(wrong), 3))
    good = np.setdiff1d(np.arange(len(rest)), wrong)
    found = robust_align(seen, rest, scale=True)
    best = align(seen[good], rest[good], scale=True)
    assert angle(found.rotation @ best.rotation.T) < 0.05
    assert found.scale == pytest.approx(best.scale, abs=2e-3)
    assert robust_align(seen, rest, scale=True).scale == found.scale  # the same every time


def test_face_size_is_the_distance_from_the_mean() -> None:
    assert face_size(np.array([[1.0, 0, 0], [-1, 0, 0], [0, 2, 0], [0, -2, 0]]) + 7) == pytest.approx(np.sqrt(2.5))


def test_head_motion_is_removed_and_returned() -> None:
    known = person(frames=40)
    rest = 1000 * face()
    laid = remove_rigid_motion(known.seen, rest, np.flatnonzero(~lower_face()))
    np.testing.assert_allclose(laid.frames, 1000 * known.truth, atol=1e-6)
    np.testing.assert_allclose(laid.rotations, known.rotations.swapaxes(1, 2), atol=1e-9)
    again = known.seen @ laid.rotations.swapaxes(1, 2) + laid.translations[:, None]
    np.testing.assert_allclose(again, laid.frames, atol=1e-9)
    still = ~lower_face()
    left = np.sqrt(((1000 * known.truth - rest)[:, still] ** 2).sum(-1).mean(-1))
    np.testing.assert_allclose(laid.residuals, left, atol=1e-6)


def test_all_vertices_are_used_where_no_stable_ones_are_given() -> None:
    known = person(frames=12)
    laid = remove_rigid_motion(known.seen, 1000 * face())
    np.testing.assert_allclose(laid.frames, 1000 * known.truth, atol=1e-6)


@pytest.mark.slow
def test_chunks_do_not_show_and_memory_stays_small(tmp_path: Path) -> None:
    """Frames and result lie on disk; what is in memory does not grow with the number of frames."""
    seen = np.tile(person(frames=120).seen, (5, 1, 1))
    np.save(tmp_path / "seen.npy", seen)
    source = np.load(tmp_path / "seen.npy", mmap_mode="r")
    out = np.lib.format.open_memmap(tmp_path / "out.npy", mode="w+", dtype=np.float32, shape=source.shape)
    tracemalloc.start()
    remove_rigid_motion(source, 1000 * face(), out=out, chunk_bytes=12 * source[0].nbytes)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < seen.nbytes / 4
    whole = remove_rigid_motion(seen, 1000 * face()).frames
    np.testing.assert_allclose(out, whole, atol=2e-5)
    inplace = seen[:5].copy()
    assert remove_rigid_motion(inplace, 1000 * face(), out=inplace).frames is inplace
    np.testing.assert_allclose(inplace, whole[:5], atol=1e-9)


def test_frames_of_whole_numbers_are_not_rounded() -> None:
    target = np.rint(1000 * face())
    frames = np.stack([target, target @ np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), target + 1]).astype(np.int32)
    found = remove_rigid_motion(frames, target)
    np.testing.assert_allclose(found.frames, np.broadcast_to(target, frames.shape), atol=1e-6)
    assert found.residuals.max() < 1e-6


def test_stable_vertices_are_those_that_do_not_move() -> None:
    known = person(frames=90)
    stable = stable_vertices(known.seen)
    assert len(stable) == round(0.3 * len(face()))
    assert not lower_face()[stable].any()
    assert not np.isin(stable, known.restless).any()
    assert np.array_equal(stable, np.unique(stable))


def test_the_median_face_is_the_median_of_every_coordinate_in_the_pose_of_the_middle() -> None:
    known = person(frames=61, outliers=0)  # few enough for all of them to be looked at
    found = median_face(known.seen, stable_vertices(known.seen))
    true = np.median(1000 * known.truth @ known.rotations[30].T, axis=0)
    np.testing.assert_allclose(found, true - true.mean(0), atol=1e-6)
