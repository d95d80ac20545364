"""VOCASET in miniature: the raw distribution, and the layout that circulates, byte for byte as they are on disk.

The names are the true ones, so that the true splits apply. A tone's loudness opens the mouth.
"""

from __future__ import annotations

import io
import pickle
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import soundfile

from tests.fakes.biwi import COLUMNS, faces_of, ply_bytes, write_regions

TRAIN, TRAIN_2 = "FaceTalk_170728_03272_TA", "FaceTalk_170904_00128_TA"
VALIDATION, TEST = "FaceTalk_170811_03275_TA", "FaceTalk_170809_00138_TA"
CLIPS: dict[str, tuple[str, ...]] = {
    TRAIN: ("sentence01", "sentence02", "sentence21"),
    TRAIN_2: ("sentence01", "sentence40"),
    VALIDATION: ("sentence01", "sentence21", "sentence22"),
    TEST: ("sentence01", "sentence21", "sentence30"),
}
"""Enough for every split; the first sentences of the last two are in no split."""
VERTICES = 80
RATE = 22_000


class Python2Pickler(pickle._Pickler):
    """Writes a protocol-2 pickle as Python 2 did: text and bytes are both plain byte strings, NumPy is old."""

    dispatch = dict(pickle._Pickler.dispatch)

    def save_string(self, value: str | bytes) -> None:
        data = value.encode("latin1") if isinstance(value, str) else value
        self.write(pickle.BINSTRING + struct.pack("<i", len(data)) + data)
        self.memoize(value)

    def save_global(self, obj: type, name: str | None = None) -> None:
        module = obj.__module__.replace("numpy._core", "numpy.core")
        self.write(pickle.GLOBAL + f"{module}\n{name or obj.__name__}\n".encode())
        self.memoize(obj)

    dispatch[str] = save_string
    dispatch[bytes] = save_string


def python2_pickle(value: object) -> bytes:
    """``value`` as Python 2 would have pickled it."""
    stream = io.BytesIO()
    Python2Pickler(stream, protocol=2).dump(value)
    return stream.getvalue()


def template_of(subject: str, vertices: int = VERTICES) -> np.ndarray:
    """A personal face (V, 3) in metres."""
    rng = np.random.default_rng(int(subject.split("_")[2]))
    x, y = np.meshgrid(np.linspace(-0.08, 0.08, COLUMNS), np.linspace(0.12, -0.12, vertices // COLUMNS))
    return np.stack([x, y, 0.05 - 3 * x**2], -1).reshape(-1, 3) + rng.normal(0, 1e-3, (vertices, 3))


def loudness(subject: str, sentence: str, frames: int) -> np.ndarray:
    """0 … 1 for each frame at 60 frames a second."""
    number = int(sentence[-2:]) + int(subject.split("_")[2])
    return 0.5 - 0.5 * np.cos(2 * np.pi * (1.2 + number % 7 / 4) * np.arange(frames) / 60)


def motion_of(subject: str, sentence: str, frames: int, vertices: int = VERTICES) -> np.ndarray:
    """Vertices (T, V, 3), float32, in metres, 60 frames a second."""
    motion = np.repeat(template_of(subject, vertices)[None], frames, 0)
    motion[:, vertices // 2 :, 1] -= 0.01 * loudness(subject, sentence, frames)[:, None]
    motion[:, : vertices // 4, 1] += 0.002 * np.sin(np.arange(frames) / 9)[:, None]
    return motion.astype(np.float32)


def frames_of(subject: str, sentence: str) -> int:
    """Lengths differ from clip to clip."""
    return 40 + (3 * int(sentence[-2:]) + int(subject.split("_")[2])) % 17


def speech_of(subject: str, sentence: str, frames: int, rate: int = RATE) -> np.ndarray:
    """A tone (S,), int16, as loud as the mouth is open, with just the motion's length."""
    samples = round(frames * rate / 60)
    loud = np.interp(np.arange(samples) / rate * 60, np.arange(frames), loudness(subject, sentence, frames))
    return np.rint(20_000 * loud * np.sin(2 * np.pi * 300 * np.arange(samples) / rate)).astype(np.int16)


def flame_masks(vertices: int = VERTICES) -> dict[str, np.ndarray]:
    """Some of FLAME's masks; the lips name a few vertices twice, as the real ones do."""
    half, quarter = vertices // 2, vertices // 4
    lips = np.concatenate([np.arange(half, half + quarter), np.arange(half, half + 4)])
    parts = {"lips": lips, "forehead": np.arange(8), "eye_region": np.arange(4, quarter)}
    return {name: part.astype(np.int64) for name, part in parts.items()} | {"face": np.arange(vertices)}


def write_raw_vocaset(
    root: Path,
    *,
    vertices: int = VERTICES,
    clips: Mapping[str, Sequence[str]] = CLIPS,
    frames: int | None = None,
    extras: bool = True,
) -> Path:
    """Write ``data_verts.npy`` with the rows of all clips mixed, the three pickles, and (``extras``) mesh and masks."""
    root.mkdir(parents=True)
    names = [(subject, sentence) for subject, sentences in clips.items() for sentence in sentences]
    motions = {name: motion_of(*name, frames or frames_of(*name), vertices) for name in names}
    slots = [(name, frame) for name, motion in motions.items() for frame in range(len(motion))]
    row_of = np.random.default_rng(0).permutation(len(slots))
    rows = np.empty((len(slots), vertices, 3), np.float32)
    index: dict[str, dict[str, dict[int, int]]] = {subject: {} for subject in clips}
    for (name, frame), row in zip(slots, row_of, strict=True):
        rows[row] = motions[name][frame]
        index[name[0]].setdefault(name[1], {})[frame] = int(row)
    audio: dict[str, dict[str, dict[str, Any]]] = {subject: {} for subject in clips}
    for subject, sentence in names:
        samples = speech_of(subject, sentence, len(motions[subject, sentence]))
        audio[subject][sentence] = {"audio": samples, "sample_rate": RATE}
    np.save(root / "data_verts.npy", rows)
    (root / "subj_seq_to_idx.pkl").write_bytes(pickle.dumps(index, 2))
    (root / "raw_audio_fixed.pkl").write_bytes(python2_pickle(audio))
    write_templates_and_mesh(root, clips, vertices, extras)
    return root


def write_templates_and_mesh(root: Path, subjects: Mapping[str, object], vertices: int, extras: bool) -> None:
    """``templates.pkl`` as Python 2 wrote it, and (``extras``) ``FLAME_sample.ply``, ``FLAME_masks.pkl``, regions."""
    templates = {subject: template_of(subject, vertices) for subject in subjects}
    (root / "templates.pkl").write_bytes(python2_pickle(templates))
    if extras:
        mesh = ply_bytes(next(iter(templates.values())), faces_of(vertices), "float", "int")
        (root / "FLAME_sample.ply").write_bytes(mesh)
        (root / "FLAME_masks.pkl").write_bytes(python2_pickle(flame_masks(vertices)))
        write_regions(root, vertices, ",")


def write_vocaset(
    root: Path,
    *,
    vertices: int = VERTICES,
    clips: Mapping[str, Sequence[str]] = CLIPS,
    frames: int | None = None,
) -> Path:
    """Write the layout that circulates: motion at 60 frames a second, wav at the rate of the raw data."""
    for folder in ("wav", "vertices_npy"):
        (root / folder).mkdir(parents=True)
    for subject, sentences in clips.items():
        for sentence in sentences:
            motion = motion_of(subject, sentence, frames or frames_of(subject, sentence), vertices)
            np.save(root / "vertices_npy" / f"{subject}_{sentence}.npy", motion.reshape(len(motion), -1))
            speech = speech_of(subject, sentence, len(motion))
            soundfile.write(root / "wav" / f"{subject}_{sentence}.wav", speech, RATE)
    write_templates_and_mesh(root, clips, vertices, True)
    return root
