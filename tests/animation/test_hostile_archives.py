"""Archives and arrays of animations whose numbers are wrong are refused by name, never read as something else."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from facediff.animation import Animation, metres_per_unit, read_animation, read_archive, write_archive
from facediff.animation.files import FORMAT
from facediff.errors import FaceDiffError
from facediff.utils.limits import quoted
from tests.fakes.clicks import clicks


@pytest.fixture
def held(tmp_path: Path) -> dict[str, Any]:
    write_archive(tmp_path / "whole.npz", clicks())
    with np.load(tmp_path / "whole.npz") as archive:
        return dict(archive)


def refused(path: Path, words: str = "") -> None:
    with pytest.raises(FaceDiffError, match=path.name) as error:
        read_animation(path)
    assert words in str(error.value)
    assert "\n" not in str(error.value)


WRONG_FACTS: list[tuple[str, object]] = [
    ("format", "facediff take 2"),
    ("format", "facediff take"),
    ("format", 1),
    ("format", None),
    *(("frame_rate", rate) for rate in (0, -25, 1e-300, 1e300, "25", True, None, [25], 10**400)),
    *(("sample_rate", rate) for rate in (0, -1, 1, 1e9, 16000.5, "16000", True, None)),
    *(("unit", unit) for unit in ("", "nan", "inf", "1e-300", "1e300", "-1", 1, None)),
    ("name", None),
    ("name", 3),
    ("metadata", []),
    ("metadata", {"seed": 3}),
    ("metadata", None),
]


@pytest.mark.parametrize(("field", "value"), WRONG_FACTS, ids=quoted)
def test_facts_of_an_archive_that_are_wrong_are_refused(
    held: dict[str, Any], tmp_path: Path, field: str, value: object
) -> None:
    about = {**json.loads(str(held["about"])), field: value}
    np.savez(tmp_path / "a.npz", **{**held, "about": np.array(json.dumps(about))})
    refused(tmp_path / "a.npz")


def test_archive_of_a_later_format_says_so(held: dict[str, Any], tmp_path: Path) -> None:
    about = json.loads(str(held["about"]))
    assert about["format"] == FORMAT
    np.savez(tmp_path / "a.npz", **{**held, "about": np.array(json.dumps({**about, "format": "facediff take 2"}))})
    refused(tmp_path / "a.npz", "update facediff")


@pytest.mark.parametrize(
    "about", ["", "[]", "null", "{", '{"format": NaN}', "[" * 9999, '{"format": "facediff take 1"}', "\x00"]
)
def test_facts_of_an_archive_that_are_no_facts_are_refused(held: dict[str, Any], tmp_path: Path, about: str) -> None:
    np.savez(tmp_path / "a.npz", **{**held, "about": np.array(about)})
    refused(tmp_path / "a.npz")
    np.savez(tmp_path / "b.npz", **{**held, "about": np.array([about, about])})
    refused(tmp_path / "b.npz")
    np.savez(tmp_path / "c.npz", **{**held, "about": np.zeros(3)})
    refused(tmp_path / "c.npz")


def spoilt(array: np.ndarray, value: float) -> np.ndarray:
    array = array.copy()
    array.flat[array.size // 2] = value
    return array


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e30])
@pytest.mark.parametrize("name", ["vertices", "template", "speech"])
def test_numbers_of_an_archive_that_are_not_finite_are_refused(
    held: dict[str, Any], tmp_path: Path, name: str, value: float
) -> None:
    np.savez(tmp_path / "a.npz", **{**held, name: spoilt(held[name], value)})
    if name == "speech" and math.isfinite(value):
        return
    refused(tmp_path / "a.npz", "NaN")
    np.savez(tmp_path / "b.npz", **{**held, name: spoilt(held[name].astype(np.float64), 1e300)})
    refused(tmp_path / "b.npz", "NaN")


@pytest.mark.parametrize("kind", ["c8", "c16", "?", "U5", "S5", "i4", "u8"])
@pytest.mark.parametrize("name", ["vertices", "template", "speech"])
def test_numbers_of_an_archive_of_another_kind_are_refused(
    held: dict[str, Any], tmp_path: Path, name: str, kind: str
) -> None:
    np.savez(tmp_path / "a.npz", **{**held, name: np.zeros_like(held[name]).astype(kind)})
    refused(tmp_path / "a.npz", name)


@pytest.mark.parametrize("order", ["<f8", ">f4", ">f8", "<f2", "fortran"])
def test_numbers_of_an_archive_become_single_precision(held: dict[str, Any], tmp_path: Path, order: str) -> None:
    changed = {
        name: np.asfortranarray(held[name]) if order == "fortran" else held[name].astype(order)
        for name in ("vertices", "template", "speech")
    }
    faces = held["faces"].astype(">i8")
    np.savez(tmp_path / "a.npz", **{**held, **changed, "faces": faces})
    animation = read_archive(tmp_path / "a.npz")
    for name in changed:
        assert getattr(animation, name).dtype == np.dtype("float32")
        np.testing.assert_allclose(getattr(animation, name), held[name], rtol=1e-2, atol=1e-4)
    assert animation.faces is not None
    assert animation.faces.dtype == np.dtype("int32")
    assert np.array_equal(animation.faces, held["faces"])


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("faces", np.array([[0, 1, 2**40]])),
        ("faces", np.array([[0, 1, 2**64 - 1]], np.uint64)),
        ("faces", np.array([[0, -1, 2]])),
        ("colours", np.zeros((2, 3), np.uint8)),
        ("colours", np.full((6, 3), 300, np.uint16)),
        ("template", np.zeros((2, 3), np.float32)),
        ("region_a", np.array([[0, 1]])),
        ("region_a", np.array([0, 2**40])),
        ("region_a", np.array(0)),
    ],
    ids=quoted,
)
def test_parts_of_an_archive_that_do_not_fit_are_refused(
    held: dict[str, Any], tmp_path: Path, name: str, value: np.ndarray
) -> None:
    np.savez(tmp_path / "a.npz", **{**held, name: value})
    refused(tmp_path / "a.npz")


def test_entries_of_other_names_are_ignored(held: dict[str, Any], tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", **held, mine=np.array([{"a": 1}], object), allow_pickle=True)
    assert read_archive(tmp_path / "a.npz").name == clicks().name


@pytest.mark.parametrize("value", [math.nan, math.inf, 1e30, 1e300])
def test_array_that_is_not_finite_is_refused_before_it_is_written(tmp_path: Path, value: float) -> None:
    motion = np.zeros((4, 6, 3))
    motion[2, 3, 1] = value
    np.save(tmp_path / "a.npy", motion)
    template = np.zeros((6, 3), np.float32)
    animation = read_animation(tmp_path / "a.npy", {"frame_rate": 25.0, "template": template})
    with pytest.raises(FaceDiffError, match="frame 2 holds NaN"):
        write_archive(tmp_path / "b.npz", animation)
    assert [path.name for path in tmp_path.iterdir()] == ["a.npy"]


@pytest.mark.parametrize("kind", ["c8", "?", "i4", "U3", "M8[s]"])
def test_array_of_another_kind_is_refused(tmp_path: Path, kind: str) -> None:
    np.save(tmp_path / "a.npy", np.zeros((4, 6, 3)).astype(kind))
    refused(tmp_path / "a.npy")


@pytest.mark.parametrize("field", ["template", "speech"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_animation_that_is_not_finite_cannot_be_made(field: str, value: float) -> None:
    with pytest.raises(FaceDiffError, match=field):
        Animation(
            "a",
            np.zeros((2, 4, 3), np.float32),
            frame_rate=25,
            **{"template": np.zeros((4, 3), np.float32), field: np.full((4, 3), value, np.float32)},
        )


@pytest.mark.parametrize("unit", ["1e-300", "1e300", "nan", "-1", "0", "", "about 1e9 mm", "x" * 9999])
def test_unit_out_of_range_is_refused(unit: str) -> None:
    with pytest.raises(FaceDiffError, match="unit") as error:
        metres_per_unit(unit)
    assert len(str(error.value)) < 300
