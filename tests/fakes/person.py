"""A person as reconstruction tools write one, and a corpus to join: 360 vertices, with everything about them known."""

from __future__ import annotations

import pickle
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import soundfile
import trimesh

Array = npt.NDArray[np.float64]

COLUMNS, ROWS = 18, 20
VERTICES = COLUMNS * ROWS
RATE = 30.0
MILLIMETRES = 1000.0
FRAMES = 240


def grid_faces() -> npt.NDArray[np.int64]:
    index = np.arange(VERTICES).reshape(ROWS, COLUMNS)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    return np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([b, d, c], -1).reshape(-1, 3)])


def face() -> Array:
    """A face-like surface in metres, some 15 cm wide, with a nose and a narrow chin; left and right differ a little."""
    x, y = np.meshgrid(np.linspace(-1, 1, COLUMNS), np.linspace(-1, 1, ROWS))
    z = 0.06 * np.sqrt(np.clip(1 - 0.45 * (x**2 + y**2), 0, None)) + 0.02 * np.exp(-8 * (x**2 + (y - 0.1) ** 2))
    return np.stack([0.075 * x * (0.8 + 0.2 * y) + 0.004 * y * x**2, 0.1 * y, z + 0.003 * x], -1).reshape(-1, 3)


def lower_face() -> npt.NDArray[np.bool_]:
    """The 35 % of the vertices that move in speech."""
    return np.arange(VERTICES) < round(0.35 * VERTICES)


def turn(vector: npt.ArrayLike) -> Array:
    """Rotation matrix of an axis-angle vector (Rodrigues' formula)."""
    vector = np.asarray(vector, float)
    angle = np.linalg.norm(vector)
    if angle == 0:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def loud(time: Array) -> Array:
    """Loudness of the speech, 0 to 1: a second of speech, a second of silence, and so on."""
    return np.clip(np.sin(np.pi * time), 0, None) ** 2


def speech(seconds: float) -> npt.NDArray[np.float32]:
    time = np.arange(round(seconds * 16000)) / 16000
    return (0.4 * loud(time) * np.sin(2 * np.pi * 180 * time)).astype(np.float32)


def motion(time: Array) -> Array:
    """Absolute vertices (T, V, 3) in metres, in the corpus's coordinates: the lower face follows the speech."""
    weight = np.where(lower_face(), np.linspace(1, 0.2, VERTICES), 0)
    down = np.array([0.0, -0.012, -0.004])
    round_ = np.array([0.003, 0.0, 0.006]) * np.sin(2 * np.pi * 0.7 * time)[:, None]
    return face() + loud(time)[:, None, None] * weight[:, None] * (down + round_)[:, None]


@dataclass(frozen=True)
class Person:
    """What the tool wrote, and what is true.

    Attributes:
        seen: (T, V, 3) in millimetres, with head motion, in front of a camera.
        truth: (T, V, 3) in metres in the corpus's coordinates, without head motion.
        rotations: (T, 3, 3) of the head.
        places: (T, 3) of the head's centre of motion, in millimetres.
        restless: the vertices that jitter in the reconstruction.
    """

    seen: Array
    truth: Array
    rotations: Array
    places: Array
    restless: npt.NDArray[np.int64]


def person(frames: int = FRAMES, *, outliers: float = 0.02, seed: int = 3) -> Person:
    """A talking person whose head turns by some 15° and moves by some centimetres."""
    random = np.random.default_rng(seed)
    time = np.arange(frames) / RATE
    truth = motion(time)
    restless = np.sort(random.permutation(VERTICES)[: round(outliers * VERTICES)])
    truth[:, restless] += random.normal(0, 0.02, (frames, len(restless), 3))
    angles = np.stack([0.25 * np.sin(0.9 * time), 0.2 * np.sin(0.6 * time + 1), 0.1 * np.sin(1.3 * time)], -1)
    camera = turn([np.pi, 0.1, 0.0])  # y downwards, as cameras have it
    rotations = np.stack([camera @ turn(angle) for angle in angles])
    drift = np.stack([30 * np.sin(0.5 * time), 20 * np.cos(0.8 * time), 25 * np.sin(0.3 * time)], -1)
    places = np.array([10.0, -5.0, 600.0]) + drift
    seen = MILLIMETRES * truth @ rotations.swapaxes(1, 2) + places[:, None]
    return Person(seen, truth, rotations, places, restless)


def write_auxiliary(root: Path, *, manifest: bool = True, rate: float = RATE) -> Path:
    """A corpus of three people whose mean face is :func:`face`, in the layout that circulates."""
    random = np.random.default_rng(0)
    for folder in ("wav", "vertices_npy", "regions", "templates"):
        (root / folder).mkdir(parents=True)
    own = random.normal(0, 1, (2, 3, 3)) * 0.02
    shapes = [face() @ (np.eye(3) + own[0]), face() @ (np.eye(3) + own[1])]
    shapes.append(3 * face() - shapes[0] - shapes[1])
    templates = dict(zip(("ANNA", "BEN", "CLEO"), shapes, strict=True))
    (root / "templates.pkl").write_bytes(pickle.dumps(templates))
    for name, template in templates.items():
        for sentence in (1, 2):
            moved = template + motion(np.arange(20) / rate) - face()
            np.save(root / "vertices_npy" / f"{name}_e{sentence:02d}.npy", moved.reshape(20, -1).astype("f4"))
            soundfile.write(root / "wav" / f"{name}_e{sentence:02d}.wav", speech(20 / rate), 16000)
    trimesh.Trimesh(face(), grid_faces(), process=False).export(root / "templates" / "mesh.ply")
    (root / "regions" / "still.txt").write_text(", ".join(map(str, np.flatnonzero(~lower_face()))))
    if manifest:
        (root / "manifest.json").write_text(f'{{"frame_rate": {rate}, "unit": "m"}}')
    return root


def write_speech(path: Path, seconds: float, *, rate: int = 44100) -> Path:
    """The speech in stereo at another rate."""
    time = np.arange(round(seconds * rate)) / rate
    tone = 0.4 * loud(time) * np.sin(2 * np.pi * 180 * time)
    soundfile.write(path, np.stack([tone, tone], -1), rate)
    return path


def write_take(path: Path, seconds: float) -> None:
    """A recording of Live Link Face whose jaw opens three times a second."""
    from facediff.spaces.files import ParameterClip, write_parameters
    from facediff.spaces.layouts import layout

    space = layout("arkit")
    values = np.zeros((round(seconds * RATE), len(space.channels)), np.float32)
    values[:, space.channels.index("jawOpen")] = 0.3 + 0.2 * np.sin(np.arange(len(values)) * 2 * np.pi * 3 / RATE)
    write_parameters(path, ParameterClip("take", values, space, RATE))
