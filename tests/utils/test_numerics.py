"""What the runtime does without SciPy, against SciPy and NumPy's dense solvers."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import butter, sosfilt
from scipy.spatial import cKDTree

from facediff.render.meshes import VertexSums
from facediff.speech.voice_activity import SPEECH_BAND
from facediff.utils.numerics import BLOCK, RecursiveFilter, nearest_distances, solve_block_chain


def test_the_speech_band_is_butterworths() -> None:
    band = butter(2, (150.0, 5000.0), "bandpass", fs=16_000, output="sos")
    np.testing.assert_allclose(SPEECH_BAND, band, rtol=1e-12)


@pytest.mark.parametrize("sizes", [[5000], [1, BLOCK - 1, BLOCK, BLOCK + 1, 0, 7], [1] * 300])
def test_recursive_filter_equals_scipys_whatever_the_pieces(sizes: list[int]) -> None:
    samples = np.random.default_rng(0).normal(size=sum(sizes))
    found = RecursiveFilter(SPEECH_BAND)
    places = np.cumsum(sizes)[:-1]
    made = np.concatenate([found.feed(piece) for piece in np.split(samples, places)])
    np.testing.assert_allclose(made, sosfilt(np.array(SPEECH_BAND), samples), atol=1e-12)


def test_nearest_by_chunks_equals_a_tree(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(1)
    points, others = rng.normal(size=(200, 3)), rng.normal(size=(30, 3))
    wanted = cKDTree(others).query(points, distance_upper_bound=0.7)[0]
    monkeypatch.setattr("facediff.utils.numerics.CHUNK", 500)  # several chunks
    np.testing.assert_allclose(nearest_distances(points, others, 0.7), wanted)
    assert np.isinf(wanted).any()
    assert np.isfinite(wanted).any()


@pytest.mark.parametrize(("frames", "count"), [(1, 1), (1, 4), (6, 3)])
def test_block_chain_equals_a_dense_solver(frames: int, count: int) -> None:
    rng = np.random.default_rng(2)
    root = rng.normal(size=(frames, count, count))
    blocks = root @ root.swapaxes(1, 2) + 5 * np.eye(count)
    links, right = -rng.random((frames - 1, count)), rng.normal(size=(frames, count))
    dense = np.zeros((frames * count, frames * count))
    for t in range(frames):
        dense[t * count : (t + 1) * count, t * count : (t + 1) * count] = blocks[t]
    for t, link in enumerate(links):
        one, other = (np.arange(count) + place * count for place in (t, t + 1))
        dense[one, other] = dense[other, one] = link
    found = solve_block_chain(blocks, links, right)
    np.testing.assert_allclose(found.ravel(), np.linalg.solve(dense, right.ravel()))


def test_sums_at_vertices_do_not_need_scipy(monkeypatch: pytest.MonkeyPatch) -> None:
    faces = np.array([[0, 1, 2], [2, 1, 3], [3, 1, 0]], np.int32)
    values = np.random.default_rng(3).normal(size=(3, 3))
    wanted = VertexSums(faces, 5)(values)
    monkeypatch.setattr("facediff.render.meshes.has_scipy", lambda: False)
    np.testing.assert_allclose(VertexSums(faces, 5)(values), wanted)
