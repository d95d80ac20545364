"""A tiny Audio2Face-3D folder in NVIDIA's layout, made of random numbers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

SKIN, TONGUE, JAW, EYES, IMPLICIT = 5, 3, 15, 4, 4
VERTICES, TONGUE_VERTICES, BUFFER, BEFORE = 24, 9, 832, 416
EMOTIONS = ("amazement", "anger", "joy", "pain")
POSES = ("eyeBlinkLeft", "eyeBlinkRight", "jawOpen", "mouthClose", "mouthLeft", "mouthRight")
TONGUE_POSES = ("tongueTipUp", "tongueRollUp", "tongueOut")
LENGTH = SKIN + TONGUE + JAW + EYES

CONFIG: dict[str, Any] = {
    "input_strength": 1.4,
    "upper_face_smoothing": 0.02,
    "lower_face_smoothing": 0.006,
    "upper_face_strength": 0.9,
    "lower_face_strength": 1.3,
    "face_mask_level": 0.6,
    "face_mask_softness": 0.05,
    "source_shot": "calm",
    "source_frame": 1,
    "skin_strength": 1.1,
    "lower_teeth_strength": 1.2,
    "lower_teeth_height_offset": -0.1,
    "lower_teeth_depth_offset": 0.25,
    "lip_open_offset": -0.05,
    "tongue_strength": 1.5,
    "tongue_height_offset": 0.2,
    "tongue_depth_offset": -0.3,
    "eyeballs_strength": 0.8,
    "saccade_strength": 0.9,
    "right_eye_rot_x_offset": 0.1,
    "right_eye_rot_y_offset": -2.0,
    "left_eye_rot_x_offset": 0.3,
    "left_eye_rot_y_offset": 2.0,
    "eyelid_open_offset": 0.06,
    "eye_saccade_seed": 3,
}


def write_audio2face(folder: Path, seed: int = 0) -> dict[str, Any]:
    """Write a folder; what is in it, for references."""
    rng = np.random.default_rng(seed)

    def normal(*shape: int, scale: float = 1.0) -> np.ndarray:
        return (rng.normal(size=shape) * scale).astype(np.float32)

    folder.mkdir(parents=True, exist_ok=True)
    sound, mood, bias = normal(BUFFER, LENGTH, scale=0.1), normal(IMPLICIT + len(EMOTIONS), LENGTH), normal(LENGTH)
    write_network(folder / "network.onnx", sound, mood, bias)
    info = {
        "id": {"type": "regression", "actor": "Nobody", "output": "geometry", "version": "2.3"},
        "params": {
            "implicit_emotion_len": IMPLICIT,
            "explicit_emotions": list(EMOTIONS),
            "default_emotion": [0.0, 0.2, 0.0, 0.0],
            "num_shapes_skin": SKIN,
            "num_shapes_tongue": TONGUE,
            "num_verts_skin": VERTICES,
            "num_verts_tongue": TONGUE_VERTICES,
            "result_jaw_size": JAW,
            "result_eyes_size": EYES,
        },
        "audio_params": {"buffer_len": BUFFER, "buffer_ofs": BEFORE, "samplerate": 16000},
    }
    database = {
        "emo_db": normal(7, IMPLICIT),
        "emo_spec_names": np.array(["lively", "calm"], "S16"),
        "emo_spec_start": np.array([0, 4], np.int32),
        "emo_spec_size": np.array([4, 3], np.int32),
    }
    data = {
        "shapes_matrix_skin": normal(SKIN, VERTICES, 3),
        "shapes_mean_skin": normal(VERTICES, 3, scale=10),
        "lip_open_pose_delta": normal(VERTICES, 3),
        "eye_close_pose_delta": normal(VERTICES, 3),
        "shapes_matrix_tongue": normal(TONGUE, TONGUE_VERTICES, 3),
        "shapes_mean_tongue": normal(TONGUE_VERTICES, 3),
        "neutral_jaw": normal(5, 3, scale=4),
        "saccade_rot_matrix": normal(11, 2),
    }
    poses = {
        "skin": write_poses(folder, "skin", POSES, data["shapes_mean_skin"], normal(len(POSES), VERTICES, 3), True),
        "tongue": write_poses(
            folder, "tongue", TONGUE_POSES, data["shapes_mean_tongue"], normal(3, TONGUE_VERTICES, 3), False
        ),
    }
    paths = {name: {"config": f"bs_{name}_config.json", "data": f"bs_{name}.npz"} for name in poses}
    documents = {
        "model.json": {
            "networkInfoPath": "network_info.json",
            "networkPath": "network.trt",
            "emotionDatabasePath": "implicit_emo_db.npz",
            "modelConfigPath": "model_config_Nobody.json",
            "modelDataPath": "model_data.npz",
            "blendshapePaths": paths,
        },
        "network_info.json": info,
        "model_config_Nobody.json": {"config": CONFIG},
    }
    for name, content in documents.items():
        (folder / name).write_text(json.dumps(content))
    np.savez(folder / "implicit_emo_db.npz", **database)
    np.savez(folder / "model_data.npz", **data)
    return {"sound": sound, "mood": mood, "bias": bias, "implicit": database["emo_db"][5], "data": data, "poses": poses}


def write_network(path: Path, sound: np.ndarray, mood: np.ndarray, bias: np.ndarray) -> None:
    """A network that is one layer: tanh of the sound's and the emotion's maps."""
    tensors = [numpy_helper.from_array(array, name) for name, array in zip("smb", (sound, mood, bias), strict=True)]
    nodes = [
        helper.make_node("MatMul", ["input", "s"], ["heard"]),
        helper.make_node("MatMul", ["emotion", "m"], ["felt"]),
        helper.make_node("Add", ["heard", "felt"], ["both"]),
        helper.make_node("Add", ["both", "b"], ["all"]),
        helper.make_node("Tanh", ["all"], ["result"]),
    ]

    def end(name: str, length: int) -> onnx.ValueInfoProto:
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", 1, length])

    inputs = [end("input", len(sound)), end("emotion", len(mood))]
    graph = helper.make_graph(nodes, "network", inputs, [end("result", len(bias))], tensors)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 9
    path.write_bytes(model.SerializeToString())


def write_poses(
    folder: Path, name: str, poses: tuple[str, ...], neutral: np.ndarray, deltas: np.ndarray, masked: bool
) -> dict[str, Any]:
    count = len(poses)
    arrays = {"poseNames": np.array(["neutral", *poses], "S32"), "neutral": neutral, "rig_version": np.array("1.0")}
    if masked:
        arrays["frontalMask"] = np.arange(0, len(neutral), 2, dtype=np.int32)
    np.savez(folder / f"bs_{name}.npz", **arrays, **dict(zip(poses, deltas, strict=True)))
    params = {
        "strengthL2regularization": 0.02,
        "strengthL1regularization": 0.1,
        "strengthTemporalSmoothing": 0.01,
        "strengthSymmetry": 0.05,
        "numPoses": count,
        "bsSolveActivePoses": [1] * (count - 1) + [0 if masked else 1],
        "bsSolveCancelPoses": [-1, -1, 0, 0, -1, -1][:count] if masked else [-1] * count,
        "bsSolveSymmetryPoses": [0, 0, -1, -1, -1, -1][:count] if masked else [-1] * count,
        "bsWeightMultipliers": [1.0, 0.8, 1.0, 1.2, 1.0, 1.0][:count],
        "bsWeightOffsets": [0.0, 0.05, 0.0, 0.0, 0.0, 0.1][:count],
        "templateBBSize": 30.0,
    }
    (folder / f"bs_{name}_config.json").write_text(json.dumps({"blendshape_params": params}))
    return {"neutral": neutral, "deltas": deltas, "params": params, "mask": arrays.get("frontalMask")}
