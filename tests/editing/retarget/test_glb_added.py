"""An animation added to a .glb: what was in the file stays, field by field, and the vertices move as carried."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from facediff.animation import Animation
from facediff.export.glb_added import add_to_glb
from facediff.mesh import read_mesh
from facediff.mesh.glb import open_glb
from facediff.mesh.glb_scene import placed_parts
from facediff.mesh.glb_shapes import target_names
from tests.fakes.glb_targets import File, pack
from tests.fakes.meshes import relief


def avatar(path: Path) -> None:
    """A textured, skinned face with two targets that are animated, below a scaled, turned node; and a second mesh."""
    (points, faces), file = relief(9, 8), File()
    add = file.add
    count = len(points)
    weights = np.zeros((count, 4), np.float32)
    weights[:, 0] = 1
    face = {
        "attributes": {
            "POSITION": add(points.astype(np.float32), "VEC3"),
            "TEXCOORD_0": add(points[:, :2].astype(np.float32), "VEC2"),
            "JOINTS_0": add(np.zeros((count, 4), np.uint16), "VEC4"),
            "WEIGHTS_0": add(weights, "VEC4"),
        },
        "indices": add(faces.astype(np.uint16).ravel(), "SCALAR"),
        "material": 0,
        "targets": [{"POSITION": add(np.full((count, 3), 0.1 * k, np.float32), "VEC3")} for k in (1, 2)],
    }
    hat = {"attributes": {"POSITION": add((points + [0, 9, 0]).astype(np.float32), "VEC3")}, "indices": face["indices"]}
    times = add(np.float32([0, 1]), "SCALAR")
    smile = {"input": times, "output": add(np.float32([0, 0, 1, 0.5]), "SCALAR"), "interpolation": "LINEAR"}
    file.content |= {
        "scene": 0,
        "scenes": [{"nodes": [0, 2]}],
        "nodes": [
            {"name": "root", "scale": [100, 100, 100], "rotation": [0.7071068, 0, 0, 0.7071068], "children": [1, 3]},
            {"name": "head", "mesh": 0, "skin": 0},
            {"name": "hat", "mesh": 1},
            {"name": "joint"},
        ],
        "meshes": [
            {"primitives": [face], "weights": [0.25, 0], "extras": {"targetNames": ["jawOpen", "smile"]}},
            {"primitives": [hat]},
        ],
        "skins": [{"joints": [3]}],
        "materials": [{"name": "skin", "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "textures": [{"source": 0}],
        "images": [{"uri": "data:image/png;base64,AAAA"}],
        "animations": [
            {
                "name": "smile",
                "samplers": [smile],
                "channels": [{"sampler": 0, "target": {"node": 1, "path": "weights"}}],
            }
        ],
        "extensionsUsed": ["KHR_materials_unlit"],
    }
    file.write(path)


def test_names_of_targets_stay_wherever_they_are_written(tmp_path: Path) -> None:
    avatar(tmp_path / "a.glb")
    glb = open_glb(tmp_path / "a.glb")
    glb.primitives(0)[0]["extras"] = glb.content["meshes"][0].pop("extras")
    (tmp_path / "a.glb").write_bytes(pack(glb.content, glb.binary))
    mesh = read_mesh(tmp_path / "a.glb")
    vertices = np.repeat(mesh.vertices[None].astype(np.float32), 3, axis=0)
    vertices[1:, : len(vertices[0]) // 2, 1] += 1.0
    for source, output in (("a.glb", "b.glb"), ("b.glb", "c.glb")):  # twice: new names are different
        add_to_glb(tmp_path / output, tmp_path / source, Animation("a", vertices, vertices[0], 25.0, mesh.faces), 0.001)
        assert target_names(open_glb(tmp_path / output), 0)[:2] == ["jawOpen", "smile"]


def test_meshes_without_nodes_get_nodes_that_move(tmp_path: Path) -> None:
    avatar(tmp_path / "avatar.glb")
    glb = open_glb(tmp_path / "avatar.glb")
    for key in ("nodes", "scenes", "scene", "skins", "animations"):
        del glb.content[key]
    (tmp_path / "bare.glb").write_bytes(pack(glb.content, glb.binary))
    mesh = read_mesh(tmp_path / "bare.glb")
    rest = mesh.vertices.astype(np.float32)
    vertices = np.repeat(rest[None], 3, axis=0)
    vertices[1:, len(rest) // 2 :, 1] += 1.0
    add_to_glb(tmp_path / "out.glb", tmp_path / "bare.glb", Animation("a", vertices, rest, 25.0, mesh.faces), 0.001)
    assert np.array_equal(read_mesh(tmp_path / "out.glb").vertices, mesh.vertices)
    new = open_glb(tmp_path / "out.glb")
    (animation,) = new.content["animations"]
    (channel,) = animation["channels"]
    assert new.content["nodes"][channel["target"]["node"]] == {"mesh": 1}
    assert new.content["scenes"][new.content["scene"]]["nodes"] == [1, 0]


def test_each_skinned_node_of_one_mesh_stands_and_moves_by_its_own_skin(tmp_path: Path) -> None:
    avatar(tmp_path / "avatar.glb")
    glb = open_glb(tmp_path / "avatar.glb")
    content, first = glb.content, len(glb.content["nodes"])
    content["nodes"] += [
        {"name": "far", "translation": [5, 0, 0], "scale": [2, 2, 2]},
        {"name": "turned", "translation": [0, 7, 0], "rotation": [0, 0.6, 0, 0.8]},
        *({"name": f"twin {skin}", "mesh": 0, "skin": skin, "translation": [99, 0, 0]} for skin in (1, 2, 1)),
    ]
    content["skins"] += [{"joints": [first]}, {"joints": [first + 1, first]}]
    content["scenes"][0]["nodes"] += range(first, first + 5)
    (tmp_path / "twins.glb").write_bytes(pack(content, glb.binary))
    mesh = read_mesh(tmp_path / "twins.glb")
    local = glb.positions(glb.primitives(0)[0])
    turn = np.array([[0.28, 0, 0.96], [0, 1, 0], [-0.96, 0, 0.28]])
    expected = {1: 2 * local + [5, 0, 0], 2: local @ turn.T + [0, 7, 0]}
    begins, before = {}, 0
    for part in placed_parts(open_glb(tmp_path / "twins.glb")):
        begins[part.node], before = before, before + len(part.local)
    vertices = np.repeat(mesh.vertices[None].astype(np.float32), 4, axis=0)
    for node in range(first + 2, first + 5):
        rows = slice(begins[node], begins[node] + len(local))
        np.testing.assert_allclose(mesh.vertices[rows], expected[content["nodes"][node]["skin"]], atol=1e-6)
        vertices[1:, rows] += np.random.default_rng(node).normal(0, 1, (3, len(local), 3)).astype(np.float32)
    animation = Animation("twins", vertices, vertices[0], 25.0, faces=mesh.faces, unit="mm")
    add_to_glb(tmp_path / "out.glb", tmp_path / "twins.glb", animation, 0.001)
    new = open_glb(tmp_path / "out.glb")
    motion = new.content["animations"][0]
    rows_of = {each["target"]["node"]: motion["samplers"][each["sampler"]]["output"] for each in motion["channels"]}
    for part in placed_parts(new):
        weights = new.entry("meshes", part.mesh).get("weights", [])
        moves = [new.numbers(each["POSITION"], "VEC3", ("f4",)) for each in new.entries("targets", part.primitive)]
        played = np.zeros((4, len(weights)))
        if part.node in rows_of:
            played = new.numbers(rows_of[part.node], "SCALAR", ("f4",)).reshape(4, -1) - np.array(weights)
        shown = part.points + (part.turned(np.einsum("tk,kvc->tvc", played, moves)) if moves else np.zeros((4, 1, 1)))
        np.testing.assert_allclose(shown, vertices[:, begins[part.node] :][:, : len(part.local)], atol=5e-3)
