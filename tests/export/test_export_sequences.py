"""Sequences of meshes, point caches and arrays, read back by readers written from the formats' descriptions."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import soundfile
import trimesh

from facediff.animation import Animation, read_archive
from facediff.export import ExportOptions, write_animations
from facediff.spaces import layout

TURN = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])  # +90 degrees about x


def read_pc2(path: Path) -> tuple[npt.NDArray[np.float32], float, float]:
    """Positions, first frame and step: a header of 32 bytes, then samples of little endian floats."""
    data = path.read_bytes()
    signature, version, points, start, step, samples = struct.unpack_from("<12siiffi", data)
    assert (signature, version) == (b"POINTCACHE2\0", 1)
    assert len(data) == 32 + 12 * points * samples
    values = struct.unpack_from(f"<{3 * points * samples}f", data, 32)
    return np.array(values, np.float32).reshape(samples, points, 3), start, step


def read_mdd(path: Path) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Positions and times: two big endian counts, the times, then positions."""
    data = path.read_bytes()
    frames, points = struct.unpack_from(">ii", data)
    assert len(data) == 8 + 4 * frames + 12 * frames * points
    times = struct.unpack_from(f">{frames}f", data, 8)
    values = struct.unpack_from(f">{3 * points * frames}f", data, 8 + 4 * frames)
    return np.array(values, np.float32).reshape(frames, points, 3), np.array(times, np.float32)


@pytest.mark.parametrize("suffix", [".obj", ".ply"])
def test_sequence_is_a_folder_with_a_mesh_for_every_frame(animation: Animation, tmp_path: Path, suffix: str) -> None:
    folder = tmp_path / f"hello_{suffix[1:]}"
    assert write_animations(tmp_path / f"hello{suffix}", [animation]) == [folder]
    names = [f"hello_{index:04d}{suffix}" for index in range(40)]
    assert {file.name for file in folder.iterdir()} == {*names, "hello.wav", "sequence.json"}
    for index, name in enumerate(names):
        mesh = trimesh.load(folder / name, process=False, maintain_order=True)
        np.testing.assert_array_equal(np.asarray(mesh.vertices, np.float32), animation.vertices[index])
        np.testing.assert_array_equal(mesh.faces, animation.triangles)
        np.testing.assert_allclose(mesh.visual.vertex_colors[:, :3], animation.colours, atol=0)
    found = json.loads((folder / "sequence.json").read_text())
    assert found["format"] == "facediff sequence 1"
    assert (found["frame_rate"], found["frames"], found["files"]) == (30.0, 40, f"hello_####{suffix}")
    assert (found["unit"], found["metres_per_unit"], found["up"], found["speech"]) == ("m", 1.0, "y", "hello.wav")
    assert found["metadata"] == {"identity": "Zoë", "style": "F1_e01"}
    assert soundfile.info(folder / "hello.wav").frames == round(40 / 30 * 16_000)


def test_sequence_without_colours(make_animation: Callable[..., Animation], tmp_path: Path) -> None:
    animation = make_animation(colours=None, speech=None)
    for suffix in (".obj", ".ply"):
        (folder,) = write_animations(tmp_path / f"hello{suffix}", [animation])
        mesh = trimesh.load(folder / f"hello_0039{suffix}", process=False, maintain_order=True)
        np.testing.assert_array_equal(np.asarray(mesh.vertices, np.float32), animation.vertices[39])
        assert not (folder / "hello.wav").exists()


def test_point_caches_and_the_mesh_next_to_them(animation: Animation, tmp_path: Path) -> None:
    for suffix in (".pc2", ".mdd"):
        path = tmp_path / suffix[1:] / f"hello{suffix}"
        assert write_animations(path, [animation]) == [path, path.with_suffix(".obj"), path.with_suffix(".wav")]
        mesh = trimesh.load(path.with_suffix(".obj"), process=False, maintain_order=True)
        np.testing.assert_array_equal(np.asarray(mesh.vertices, np.float32), animation.template)
        np.testing.assert_array_equal(mesh.faces, animation.triangles)
    positions, start, step = read_pc2(tmp_path / "pc2/hello.pc2")
    np.testing.assert_array_equal(positions, animation.vertices)
    assert (start, step) == (0, 1)
    positions, times = read_mdd(tmp_path / "mdd/hello.mdd")
    np.testing.assert_array_equal(positions, animation.vertices)
    np.testing.assert_array_equal(times, (np.arange(40) / 30).astype(np.float32))


def test_point_caches_need_no_faces(make_animation: Callable[..., Animation], tmp_path: Path) -> None:
    animation = make_animation(faces=None, speech=None)
    for suffix in (".pc2", ".mdd", ".npy", ".npz"):
        assert write_animations(tmp_path / f"hello{suffix}", [animation]) == [tmp_path / f"hello{suffix}"]


def test_unit_and_axis(make_animation: Callable[..., Animation], tmp_path: Path) -> None:
    animation = make_animation(unit="mm")
    options = ExportOptions(output_unit="cm", up="z", no_speech=True)
    for suffix in (".obj", ".ply", ".pc2", ".mdd", ".npy"):
        write_animations(tmp_path / suffix[1:] / f"a{suffix}", [animation], options)
    want, rest = animation.vertices @ TURN.T / 10, animation.template @ TURN.T / 10
    for positions in (read_pc2(tmp_path / "pc2/a.pc2")[0], read_mdd(tmp_path / "mdd/a.mdd")[0]):
        np.testing.assert_allclose(positions, want, rtol=1e-6)
    np.testing.assert_allclose(np.load(tmp_path / "npy/a.npy"), want, rtol=1e-6)
    mesh = trimesh.load(tmp_path / "mdd/a.obj", process=False, maintain_order=True)
    np.testing.assert_allclose(mesh.vertices, rest, rtol=1e-6)
    assert (tmp_path / "mdd/a.obj").read_text().startswith("# facediff: Hello Zoë, unit cm (0.01 m), z up, 30 frames")
    for suffix in ("obj", "ply"):
        folder = tmp_path / suffix / f"a_{suffix}"
        mesh = trimesh.load(folder / f"a_0007.{suffix}", process=False, maintain_order=True)
        np.testing.assert_allclose(mesh.vertices, want[7], rtol=1e-6)
        found = json.loads((folder / "sequence.json").read_text())
        assert (found["unit"], found["metres_per_unit"], found["up"]) == ("cm", 0.01, "z")
    assert not list(tmp_path.rglob("*.wav"))


def test_numpy_files(animation: Animation, tmp_path: Path) -> None:
    write_animations(tmp_path / "a.npy", [animation])
    bare = np.load(tmp_path / "a.npy", mmap_mode="r", allow_pickle=False)
    assert bare.dtype == np.float32
    np.testing.assert_array_equal(bare, animation.vertices)
    write_animations(tmp_path / "a.npz", [animation])
    np.testing.assert_array_equal(read_archive(tmp_path / "a.npz").vertices, animation.vertices)
    write_animations(tmp_path / "b.npz", [animation], ExportOptions(output_unit="mm", no_speech=True))
    scaled = read_archive(tmp_path / "b.npz")
    np.testing.assert_allclose(scaled.vertices, animation.vertices * 1000, rtol=1e-6)
    np.testing.assert_allclose(scaled.template, animation.template * 1000, rtol=1e-6)
    assert (scaled.unit, scaled.speech) == ("mm", None)


def test_an_archive_in_another_unit_keeps_its_channels(animation: Animation, tmp_path: Path) -> None:
    space = layout("arkit")
    values = np.random.default_rng(0).random((len(animation.vertices), len(space.channels))).astype(np.float32)
    deltas = np.ones((len(space.face), *animation.template.shape), np.float32)
    write_animations(tmp_path / "a.npz", [animation.made_of(space, values, deltas)], ExportOptions(output_unit="mm"))
    scaled = read_archive(tmp_path / "a.npz")
    assert scaled.values is not None
    assert scaled.deltas is not None
    np.testing.assert_array_equal(scaled.values, values)
    np.testing.assert_allclose(scaled.deltas, 1000 * deltas)


def test_memory_map_may_be_replaced_by_its_own_export(animation: Animation, tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", animation.vertices)
    mapped = np.load(tmp_path / "a.npy", mmap_mode="r")
    write_animations(tmp_path / "a.npy", [replace(animation, vertices=mapped)], ExportOptions(output_unit="mm"))
    np.testing.assert_allclose(np.load(tmp_path / "a.npy"), animation.vertices * 1000, rtol=1e-6)
