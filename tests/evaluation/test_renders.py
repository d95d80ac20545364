"""Scores of renders by tiny graphs of ONNX that the tests write: what they see and hear, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import onnx
import pytest
import soundfile
from onnx import TensorProto, helper

from facediff.cli.app import run
from facediff.errors import FaceDiffError
from facediff.evaluation.renders import SyncScores, framing, mel_spectrogram, read_render_metrics
from facediff.mesh.mesh_files import read_mesh
from facediff.render.rasteriser import Renderer
from facediff.speech.cepstra import mel_filters

GRID = 6


def write_graph(path: Path, inputs: dict[str, list[int | str]], nodes: list[onnx.NodeProto], output: str) -> Path:
    ends = [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in inputs.items()]
    results = [helper.make_tensor_value_info(output, TensorProto.FLOAT, None)]
    graph = helper.make_graph(nodes, "score", ends, results)
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9), str(path))
    return path


def write_brightness(path: Path, height: int = 32, width: int = 48) -> Path:
    nodes = [helper.make_node("ReduceMean", ["frames"], ["brightness"], keepdims=0)]
    return write_graph(path, {"frames": [1, "T", height, width, 3]}, nodes, "brightness")


def write_encoders(folder: Path, batch: int | str = "N") -> tuple[Path, Path]:
    """Encoders of one number each: how bright the mouth is, and how loud the sound."""
    video = [helper.make_node("ReduceMean", ["crops"], ["seen"], axes=[1, 2, 3], keepdims=1)]
    audio = [helper.make_node("ReduceMean", ["mel"], ["heard"], axes=[1, 2, 3], keepdims=1)]
    return (
        write_graph(folder / "video.onnx", {"crops": [batch, 15, 16, 16]}, video, "seen"),
        write_graph(folder / "audio.onnx", {"mel": [batch, 1, 80, 16]}, audio, "heard"),
    )


@pytest.fixture
def faces(tmp_path: Path) -> Path:
    """A square that bulges towards the viewer, truths and predictions that move, and their speech."""
    x, y = np.meshgrid(np.linspace(-1, 1, GRID), np.linspace(-1, 1, GRID))
    rest = np.stack([x.ravel(), y.ravel(), 0.3 * np.cos(x * y).ravel()], 1).astype(np.float32)
    quads = [(GRID * row + column) for row in range(GRID - 1) for column in range(GRID - 1)]
    triangles = [t for q in quads for t in ((q, q + 1, q + GRID), (q + 1, q + GRID + 1, q + GRID))]
    lines = [f"v {a} {b} {c}" for a, b, c in rest] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in triangles]
    (tmp_path / "face.obj").write_text("\n".join(lines))
    random = np.random.default_rng(0)
    for folder in ("truth", "ours", "truth/wav"):
        (tmp_path / folder).mkdir()
    for folder in ("truth", "ours"):
        for clip in ("a_1", "a_2"):
            np.save(tmp_path / folder / f"{clip}.npy", rest + 0.05 * random.standard_normal((4, *rest.shape)))
    return tmp_path


def test_a_graph_scores_what_is_rendered(faces: Path, capsys: pytest.CaptureFixture[str]) -> None:
    graph = write_brightness(faces / "net.onnx")
    words = [str(faces / name) for name in ("ours", "truth")] + ["--lips", "14,15,20,21", "--protocol", "meshtalk"]
    (faces / "lips.txt").write_text("14,15,20,21")
    words[3] = str(faces / "lips.txt")
    words += ["--mesh", str(faces / "face.obj"), "--frame-rate", "25", "--bootstrap", "0", "--quiet"]
    for part in ("face", "mouth"):
        text = f"onnx:graph={graph},part={part}"
        assert run("evaluate", [*words, "--render", text, "--json", "-"]) == 0
        found = json.loads(capsys.readouterr().out)["renders"]
        (metric,) = read_render_metrics([text]).values()
        for who, folder in (("truth", "truth"), (next(name for name in found if name != "truth"), "ours")):
            means = []
            for clip in ("a_1", "a_2"):
                truth, motion = (np.load(faces / name / f"{clip}.npy") for name in ("truth", folder))
                camera = framing(metric, truth.mean(0), {"lips": [14, 15, 20, 21]})
                mesh = read_mesh(faces / "face.obj")
                renderer = Renderer(mesh.faces, template=truth.mean(0), size=(32, 48), camera=camera)
                means.append(np.mean([renderer.render(frame).mean() for frame in motion]) / 255)
            assert found[who]["onnx/brightness"] == pytest.approx(np.mean(means), rel=1e-4)
    assert run("evaluate", [*words, "--render", text]) == 0
    assert "on renders" in capsys.readouterr().out
    with pytest.raises(FaceDiffError, match="--mesh"):
        run("evaluate", [*words[:6], *words[8:], "--render", text])


def test_sync_finds_the_offset_and_follows_the_formula(tmp_path: Path) -> None:
    video, audio = write_encoders(tmp_path)
    random = np.random.default_rng(1)
    loudness = np.repeat(random.uniform(0.0, 1.0, 120), 640)
    speech = (loudness * random.standard_normal(len(loudness))).astype(np.float32) * 0.1
    mel = mel_spectrogram(speech)
    metric = SyncScores(video=str(video), audio=str(audio), reach=10)
    levels = np.array([mel[:, round(3.2 * t) : round(3.2 * t) + 16].mean() for t in range(100)])
    # Mouth pictures as bright as the sound is loud, on the encoders' common scale.
    for late in (0, 4):
        bright = np.roll(np.clip((levels - levels.min()) / np.ptp(levels), 0, 1), late)
        frames = np.repeat(255 * bright, 16 * 16 * 3).reshape(100, 16, 16, 3).astype(np.uint8)
        scores = metric.score(frames, speech, 25.0)
        count = min(96, int((len(speech) / 16_000 - 0.2) * 25) + 1)
        seen = np.array([frames[t : t + 5].mean() / 255 for t in range(count)])
        heard = levels[:count]
        distances = []
        for offset in range(-10, 11):
            pairs = [(t, t + offset) for t in range(count) if 0 <= t + offset < count]
            distances.append(np.mean([abs(seen[a] - heard[b]) for a, b in pairs]))
        assert scores["lse_d"] == pytest.approx(min(distances), rel=1e-4)
        assert scores["lse_c"] == pytest.approx(np.median(distances) - min(distances), rel=1e-3, abs=1e-5)
        assert scores["offset"] == np.argmin(distances) - 10
    with pytest.raises(FaceDiffError, match="too short"):
        metric.score(frames[:8], speech, 25.0)
    with pytest.raises(FaceDiffError, match="wav"):
        metric.score(frames, speech[:0], 25.0)


def test_the_last_window_of_the_sound_is_scored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    video, audio = write_encoders(tmp_path)
    metric = SyncScores(video=str(video), audio=str(audio), reach=5)
    seen = []
    embeddings = SyncScores._embeddings

    def counted(self: SyncScores, graph: object, which: int, windows: np.ndarray) -> np.ndarray:
        seen.append(len(windows))
        return embeddings(self, graph, which, windows)

    monkeypatch.setattr(SyncScores, "_embeddings", counted)
    metric.score(np.zeros((30, 16, 16, 3), np.uint8), np.ones(15 * 640, np.float32), 25.0)
    assert seen == [11, 11]


def test_encoders_may_take_a_fixed_number_of_windows(tmp_path: Path) -> None:
    random = np.random.default_rng(2)
    frames = random.integers(0, 255, (40, 16, 16, 3)).astype(np.uint8)
    speech = random.standard_normal(40 * 640).astype(np.float32)
    scores = []
    for batch in ("N", 8):
        video, audio = write_encoders(tmp_path, batch)
        scores.append(SyncScores(video=str(video), audio=str(audio), reach=5).score(frames, speech, 25.0))
    assert scores[0] == pytest.approx(scores[1], rel=1e-6)


def test_mel_filters_of_slaneys_scale() -> None:
    filters = mel_filters(80, 800, 55.0, 7600.0, scale="slaney").astype(np.float64)
    centres = filters @ (np.arange(401) * 20.0) / filters.sum(1)
    # Below 1 kHz centres lie evenly in Hz, above evenly in its logarithm.
    assert np.diff(centres[2:20]).std() < 6
    assert np.diff(np.log(centres[40:])).std() < 0.01
    tone = np.sin(2 * np.pi * 2000 * np.arange(16_000) / 16_000).astype(np.float32)
    mel = mel_spectrogram(tone)
    assert mel.shape == (80, 81)
    assert abs(centres[mel[:, 40].argmax()] - 2000) < 80
    assert mel.min() == -4


def test_speech_is_handed_to_a_graph_that_hears(faces: Path, capsys: pytest.CaptureFixture[str]) -> None:
    nodes = [
        helper.make_node("ReduceMean", ["frames"], ["light"], keepdims=0),
        helper.make_node("ReduceMax", ["speech"], ["loud"], keepdims=0),
        helper.make_node("Mul", ["light", "loud"], ["zero"]),
        helper.make_node("Sub", ["zero", "zero"], ["nothing"]),
        helper.make_node("Add", ["nothing", "loud"], ["peak"]),
    ]
    graph = write_graph(faces / "ear.onnx", {"frames": [1, "T", 32, 32, 3], "speech": [1, "S"]}, nodes, "peak")
    (faces / "lips.txt").write_text("14,15,20,21")
    words = [str(faces / "ours"), str(faces / "truth"), "--lips", str(faces / "lips.txt"), "--protocol", "meshtalk"]
    words += ["--mesh", str(faces / "face.obj"), "--frame-rate", "25", "--bootstrap", "0", "--quiet"]
    words += ["--render", f"onnx:graph={graph}", "--json", "-"]
    with pytest.raises(FaceDiffError, match="wav"):
        run("evaluate", words)
    (faces / "vertices_npy").mkdir()
    for clip in ("a_1", "a_2"):
        (faces / "truth" / f"{clip}.npy").rename(faces / "vertices_npy" / f"{clip}.npy")
    (faces / "wav").mkdir()
    for clip, peak in (("a_1", 0.25), ("a_2", 0.75)):
        sound = np.zeros(16_000)
        sound[100], sound[-1] = peak, 0.9  # the end lies beyond the motion
        soundfile.write(faces / "wav" / f"{clip}.wav", sound, 16_000)
    words[1] = str(faces)
    assert run("evaluate", words) == 0
    scores = json.loads(capsys.readouterr().out)["renders"]
    assert scores["truth"]["onnx/peak"] == pytest.approx(0.5, abs=1e-3)
