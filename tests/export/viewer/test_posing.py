"""A page gives the weights of a motion in weights: as tables, in the archive, and as a .glb under their names."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from facediff.animation import Animation, read_archive
from facediff.mesh.flame import rotations
from facediff.spaces import layout
from tests.export.viewer.test_editor import downloaded
from tests.fakes.chromium import Page
from tests.fakes.clicks import clicks
from tests.fakes.glb_reader import Reader


def in_weights() -> Animation:
    """Weights above 1, a head and eyes that turn, on a small face."""
    face, space, rng = clicks(), layout("live_link"), np.random.default_rng(0)
    values = rng.uniform(0, 1.1, (len(face.vertices), 61)).astype(np.float32)
    values[:, 52:] *= 0.2
    deltas = rng.normal(size=(52, *face.template.shape)).astype(np.float32)
    vertices = face.template + np.tensordot(values[:, :52], deltas, 1)
    head = np.pad(values[:, 52:55].astype(float), ((0, 0), (0, 3)), constant_values=1.0)
    moved = np.einsum("tij,tvj->tvi", rotations(head[:, :3]), vertices) + head[:, None, 3:]
    animation = replace(face, name="take", vertices=moved.astype(np.float32), head=head)
    return animation.made_of(space, values, deltas)


def test_a_take_in_weights_is_downloaded_in_weights(show: Callable[..., Page], tmp_path: Path) -> None:
    animation = in_weights()
    page = show([clicks(), animation])

    def pressed(button: str) -> Path:
        click = f"(document.querySelector('{button}').click(), 0)"
        return downloaded(page, tmp_path / button.strip("#[]").replace("'", ""), lambda: page.evaluate(click))

    hidden = "document.getElementById('take-tables').hidden"
    assert page.evaluate(f"(downloads.click(), {hidden})")  # the first take has no weights
    page.evaluate("(taken.value = '1', taken.dispatchEvent(new Event('change')), 0)")
    assert not page.evaluate(hidden)
    (tmp_path / "export").mkdir()
    animation.save(tmp_path / "export" / "take.csv")
    assert pressed("[data-tracks=arkit]").read_bytes() == (tmp_path / "export" / "take.csv").read_bytes()
    animation.save(tmp_path / "export" / "visemes.csv", tracks="oculus")
    table = pressed("[data-tracks=oculus]")
    assert table.name == "take_oculus.csv"
    assert table.read_bytes() == (tmp_path / "export" / "visemes.csv").read_bytes()
    archive = read_archive(pressed("#take-motion"))
    assert archive.space == animation.space
    np.testing.assert_array_equal(np.asarray(archive.values), np.asarray(animation.values))
    animation.save(tmp_path / "export" / "take.glb")
    own, exported = Reader(pressed("#take-glb")), Reader(tmp_path / "export" / "take.glb")
    assert own.gltf.meshes[0].extras["targetNames"] == exported.gltf.meshes[0].extras["targetNames"]
    np.testing.assert_array_equal(own.weights, exported.weights)
    for frame in (0, 9, 74):
        assert np.linalg.norm(own.at(frame / 25) - exported.at(frame / 25), axis=1).max() < 1e-4  # 0.1 mm
    turns = [[read.values(s.output) for s in read.gltf.animations[0].samplers[1:]] for read in (own, exported)]
    assert len(turns[0]) == 4
    np.testing.assert_array_equal(np.concatenate(turns[0], axis=1), np.concatenate(turns[1], axis=1))
    assert [(n.name, n.children) for n in own.gltf.nodes] == [(n.name, n.children) for n in exported.gltf.nodes]
    assert own.gltf.scenes[0].nodes == exported.gltf.scenes[0].nodes
