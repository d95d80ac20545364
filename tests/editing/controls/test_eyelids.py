"""Where a topology's eyes are, from any file, and how its lids shut."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from facediff.animation import Animation
from facediff.editing.controls.controlled_face import apply_controls
from facediff.editing.controls.eyelids import Eyes, puppet_eyes, read_eyes
from facediff.errors import FaceDiffError
from facediff.synthetic.head.parts import build_head
from tests.fakes.meshes import write_obj
from tests.fakes.single_controls import parsed


def test_the_puppets_own_eyes(make_animation: Callable[..., Animation], eyes: Eyes) -> None:
    animation = make_animation(1)
    found = puppet_eyes(animation.template, animation.faces)
    assert found is not None
    assert found.closing is not None
    np.testing.assert_allclose(found.closing, eyes.closing, atol=1e-6)
    assert {frozenset(ball.tolist()) for ball in found.eyeballs} == {frozenset(b.tolist()) for b in eyes.eyeballs}
    assert puppet_eyes(animation.template, None) is None
    assert puppet_eyes(animation.template[:9], animation.faces) is None
    assert puppet_eyes(animation.template, animation.triangles[1:]) is None


def lid_gap(vertices: np.ndarray) -> float:
    ring = build_head().groups["eye_edge"]
    return float((vertices[ring[1:12], 1] - vertices[ring[13:][::-1], 1]).max())


def test_lids_of_other_speakers_on_the_puppets_mesh_shut_by_their_edges(
    make_animation: Callable[..., Animation],
) -> None:
    animation = make_animation(1)
    face = animation.template * np.array([1.3, 1.15, 1.1], np.float32)
    found = puppet_eyes(face, animation.faces)
    assert found is not None
    assert found.closing is not None
    shut = face + found.closing
    assert lid_gap(face) > 0.009
    assert abs(lid_gap(shut)) < 0.0004
    assert not found.closing[np.concatenate(found.eyeballs)].any()
    assert not found.closing[animation.regions["lips"]].any()
    mirror = build_head().mirror
    np.testing.assert_allclose(found.closing[mirror] * [-1, 1, 1], found.closing, atol=2e-4)


@pytest.fixture
def eyes_folder(make_animation: Callable[..., Animation], eyes: Eyes, tmp_path: Path) -> Path:
    """Blink shapes in centimetres, masks as FLAME's file has them, and lists of edges."""
    animation, mesh = make_animation(1), build_head()
    assert eyes.closing is not None
    left = animation.template[:, 0] > 0
    write_obj(tmp_path / "neutral.obj", 100 * animation.template, animation.triangles)
    for name, side in (("eyeBlinkLeft", left), ("eyeBlinkRight", ~left)):
        write_obj(
            tmp_path / f"{name}.obj", 100 * (animation.template + side[:, None] * eyes.closing), animation.triangles
        )
        np.save(tmp_path / f"{name}.npy", side[:, None] * eyes.closing)
    masks = dict(zip(("left_eyeball", "right_eyeball"), eyes.eyeballs, strict=True))
    (tmp_path / "masks.pkl").write_bytes(pickle.dumps(masks))
    ring = mesh.groups["eye_edge"]
    upper, lower = ring[:13], ring[[0, *range(23, 11, -1)]]
    (tmp_path / "upper.txt").write_text(", ".join(map(str, upper)))
    told = {
        "shapes": {
            "neutral": "neutral.obj",
            "blinks": ["eyeBlinkLeft.obj", "eyeBlinkRight.obj"],
            "eyeballs": ["masks.pkl:left_eyeball", "masks.pkl:right_eyeball"],
        },
        "ways": {"blinks": ["eyeBlinkLeft.npy", "eyeBlinkRight.npy"], "eyeballs": [eyes.eyeballs[0].tolist()]},
        "edges": {
            "lids": [
                {"upper": "upper.txt", "lower": lower.tolist()},
                {"upper": mesh.mirror[upper].tolist(), "lower": mesh.mirror[lower][::-1].tolist()},
            ],
            "eyeballs": ["masks.pkl:left_eyeball", "masks.pkl:right_eyeball"],
        },
    }
    for name, content in told.items():
        (tmp_path / f"{name}.json").write_text(json.dumps(content))
    return tmp_path


@pytest.mark.parametrize("name", ["shapes.json", "ways.json"])
def test_eyes_from_files_shut_as_the_rig_does(
    name: str, eyes_folder: Path, make_animation: Callable[..., Animation], eyes: Eyes
) -> None:
    animation = replace(make_animation(200), faces=None)
    found = read_eyes(eyes_folder / name, animation.template)
    assert found.closing is not None
    np.testing.assert_allclose(found.closing, eyes.closing, atol=1e-6)
    assert np.array_equal(np.sort(found.eyeballs[0]), np.sort(eyes.eyeballs[0]))
    made = apply_controls(animation, parsed("--blinks", "--gaze", "--eyes", str(eyes_folder / name)))
    expected = apply_controls(make_animation(200), parsed("--blinks"))
    lids = np.linalg.norm(eyes.closing, axis=1) > 0  # type: ignore[arg-type]
    assert np.abs(made.vertices - expected.vertices)[:, lids].max() < 1e-3


def test_eyes_from_the_lids_edges_alone(eyes_folder: Path, make_animation: Callable[..., Animation]) -> None:
    animation = make_animation(1)
    found = read_eyes(eyes_folder / "edges.json", animation.template)
    assert found.closing is not None
    assert abs(lid_gap(animation.template + found.closing)) < 0.0005
    assert abs(lid_gap((animation.template + found.closing)[build_head().mirror] * [-1, 1, 1])) < 0.0005
    assert np.linalg.norm(found.closing, axis=1).max() < 0.015


def test_blinks_in_another_unit_and_of_another_topology(
    eyes_folder: Path, make_animation: Callable[..., Animation], eyes: Eyes
) -> None:
    template = make_animation(1).template
    assert eyes.closing is not None

    def written(**content: object) -> Path:
        path = eyes_folder / f"{'_'.join(content)}.json"
        path.write_text(json.dumps(content))
        return path

    np.save(eyes_folder / "mm.npy", 1000 * eyes.closing)
    with pytest.raises(FaceDiffError, match="moves a lid by"):
        read_eyes(written(blinks=["mm.npy"]), template)
    lids_alone = written(blinks=["eyeBlinkLeft.npy", "eyeBlinkRight.npy"])
    with pytest.raises(FaceDiffError, match=r"has shape \(5875, 3\) .* on a face of shape \(900, 3\)"):
        read_eyes(lids_alone, template[:900])
    animation = make_animation(2)
    with pytest.raises(FaceDiffError, match="gaze: eyes .* has no eyeballs"):
        apply_controls(animation, parsed("--gaze", "--eyes", str(lids_alone)))
    with pytest.raises(FaceDiffError, match="does not say how the lids shut"):
        apply_controls(animation, parsed("--blinks", "--eyes", str(written(eyeballs=[eyes.eyeballs[0].tolist()]))))
