"""Numbers without meaning (NaN, 1e30, indices of no vertex) are refused before they become a result."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from facediff.animation import metres_per_unit, write_archive
from facediff.cli.app import main
from facediff.editing.correspondence import correspond
from facediff.editing.landmarks import read_landmarks
from facediff.editing.retargeting import load_correspondence, save_correspondence
from facediff.errors import FaceDiffError
from tests.fakes.clicks import clicks


@pytest.fixture
def archive(tmp_path: Path) -> dict[str, Any]:
    write_archive(tmp_path / "good.npz", clicks())
    return dict(np.load(tmp_path / "good.npz"))


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e30])
@pytest.mark.parametrize("suffix", ["npy", "npz", "obj", "glb", "mdd", "pc2", "html"])
def test_no_format_is_written_of_absurd_motion(
    value: float, suffix: str, archive: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    archive["vertices"][-1, -1, -1] = value
    np.savez(tmp_path / "bad.npz", **archive)
    assert main(["export", str(tmp_path / "bad.npz"), "-o", str(tmp_path / f"out.{suffix}")]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
    assert {path.name for path in tmp_path.iterdir()} == {"good.npz", "bad.npz"}


@pytest.mark.parametrize("unit", ["1e-300", "1e300", "0", "-1", "nan", "inf", "parsec", "", "1e-46"])
def test_units_that_single_precision_does_not_hold_are_refused(
    unit: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(FaceDiffError, match="unit"):
        metres_per_unit(unit)
    write_archive(tmp_path / "good.npz", clicks())
    command = ["export", str(tmp_path / "good.npz"), "-o", str(tmp_path / "out.npy"), "--output-unit", unit]
    assert main(command) == 2
    assert "unit" in capsys.readouterr().err
    assert not (tmp_path / "out.npy").exists()


@pytest.mark.parametrize(
    "text",
    [
        "1,2\n-3,4\n",
        "1,2\n3.5,4\n",
        "1,2\n\u00b2,4\n",
        f"1,2\n{'9' * 30},4\n",
        "1,2\nnan,inf\n",
    ],
)
def test_landmarks_that_are_no_vertices_are_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "marks.csv").write_text(text, encoding="utf-8")
    with pytest.raises(FaceDiffError, match=r"marks\.csv"):
        read_landmarks(tmp_path / "marks.csv")


def test_a_correspondence_of_a_later_format_is_refused(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=1)
    path = tmp_path / "map.npz"
    save_correspondence(path, correspond(ball.vertices, ball.faces, ball.vertices, ball.faces))
    held = dict(np.load(path))
    number = int(str(held["format"]).rpartition(" ")[2])
    held["format"] = np.array(str(held["format"]).rpartition(" ")[0] + f" {number + 1}")
    np.savez(path, **held)
    with pytest.raises(FaceDiffError, match=r"map\.npz.*format"):
        load_correspondence(path)


FACE = clicks()
MESHES = {
    "point": (FACE.template * 0, FACE.faces),
    "line": (FACE.template * [1, 0, 0], FACE.faces),
    "degenerate": (FACE.template, np.zeros((10, 3), int)),
    "one triangle": (FACE.template[:3], np.array([[0, 1, 2]])),
    "huge": (FACE.template * 1e20, FACE.faces),
}


@pytest.mark.parametrize("name", MESHES)
def test_motion_is_not_carried_to_a_mesh_that_is_no_face(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    vertices, faces = MESHES[name]
    write_archive(tmp_path / "good.npz", FACE)
    lines = [f"v {x} {y} {z}\n" for x, y, z in vertices] + [f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in faces]
    (tmp_path / "other.obj").write_text("".join(lines))
    files = [str(tmp_path / file) for file in ("good.npz", "other.obj", "out.npz")]
    assert main(["retarget", files[0], "--target-mesh", files[1], "-o", files[2]]) == 2
    error = capsys.readouterr().err.strip()
    assert len(error.splitlines()) == 1
    assert "other.obj" in error


def test_scores_of_absurd_motion_are_not_given(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Squares of 1e30 are infinite in single precision: the scores would be, too."""
    for folder, factor in (("truth", 1.0), ("pred", 1e30)):
        (tmp_path / folder).mkdir()
        np.save(tmp_path / folder / "A_s1.npy", np.float32(factor) * np.ones((5, 4, 3), np.float32))
    folders = [str(tmp_path / folder) for folder in ("pred", "truth")]
    assert main(["evaluate", *folders, "--lips", "all", "--protocol", "meshtalk"]) == 2
    assert "A_s1" in capsys.readouterr().err
