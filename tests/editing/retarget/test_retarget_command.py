"""``facediff retarget``: an animation on another mesh, correspondences that are used again, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from facediff.animation import Animation, read_archive, write_archive
from facediff.cli.app import main
from facediff.editing.controls.procedural import move_head
from facediff.editing.retargeting import retarget
from facediff.mesh.glb import open_glb
from facediff.render import Look
from tests.fakes.glb_targets import File
from tests.fakes.meshes import write_obj

TARGET = ("--target-mesh", "face.obj")


@pytest.fixture
def animation(tmp_path: Path) -> Animation:
    """An egg with a bump that moves, as an archive in the folder."""
    mesh = trimesh.creation.icosphere(3)
    rest = np.array(mesh.vertices) * [0.08, 0.12, 0.1]
    bump = np.exp(-np.square((rest - [0, -0.04, 0.09]) / 0.05).sum(axis=1))
    vertices = rest + np.array([0.0, 1.0, 0.4])[:, None, None] * bump[:, None] * [0.0, -0.02, 0.01]
    animation = Animation(
        "egg", vertices.astype(np.float32), rest.astype(np.float32), 30.0, faces=np.array(mesh.faces, np.int32)
    )
    write_archive(tmp_path / "take.npz", animation)
    return animation


@pytest.fixture
def face(tmp_path: Path, animation: Animation) -> Path:
    """The egg with fewer vertices, in millimetres."""
    mesh = trimesh.creation.icosphere(2)
    write_obj(tmp_path / "face.obj", np.array(mesh.vertices) * [80, 120, 100], np.array(mesh.faces))
    return tmp_path / "face.obj"


def test_retarget_writes_an_animation_on_another_mesh(
    animation: Animation,
    face: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ["retarget", "take.npz", "--target-mesh", "face.obj", "--correspondence", "map.npz"]
    assert main([*words, "-o", "out.npz", "--show", "check.png"]) == 0
    made = read_archive(tmp_path / "out.npz")
    # A coarser ball's vertices are some of the finer one's: the truth is known there.
    away = np.linalg.norm(made.template[:, None] / 1000 - animation.template[None], axis=2)
    truth = (animation.vertices - animation.template)[:, away.argmin(axis=1)] * 1000
    found = made.vertices - made.template
    assert np.square(found - truth).sum() < 0.02**2 * np.square(truth).sum()
    assert made.unit == "mm"
    said = capsys.readouterr().out
    assert "642 vertices to 162" in said
    assert "unit mm" in said
    assert (tmp_path / "check.png").read_bytes()[:4] == b"\x89PNG"
    # The map is used again, gives the same, and is left as it was.
    kept = (tmp_path / "map.npz").read_bytes()
    assert main([*words, "-o", "again.npz"]) == 0
    assert np.array_equal(read_archive(tmp_path / "again.npz").vertices, made.vertices)
    assert (tmp_path / "map.npz").read_bytes() == kept
    assert np.array_equal(retarget(animation, face, tmp_path / "map.npz")[0].vertices, made.vertices)
    assert np.array_equal(retarget(animation, face)[0].vertices, made.vertices)


def as_z_up(points: np.ndarray) -> np.ndarray:
    """Points (…, 3) as Blender and 3ds Max see them: the front is at −y."""
    return np.stack([points[..., 0], -points[..., 2], points[..., 1]], axis=-1)


UPRIGHT = "the target mesh has z up and is turned: the written file has y up"


@pytest.mark.parametrize("tilt", [0, 15, 90])
def test_only_a_mesh_with_z_up_is_set_upright(
    tilt: float,
    animation: Animation,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A head may look up a little; one that lies on its side has no axes of its own."""
    monkeypatch.chdir(tmp_path)
    turn = trimesh.transformations.rotation_matrix(np.deg2rad(tilt), [0, 1, 0])[:3, :3]
    write_obj(tmp_path / "z.obj", 1000 * as_z_up(animation.template) @ turn.T, animation.triangles)
    write_archive(tmp_path / "take.npz", swaying := move_head(animation, *np.full((2, 3, 3), 0.02)))
    assert main(["retarget", "take.npz", "--target-mesh", "z.obj", "-o", "out.npz"]) == 0
    said, goal = capsys.readouterr().out, as_z_up(1000 * swaying.vertices) @ turn.T
    upright = read_archive(tmp_path / "out.npz")
    assert (UPRIGHT in said, "so is the written file" in said) == (tilt < 20, tilt > 20)
    moved = upright.vertices if tilt > 20 else as_z_up(upright.vertices)
    assert np.abs(moved - goal).max() < 0.01
    assert np.abs(upright.still().vertices[0] - upright.template).max() < 0.01, "the head's motion turns with its face"


def test_files_that_may_have_z_up_fit_a_mesh_that_has(
    animation: Animation, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    rest, moved = as_z_up(1000 * animation.template), as_z_up(1000 * animation.vertices)
    write_obj(tmp_path / "z.obj", rest, animation.triangles)
    words = ["retarget", "take.npz", "--target-mesh", "z.obj", "--correspondence", "map.npz", "-o"]
    assert main([*words, "out.pc2"]) == 0
    assert "the target mesh has z up, and so has the written file" in capsys.readouterr().out
    cache = np.frombuffer((tmp_path / "out.pc2").read_bytes()[32:], "<f4").reshape(moved.shape)
    assert np.abs(cache - moved).max() < 0.01
    assert " z up" in (tmp_path / "out.obj").read_text().splitlines()[0]
    for again in ("out.glb", "out.html"):
        assert main([*words, again]) == 0
        assert UPRIGHT in capsys.readouterr().out
    glb = open_glb(tmp_path / "out.glb")
    points = glb.positions(glb.primitives(0)[0])
    assert np.abs(points - animation.template).max() < 1e-5


def test_a_glb_with_z_up_keeps_its_axes(
    animation: Animation, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    trimesh.Trimesh(as_z_up(animation.template), animation.triangles, process=False).export("z.glb")
    words = ["retarget", "take.npz", "--target-mesh", "z.glb", "-o", "own.glb", "--add-to-mesh"]
    assert main(words) == 0
    assert "so is the written file" in capsys.readouterr().out
    glb = open_glb(tmp_path / "own.glb")
    (part,) = glb.primitives(0)
    targets = np.stack([glb.numbers(target["POSITION"], "VEC3", ("f4",)) for target in part["targets"]])
    weights = glb.numbers(glb.entries("animations")[0]["samplers"][0]["output"], "SCALAR", ("f4",)).reshape(3, -1)
    own = glb.positions(part) + np.tensordot(weights, targets, 1)
    assert np.abs(own - as_z_up(animation.vertices)).max() < 1e-4


def test_plain_materials_of_a_glb_colour_what_is_no_glb(
    animation: Animation, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    file = File()
    looks: list[dict[str, object]] = [{"baseColorFactor": [0.5, 0.2159, 0.0, 1.0]}, {"baseColorFactor": [2, 0, 0, 1]}]
    looks.append({"baseColorFactor": [0.5, 0, 0, 1], "baseColorTexture": {"index": 0}})
    file.content["materials"] = [{"pbrMetallicRoughness": look} for look in looks]
    primitives = []
    for material in range(4):  # the last one does not exist
        points, corners = animation.template, animation.triangles
        if material:
            points, corners = points[corners[0]] + np.float32([0, 0.2, 0]), np.array([[0, 1, 2]])
        attributes = {"POSITION": file.add(points, "VEC3", bounds=True)}
        indices = file.add(corners.astype(np.uint16).ravel(), "SCALAR")
        primitives.append({"attributes": attributes, "indices": indices, "material": material})
    file.content |= {"meshes": [{"primitives": primitives}], "nodes": [{"mesh": 0}], "scenes": [{"nodes": [0]}]}
    file.write(tmp_path / "own.glb")
    assert main(["retarget", "take.npz", "--target-mesh", "own.glb", "-o", "out.npz"]) == 0
    assert "of own.glb, the colours of materials are kept as vertex colours" in capsys.readouterr().out
    colours = read_archive(tmp_path / "out.npz").colours
    assert colours is not None
    assert np.unique(colours[:-9], axis=0).tolist() == [[188, 128, 0]], "sRGB of the linear factor"
    assert np.unique(colours[-9:], axis=0).tolist() == [np.rint(255 * np.array(Look.albedo)).tolist()], "as skin"


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["take.npz", "--target-mesh", "flat.obj", "-o", "o.npz"], "flat.obj: target mesh: 3 vertices"),
        (["take.npz", "--target-mesh", "face.obj", "-o", "o.csv"], "weights need shapes; write .npz"),
        (["take.npz", "--target-mesh", "face.obj", "-o", "o.npz", "--correspondence", "take.npz"], "facediff corresp"),
        (["nan.npy", "--target-mesh", "face.obj", "-o", "o.npz", "--frame-rate", "25"], "holds NaN"),
        (["bare.npy", "--target-mesh", "face.obj", "-o", "o.npz", "--frame-rate", "25"], "error: bare: comes without"),
        (
            ["take.npz", *TARGET, "-o", "o.npz", "--landmarks", "l.csv", "--correspondence", "take.npz"],
            "would be used without it",
        ),
    ],
)
def test_what_is_wrong_is_one_sentence_and_nothing_is_written(
    words: list[str],
    says: str,
    animation: Animation,
    face: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    np.save(tmp_path / "bare.npy", animation.vertices)
    np.save(tmp_path / "nan.npy", np.full((2, 642, 3), np.nan, np.float32))
    (tmp_path / "flat.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (tmp_path / "l.csv").write_text("1,1\n")
    before = sorted(tmp_path.iterdir())
    monkeypatch.chdir(tmp_path)
    assert main(["retarget", *words]) == 2
    said = capsys.readouterr().err
    assert says in said
    assert said.count("\n") == 1
    assert sorted(tmp_path.iterdir()) == before
