"""A folder of Audio2Face-3D through ``facediff.load`` and ``facediff animate``: what a user gets of it."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile
from scipy.optimize import lsq_linear

import facediff
from facediff.cli.app import main
from facediff.errors import FaceDiffError
from facediff.pipelines.animator import Audio2FaceAnimator
from facediff.runtime.audio2face import FaceAnimator
from tests.fakes.audio2face import POSES, TONGUE_POSES, VERTICES, write_audio2face

SPEECH = (np.random.default_rng(1).normal(size=20_000) * 0.1).astype(np.float32)
FRAMES = 38  # 37.5 of them begin in the speech


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("audio2face") / "model"


@pytest.fixture(scope="module")
def content(folder: Path) -> dict[str, Any]:
    return write_audio2face(folder)


@pytest.fixture
def model(folder: Path, content: dict[str, Any]) -> Audio2FaceAnimator:
    loaded = facediff.load(folder)
    assert isinstance(loaded, Audio2FaceAnimator)
    return loaded


def solved(content: dict[str, Any], part: str, vertices: np.ndarray, temporal: float = 0.01) -> np.ndarray:
    """NVIDIA's system of one part's shapes, by SciPy."""
    pose, params = content["poses"][part], content["poses"][part]["params"]
    used = np.flatnonzero(params["bsSolveActivePoses"])
    rows = slice(None) if pose["mask"] is None else pose["mask"]
    d = pose["deltas"][used][:, rows].reshape(len(used), -1).T.astype(float)
    s = (np.linalg.norm(np.ptp(pose["neutral"].astype(float), axis=0)) / params["templateBBSize"]) ** 2
    a = d.T @ d + s * (
        0.25 * params["strengthL1regularization"] ** 2 * np.ones((len(used), len(used)))
        + (10 * params["strengthL2regularization"] + 100 * temporal) * np.eye(len(used))
    )
    if part == "skin":
        row = np.zeros((1, len(used)))
        row[0, :2] = 1, -1
        a += s * 10 * params["strengthSymmetry"] * row.T @ row
    last, result = np.zeros(len(used)), np.zeros((len(vertices), len(params["bsSolveActivePoses"])))
    for t, pose_t in enumerate(vertices):
        b = d.T @ (pose_t - pose["neutral"])[rows].ravel().astype(float) + s * temporal * last
        upper = np.ones(len(used))
        last = lsq_linear(a, b, (np.zeros(len(used)), upper), method="bvls", tol=1e-14).x
        if part == "skin":
            upper[3 if last[2] >= last[3] else 2] = 1e-10
            last = lsq_linear(a, b, (np.zeros(len(used)), upper), method="bvls", tol=1e-14).x
        result[t, used] = last
    return result * params["bsWeightMultipliers"] + params["bsWeightOffsets"]


@pytest.mark.parametrize("part", ["skin", "tongue"])
def test_solve_is_nvidias_with_the_folders_settings(
    model: Audio2FaceAnimator,
    content: dict[str, Any],
    part: Any,  # noqa: ANN401
) -> None:
    animator = FaceAnimator(model.model.folder, 30)
    vertices = animator.animate(model.model.infer(SPEECH, 30))[f"{part}_vertices"]
    np.testing.assert_allclose(model.solve(part, vertices), solved(content, part, vertices), atol=1e-6)


def test_animate_gives_vertices_and_what_they_are_made_of(model: Audio2FaceAnimator) -> None:
    animation = model.animate((SPEECH, 16_000), style="joy:0.7,pain:0.2")
    result = model.model.infer(SPEECH, 30, {"joy": 0.7, "pain": 0.2})
    animated = FaceAnimator(model.model.folder, 30).animate(result)
    np.testing.assert_allclose(animation.vertices, animated["skin_vertices"], atol=1e-5)
    assert animation.vertices.shape == (FRAMES, VERTICES, 3)
    assert (animation.frame_rate, animation.unit) == (30.0, "cm")
    assert animation.metadata["commercial_use"] == "allowed"
    assert animation.metadata["style"] == "joy:0.7,pain:0.2"
    values = animation.values
    assert values is not None
    channels = animation.space.channels
    assert channels[: len(POSES) + len(TONGUE_POSES)] == (*POSES, *TONGUE_POSES)
    solved = model.solve("skin", animation.vertices)
    solved[:, POSES.index("jawOpen")] += solved[:, POSES.index("mouthClose")]
    np.testing.assert_allclose(values[:, : len(POSES)], solved, atol=1e-6)
    eyes = {name: values[:, channels.index(f"{name}")] for name in ("right_eye_pitch", "left_eye_yaw")}
    np.testing.assert_allclose(np.rad2deg(eyes["right_eye_pitch"]), animated["eyes_rotation"][:, 0], atol=1e-4)
    np.testing.assert_allclose(np.rad2deg(eyes["left_eye_yaw"]), animated["eyes_rotation"][:, 3], atol=1e-4)
    turn = values[5, channels.index("jaw_x") : channels.index("jaw_x") + 3]
    angle = np.arccos((np.trace(animated["jaw_transform"][5, :3, :3]) - 1) / 2)
    assert np.linalg.norm(turn) == pytest.approx(angle, abs=1e-3)


def test_a_stream_gives_the_frames_of_the_recording(model: Audio2FaceAnimator) -> None:
    model.frame_rate = 25.0
    whole = model.animate((SPEECH, 16_000)).vertices
    chunks = [SPEECH[start : start + 700] for start in range(0, len(SPEECH), 700)]
    parts = list(model.stream(chunks))
    assert len(parts) > 10
    np.testing.assert_allclose(np.concatenate(parts), whole, atol=1e-5)


def test_mouth_rests_in_pauses_after_the_first_second(model: Audio2FaceAnimator) -> None:
    model.frame_rate = 5.0
    speech = np.concatenate([SPEECH[:8000], np.zeros(24_000, np.float32)])
    parts = {gate: np.concatenate(list(model.stream([speech], voice_gate=gate))) for gate in ("energy", "off")}
    np.testing.assert_array_equal(model.animate(speech, 16_000, voice_gate="energy").vertices, parts["energy"])
    assert not np.array_equal(parts["energy"][6:], parts["off"][6:])


def test_the_command_writes_vertices_and_weights(
    folder: Path, content: dict[str, Any], model: Audio2FaceAnimator, tmp_path: Path
) -> None:
    soundfile.write(tmp_path / "speech.wav", SPEECH, 16_000, subtype="FLOAT")
    words = ["animate", str(tmp_path / "speech.wav"), "--checkpoint", str(folder), "--style", "anger:0.5", "-o"]
    assert main([*words, str(tmp_path / "face.npy")]) == 0
    expected = model.animate((SPEECH, 16_000), style="anger:0.5")
    np.testing.assert_allclose(np.load(tmp_path / "face.npy"), expected.vertices, atol=1e-5)
    assert main([*words, str(tmp_path / "face.csv")]) == 0
    with (tmp_path / "face.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert expected.values is not None
    column = expected.values[:, POSES.index("eyeBlinkRight")]
    np.testing.assert_allclose([float(row["EyeBlinkRight"]) for row in rows[:FRAMES]], column, atol=1e-6)
    about = json.loads((tmp_path / "face.json").read_text())
    assert set(TONGUE_POSES) - {"tongueOut"} <= set(about["not_in_table"])


def test_it_needs_neither_pytorch_nor_scipy(folder: Path, content: dict[str, Any], tmp_path: Path) -> None:
    program = """
import sys
import numpy as np
import facediff
speech = np.random.default_rng(0).normal(size=8000).astype(np.float32)
facediff.load(sys.argv[1]).animate((speech, 16_000)).save(sys.argv[2])
print([name for name in ("torch", "scipy", "lightning") if name in sys.modules])
"""
    words = [sys.executable, "-c", program, str(folder), str(tmp_path / "face.csv")]
    assert subprocess.run(words, capture_output=True, text=True, check=True).stdout == "[]\n"  # noqa: S603


def test_rate_and_triangles_come_from_the_command_line(
    folder: Path, content: dict[str, Any], model: Audio2FaceAnimator, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    soundfile.write(tmp_path / "a.wav", SPEECH, 16_000, subtype="FLOAT")
    rest = model.model.folder.arrays["skin"]
    lines = [f"v {x} {y} {z}" for x, y, z in rest] + ["f 1 2 3", "f 2 3 4"]
    (tmp_path / "face.obj").write_text("\n".join(lines) + "\n")
    words = ["animate", str(tmp_path / "a.wav"), "--checkpoint", str(folder), "--quiet", "--frame-rate", "60"]
    assert main([*words, "-o", str(tmp_path / "x.npz")]) == 0
    animation = facediff.read(tmp_path / "x.npz")
    assert (animation.frame_rate, len(animation.vertices)) == (60.0, 75)
    model.frame_rate = 60.0
    np.testing.assert_allclose(animation.vertices, model.animate((SPEECH, 16_000)).vertices, atol=1e-5)
    assert main([*words, "--mesh", str(tmp_path / "face.obj"), "-o", str(tmp_path / "x.glb")]) == 0
    assert (tmp_path / "x.glb").stat().st_size > 1000
    (tmp_path / "other.obj").write_text("\n".join([*lines[:3], "f 1 2 3"]) + "\n")
    assert main([*words, "--mesh", str(tmp_path / "other.obj"), "-o", str(tmp_path / "y.glb")]) == 2
    assert "other.obj" in capsys.readouterr().err
    with pytest.raises(FaceDiffError, match="frame_rate"):
        facediff.load().animate((SPEECH, 16_000), frame_rate=60.0)


def test_live_needs_no_windows(
    folder: Path, content: dict[str, Any], model: Audio2FaceAnimator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    soundfile.write(tmp_path / "a.wav", SPEECH, 16_000, subtype="FLOAT")
    monkeypatch.chdir(tmp_path)
    words = ["live", str(folder), "a.wav", "--to", "jsonl:out.jsonl?weights=false", "--quiet"]
    assert main(words) == 0
    lines = [json.loads(line) for line in (tmp_path / "out.jsonl").read_text().splitlines()]
    assert len(lines) >= 5  # a slow machine drops frames
