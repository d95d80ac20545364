"""A page gives the weights of a motion in weights in its archive."""

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
    page.evaluate("(downloads.click(), taken.value = '1', taken.dispatchEvent(new Event('change')), 0)")
    click = "(document.getElementById('take-motion').click(), 0)"
    archive = read_archive(downloaded(page, tmp_path / "take.npz", lambda: page.evaluate(click)))
    assert archive.space == animation.space
    np.testing.assert_array_equal(np.asarray(archive.values), np.asarray(animation.values))
