"""The writer of .glb files, read back by the reader: arrays of any length, what was there before, and too much data."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from facediff.export import glb_writer
from facediff.export.glb_writer import GlbWriter
from facediff.mesh.glb import Glb


def test_arrays_come_back_whatever_their_lengths(tmp_path: Path) -> None:
    writer = GlbWriter({"asset": {"version": "2.0"}}, b"odd")
    indices = np.arange(5, dtype=np.uint16)  # ten bytes, after which floats must begin at a multiple of four
    points = np.random.default_rng(0).normal(size=(7, 3)).astype(np.float32)
    numbers = [writer.add(indices), writer.add(points, target=glb_writer.ARRAY_BUFFER, bounds=True)]
    writer.write(tmp_path / "a.glb")
    glb = Glb((tmp_path / "a.glb").read_bytes(), "a.glb")
    assert glb.binary.startswith(b"odd")
    np.testing.assert_array_equal(glb.numbers(numbers[0], "SCALAR", ("u2",))[:, 0], indices)
    np.testing.assert_array_equal(glb.numbers(numbers[1], "VEC3", ("f4",)), points)
    assert all(view["byteOffset"] % 4 == 0 for view in glb.entries("bufferViews"))
    assert glb.entry("accessors", numbers[1])["min"] == points.min(axis=0).tolist()
