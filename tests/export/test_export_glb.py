"""A .glb read back by pygltflib and trimesh, and checked against the rules of the glTF 2.0 specification."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from facediff.animation import Animation
from facediff.export import ExportOptions, write_animations
from facediff.export.format import normals_of, outward
from facediff.export.motion_shapes import compress
from facediff.mesh import read_mesh
from facediff.mesh.glb import Glb
from facediff.utils.colours import to_linear, to_srgb
from tests.fakes.glb_reader import COMPONENTS, WIDTHS, Reader
from tests.fakes.glb_targets import pack
from tests.fakes.small_face import small_shapes, write_small_shapes


@pytest.mark.parametrize("unit", ["m", "mm", "normalised (about 185 mm)"])
def test_glb_gives_back_every_vertex_at_its_time(
    make_animation: Callable[..., Animation], tmp_path: Path, unit: str
) -> None:
    animation = make_animation(unit=unit)
    metres = {"m": 1.0, "mm": 0.001}.get(unit, 0.185)
    write_animations(tmp_path / "a.glb", [animation])
    reader = Reader(tmp_path / "a.glb")
    np.testing.assert_array_equal(reader.times, (np.arange(40) / 30).astype(np.float32))
    assert reader.weights.min() >= 0
    assert reader.weights.max() <= 1
    for index in range(40):
        distance = np.linalg.norm(reader.at(float(reader.times[index])) - animation.vertices[index] * metres, axis=-1)
        assert distance.max() <= 0.05e-3
    between = (animation.vertices[6] + animation.vertices[7]) / 2 * metres
    assert np.linalg.norm(reader.at(6.5 / 30) - between, axis=-1).max() <= 0.05e-3


def test_glb_has_few_targets_for_a_motion_of_few_shapes(animation: Animation, tmp_path: Path) -> None:
    write_animations(tmp_path / "a.glb", [animation], ExportOptions(tolerance=0.001))
    reader = Reader(tmp_path / "a.glb")
    assert len(reader.primitive.targets) == 10  # two halves of each of five components
    assert reader.gltf.meshes[0].extras["targetNames"] == [f"shape_{index:04d}" for index in range(10)]
    np.testing.assert_allclose(reader.values(reader.primitive.attributes.POSITION), animation.template)


def test_glb_has_a_target_for_every_frame_that_cannot_be_compressed(
    make_animation: Callable[..., Animation], tmp_path: Path
) -> None:
    noise = np.random.default_rng(1).normal(0, 0.01, (9, 162, 3))
    template = make_animation().template
    animation = make_animation(vertices=(template + noise).astype(np.float32))
    write_animations(tmp_path / "a.glb", [animation])
    reader = Reader(tmp_path / "a.glb")
    assert len(reader.primitive.targets) == 9
    np.testing.assert_array_equal(reader.weights, np.eye(9))
    for index in range(9):
        np.testing.assert_allclose(reader.at(index / 30), animation.vertices[index], atol=1e-7)


@pytest.mark.parametrize("frames", [1, 2])
def test_glb_of_short_and_still_animations(
    make_animation: Callable[..., Animation], tmp_path: Path, frames: int
) -> None:
    moving, still = make_animation(), make_animation().template
    for name, vertices in {"moving": moving.vertices[:frames], "still": np.stack([still] * frames)}.items():
        write_animations(tmp_path / f"{name}.glb", [make_animation(vertices=vertices)])
        reader = Reader(tmp_path / f"{name}.glb")
        for index in range(frames):
            np.testing.assert_allclose(reader.at(index / 30), vertices[index], atol=1e-7)


def test_glb_follows_the_specification(animation: Animation, tmp_path: Path) -> None:
    write_animations(tmp_path / "a.glb", [animation])
    data = (tmp_path / "a.glb").read_bytes()
    magic, version, length, json_length, json_kind = struct.unpack_from("<4sIII4s", data)
    binary_length, binary_kind = struct.unpack_from("<I4s", data, 20 + json_length)
    assert (magic, version, length, json_kind, binary_kind) == (b"glTF", 2, len(data), b"JSON", b"BIN\0")
    assert json_length % 4 == binary_length % 4 == 0
    document = json.loads(data[20 : 20 + json_length])
    assert document["buffers"] == [{"byteLength": binary_length}]
    assert 28 + json_length + binary_length == length
    reader, end = Reader(tmp_path / "a.glb"), 0
    for accessor, view in zip(document["accessors"], document["bufferViews"], strict=True):
        size = np.dtype(COMPONENTS[accessor["componentType"]]).itemsize * WIDTHS[accessor["type"]] * accessor["count"]
        assert view["byteOffset"] % 4 == 0
        assert view["byteOffset"] >= end
        assert view["byteLength"] == size
        end = view["byteOffset"] + size
        if "min" in accessor:
            values = reader.values(accessor["bufferView"]).reshape(accessor["count"], -1)
            assert accessor["min"] == values.min(0).tolist()
            assert accessor["max"] == values.max(0).tolist()
    assert end <= binary_length
    (primitive,) = document["meshes"][0]["primitives"]
    attributes = [*primitive["attributes"].values(), *(i for target in primitive["targets"] for i in target.values())]
    views = document["bufferViews"]
    assert {views[index]["target"] for index in attributes} == {34962}
    assert views[primitive["indices"]]["target"] == 34963
    animated = document["animations"][0]["samplers"][0]
    assert "target" not in views[animated["input"]]
    assert "target" not in views[animated["output"]]
    assert "min" in document["accessors"][animated["input"]]
    positions = [primitive["attributes"]["POSITION"], *(target["POSITION"] for target in primitive["targets"])]
    assert all("min" in document["accessors"][index] for index in positions)
    assert len(document["meshes"][0]["weights"]) == len(primitive["targets"])
    assert document["accessors"][animated["output"]]["count"] == 40 * len(primitive["targets"])
    assert document["asset"]["generator"] == "facediff"
    assert document["nodes"][0]["extras"] == {
        "name": "Hello Zoë",
        "frame_rate": 30.0,
        "frames": 40,
        "unit": "m",
        "metres_per_unit": 1.0,
        "up": "y",
        "metadata": {"identity": "Zoë", "style": "F1_e01"},
        "tolerance_mm": 0.05,
        "speech": "a.wav",
    }


def test_glb_face_is_whole_and_its_colours_are_linear(animation: Animation, tmp_path: Path) -> None:
    write_animations(tmp_path / "a.glb", [animation])
    mesh = trimesh.load(tmp_path / "a.glb", process=False, maintain_order=True, force="mesh")
    np.testing.assert_allclose(mesh.vertices, animation.template, atol=1e-8)
    assert {tuple(sorted(face)) for face in mesh.faces} == {tuple(sorted(face)) for face in animation.triangles}
    share = animation.colours / 255  # type: ignore[operator]
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)  # IEC 61966-2-1
    reader = Reader(tmp_path / "a.glb")
    np.testing.assert_allclose(reader.values(reader.primitive.attributes.COLOR_0), linear, atol=1e-6)


@pytest.mark.parametrize("tint", [None, [0.5, 1.0, 0.25, 1.0]])
def test_colours_of_a_glb_come_back_multiplied_by_its_materials(
    animation: Animation, tmp_path: Path, tint: list[float] | None
) -> None:
    write_animations(tmp_path / "a.glb", [animation])
    glb = Glb((tmp_path / "a.glb").read_bytes(), "a.glb")
    if tint is not None:
        glb.content["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"] = tint
        (tmp_path / "a.glb").write_bytes(pack(glb.content, glb.binary))
    expected = to_srgb(to_linear(animation.colours / 255) * np.array((tint or [1, 1, 1])[:3]))  # type: ignore[operator]
    np.testing.assert_allclose(read_mesh(tmp_path / "a.glb").colours, 255 * expected, atol=0.51)


@pytest.mark.parametrize("inside_out", [False, True])
def test_glb_faces_and_normals_look_outward(
    make_animation: Callable[..., Animation], tmp_path: Path, inside_out: bool
) -> None:
    faces = make_animation().triangles
    animation = make_animation(faces=np.ascontiguousarray(faces[:, ::-1]) if inside_out else faces)
    write_animations(tmp_path / "a.glb", [animation])
    mesh = trimesh.load(tmp_path / "a.glb", process=False, maintain_order=True, force="mesh")
    assert mesh.volume > 0
    reader = Reader(tmp_path / "a.glb")
    for index in (0, 13, 39):
        corners = animation.vertices[index].astype(float)[faces]
        true = np.zeros((162, 3))  # area-weighted means of the faces around
        for corner in range(3):
            np.add.at(true, faces[:, corner], np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
        true /= np.linalg.norm(true, axis=-1, keepdims=True)
        made = reader.at(index / 30, "NORMAL")
        made /= np.linalg.norm(made, axis=-1, keepdims=True)
        angles = np.degrees(np.arccos(np.clip((made * true).sum(-1), -1, 1)))
        assert np.median(angles) < 2
    np.testing.assert_allclose(np.linalg.norm(reader.values(reader.primitive.attributes.NORMAL), axis=-1), 1, atol=1e-6)


@settings(max_examples=25, deadline=None)
@given(
    frames=st.integers(1, 14),
    rank=st.integers(0, 5),
    noise=st.sampled_from([0.0, 1e-6, 1e-3]),
    tolerance=st.sampled_from([1e-5, 1e-4]),
    seed=st.integers(0, 99),
)
def test_compress_keeps_any_motion_within_the_tolerance(
    frames: int, rank: int, noise: float, tolerance: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    motion = rng.normal(0, 1, (frames, rank)) @ rng.normal(0, 5e-3, (rank, 60)) + rng.normal(0, noise, (frames, 60))
    offsets = motion.reshape(frames, 20, 3).astype(np.float32)
    morphs = compress(offsets, tolerance)
    assert morphs.weights.min() >= 0
    assert morphs.weights.max() <= 1
    made = np.tensordot(morphs.weights.astype(float), morphs.shapes.astype(float), axes=1)
    assert np.linalg.norm(made - offsets, axis=-1).max() <= tolerance * (1 + 1e-3)
    assert len(morphs.shapes) <= max(frames, 1)


def test_glb_of_more_vertices_than_short_indices_can_count(
    make_animation: Callable[..., Animation], tmp_path: Path
) -> None:
    template = np.random.default_rng(0).normal(0, 0.1, (65_600, 3)).astype(np.float32)
    faces = np.array([[65_599, 0, 65_535]], np.int32)
    animation = make_animation(vertices=template[None], template=template, faces=faces, colours=None, speech=None)
    assert write_animations(tmp_path / "a.glb", [animation]) == [tmp_path / "a.glb"]
    reader = Reader(tmp_path / "a.glb")
    assert set(reader.values(reader.primitive.indices).tolist()) == {65_599, 0, 65_535}
    assert reader.primitive.attributes.COLOR_0 is None


@pytest.mark.parametrize("key_tolerance", [0.0, 0.05])
def test_named_shapes_give_named_targets_and_curves(tmp_path: Path, key_tolerance: float) -> None:
    """Targets, their normals, and weights at the keys are those of the shapes' own face."""
    neutral, faces, shapes = small_shapes()
    write_small_shapes(tmp_path / "shapes")
    time = np.arange(40) / 25
    goal = {"jawOpen": 0.4 + 0.4 * np.sin(3 * time), "eyeBlinkLeft": np.clip(1 - 8 * np.abs(time - 0.8), 0, 1)}
    moved = neutral + sum(curve[:, None, None] * (shapes[name] - neutral) for name, curve in goal.items())
    made = Animation("a", np.float32(moved), np.float32(neutral), 25.0, faces=faces)
    options = ExportOptions(shapes=tmp_path / "shapes", key_tolerance=key_tolerance)
    write_animations(tmp_path / "a.glb", [made], options)
    read = Reader(tmp_path / "a.glb")
    names = read.gltf.meshes[0].extras["targetNames"]
    assert sorted(names) == sorted(shapes)
    extras = read.gltf.nodes[0].extras
    assert extras["keys"] == len(read.times)
    assert extras["residual_rms_mm"] < 0.2
    assert (len(read.times) < 40) == (key_tolerance > 0)
    for name, curve in goal.items():
        found = np.interp(time, read.times, read.weights[:, names.index(name)])
        assert found == pytest.approx(curve, abs=0.05 + key_tolerance)
        target = read.primitive.targets[names.index(name)]
        assert read.values(target["POSITION"]) == pytest.approx(shapes[name] - neutral, abs=1e-6)
        posed = np.float32(
            normals_of(np.float32(shapes[name]), outward(made)) - normals_of(np.float32(neutral), outward(made))
        )
        assert read.values(target["NORMAL"]) == pytest.approx(posed, abs=1e-4)
    others = [index for index, name in enumerate(names) if name not in goal]
    assert np.abs(read.weights[:, others]).mean() < 0.01
