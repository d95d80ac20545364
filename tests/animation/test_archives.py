"""Archives of animations: their numbers become single precision, and wrong ones are refused by the file's name."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from facediff.animation import read_animation, read_archive, write_archive
from facediff.errors import FaceDiffError
from tests.fakes.clicks import clicks


@pytest.fixture
def held(tmp_path: Path) -> dict[str, Any]:
    write_archive(tmp_path / "whole.npz", clicks())
    with np.load(tmp_path / "whole.npz") as archive:
        return dict(archive)


@pytest.mark.parametrize(
    "facts",
    [
        {"format": "facediff take 2"},
        {"format": None},
        {"frame_rate": 0},
        {"frame_rate": "25"},
        {"sample_rate": 1},
        {"unit": "nan"},
        {"name": 3},
        {"metadata": {"seed": 3}},
    ],
)
def test_wrong_facts_are_refused(held: dict[str, Any], tmp_path: Path, facts: dict[str, Any]) -> None:
    about = {**json.loads(str(held["about"])), **facts}
    np.savez(tmp_path / "a.npz", **{**held, "about": np.array(json.dumps(about))})
    with pytest.raises(FaceDiffError, match="a.npz"):
        read_animation(tmp_path / "a.npz")


@pytest.mark.parametrize("name", ["vertices", "template"])
@pytest.mark.parametrize("value", [np.nan, 1e30])
def test_numbers_that_are_not_finite_are_refused(held: dict[str, Any], tmp_path: Path, name: str, value: float) -> None:
    spoilt = held[name].copy()
    spoilt.flat[spoilt.size // 2] = value
    np.savez(tmp_path / "a.npz", **{**held, name: spoilt})
    with pytest.raises(FaceDiffError, match="a.npz.*NaN"):
        read_animation(tmp_path / "a.npz")


@pytest.mark.parametrize("order", ["<f8", ">f4", "<f2", "fortran"])
def test_numbers_become_single_precision(held: dict[str, Any], tmp_path: Path, order: str) -> None:
    changed = {
        name: np.asfortranarray(held[name]) if order == "fortran" else held[name].astype(order)
        for name in ("vertices", "template", "speech")
    }
    np.savez(tmp_path / "a.npz", **{**held, **changed, "faces": held["faces"].astype(">i8")})
    animation = read_archive(tmp_path / "a.npz")
    for name in changed:
        assert getattr(animation, name).dtype == np.dtype("float32")
        np.testing.assert_allclose(getattr(animation, name), held[name], rtol=1e-2, atol=1e-4)
    assert animation.faces is not None
    assert np.array_equal(animation.faces, held["faces"])
