"""Texture coordinates, materials and pictures of an .obj or .glb in what is written, as other programs read it."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from facediff.animation import Animation
from facediff.animation.options import ExportOptions
from facediff.cli.app import main
from facediff.cli.retarget import with_pictures
from facediff.errors import FaceDiffError
from facediff.export import write_animations
from facediff.mesh import read_mesh
from facediff.mesh.glb import open_glb
from facediff.mesh.textures import mesh_files, read_textures
from tests.fakes.avatar import write_avatar
from tests.fakes.glb_targets import pack

FRAMES = 3


@pytest.fixture
def source(tmp_path: Path) -> Path:
    """A box of quadrangles unwrapped with seams, half of it with a picture and half with a colour."""
    folder = tmp_path / "mine"
    (folder / "maps").mkdir(parents=True)
    box = trimesh.creation.box()
    quads = [(1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4)]
    lines = ["mtllib mine.mtl", *(f"v {x} {y} {z}" for x, y, z in box.vertices)]
    lines += [f"vt {k / 24:.6f} {(5 * k) % 24 / 24:.6f}" for k in range(24)]
    for k, quad in enumerate(quads):
        lines += ["usemtl skin"] if k == 0 else ["usemtl cloth"] if k == 3 else []
        # The second half counts back from the end, as some exporters do.
        places = [4 * k + j + 1 if k < 3 else 4 * k + j - 24 for j in range(4)]
        lines.append("f " + " ".join(f"{v}/{t}" for v, t in zip(quad, places, strict=True)))
    (folder / "mine.obj").write_text("\n".join(lines) + "\n")
    (folder / "mine.mtl").write_text(
        "newmtl skin\nKd 1 1 1\nmap_Kd -s 1 1 1 C:\\art\\skin.png\nnewmtl cloth\nKd 0.2 0.4 0.6\n"
    )
    Image.fromarray(np.arange(48, dtype=np.uint8).reshape(4, 4, 3)).save(folder / "skin.png")
    return folder / "mine.obj"


@pytest.fixture
def animation(source: Path) -> Animation:
    mesh = read_mesh(source)
    rest = mesh.vertices.astype(np.float32)
    moves = np.linspace(1, 1.5, FRAMES)[:, None, None].astype(np.float32)
    return Animation("box", rest * moves, rest, 25.0, faces=mesh.faces)


def corners(points: np.ndarray, faces: np.ndarray, uvs: np.ndarray) -> np.ndarray:
    """Place and texture coordinate of each corner of each triangle (F, 3, 5), in an order that says nothing."""
    table = np.concatenate([points[faces], uvs.reshape(len(faces), 3, 2)], axis=2).round(5)
    return np.array(sorted(sorted(map(tuple, triangle)) for triangle in table.tolist()))


@pytest.fixture
def truth(source: Path, animation: Animation) -> np.ndarray:
    uvs = np.array([[k / 24, (5 * k) % 24 / 24] for k in range(24)])
    fans = np.array([[4 * k + j for j in part] for k in range(6) for part in ((0, 1, 2), (0, 2, 3))])
    return corners(animation.template.astype(float), np.asarray(animation.triangles), uvs[fans])


def parts_of(scene: trimesh.Scene) -> dict[str, trimesh.Trimesh]:
    return {part.visual.material.name: part for part in scene.geometry.values()}


def both(parts: dict[str, trimesh.Trimesh]) -> np.ndarray:
    tables = [corners(part.vertices, part.faces, part.visual.uv[part.faces]) for part in parts.values()]
    return np.array(sorted(np.concatenate(tables).tolist()))


def test_glb_has_seams_materials_and_the_picture(
    tmp_path: Path, source: Path, animation: Animation, truth: np.ndarray
) -> None:
    (written,) = write_animations(tmp_path / "a.glb", [animation], into=source)
    parts = parts_of(trimesh.load(written, process=False))
    assert both(parts) == pytest.approx(truth, abs=1e-5)
    assert sorted(parts) == ["cloth", "skin"]
    picture = np.asarray(parts["skin"].visual.material.baseColorTexture.convert("RGB"))
    assert (picture == np.asarray(Image.open(source.parent / "skin.png"))).all()
    assert len(parts["skin"].faces) == len(parts["cloth"].faces) == 6
    # Colours of glTF are linear light.
    linear = ((np.array([0.2, 0.4, 0.6]) + 0.055) / 1.055) ** 2.4
    assert np.asarray(parts["cloth"].visual.material.baseColorFactor)[:3] / 255 == pytest.approx(linear, abs=0.01)


def test_vertices_have_the_colours_of_pictures_in_the_check_of_a_transfer(source: Path, animation: Animation) -> None:
    shown = with_pictures(animation, source).colours
    assert shown is not None
    pixels = np.asarray(Image.open(source.parent / "skin.png")).reshape(-1, 3).tolist()
    cloth = (np.array([0.2, 0.4, 0.6]) * 255).round().tolist()
    of_skin, of_cloth = (np.unique(animation.triangles[some]) for some in (slice(0, 6), slice(6, 12)))
    assert all(colour in [*pixels, cloth] for colour in shown.tolist())
    assert shown[of_cloth].tolist() == [cloth] * len(of_cloth)  # the last material to reach a vertex
    corner = np.setdiff1d(of_skin, of_cloth)
    assert all(colour in pixels for colour in shown[corner].tolist())
    assert with_pictures(animation, source.with_suffix(".mtl")) is animation


def test_usd_has_coordinates(tmp_path: Path, source: Path, animation: Animation, truth: np.ndarray) -> None:
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom

    assert write_animations(tmp_path / "a.usda", [animation], into=source) == [tmp_path / "a.usda"]
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/box/face"))
    faces = np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
    st = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st")
    assert st.GetInterpolation() == "faceVarying"
    assert corners(np.array(mesh.GetPointsAttr().Get()), faces, np.array(st.Get())) == pytest.approx(truth, abs=1e-5)


def test_what_is_missing_or_lies_elsewhere_is_left_out_and_said(tmp_path: Path, source: Path) -> None:
    secret = tmp_path / "secret.png"
    (source.parent / "skin.png").rename(secret)
    (source.parent / "loop.png").symlink_to("loop.png")
    for name in ("../secret.png", str(secret), "none.png", "mine.mtl", "loop.png", "a\0b.png", 300 * "long" + ".png"):
        (source.parent / "mine.mtl").write_text(f"newmtl skin\nmap_Kd {name}\n")
        surface = read_textures(source, 12)
        assert surface.materials[0].picture is None
        assert any(name in sentence for sentence in surface.losses)
    (source.parent / "mine.mtl").unlink()
    assert "mine.mtl" in read_textures(source, 12).losses[0]
    (source.parent / "mine.mtl").write_text("newmtl skin\nd 0.5\nmap_Bump skin.png\nnewmtl cloth\nd 1.0\n")
    (sentence,) = read_textures(source, 12).losses
    assert "d, map_Bump of mine.mtl" in sentence
    text = source.read_text()
    for broken in (
        text.replace("2/2", "2/99"),
        text.replace("2/2", "2/x"),
        text.replace("f 1/1", "f 1/1 1/1"),
        "v 0 0 0",
    ):
        source.write_text(broken)
        with pytest.raises(FaceDiffError, match=r"mine\.obj"):
            read_textures(source, 12)


def test_the_commands_take_the_surface(
    tmp_path: Path, source: Path, animation: Animation, capsys: pytest.CaptureFixture[str]
) -> None:
    from facediff.animation import write_archive

    write_archive(tmp_path / "a.npz", animation)
    assert main(["export", str(tmp_path / "a.npz"), "-o", str(tmp_path / "b.glb"), "--surface", str(source)]) == 0
    assert b"TEXCOORD_0" in (tmp_path / "b.glb").read_bytes()
    assert main(["export", str(tmp_path / "a.npz"), "-o", str(tmp_path / "b.ply"), "--surface", str(source)]) == 2
    assert "--surface" in capsys.readouterr().err
    assert [file.name for file in mesh_files(source)] == ["mine.obj", "mine.mtl", "skin.png"]
    *others, last = source.read_text().splitlines()
    source.write_text("\n".join([*others[:-1], last, others[-1]]))
    assert main(["export", str(tmp_path / "a.npz"), "-o", str(tmp_path / "b.glb"), "--surface", str(source)]) == 2
    assert "another order" in capsys.readouterr().err


def test_coordinates_and_materials_after_a_tab_are_read_too(source: Path) -> None:
    usual = read_textures(source, 12)
    source.write_text(source.read_text().replace("vt ", "vt\t"))
    library = source.parent / "mine.mtl"
    text = library.read_text()
    library.write_text(re.sub(r"^(\w+) ", r"\1\t", text, flags=re.MULTILINE))
    read = read_textures(source, 12)
    np.testing.assert_array_equal(read.uvs, usual.uvs)
    assert [vars(material) for material in read.materials] == [vars(material) for material in usual.materials]
    library.write_text(text.replace("Kd 0.2 0.4 0.6", "Kd nan 2 -inf"))
    assert read_textures(source, 12).materials[1].colour == (0, 1, 0)


@pytest.fixture
def avatar(tmp_path: Path) -> Path:
    """A skinned figure whose parts share a picture, but for two of one name, plain and with a broken picture."""
    write_avatar(tmp_path / "avatar.glb")
    glb = open_glb(tmp_path / "avatar.glb")
    looks = glb.content["materials"]
    looks[0] = {"name": "plain suit", "pbrMetallicRoughness": {"baseColorFactor": [0.2159, 0, 1, 1]}}
    looks[1] |= {"name": "plain suit", "normalTexture": {"index": 0}}
    looks[1]["pbrMetallicRoughness"] = {"baseColorTexture": {"index": 9}}
    (tmp_path / "avatar.glb").write_bytes(pack(glb.content, glb.binary))
    return tmp_path / "avatar.glb"


def test_textures_of_an_avatar_are_where_its_vertices_are(tmp_path: Path, avatar: Path) -> None:
    mesh = read_mesh(avatar)
    rest = mesh.vertices.astype(np.float32)
    animation = Animation("avatar", np.stack([rest, rest]), rest, 25.0, faces=mesh.faces)
    own = read_textures(avatar, len(mesh.faces))
    # The figure's coordinates are its vertices' places in metres, without whole ones; glTF counts them downwards.
    off = own.uvs[own.corners] - (mesh.vertices[:, :2] * [1, -1])[mesh.faces]
    assert np.abs(off - np.rint(off)).max() < 1e-5
    names = [material.name for material in own.materials]
    plain = [number for number, text in enumerate(names) if text == f"plain_suit_{number}"]
    assert len(plain) == 2
    assert any(own.materials[number].colour == pytest.approx((128 / 255, 0, 1), abs=1e-3) for number in plain)
    assert sum(material.picture is None for material in own.materials) == 2
    assert len(own.losses) == 2
    assert "picture of plain_suit" in own.losses[0]
    assert "normalTexture of avatar.glb left out" in own.losses[1]
    (written,) = write_animations(tmp_path / "a.glb", [animation], ExportOptions(surface=avatar))
    uvs = parts_of(trimesh.load(written, process=False))["HairMaterial"].visual.uv
    assert {tuple(row) for row in uvs.round(4)} <= {tuple(row) for row in own.uvs.round(4)}
