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


def test_damaged_correspondences_are_refused(found: Correspondence, tmp_path: Path) -> None:
    path = tmp_path / "map.npz"
    with pytest.raises(FaceDiffError, match="no such file"):
        load_correspondence(path)
    with pytest.raises(FaceDiffError, match=r"expected a correspondence \.npz"):
        save_correspondence(tmp_path / "map.txt", found)
    save_correspondence(path, found)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(FaceDiffError, match="not a readable .npz"):
        load_correspondence(path)
    np.savez(path, vertices=np.zeros(3))
    with pytest.raises(FaceDiffError, match="is no correspondence"):
        load_correspondence(path)
    path.write_bytes(whole)
    with np.load(path) as archive:
        held = dict(archive)
    for name, wrong, says in (
        ("corners", held["corners"] + 1000, "do not fit"),
        ("weights", held["weights"][1:], "do not fit"),
        ("share", np.full(42, np.nan), "share are damaged"),
        ("scale", np.array("x"), "scale are damaged"),
        ("scale", np.array(0.0), "do not fit"),
        ("rotation", np.full((3, 3), np.nan), "rotation are damaged"),
        ("target_faces", held["target_faces"].astype(float), "target_faces are damaged"),
    ):
        np.savez(path, **{**held, name: wrong})
        with pytest.raises(FaceDiffError, match=says):
            load_correspondence(path)
    np.save(tmp_path / "bare.npy", held["share"])
    (tmp_path / "bare.npy").rename(path)
    with pytest.raises(FaceDiffError, match="not a readable .npz"):
        load_correspondence(path)


@pytest.mark.parametrize("text", ["1,2\n3,4\n", "source,target\n1,2\n\n3, 4\n", "\ufeff1,2\r\n3,4\r\n"])
def test_landmarks(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.csv").write_text(text, encoding="utf-8")
    assert read_landmarks(tmp_path / "a.csv").nearest_vertices.tolist() == [[1, 2], [3, 4]]


def test_a_correspondence_of_another_face_is_refused_and_a_sculpted_one_kept() -> None:
    own = np.random.default_rng(0).uniform(-1, 1, (100, 3))
    nose = own.copy()
    nose[:30] += 0.2
    refuse_other_face("mesh.obj", nose, own)
    with pytest.raises(FaceDiffError, match=r"mesh\.obj: .*another face"):
        refuse_other_face("mesh.obj", 1.02 * own, own)
