"""Correspondences come back from disk as they were; damaged files and landmarks are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from facediff.editing.correspondence import Correspondence, correspond, refuse_other_face
from facediff.editing.landmarks import read_landmarks
from facediff.editing.retargeting import load_correspondence, save_correspondence
from facediff.errors import FaceDiffError
from tests.fakes.heads import nearest_vertices


@pytest.fixture(scope="module")
def found() -> Correspondence:
    coarse, fine = trimesh.creation.icosphere(1), trimesh.creation.icosphere(2)
    shape = np.array([1.0, 1.4, 1.2])
    return correspond(fine.vertices * shape, fine.faces, 10 * coarse.vertices * shape, coarse.faces)


def test_what_is_saved_comes_back(found: Correspondence, tmp_path: Path) -> None:
    save_correspondence(tmp_path / "map.npz", found)
    back = load_correspondence(tmp_path / "map.npz")
    for name, value in vars(found).items():
        if isinstance(value, np.ndarray):
            assert np.array_equal(getattr(back, name), value)
    assert np.array_equal(back.similarity.rotation, found.similarity.rotation)
    assert back.similarity.scale == found.similarity.scale
    with np.load(tmp_path / "map.npz", allow_pickle=False) as archive:
        assert "corners" in archive.files


@pytest.mark.parametrize("text", ["1,2\n3,4\n", "source,target\n1,2\n\n3, 4\n", "\ufeff1,2\r\n3,4\r\n"])
def test_landmarks(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.csv").write_text(text, encoding="utf-8")
    assert nearest_vertices(read_landmarks(tmp_path / "a.csv")) == [[1, 2], [3, 4]]


def test_a_correspondence_of_another_face_is_refused_and_a_sculpted_one_kept() -> None:
    own = np.random.default_rng(0).uniform(-1, 1, (100, 3))
    nose = own.copy()
    nose[:30] += 0.2
    refuse_other_face("mesh.obj", nose, own)
    with pytest.raises(FaceDiffError, match=r"mesh\.obj: .*another face"):
        refuse_other_face("mesh.obj", 1.02 * own, own)
