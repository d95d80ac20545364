"""Audio2Face-3D's network, animator and folder, against the formulas in plain NumPy."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from scipy.spatial.transform import Rotation

from facediff.errors import FaceDiffError
from facediff.runtime.audio2face import Audio2Face, FaceAnimator, rigid_transform
from tests.fakes.audio2face import BEFORE, BUFFER, CONFIG, EMOTIONS, LENGTH, SKIN, TONGUE, write_audio2face

SPEECH = (np.random.default_rng(1).normal(size=5000) * 0.1).astype(np.float32)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("audio2face")


@pytest.fixture(scope="module")
def content(folder: Path) -> dict[str, Any]:
    return write_audio2face(folder)


@pytest.fixture(scope="module")
def model(folder: Path, content: dict[str, Any]) -> Audio2Face:
    return Audio2Face.open(folder)


def network(content: dict[str, Any], moment: int, explicit: list[float]) -> np.ndarray:
    """The network of one window, sample by sample."""
    window = [SPEECH[t] if 0 <= t < len(SPEECH) else 0.0 for t in range(moment - BEFORE, moment - BEFORE + BUFFER)]
    emotion = np.concatenate([content["implicit"], explicit])
    heard = 1.4 * np.array(window) @ content["sound"].astype(np.float64)
    return np.tanh(heard + emotion @ content["mood"] + content["bias"])


@pytest.mark.parametrize(("frame_rate", "frames"), [(30, 10), (25, 8), (60, 19)])
def test_infer_is_the_network_of_windows_around_each_frame(
    model: Audio2Face, content: dict[str, Any], frame_rate: int, frames: int
) -> None:
    assert frames == math.ceil(len(SPEECH) * frame_rate / 16000)
    result = model.infer(SPEECH, frame_rate)
    expected = [network(content, k * 16000 // frame_rate, [0.0, 0.2, 0.0, 0.0]) for k in range(frames)]
    np.testing.assert_allclose(result, expected, atol=2e-6)


def test_infer_takes_emotions_by_name(model: Audio2Face, content: dict[str, Any]) -> None:
    result = model.infer(SPEECH, 30, {"joy": 0.7, "pain": 0.2})
    np.testing.assert_allclose(result[4], network(content, 2133, [0.0, 0.2, 0.7, 0.2]), atol=2e-6)
    with pytest.raises(FaceDiffError, match="envy"):
        model.infer(SPEECH, 30, {"envy": 1.0})


def test_infer_of_parts_is_that_of_the_whole(model: Audio2Face) -> None:
    whole = model.infer(SPEECH, 60)
    parts = [model.infer(SPEECH, 60, start=start, frames=4) for start in (0, 4, 8, 12)]
    np.testing.assert_allclose(np.concatenate(parts), whole[:16], atol=1e-6)
    assert model.infer(SPEECH, 30000 / 1001).shape == (10, LENGTH)


def reference(content: dict[str, Any], result: np.ndarray, frame_rate: float) -> dict[str, Any]:
    """The animator, vertex by vertex and filter by filter."""
    data, c = {name: array.astype(np.float64) for name, array in content["data"].items()}, CONFIG
    rest = data["shapes_mean_skin"]
    low, high = min(rest[:, 1]), max(rest[:, 1])
    skin = np.zeros((len(result), *rest.shape))
    smoothed: dict[tuple[str, int], Any] = {}
    for t, row in enumerate(result.astype(np.float64)):
        p = c["skin_strength"] * sum(row[k] * data["shapes_matrix_skin"][k] for k in range(SKIN))
        p = p - data["eye_close_pose_delta"] * c["eyelid_open_offset"]
        p = p + data["lip_open_pose_delta"] * c["lip_open_offset"]
        for part in ("lower", "upper"):
            alpha = 1 - 0.5 ** (1 / frame_rate / c[f"{part}_face_smoothing"])
            value = p
            for pole in (1, 2):
                if t == 0:
                    smoothed[part, pole] = p
                value = smoothed[part, pole] = smoothed[part, pole] + (value - smoothed[part, pole]) * alpha
        for v in range(len(rest)):
            share = (rest[v, 1] - low) / (high - low)
            m = 1 / (1 + math.exp(-(c["face_mask_level"] - share) / c["face_mask_softness"]))
            upper, lower = smoothed["upper", 2][v] * 0.9 * (1 - m), smoothed["lower", 2][v] * 1.3 * m
            skin[t, v] = rest[v] + upper + lower
    at = SKIN
    tongue = np.tensordot(result[:, at : at + TONGUE], data["shapes_matrix_tongue"], 1) * 1.5
    tongue += data["shapes_mean_tongue"] + [0, 0.2, -0.3]
    eyes = np.zeros((len(result), 4))
    for t, row in enumerate(result):
        saccade = data["saccade_rot_matrix"][(3 + t * 30 // int(frame_rate)) % 11]
        eyes[t] = [0.1, -2.0, 0.3, 2.0] + 0.8 * row[-4:] + 0.9 * np.tile(saccade, 2)
    moved = data["neutral_jaw"] + 1.2 * result[:, at + TONGUE : -4].reshape(-1, 5, 3) + [0, -0.1, 0.25]
    return {"skin_vertices": skin, "tongue_vertices": tongue, "eyes_rotation": eyes, "moved": moved}


@pytest.mark.parametrize("frame_rate", [30, 25, 60])
def test_animate_follows_the_formulas(model: Audio2Face, content: dict[str, Any], frame_rate: int) -> None:
    result = np.random.default_rng(2).normal(size=(40, LENGTH)).astype(np.float32)
    animated = FaceAnimator(model.folder, frame_rate).animate(result)
    expected = reference(content, result, frame_rate)
    for name in ("skin_vertices", "tongue_vertices", "eyes_rotation"):
        np.testing.assert_allclose(animated[name], expected[name], atol=2e-5, err_msg=name)
    for transform, moved in zip(animated["jaw_transform"], expected["moved"], strict=True):
        rest = content["data"]["neutral_jaw"].astype(np.float64)
        rotation = Rotation.align_vectors(moved - moved.mean(0), rest - rest.mean(0))[0]
        np.testing.assert_allclose(transform[:3, :3], rotation.as_matrix(), atol=1e-5)
        np.testing.assert_allclose(transform[:3, 3], moved.mean(0) - rotation.apply(rest.mean(0)), atol=1e-5)
        np.testing.assert_array_equal(transform[3], [0, 0, 0, 1])


def test_rigid_transform_never_mirrors() -> None:
    rest = np.random.default_rng(0).normal(size=(5, 3))
    assert np.linalg.det(rigid_transform(rest, rest * [-1, 1, 1])[:3, :3]) == pytest.approx(1)


def test_an_animator_goes_on_where_it_was(model: Audio2Face) -> None:
    result = np.random.default_rng(3).normal(size=(20, LENGTH)).astype(np.float32)
    whole, animator = FaceAnimator(model.folder, 24).animate(result), FaceAnimator(model.folder, 24)
    parts = [animator.animate(result[:7]), animator.animate(result[7:])]
    for name, array in whole.items():
        np.testing.assert_array_equal(np.concatenate([part[name] for part in parts]), array)


# Folders of strangers.

INFO, SETTINGS = "network_info.json", "model_config_Nobody.json"

Change = Callable[[Path], object]


def edit(name: str, *keys: str, value: object) -> Change:
    def change(folder: Path) -> None:
        content = json.loads((folder / name).read_text())
        inner = content
        for key in keys[:-1]:
            inner = inner[key]
        inner[keys[-1]] = value
        (folder / name).write_text(json.dumps(content))

    return change


def arrays(name: str, **changes: np.ndarray | None) -> Change:
    def change(folder: Path) -> None:
        with np.load(folder / name) as archive:
            content = {key: archive[key] for key in archive.files} | changes
        np.savez(folder / name, **{key: array for key, array in content.items() if array is not None})

    return change


def looped(folder: Path) -> None:
    model = onnx.load(folder / "network.onnx")
    model.graph.node[-1].op_type = "RandomNormalLike"
    (folder / "network.onnx").write_bytes(model.SerializeToString())


def linked(folder: Path) -> None:
    (folder / "model_data.npz").rename(folder.parent / "elsewhere.npz")
    (folder / "model_data.npz").symlink_to(folder.parent / "elsewhere.npz")


def linked_graph(folder: Path) -> None:
    edit("model.json", "networkPath", value="network.trt")(folder)
    (folder / "network.onnx").rename(folder.parent / "elsewhere.onnx")
    (folder / "network.onnx").symlink_to(folder.parent / "elsewhere.onnx")


HOSTILE: dict[str, tuple[str, Change]] = {
    "a path outside": ("networkInfoPath", edit("model.json", "networkInfoPath", value="../network_info.json")),
    "an absolute path": ("modelDataPath", edit("model.json", "modelDataPath", value="/etc/passwd")),
    "a path of a drive": ("modelDataPath", edit("model.json", "modelDataPath", value="C:\\data.npz")),
    "a link outside": ("modelDataPath", linked),
    "a graph that is a link outside": ("networkPath", linked_graph),
    "no path": ("model.json", edit("model.json", "emotionDatabasePath", value=7)),
    "no ONNX graph": ("networkPath", lambda folder: (folder / "network.onnx").unlink()),
    "another kind of network": ("type", edit(INFO, "id", "type", value="diffusion")),
    "an endless window": ("network_info", edit(INFO, "audio_params", "buffer_len", value=1e30)),
    "a size that is not the network's": ("network.onnx", edit(INFO, "audio_params", "buffer_len", value=800)),
    "emotions twice": ("explicit_emotions", edit(INFO, "params", "explicit_emotions", value=["joy"] * 4)),
    "a shot that is missing": ("other", edit(SETTINGS, "config", "source_shot", value="other")),
    "a frame beyond its shot": ("source_frame", edit(SETTINGS, "config", "source_frame", value=3)),
    "no softness": ("softness", edit(SETTINGS, "config", "face_mask_softness", value=0)),
    "no shapes": ("shapes_matrix_skin", arrays("model_data.npz", shapes_matrix_skin=None)),
    "other shapes": ("lip_open_pose_delta", arrays("model_data.npz", lip_open_pose_delta=np.zeros((3, 3), np.float32))),
    "NaN": ("neutral_jaw", arrays("model_data.npz", neutral_jaw=np.full((5, 3), np.nan, np.float32))),
    "objects": ("model_data.npz", arrays("model_data.npz", neutral_jaw=np.array([{}] * 15))),
    "a mask outside": ("frontalMask", arrays("bs_skin.npz", frontalMask=np.array([24]))),
    "a pose that is missing": ("jawOpen", arrays("bs_skin.npz", jawOpen=None)),
    "a pair of three": (
        "bsSolveCancelPoses",
        edit("bs_skin_config.json", "blendshape_params", "bsSolveCancelPoses", value=[0, 0, 0, -1, -1, -1]),
    ),
    "an operator that draws numbers": ("network.onnx", looped),
}


@pytest.mark.parametrize(("named", "change"), HOSTILE.values(), ids=HOSTILE)
def test_open_refuses_a_hostile_folder(tmp_path: Path, named: str, change: Change) -> None:
    write_audio2face(tmp_path / "model")
    change(tmp_path / "model")
    with pytest.raises(FaceDiffError, match=named):
        Audio2Face.open(tmp_path / "model")


def test_a_graph_may_name_operators_that_it_does_not_use_and_leave_lengths_open(
    tmp_path: Path, model: Audio2Face
) -> None:
    write_audio2face(tmp_path)
    network = onnx.load(tmp_path / "network.onnx")
    network.opset_import.append(onnx.helper.make_opsetid("ai.onnx.ml", 3))
    network.graph.input[0].type.tensor_type.shape.dim[2].dim_param = "samples"
    (tmp_path / "network.onnx").write_bytes(network.SerializeToString())
    np.testing.assert_allclose(Audio2Face.open(tmp_path).infer(SPEECH, 30), model.infer(SPEECH, 30), atol=1e-6)
    network.graph.node[-1].domain = "ai.onnx.ml"
    (tmp_path / "network.onnx").write_bytes(network.SerializeToString())
    with pytest.raises(FaceDiffError, match="operator"):
        Audio2Face.open(tmp_path)


def test_emotions_are_those_of_the_folder(model: Audio2Face) -> None:
    assert model.folder.facts.emotions == EMOTIONS
    assert model.emotion({"anger": 0.5}).tolist()[4:] == [0.0, 0.5, 0.0, 0.0]


def test_no_speech_is_no_frames(model: Audio2Face) -> None:
    face = FaceAnimator(model.folder, 30).animate(model.infer(SPEECH[:0], 30))
    assert [len(part) for part in face.values()] == [0, 0, 0, 0]
    assert face["jaw_transform"].shape == (0, 4, 4)
