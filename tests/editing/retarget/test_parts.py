"""Files of several parts: names, the parts that show the face, and what eyes, teeth, tongue, hair and a body do."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from facediff.animation import Animation, read_archive, write_archive
from facediff.cli.app import main
from facediff.editing.correspondence import Correspondence, correspond
from facediff.editing.detached_parts import detached_parts
from facediff.editing.face_features import find_features
from facediff.editing.fit_check import FitReport
from facediff.editing.retargeting import parts_with_a_face, retarget, transfer
from facediff.editing.surface import Surface
from facediff.errors import FaceDiffError, OptionError
from facediff.mesh import Mesh, read_mesh
from facediff.mesh.glb import open_glb
from facediff.mesh.glb_scene import placed_parts
from facediff.mesh.parts import mesh_parts, named_triangles
from tests.fakes.avatar import avatar_parts, write_avatar
from tests.fakes.heads import APART, BALLS, TILTED, coarser, joined, only, second, talking, talking_second, turned

OBJ = """v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
o Head
g Skin
usemtl Beige
f 1/1 2/2 3/3 4/4
g Lips
f 1 2 3
o Hat
g
usemtl Felt
f 2 3 4
"""


@pytest.fixture(scope="module")
def animation() -> Animation:
    return talking()


def test_names_of_an_obj(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text(OBJ)
    found = {part.names: part.triangles.tolist() for part in mesh_parts(tmp_path / "a.obj")}
    assert found == {("Head", "Skin", "Beige"): [0, 1], ("Head", "Lips", "Beige"): [2], ("Hat", "Felt"): [3]}
    assert len(read_mesh(tmp_path / "a.obj").faces) == 4
    for names, triangles in ((["Head"], [0, 1, 2]), (["hat", "Lips"], [2, 3]), (["H*"], [0, 1, 2, 3])):
        assert named_triangles(tmp_path / "a.obj", names).tolist() == triangles
    with pytest.raises(FaceDiffError, match="Heat") as caught:
        named_triangles(tmp_path / "a.obj", ["Head", "Heat"])
    assert all(name in str(caught.value) for name in ("Head", "Skin", "Lips", "Hat", "Felt"))
    (tmp_path / "a.obj").write_text(OBJ.replace("Hat", "Hat[1]?"))
    assert named_triangles(tmp_path / "a.obj", ["Hat[1]?"]).tolist() == [3]
    (tmp_path / "b.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 3\n")
    with pytest.raises(FaceDiffError, match="no names"):
        named_triangles(tmp_path / "b.obj", ["Head"])


@pytest.mark.slow
def test_a_part_with_a_face_is_tried_by_itself(animation: Animation, tmp_path: Path) -> None:
    """A ball, and a face beside it: where the whole is refused, the part is taken by itself."""
    ball = trimesh.creation.icosphere(3, 0.08)
    text = []
    for name, points, faces, first in (
        ("Ball", np.array(ball.vertices) + [0.5, 0, 0], np.array(ball.faces), 1),
        ("Face", animation.template, animation.triangles, 1 + len(ball.vertices)),
    ):
        text += [f"o {name}", *(f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in points)]
        text += [f"f {a} {b} {c}" for a, b, c in faces + first]
    (tmp_path / "two.obj").write_text("\n".join(text) + "\n")
    mesh = read_mesh(tmp_path / "two.obj")
    assert parts_with_a_face(animation, tmp_path / "two.obj", mesh) == ["Face"]

    tried = []

    def refuse_the_whole(_: Animation, found: Correspondence, __: FitReport) -> None:
        tried.append(len(found.hidden))
        if not len(found.hidden):
            raise OptionError.naming("two.obj: is poor; see {pick}")

    _, found = retarget(animation, tmp_path / "two.obj", check=refuse_the_whole)
    assert tried == [0, len(ball.faces)]
    assert len(found.hidden) == len(ball.faces)


def test_names_of_a_glb_are_those_of_nodes_meshes_and_materials(tmp_path: Path) -> None:
    parts = avatar_parts(rounds=0)
    write_avatar(tmp_path / "a.glb", parts)
    mesh = read_mesh(tmp_path / "a.glb")
    for name in ("Teeth", "TeethMesh", "TeethMaterial"):
        faces = mesh.faces[named_triangles(tmp_path / "a.glb", [name])]
        assert mesh.vertices[np.unique(faces)] == pytest.approx(parts["Teeth"].vertices, abs=2e-6)


def test_pieces_of_a_head_are_told_by_their_place(animation: Animation) -> None:
    """Single teeth overlap the line between the lips; hair, a beard, glasses and lashes are no teeth."""
    vertices, faces = np.float64(animation.template), animation.triangles.astype(np.int64)
    features = find_features(vertices, faces)
    assert features is not None
    box = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    hull = np.array(
        [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4],
         [1, 5, 7], [1, 7, 3]]
    )  # fmt: skip
    x, y, z = features.mouth.centre
    wanted = {"skin": (vertices, faces)}

    def add(name: str, centre: tuple[float, float, float], size: tuple[float, float, float]) -> None:
        wanted[name] = (box * np.array(size) / 2 + np.array(centre), hull)

    for k in range(-3, 4):
        # The upper row reaches below the line between the lips, as people's do.
        add(f"upper {k}", (x + 0.005 * k, y - 0.002, z - 0.008), (0.004, 0.008, 0.004))
        add(f"lower {k}", (x + 0.005 * k, y - 0.011, z - 0.009), (0.004, 0.006, 0.004))
    add("tongue", (x, y - 0.014, z - 0.03), (0.02, 0.006, 0.03))
    add("palate", (x, y + 0.012, z - 0.03), (0.03, 0.004, 0.03))
    add("moustache", (x, y + 0.013, z + 0.008), (0.03, 0.004, 0.002))
    add("hair", (0, 0.09, -0.05), (0.2, 0.1, 0.15))
    add("glasses", (0, 0.026, 0.09), (0.15, 0.03, 0.01))
    add("body", (0, -0.5, -0.02), (0.4, 0.6, 0.2))
    add("beard", (0, y - 0.03, z + 0.005), (0.11, 0.03, 0.01))
    eye = features.eyes[1]
    assert eye is not None
    skin = vertices[features.skin]

    def on_skin(at_x: float, at_y: float, ahead: float) -> tuple[float, float, float]:
        near = skin[(np.abs(skin[:, 0] - at_x) < 0.01) & (np.abs(skin[:, 1] - at_y) < 0.01)]
        return at_x, at_y, float(near[:, 2].max()) + ahead

    add("lens", on_skin(eye.centre[0], eye.centre[1], 0.015), (0.045, 0.035, 0.001))
    add("bridge", on_skin(0.0, eye.centre[1], 0.012), (0.02, 0.002, 0.002))
    add("brow", on_skin(eye.centre[0], eye.centre[1] + 0.02, 0.0), (0.012, 0.004, 0.002))
    add("iris", tuple(eye.centre), (0.004, 0.003, 0.001))
    add("lash", tuple(eye.upper[16] + [0, 0.002, 0.002]), (0.012, 0.003, 0.003))
    head = joined(**wanted)
    begins = dict(zip(wanted, np.cumsum([0, *(len(points) for points, _ in wanted.values())]), strict=False))
    whole = Surface(head.vertices, head.faces)
    seen = find_features(head.vertices, head.faces, features)
    assert seen is not None
    alone = [np.arange(8) + first for name, first in begins.items() if name != "skin"]
    detached = detached_parts(Surface(vertices, faces), whole, features, seen, alone)
    followers, corners, weights = detached.followers
    kinds = {
        name: "jaw" if first in detached.jaw else "still" if first in detached.still else "skin"
        for name, first in begins.items()
    }
    assert {name for name, kind in kinds.items() if kind == "jaw"} == {
        "tongue", *(f"lower {k}" for k in range(-3, 4))
    }  # fmt: skip
    assert {name for name, kind in kinds.items() if kind == "skin"} == {"skin", "moustache", "beard", "brow", "lash"}
    # What lies on the skin moves with it, and lashes with the edge of their lid.
    assert {name for name, first in begins.items() if first in followers} == {"moustache", "beard", "brow", "lash"}
    lash = np.isin(followers, begins["lash"] + np.arange(8))
    assert np.isin(corners[lash], eye.upper_seeds).all()
    assert weights.sum(axis=1) == pytest.approx(1)
    # Lashes that are one strip bend with the edge.
    assert len(np.unique(corners[lash], axis=0)) > 1


@pytest.mark.parametrize("second_edition", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_single_lashes_keep_their_shape_in_a_blink_and_turn_together(
    second_edition: bool, animation: Animation
) -> None:
    """Whether or not the animation's face has lashes too, and on lids of few triangles."""
    blinking = talking_second() if second_edition else animation
    skin = coarser(*second(TILTED, *APART), 0.5)
    head = joined(skin=skin, balls=only(TILTED, *BALLS), lashes=only(TILTED, "lash_"))
    correspondence = correspond(blinking.template, blinking.triangles, head.vertices, head.faces)
    retargeted = transfer(blinking, correspondence, Mesh(head.vertices, head.faces.astype(np.int32)))
    # A lash is a triangle whose first two corners, in the order of its vertices, are the root.
    lashes = np.sort(np.unique(np.sort(head.faces[head.parts["lashes"]], axis=1), axis=0))
    lashes = lashes[(np.diff(lashes, axis=1) > 0).all(axis=1)]
    assert len(lashes) == 30
    rest, shut = np.float64(retargeted.template)[lashes], np.float64(retargeted.vertices[9])[lashes]
    edges = [np.linalg.norm(points - np.roll(points, 1, axis=1), axis=2) for points in (rest, shut)]
    assert edges[1] == pytest.approx(edges[0], rel=0.02)
    arms = [points[:, 2] - points[:, :2].mean(axis=1) for points in (rest, shut)]
    one, two = (arm / np.linalg.norm(arm, axis=1, keepdims=True) for arm in arms)
    turns = np.rad2deg(np.arccos(np.einsum("nd,nd->n", one, two)))
    for side in (-1, 1):
        some = np.flatnonzero(side * rest[:, 0, 0] > 0)
        some = some[np.argsort(rest[some, 0, 0])]
        # Where the lid turns by t, a lash at an angle to its axis goes 2 asin(sin(t / 2) sin(angle)). With sines that
        # differ by up to 0.08 between neighbours and t up to 50 degrees, these differ by 0.08 * 2 tan(t / 2), 4.3
        # degrees.
        assert turns.max() < 50
        assert turns[some].min() > 15
        assert np.abs(np.diff(turns[some])).max() < 4.5


@pytest.mark.parametrize("words", [["--part", "Head"], pytest.param([], marks=pytest.mark.slow)])
def test_a_whole_avatar_talks(
    words: list[str],
    animation: Animation,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    write_archive(tmp_path / "a.npz", animation)
    parts = avatar_parts(rounds=0)
    write_avatar(tmp_path / "avatar.glb", parts)
    told = ["retarget", "a.npz", "--target-mesh", "avatar.glb", "-o"]
    assert main([*told, "o.npz", "--part", "Haed"]) == 2
    said = capsys.readouterr().err
    assert all(name in said for name in ("Haed", "Head", "Teeth", "TongueMesh", "HairMaterial"))
    assert not (tmp_path / "o.npz").exists()
    assert main([*told, "o.npz", *words]) == 0
    made = read_archive(tmp_path / "o.npz")
    assert len(made.template) == sum(len(part.vertices) for part in parts.values())
    moved, first = {}, 0
    for placed in placed_parts(open_glb(tmp_path / "avatar.glb")):
        name = next(name for name in parts if f"{name}Material" in placed.names)
        moved[name] = (made.vertices[3] - made.template)[first : first + len(placed.local)]
        first += len(placed.local)
    for name in ("Body", "Hair", "EyeLeft", "EyeRight"):
        assert not moved[name].any()
    assert np.linalg.norm(moved["Head"], axis=1).max() > 0.008
    upper, lower = np.split(moved["Teeth"], 2)
    assert not upper.any()
    assert np.ptp(lower, axis=0) == pytest.approx(0, abs=1e-6)
    assert np.linalg.norm(lower[0]) > 0.006
    assert moved["Tongue"] == pytest.approx(np.tile(lower[0], (len(moved["Tongue"]), 1)), abs=1e-6)


@pytest.mark.slow
def test_a_swaying_head_takes_its_parts_along_and_leaves_the_body(animation: Animation) -> None:
    """Eyes and hair stand still on a head that stands still, and not in a head that turns."""
    face = (np.float64(animation.template), animation.triangles.astype(np.int64))
    box = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    low = face[0][:, 1].min()
    hull = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6]])
    both = joined(
        face=face, hat=(0.1 * box + [0, 0.15, 0], hull), body=(0.2 * box * [1, 0.5, 1] + [0, low - 0.5, 0], hull)
    )
    turn = turned(0, 0, 90)
    points = 100 * both.vertices @ turn.T + [5.0, 0, 2]
    head = np.zeros((2, 6))
    head[1] = [0.0, 0.05, 0.02, 0.001, 0.0, 0.002]
    matrix = Rotation.from_rotvec(head[1, :3]).as_matrix()
    still = np.repeat(animation.template[None], 2, axis=0)
    moved = still.copy()
    moved[1] = still[1] @ matrix.T + head[1, 3:]
    swaying = Animation("sway", moved, animation.template, 25.0, faces=animation.triangles, head=head)
    found = correspond(*face, points, both.faces)
    made = transfer(swaying, found, Mesh(points, both.faces.astype(np.int32)))
    expected = 100 * (both.vertices @ matrix.T + head[1, 3:]) @ turn.T + [5.0, 0, 2]
    upper = slice(0, len(face[0]) + 8)
    assert made.vertices[1, upper] == pytest.approx(expected[upper], abs=0.01)
    assert made.vertices[1, upper.stop :] == pytest.approx(points[upper.stop :], abs=1e-5)
    assert made.vertices[0] == pytest.approx(points, abs=1e-5)
    assert made.head is None
    some = Mesh(points[upper], both.faces[: -2 * len(hull) + len(hull)].astype(np.int32))
    alone = transfer(swaying, correspond(*face, some.vertices, some.faces), some)
    assert alone.vertices[1] == pytest.approx(expected[upper], abs=0.01)
    assert alone.still().vertices[1] == pytest.approx(points[upper], abs=1e-4)
