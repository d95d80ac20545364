"""Corpus folders whose files are damaged, absurd or hostile are refused by name."""

from __future__ import annotations

import math
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from facediff.data.corpus import Corpus, read_clip_table, read_templates
from facediff.data.reconstructions import read_parameters
from facediff.errors import FaceDiffError
from facediff.utils.limits import quoted

FACE = np.random.default_rng(0).normal(size=(9, 3))


@pytest.mark.parametrize(
    "value",
    [
        FACE + 1j,
        FACE.astype(int),
        [[0.0], [1.0, 2.0]],
        [FACE.tolist()],
        "face",
        np.where(FACE[2, 1] == FACE, math.nan, FACE),
        FACE * 1e13,
        FACE[:, :2],
        np.zeros((0, 3)),
    ],
    ids=lambda value: quoted(getattr(value, "dtype", value)),
)
def test_template_that_is_no_face_is_refused(value: Any, tmp_path: Path) -> None:  # noqa: ANN401
    (tmp_path / "templates.pkl").write_bytes(pickle.dumps({"A": FACE, "B": value}))
    with pytest.raises(FaceDiffError, match=r"templates\.pkl.*'B'") as refused:
        read_templates(tmp_path / "templates.pkl", 9)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("value", [FACE, FACE.astype("f4"), FACE.astype(">f8"), FACE.ravel(), FACE.tolist()])
def test_template_of_floating_point_numbers_is_read(value: Any, tmp_path: Path) -> None:  # noqa: ANN401
    (tmp_path / "templates.pkl").write_bytes(pickle.dumps({"A": value}))
    np.testing.assert_allclose(read_templates(tmp_path / "templates.pkl")["A"], FACE, atol=1e-6)


@pytest.mark.parametrize(
    "content",
    [
        b"clip,mood\nA_01\n",
        b"clip,mood\nA_01,sad\nA_01,glad\n",
        b'clip,mood\nA_01,"sad\nglad"\n',
        b"clip,mood\nA_01,\x1b[31m\n",
        b"mood\nsad\n",
        "clip,mood\nA_01,sad\n".encode("utf-16")[:-1],
        b"clip,mood\nA_01," + b"x" * 200_000,
    ],
    ids=quoted,
)
def test_clip_table_with_a_damaged_row_is_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "clips.csv").write_bytes(content)
    with pytest.raises(FaceDiffError, match=r"clips\.csv") as refused:
        read_clip_table(tmp_path)
    assert str(refused.value).isprintable()


def test_parameters_that_lie_in_another_file_are_refused(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    widths = {"shape": 300, "exp": 100, "jaw": 3}
    with h5py.File(tmp_path / "other.h5", "w") as other:
        for name, width in widths.items():
            other[f"data/{name}"] = np.zeros((1, 5, width))
    assert len(read_parameters(tmp_path / "other.h5").jaw) == 5
    with h5py.File(tmp_path / "group.h5", "w") as file:
        file["data"] = h5py.ExternalLink("other.h5", "/data")
    with h5py.File(tmp_path / "soft.h5", "w") as file:
        for name in widths:
            file[f"far_{name}"] = h5py.ExternalLink("other.h5", f"/data/{name}")
            file[name] = h5py.SoftLink(f"/far_{name}")
    with h5py.File(tmp_path / "complex.h5", "w") as file:
        for name, width in widths.items():
            file[name] = np.zeros((1, 5, width), complex)
    with h5py.File(tmp_path / "raw.h5", "w") as file:
        for name, width in widths.items():
            file.create_dataset(name, (1, 5, width), "<f4", external=[(str(tmp_path / "other.h5"), 0, 1000 * width)])
    for name in ("group", "soft", "complex", "raw"):
        with pytest.raises(FaceDiffError, match=rf"{name}\.h5"):
            read_parameters(tmp_path / f"{name}.h5")


@pytest.mark.parametrize("row", ["0 6 7", "0, 6, 7", "upper, lower"])
def test_pairs_of_vertices_that_are_none_are_named_with_their_row(row: str, tmp_path: Path) -> None:
    (tmp_path / "pairs.txt").write_text(f"0, 6\n{row}\n")
    with pytest.raises(FaceDiffError, match=rf"pairs\.txt: row 2 is '{row}'; expected .* such as 12, 34"):
        Corpus(tmp_path, n_vertices=9, frame_rate=25.0).read_pairs("pairs.txt")
    (tmp_path / "pairs.txt").write_text("0, 6\n 1 7\n")
    pairs = Corpus(tmp_path, n_vertices=9, frame_rate=25.0).read_pairs("pairs.txt")
    assert pairs is not None
    assert pairs.tolist() == [[0, 6], [1, 7]]
