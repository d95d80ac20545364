"""A whole avatar with skeleton, texture, 52 targets and an animation gets another one and keeps all it had."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from facediff.animation import Animation, write_archive
from facediff.cli.app import main
from facediff.errors import FaceDiffError
from facediff.export import ExportOptions, write_animations
from facediff.export.glb_added import add_to_glb
from facediff.mesh import read_mesh
from facediff.mesh.glb import Glb, has_materials_or_targets, open_glb
from facediff.mesh.glb_scene import placed_parts
from tests.fakes.avatar import AvatarPart, avatar_parts, normals_of, write_avatar
from tests.fakes.glb_reader import without_new_animation
from tests.fakes.glb_targets import pack

FRAMES = 9
MOVING = ("Head", "Teeth", "Tongue")


@pytest.fixture(scope="module")
def parts() -> dict[str, AvatarPart]:
    return avatar_parts(rounds=0)


def talk(path: Path, parts: dict[str, AvatarPart], *, posed: bool = False) -> Animation:
    """The avatar opens its jaw and smiles on one side, as its own targets do."""
    mesh = read_mesh(path)
    rest = mesh.vertices.astype(np.float32)
    shown = [names for part in placed_parts(open_glb(path)) if (names := part.names)]
    vertices = np.repeat(rest[None], FRAMES, axis=0)
    before = 0
    for names in shown:
        part = next(parts[name] for name in parts if f"{name}Material" in names)
        count = len(part.vertices)
        exact = 2e-6 if "extensionsUsed" not in open_glb(path).content else 1e-4  # 16 bits of 1.7 m
        assert posed or rest[before : before + count] == pytest.approx(part.vertices, abs=exact)
        for name, peak in (("jawOpen", 4), ("mouthSmileLeft", 6)):
            weights = np.clip(1 - np.abs(np.arange(FRAMES) - peak) / 4, 0, 1)
            delta = part.targets.get(name, np.zeros((count, 3)))
            vertices[:, before : before + count] += (weights[:, None, None] * delta).astype(np.float32)
        before += count
    return Animation("talk", vertices, rest, 25.0, faces=mesh.faces)


def evaluated(glb: Glb, name: str, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and normals of a part at a frame of the added animation, in the scene: targets first, then the skin."""
    part = next(part for part in placed_parts(glb) if f"{name}Material" in part.names)
    animation = glb.content["animations"][0]
    targets = part.primitive.get("targets", [])
    weights = np.zeros(len(targets))
    for channel in animation["channels"]:
        if channel["target"] == {"node": part.node, "path": "weights"}:
            output = animation["samplers"][channel["sampler"]]["output"]
            weights = glb.numbers(output, "SCALAR", ("f4",)).reshape(-1, len(targets))[frame]
    made = []
    for kind in ("POSITION", "NORMAL"):
        values = glb.numbers(part.primitive["attributes"][kind], "VEC3", ("f4", "i2")).astype(np.float64)
        for weight, target in zip(weights, targets, strict=True):
            if weight and kind in target:
                values = values + weight * glb.numbers(target[kind], "VEC3", ("f4",), len(values))
        made.append(values)
    points, normals = made
    matrix = np.eye(4) if part.matrix is None else part.matrix
    matrix = np.broadcast_to(matrix, (len(points), 4, 4))
    placed = np.einsum("vij,vj->vi", matrix[:, :3, :3], points) + matrix[:, :3, 3]
    turned = np.einsum("vi,vij->vj", normals, np.linalg.inv(matrix[:, :3, :3]))
    return placed, turned / np.linalg.norm(turned, axis=1, keepdims=True)


def without_additions(new: dict[str, Any], old: dict[str, Any]) -> dict[str, Any]:
    """The new description less what may be added to the old one."""
    made = without_new_animation(new, old)
    for mesh, before in zip(made["meshes"], old["meshes"], strict=True):
        count = len(before.get("weights", []))
        if "weights" in mesh:
            mesh["weights"] = mesh["weights"][:count]
            mesh["extras"]["targetNames"] = mesh["extras"]["targetNames"][:count]
        for primitive in mesh["primitives"]:
            primitive["targets"] = primitive.get("targets", [])[:count]
            if not count:
                del primitive["targets"]
        if not count:
            del mesh["weights"], mesh["extras"]
    return made


LAYOUTS: dict[str, dict[str, Any]] = {
    "skinned, centimetres, z up": {},
    "skinned, stored in a pose": {"posed": True},
    "several skins, stored in a pose": {"posed": True, "skins": 3, "sparse": False},
    "quantised positions": {"skinned": False, "quantised": True},
    "one mesh, metres": {"joined": True, "unit": 1.0, "z_up": False, "skinned": False, "sparse": False},
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_an_avatar_keeps_all_it_has(tmp_path: Path, parts: dict[str, AvatarPart], layout: str) -> None:
    write_avatar(tmp_path / "avatar.glb", parts, **LAYOUTS[layout])
    animation = talk(tmp_path / "avatar.glb", parts, posed=LAYOUTS[layout].get("posed", False))
    add_to_glb(tmp_path / "out.glb", tmp_path / "avatar.glb", animation, 0.01)
    old, new = open_glb(tmp_path / "avatar.glb"), open_glb(tmp_path / "out.glb")
    assert new.binary.startswith(old.binary)
    idle, kept = old.content["animations"][0], new.content["animations"][1]
    changed = kept["samplers"][1]
    assert {**changed, "output": 0} == {**idle["samplers"][1], "output": 0}
    count = len(parts["Head"].targets)
    assert count == 52
    own = new.numbers(changed["output"], "SCALAR", ("f4",)).reshape(3, -1)
    assert (
        own[:, :count].tolist() == old.numbers(idle["samplers"][1]["output"], "SCALAR", ("f4",)).reshape(3, -1).tolist()
    )
    assert not own[:, count:].any()
    changed["output"] = idle["samplers"][1]["output"]
    # What stands still is not touched, so that nothing need be taken away from it.
    still = {i for i, mesh in enumerate(old.content["meshes"]) if mesh["name"].removesuffix("Mesh") not in MOVING}
    assert len(still) == 4
    assert all(new.content["meshes"][i] == old.content["meshes"][i] for i in still)
    for i in still:
        for content in (old.content, new.content):
            content["meshes"][i] |= {"weights": [], "extras": {"targetNames": []}}
    if not LAYOUTS[layout].get("joined"):
        assert {c["target"]["node"] for c in new.content["animations"][0]["channels"]} == {
            i for i, node in enumerate(old.content["nodes"]) if node["name"] in MOVING
        }
    expected = copy.deepcopy(old.content)
    for i in still:
        del expected["meshes"][i]["weights"], expected["meshes"][i]["extras"]
    assert without_additions(new.content, old.content) == expected


@pytest.mark.parametrize("layout", LAYOUTS)
def test_vertices_and_normals_move_as_the_animation_has_it(
    tmp_path: Path, parts: dict[str, AvatarPart], layout: str
) -> None:
    write_avatar(tmp_path / "avatar.glb", parts, **LAYOUTS[layout])
    animation = talk(tmp_path / "avatar.glb", parts, posed=LAYOUTS[layout].get("posed", False))
    add_to_glb(tmp_path / "out.glb", tmp_path / "avatar.glb", animation, 0.01)
    new = open_glb(tmp_path / "out.glb")
    starts = np.cumsum([0, *(len(part.local) for part in placed_parts(new))])
    for (name, part), first in zip(
        [(next(n for n in parts if f"{n}Material" in each.names), each) for each in placed_parts(new)],
        starts,
        strict=False,
    ):
        truth = animation.vertices[:, first : first + len(part.local)].astype(np.float64)
        for frame in (0, 4, 5):
            points, normals = evaluated(new, name, frame)
            assert np.linalg.norm(points - truth[frame], axis=1).max() < 2e-5
            if name != "Head":
                continue
            expected = normals_of(truth[frame], part.faces)
            cosine = (normals * expected).sum(axis=1)
            stays = (normals_of(truth[0], part.faces) * expected).sum(axis=1)
            # The file's normals weigh triangles by angle, and seams are turned as one.
            # A skin turns normals by its weights and not by how these change from vertex to vertex.
            limit = 3 if LAYOUTS[layout].get("posed") else 1
            assert np.rad2deg(np.arccos(np.clip(np.median(cosine), -1, 1))) < limit
            assert np.mean(cosine > np.cos(np.deg2rad(8))) > 0.95
            if frame == 4:
                assert np.mean(stays < np.cos(np.deg2rad(8))) > 0.1


def test_the_command_writes_into_the_avatar_unless_the_bare_face_is_asked_for(
    tmp_path: Path, parts: dict[str, AvatarPart], capsys: pytest.CaptureFixture[str]
) -> None:
    source = tmp_path / "avatar.glb"
    write_avatar(source, parts)
    write_archive(tmp_path / "talk.npz", talk(source, parts))
    words = ["retarget", str(tmp_path / "talk.npz"), "--target-mesh", str(source), "--accept-poor"]
    assert main([*words, "--carry", "-o", str(tmp_path / "out.glb")]) == 0
    assert "--bare-face" in capsys.readouterr().out
    kept, had = (open_glb(path).content for path in (tmp_path / "out.glb", source))
    assert [kept["images"], kept["materials"], kept["skins"][0]["joints"]] == [
        had["images"],
        had["materials"],
        had["skins"][0]["joints"],
    ]
    assert main([*words, "-o", str(tmp_path / "bare.glb"), "--bare-face"]) == 0
    assert not open_glb(tmp_path / "bare.glb").entries("skins")
    assert main([*words, "-o", str(source)]) == 2
    write_animations(tmp_path / "into.glb", [talk(source, parts)], into=source)
    assert open_glb(tmp_path / "into.glb").content["images"] == had["images"]
    with pytest.raises(FaceDiffError, match=r"no effect on a copy of the target \.glb"):
        write_animations(tmp_path / "b.glb", [talk(source, parts)], ExportOptions(key_tolerance=0.3), into=source)
    assert not has_materials_or_targets(tmp_path / "talk.npz")


def test_an_avatar_of_a_plain_colour_keeps_it(tmp_path: Path) -> None:
    bare = {"asset": {"version": "2.0"}, "meshes": [{"primitives": [{"attributes": {}}]}]}
    (tmp_path / "bare.glb").write_bytes(pack(bare, b""))
    (tmp_path / "plain.glb").write_bytes(pack({**bare, "materials": [{"name": "skin"}]}, b""))
    assert [has_materials_or_targets(tmp_path / name) for name in ("bare.glb", "plain.glb")] == [False, True]


def test_a_mesh_shown_twice_moves_where_it_should(tmp_path: Path, parts: dict[str, AvatarPart]) -> None:
    """Two eyes of one mesh, of which one turns: the other keeps the file's."""
    some = {name: parts[name] for name in ("Head", "EyeLeft")}
    write_avatar(tmp_path / "a.glb", some, unit=1.0, z_up=False, skinned=False, animated=False)
    glb = open_glb(tmp_path / "a.glb")
    content = glb.content
    eye = next(i for i, node in enumerate(content["nodes"]) if node["name"] == "EyeLeft")
    content["nodes"].append({"name": "EyeRight", "mesh": content["nodes"][eye]["mesh"], "translation": [-0.06, 0, 0]})
    content["nodes"][0]["children"].append(len(content["nodes"]) - 1)
    (tmp_path / "a.glb").write_bytes(pack(content, glb.binary))
    mesh = read_mesh(tmp_path / "a.glb")
    names = [(part.names[0], len(part.local)) for part in placed_parts(open_glb(tmp_path / "a.glb"))]
    starts = dict(zip((name for name, _ in names), np.cumsum([0, *(n for _, n in names)]), strict=False))
    vertices = np.repeat(mesh.vertices[None].astype(np.float32), 3, axis=0)
    count = len(parts["EyeLeft"].vertices)
    vertices[1, starts["EyeRight"] : starts["EyeRight"] + count] += np.float32([0, 0.01, 0])
    animation = Animation("gaze", vertices, vertices[0], 25.0, faces=mesh.faces)
    add_to_glb(tmp_path / "out.glb", tmp_path / "a.glb", animation, 0.01)
    new = open_glb(tmp_path / "out.glb")
    left, right = (next(n for n in new.content["nodes"] if n["name"] == name) for name in ("EyeLeft", "EyeRight"))
    assert left["mesh"] == content["nodes"][eye]["mesh"]
    assert "targets" not in new.content["meshes"][left["mesh"]]["primitives"][0]
    (target,) = new.content["meshes"][right["mesh"]]["primitives"][0]["targets"]
    assert new.numbers(target["POSITION"], "VEC3", ("f4",)) == pytest.approx(
        np.tile([0, 0.01, 0], (count, 1)), abs=1e-5
    )
