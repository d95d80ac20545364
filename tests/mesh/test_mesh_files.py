"""Meshes are read as they were written, in every format, and lies about their content are refused."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from facediff.errors import FaceDiffError
from facediff.mesh import read_mesh
from facediff.mesh.textures import read_textures
from tests.fakes.glb_targets import pack

XYZ = ["property float x", "property float y", "property float z"]
LIST = "property list uchar int vertex_indices"
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], "<f4")
SQUARE = "0 0 0\n1 0 0\n1 1 0\n0 1 0\n"


def ply(*lines: str, body: bytes = b"", form: str = "binary_little_endian") -> bytes:
    return "\n".join(["ply", f"format {form} 1.0", *lines, "end_header", ""]).encode() + body


def ascii_ply(body: str, vertices: object = 4, faces: object = 1) -> bytes:
    return ply(f"element vertex {vertices}", *XYZ, f"element face {faces}", LIST, body=body.encode(), form="ascii")


def binary_ply(faces: bytes, n_faces: int = 1) -> bytes:
    return ply("element vertex 4", *XYZ, f"element face {n_faces}", LIST, body=CORNERS.tobytes() + faces)


GOOD: dict[str, Any] = {
    "asset": {"version": "2.0"},
    "scene": 0,
    "scenes": [{"nodes": [0]}],
    "nodes": [{"mesh": 0}],
    "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
    "accessors": [
        {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
        {"bufferView": 1, "componentType": 5121, "count": 6, "type": "SCALAR"},
    ],
    "bufferViews": [
        {"buffer": 0, "byteLength": 48},
        {"buffer": 0, "byteOffset": 48, "byteLength": 6},
    ],
    "buffers": [{"byteLength": 56}],
}
DATA = CORNERS.tobytes() + bytes([0, 1, 2, 0, 2, 3, 0, 0])


def changed(path: str, value: object) -> bytes:
    """The good file with one entry replaced, such as ``accessors.0.count``."""
    content = json.loads(json.dumps(GOOD))
    *outer, last = path.split(".")
    holder = content
    for key in outer:
        holder = holder[int(key) if key.isdigit() else key]
    holder[int(last) if last.isdigit() else last] = value
    return pack(content, DATA)


REFUSED: dict[str, tuple[str, bytes]] = {
    # OBJ
    "obj of nan": (".obj", b"v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"),
    "obj of a colour of nan": (".obj", b"v 0 0 0 1 1 nan\nv 1 0 0 1 1 1\nv 0 1 0 1 1 1\nf 1 2 3\n"),
    "obj of 1e308": (".obj", b"v 0 0 1e308\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"),
    "obj with vertex 0": (".obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n"),
    "obj with vertex 4": (".obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n"),
    "obj with two coordinates": (".obj", b"v 0 0 0\nv 1 0\nv 0 1 0 1\nf 1 2 3\n"),
    "obj with relative faces in between": (".obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\nv 5 5 5\nf -3 -2 -1\n"),
    "obj with such faces after tabs": (".obj", b"v\t0 0 0\nv\t1 0 0\nv\t0 1 0\nf\t-3\t-2\t-1\nv\t5 5 5\nf 1 2 3\n"),
    # PLY
    "ply of one more vertex": (".ply", ply("element vertex 5", *XYZ, body=CORNERS.tobytes())),
    "ply of one vertex less": (".ply", ply("element vertex 3", *XYZ, body=CORNERS.tobytes())),
    "ply whose list is cut": (".ply", binary_ply(b"\x03" + struct.pack("<2i", 0, 1))),
    "ply with vertex -1": (".ply", binary_ply(b"\x03" + struct.pack("<3i", 0, 1, -1))),
    "ply with vertex 4": (".ply", binary_ply(b"\x03" + struct.pack("<3i", 0, 1, 4))),
    "ply cut in its faces": (".ply", ascii_ply(SQUARE + "3 0 1 2\n", faces=2)),
    "ply of nan": (".ply", ascii_ply(SQUARE.replace("1 1 0", "1 nan 0") + "3 0 1 2\n")),
    # Binary glTF
    "glb beyond its view": (".glb", changed("bufferViews.0.byteLength", 47)),
    "glb beyond its data": (".glb", changed("bufferViews.1.byteOffset", 1 << 40)),
    "glb with stride 0": (".glb", changed("bufferViews.0.byteStride", 0)),
    "glb with accessor -1": (".glb", changed("meshes.0.primitives.0.attributes.POSITION", -1)),
    "glb of another file": (".glb", changed("buffers.0", {"byteLength": 56, "uri": "/etc/passwd"})),
    "glb of data in a name": (".glb", changed("buffers.0", {"byteLength": 56, "uri": "data:;base64,AAAA"})),
    "glb compressed": (".glb", changed("extensionsRequired", ["KHR_draco_mesh_compression"])),
    "glb of a cycle": (".glb", changed("nodes.0", {"mesh": 0, "children": [0]})),
    "glb turned by a huge rotation": (".glb", changed("nodes.0", {"mesh": 0, "rotation": [1e300, 0, 0, 1]})),
    "glb moved beyond all numbers": (".glb", changed("nodes.0", {"mesh": 0, "translation": [1e300, 0, 0]})),
    "glb of a huge scale": (".glb", changed("nodes.0", {"mesh": 0, "scale": [1e300, 1, 1]})),
    "glb with vertex 9": (".glb", pack(GOOD, DATA.replace(bytes([0, 2, 3, 0, 0]), bytes([0, 2, 9, 0, 0])))),
    "glb whose chunk is longer": (".glb", pack(GOOD, DATA)[:-8]),
    # Others
    "a format that is not read": (".gltf", json.dumps(GOOD).encode()),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_mesh_that_lies_is_refused_in_one_sentence(name: str, tmp_path: Path) -> None:
    suffix, content = REFUSED[name]
    path = tmp_path / f"face{suffix}"
    path.write_bytes(content)
    with pytest.raises(FaceDiffError, match=r"face\.\w+: ") as error:
        read_mesh(path)
    assert "\n" not in str(error.value)


ICO = trimesh.creation.icosphere(subdivisions=1)


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".glb"])
def test_a_mesh_is_read_as_it_was_written(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"ball{suffix}"
    ICO.export(path)
    mesh = read_mesh(path)
    corners = ICO.vertices[ICO.faces]
    np.testing.assert_allclose(mesh.vertices[mesh.faces], corners, atol=1e-6)
    assert len(mesh.vertices) == len(ICO.vertices)


MIXED = [[0, 1, 2, 3], [0, 1, 4], [4, 3, 2, 1, 0]]
CUT = [[0, 1, 4], [0, 1, 2], [2, 3, 0], [4, 3, 2], [4, 2, 1], [4, 1, 0]]
POINTS = np.vstack([CORNERS, [[0, 0, 1]]]).astype("<f4")


def test_polygons_of_several_sizes_are_cut_alike_in_all_forms(tmp_path: Path) -> None:
    rows = "".join(f"{len(face)} {' '.join(map(str, face))}\n" for face in MIXED)
    points = "".join(f"{x:g} {y:g} {z:g}\n" for x, y, z in POINTS)
    head = ["element vertex 5", *XYZ, "element face 3", LIST]
    faces = b"".join(bytes([len(face)]) + struct.pack(f"<{len(face)}i", *face) for face in MIXED)
    swapped = b"".join(bytes([len(face)]) + struct.pack(f">{len(face)}i", *face) for face in MIXED)
    files = {
        "text.ply": ply(*head, body=(points + rows).encode(), form="ascii"),
        "little.ply": ply(*head, body=POINTS.tobytes() + faces),
        "big.ply": ply(*head, body=POINTS.astype(">f4").tobytes() + swapped, form="binary_big_endian"),
        "windows.ply": ply(*head, body=(points + rows).encode(), form="ascii").replace(b"\n", b"\r\n"),
    }
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
        mesh = read_mesh(tmp_path / name)
        assert mesh.faces.tolist() == CUT, name
        assert mesh.vertices.tolist() == POINTS.tolist(), name


def test_a_textured_ply_keeps_its_vertices(tmp_path: Path) -> None:
    head = ["element vertex 4", *XYZ, "element face 2", LIST, "property list uchar float texcoord"]
    body = SQUARE + "3 0 1 2 6 0 0 1 0 1 1\n3 0 2 3 6 .5 .5 0 0 1 0\n"
    (tmp_path / "a.ply").write_bytes(ply("comment TextureFile /etc/passwd", *head, body=body.encode(), form="ascii"))
    mesh = read_mesh(tmp_path / "a.ply")
    assert mesh.vertices.tolist() == CORNERS.tolist()
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3]]


@pytest.mark.parametrize(
    ("kind", "colours"),
    [("uchar", "255 51 0"), ("float", "1 0.2 0"), ("float", "255 51 0"), ("ushort", "65535 13107 0")],
)
def test_colours_of_a_ply_are_those_of_a_screen_whatever_their_type(kind: str, colours: str, tmp_path: Path) -> None:
    head = [f"property {kind} {name}" for name in ("red", "green", "blue")]
    body = "".join(f"{row} {colours}\n" for row in SQUARE.splitlines()) + "3 0 1 2\n"
    head = ["element vertex 4", *XYZ, *head, "element face 1", LIST]
    (tmp_path / "a.ply").write_bytes(ply(*head, body=body.encode(), form="ascii"))
    read = read_mesh(tmp_path / "a.ply").colours
    assert read is not None
    assert read.tolist() == [[255, 51, 0]] * 4


def test_sparse_changes_of_a_glb_are_made(tmp_path: Path) -> None:
    content = json.loads(json.dumps(GOOD))
    content["bufferViews"] += [
        {"buffer": 0, "byteOffset": 56, "byteLength": 1},
        {"buffer": 0, "byteOffset": 60, "byteLength": 12},
    ]
    content["accessors"][0]["sparse"] = {
        "count": 1,
        "indices": {"bufferView": 2, "componentType": 5121},
        "values": {"bufferView": 3},
    }
    moved = np.array([[7, 8, 9]], "<f4")
    (tmp_path / "a.glb").write_bytes(pack(content, DATA + bytes([2, 0, 0, 0]) + moved.tobytes()))
    assert read_mesh(tmp_path / "a.glb").vertices.tolist() == [[0, 0, 0], [1, 0, 0], [7, 8, 9], [0, 1, 0]]


@pytest.mark.parametrize(
    ("node", "expected"),
    [
        ({"translation": [1, 2, 3]}, [2, 2, 3]),
        ({"scale": [2, 1, 1]}, [2, 0, 0]),
        ({"rotation": [0, 0, 0.5**0.5, 0.5**0.5]}, [0, 1, 0]),
        ({"matrix": [0, 1, 0, 0, -1, 0, 0, 0, 0, 0, 1, 0, 5, 6, 7, 1]}, [5, 7, 7]),
    ],
)
def test_nodes_place_the_meshes_of_a_glb(node: dict[str, Any], expected: list[float], tmp_path: Path) -> None:
    (tmp_path / "a.glb").write_bytes(changed("nodes", [{"children": [1], **node}, {"mesh": 0}]))
    np.testing.assert_allclose(read_mesh(tmp_path / "a.glb").vertices[1], expected, atol=1e-6)


def test_a_mirrored_mesh_keeps_its_outside(tmp_path: Path) -> None:
    (tmp_path / "a.glb").write_bytes(changed("nodes", [{"mesh": 0, "scale": [-1, 1, 1]}]))
    assert read_mesh(tmp_path / "a.glb").faces.tolist() == [[2, 1, 0], [3, 2, 0]]


@pytest.mark.parametrize("number", ["1e308", "-1e20", "nan", "inf"])
def test_texture_coordinates_beyond_all_numbers_are_refused(number: str, tmp_path: Path) -> None:
    (tmp_path / "face.obj").write_text(f"v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 {number}\nf 1/1 2/1 3/1\n")
    with pytest.raises(FaceDiffError, match=r"face\.obj"):
        read_textures(tmp_path / "face.obj", 1)


def test_materials_may_share_a_picture(tmp_path: Path) -> None:
    """A file of megabytes may have thousands of materials with one picture, or name one file as often."""
    picture = b"\x89PNG\r\n\x1a\n" + bytes(1000)
    (tmp_path / "face.png").write_bytes(picture)
    names = [f"m{number}" for number in range(50)]
    library = "\n".join(f"newmtl {name}\nmap_Kd face.png\nmap_Kd face.png\nmap_Kd none.png" for name in names)
    (tmp_path / "face.mtl").write_text(library)
    faces = "\n".join(f"usemtl {name}\nf 1/1 2/2 3/3" for name in names)
    text = "mtllib face.mtl\n" * 50 + f"v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\n{faces}\n"
    (tmp_path / "face.obj").write_text(text)
    surface = read_textures(tmp_path / "face.obj", 50)
    assert {material.picture for material in surface.materials} == {tmp_path / "face.png"}
    assert len(surface.losses) == 1


SQUARE_OBJ = "# caf\u00e9\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3\nf 1 3 4\n"
SQUARE_PLY = (
    "ply\nformat ascii 1.0\ncomment caf\u00e9\nobj_info \u00fcber\nelement vertex 4\n"
    "property float x\nproperty float y\n"
    "property float z\nelement face 2\nproperty list uchar int vertex_indices\nend_header\n"
    "0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2\n3 0 2 3\n"
)
WRITTEN = {
    "PLY in Latin-1": (".ply", SQUARE_PLY.encode("latin-1")),
    "PLY with a line end of Unicode in a comment": (".ply", SQUARE_PLY.replace("caf", "\x85 caf").encode("latin-1")),
    "PLY of Windows": (".ply", SQUARE_PLY.replace("\n", "\r\n").encode("latin-1")),
    "PLY with a mark": (".ply", SQUARE_PLY.encode("utf-8-sig")),
    "OBJ with a mark": (".obj", SQUARE_OBJ.removeprefix("# caf\u00e9\n").encode("utf-8-sig")),
    "OBJ in Latin-1": (".obj", SQUARE_OBJ.encode("latin-1")),
    "OBJ, indented": (".obj", SQUARE_OBJ.replace("\nv", "\n  v").replace("\nf", "\n\tf").encode()),
    "OBJ with lines that go on": (".obj", SQUARE_OBJ.replace("f 1 2 3", "f 1 2 \\\n 3").encode()),
}


@pytest.mark.parametrize("name", WRITTEN)
def test_a_mesh_of_other_editors_is_read(name: str, tmp_path: Path) -> None:
    suffix, content = WRITTEN[name]
    (tmp_path / f"square{suffix}").write_bytes(content)
    mesh = read_mesh(tmp_path / f"square{suffix}")
    assert mesh.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3]]
