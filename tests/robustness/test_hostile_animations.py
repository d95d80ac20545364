"""Animations, correspondences and small text files whose facts are no facts: numbers, marks of formats, indices."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from facediff.animation import metres_per_unit, read_animation, write_archive
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


def about(**changes: object) -> dict[str, Any]:
    return {"about": changes}


CHANGES: dict[str, dict[str, Any]] = {
    "of a later format": about(format="facediff take 2"),
    "of another format": about(format="something"),
    "of format 1.0": about(format=1.0),
    "with a rate of 0": about(frame_rate=0),
    "with a negative rate": about(frame_rate=-25),
    "with a rate of 1e300": about(frame_rate=1e300),
    "with a rate of text": about(frame_rate="25"),
    "with a true rate": about(frame_rate=True),
    "with a list as rate": about(frame_rate=[25]),
    "with a sample rate of 0": about(sample_rate=0),
    "with a broken sample rate": about(sample_rate=16000.5),
    "with a unit of 1e-300": about(unit="1e-300"),
    "with a unit of nan": about(unit="nan"),
    "with metadata of a list": about(metadata=[1]),
    "with half a character": about(name="\udcff"),
    "with complex vertices": {"vertices": lambda a: a.astype(np.complex64)},
    "with a complex template": {"template": lambda a: a.astype(np.complex64)},
    "with a template of whole numbers": {"template": lambda a: a.astype(int)},
    "with a template of another mesh": {"template": lambda a: a[:-1]},
    "with faces of numbers": {"faces": lambda a: a.astype(float)},
    "with faces beyond": {"faces": lambda a: a + 10**6},
    "with negative faces": {"faces": lambda a: -a - 1},
    "with colours of two bytes": {"colours": lambda a: np.full((len(a), 3), 300, np.uint16)},
    "with a region beyond": {"region_lips": lambda a: np.array([10**6])},
    "with a negative region": {"region_lips": lambda a: np.array([-1])},
    "with a region of numbers": {"region_lips": lambda a: np.array([0.5])},
    "with a region of pairs": {"region_lips": lambda a: np.array([[0, 1]])},
}


@pytest.mark.parametrize("name", CHANGES)
def test_an_animation_that_is_none_is_refused_by_name(name: str, archive: dict[str, Any], tmp_path: Path) -> None:
    for entry, change in CHANGES[name].items():
        if entry == "about":
            archive["about"] = np.array(json.dumps(json.loads(str(archive["about"])) | change))
        else:
            archive[entry] = change(archive.get(entry, archive["template"]))
    np.savez(tmp_path / "bad.npz", **archive)
    with pytest.raises(FaceDiffError) as error:
        read_animation(tmp_path / "bad.npz")
    assert "\n" not in str(error.value)
    assert "bad.npz" in str(error.value) or "unit" in name or "faces" in name or "template" in name


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
        "1,2\n3,4,5\n",
        "1,2\n3\n",
        "1,2\n-3,4\n",
        "1,2\n3.5,4\n",
        "1,2\n\u00b2,4\n",
        f"1,2\n{'9' * 30},4\n",
        f"1,2\n{'9' * 9999},4\n",
        "source,target\n",
        "",
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


EYES = [
    '{"lids": [], "lids": []}',
    '{"eyeballs": [[NaN]]}',
    '{"eyeballs": [[-1]]}',
    '{"eyeballs": [[1e30]]}',
    '{"eyeballs": [[10000000000000000000000000]]}',
    '{"eyeballs": [[0.5]]}',
    '{"eyeballs": [[[[1]]]]}',
    '{"eyeballs": [[1, "a"]]}',
    '{"eyeballs": [[1, [2]]]}',
    '{"eyeballs": ["/dev/zero"]}',
    '{"eyeballs": ["/dev/zero.pkl:left"]}',
    '{"blinks": ["/dev/zero"], "neutral": "/dev/zero"}',
    '{"blinks": [1, 2]}',
    '{"neutral": "a\\u0000b"}',
    '{"lids": [{"upper": [0, 1], "lower": [99]}]}',
    '{"lids": [{"upper": [], "lower": []}]}',
    '{"lids": [1]}',
    "[1]",
    "",
]


@pytest.mark.parametrize("text", EYES)
def test_eyes_that_are_none_are_refused(text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_archive(tmp_path / "good.npz", clicks())
    (tmp_path / "eyes.json").write_text(text, encoding="utf-8")
    command = ["export", "good.npz", "-o", "out.npz", "--blinks", "--eyes", "eyes.json"]
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path)
        assert main(command) == 2
    error = capsys.readouterr().err.strip()
    assert len(error.splitlines()) == 1
    assert "eyes.json" in error or "/dev/zero" in error
    assert not (tmp_path / "out.npz").exists()


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
