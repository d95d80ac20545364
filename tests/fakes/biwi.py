"""BIWI in miniature: the raw distribution, and the layout that circulates, byte for byte as they are on disk.

The names are the true ones, so that the true splits apply. A tone's loudness opens the mouth.
"""

from __future__ import annotations

import pickle
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import soundfile

SUBJECTS = ("F2", "M3", "F1")
"""Two that are trained on and one that is not: with the sentences below, every split has a clip."""
SENTENCES = ("e01", "e02", "e33", "e37")
VERTICES = 64
COLUMNS = 8
RATE = 44_100
OFFSET = np.array([4.0, -15.0, 30.0])


def faces_of(vertices: int = VERTICES) -> np.ndarray:
    """Triangles (F, 3) of a grid with eight columns."""
    corner = np.array([r * COLUMNS + c for r in range(vertices // COLUMNS - 1) for c in range(COLUMNS - 1)])
    first = np.stack([corner, corner + 1, corner + COLUMNS], 1)
    return np.concatenate([first, np.stack([corner + 1, corner + COLUMNS + 1, corner + COLUMNS], 1)])


def raw_template(subject: str, vertices: int = VERTICES) -> np.ndarray:
    """A personal face (V, 3) in mm, upside down as the scanner has it."""
    rng = np.random.default_rng(sum(map(ord, subject)))
    rows = vertices // COLUMNS
    x, y = np.meshgrid(np.linspace(-70, 70, COLUMNS), np.linspace(95, -95, rows))
    z = 60 - 0.006 * (x**2 + 0.6 * y**2)
    face = np.stack([x, -y, -z], -1).reshape(-1, 3) + rng.normal(0, 1.5, (vertices, 3))
    return np.round(face + OFFSET, 4)


def loudness(subject: str, sentence: str, frames: int) -> np.ndarray:
    """0 … 1 for each frame."""
    number = int(sentence[-2:]) + sum(map(ord, subject))
    return 0.5 - 0.5 * np.cos(2 * np.pi * (1.2 + number % 7 / 4) * np.arange(frames) / 25)


def raw_frames(subject: str, sentence: str, frames: int, vertices: int = VERTICES) -> np.ndarray:
    """Vertices (T, V, 3) of a sequence, float32, in mm."""
    loud = loudness(subject, sentence, frames)
    motion = np.repeat(raw_template(subject, vertices)[None], frames, 0)
    half = vertices // 2
    motion[:, half:, 1] += 6 * loud[:, None]
    motion[:, : half // 2, 1] -= 1.5 * np.sin(np.arange(frames) / 5)[:, None]
    return motion.astype("<f4")


def frames_of(subjects: Sequence[str], subject: str, sentence: str) -> int:
    """Lengths differ from clip to clip."""
    return 14 + 2 * list(subjects).index(subject) + int(sentence[-2:]) % 9


def speech_of(subject: str, sentence: str, frames: int, rate: int = RATE) -> np.ndarray:
    """A tone (S,) that is as loud as the mouth is open, with just the motion's length."""
    samples = round(frames * rate / 25)
    loud = np.interp(np.arange(samples) / rate * 25, np.arange(frames), loudness(subject, sentence, frames))
    return 0.6 * loud * np.sin(2 * np.pi * 300 * np.arange(samples) / rate)


def vl_bytes(vertices: np.ndarray, header: int = 4) -> bytes:
    """A frame's file: the count of vertices in ``header`` bytes, then float32 x, y, z of each."""
    return struct.pack("<I" if header == 4 else "<Q", len(vertices)) + np.asarray(vertices, "<f4").tobytes()


def obj_text(vertices: np.ndarray, faces: np.ndarray) -> str:
    """A textured mesh as a scanner's software writes it."""
    lines = ["# scan", "mtllib scan.mtl", *(f"v {x:.4f} {y:.4f} {z:.4f}" for x, y, z in vertices)]
    lines += [f"vt {i / len(vertices):.4f} 0.5" for i in range(len(vertices))]
    lines += ["usemtl face", *(f"f {a}/{b} {b}/{a} {c}/{c}" for a, b, c in faces + 1)]
    return "\n".join(lines) + "\n"


def write_flv(path: Path, speech: np.ndarray, rate: int = RATE) -> None:
    """A video of grey frames with the speech as its mp3 sound."""
    import av

    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w", format="flv") as container:
        video = container.add_stream("flv1", rate=25)
        video.width, video.height, video.pix_fmt = 16, 16, "yuv420p"
        sound = container.add_stream("libmp3lame", rate=rate, layout="mono")
        for i in range(round(len(speech) / rate * 25)):
            picture = av.VideoFrame.from_ndarray(np.full((16, 16, 3), 128, np.uint8), format="rgb24")
            picture.pts = i
            container.mux(video.encode(picture))
        container.mux(video.encode(None))
        # The encoder takes blocks of its own size.
        size = sound.codec_context.frame_size or 1152
        for start in range(0, len(speech), size):
            block = np.ascontiguousarray(speech[None, start : start + size], dtype=np.float32)
            frame = av.AudioFrame.from_ndarray(block, format="fltp", layout="mono")
            frame.sample_rate, frame.pts = rate, start
            container.mux(sound.encode(frame))
        container.mux(sound.encode(None))


def write_raw_biwi(
    root: Path,
    *,
    vertices: int = VERTICES,
    subjects: Sequence[str] = SUBJECTS,
    sentences: Sequence[str] = SENTENCES,
    frames: int | None = None,
    header: Literal[4, 8] = 4,
    audio: Literal["wav", "flv"] = "wav",
    regions: bool = True,
) -> Path:
    """Write the raw distribution: ``faces/``, ``rigid_scans/``, and ``audio/`` or ``videos/``; and ``regions/``."""
    (root / "rigid_scans").mkdir(parents=True)
    for subject in subjects:
        (root / "rigid_scans" / f"{subject}.obj").write_text(
            obj_text(raw_template(subject, vertices), faces_of(vertices))
        )
        for sentence in sentences:
            length = frames or frames_of(subjects, subject, sentence)
            folder = root / "faces" / subject / sentence
            folder.mkdir(parents=True)
            for i, frame in enumerate(raw_frames(subject, sentence, length, vertices), 1):
                (folder / f"frame_{i:03d}.vl").write_bytes(vl_bytes(frame, header))
            speech = speech_of(subject, sentence, length)
            if audio == "flv":
                write_flv(root / "videos" / f"{subject}_{sentence}.flv", speech)
            else:
                (root / "audio").mkdir(exist_ok=True)
                soundfile.write(root / "audio" / f"{subject}_{sentence}.wav", speech, RATE, subtype="PCM_16")
    if regions:
        write_regions(root, vertices, ", ")
    return root


def write_regions(root: Path, vertices: int, separator: str) -> None:
    """Lists of vertices on one line, without a line end: the mouth, and the brows."""
    (root / "regions").mkdir(parents=True, exist_ok=True)
    (root / "regions" / "lve.txt").write_text(separator.join(map(str, range(vertices // 2, vertices))))
    (root / "regions" / "fdd.txt").write_text(separator.join(map(str, range(vertices // 4))))


def normalised(frames: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Frames (…, V, 3), each turned, centred and scaled to a surface area of one; float64."""
    turned = np.asarray(frames, np.float64) @ np.diag([1.0, -1.0, -1.0])
    centred = turned - turned.mean(-2, keepdims=True)
    a, b, c = (centred[..., faces[:, i], :] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=-1).sum(-1) / 2
    return centred / np.sqrt(area)[..., None, None]


def ply_bytes(vertices: np.ndarray, faces: np.ndarray, vertex_type: str, face_type: str) -> bytes:
    """A binary little-endian PLY with the given types, e.g. ``double`` and ``ushort``."""
    codes = {"float": "<f4", "double": "<f8", "ushort": "<u2", "int": "<i4"}
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    head += [f"property {vertex_type} {axis}" for axis in "xyz"]
    head += [f"element face {len(faces)}", f"property list uchar {face_type} vertex_indices", "end_header\n"]
    rows = np.zeros(len(faces), np.dtype([("count", "u1"), ("corners", codes[face_type], 3)]))
    rows["count"], rows["corners"] = 3, faces
    return "\n".join(head).encode() + np.asarray(vertices, codes[vertex_type]).tobytes() + rows.tobytes()


def write_biwi(
    root: Path,
    *,
    vertices: int = VERTICES,
    subjects: Sequence[str] = SUBJECTS,
    sentences: Sequence[str] = SENTENCES,
    frames: int | None = None,
) -> Path:
    """Write the layout that circulates: float64 motion, 44.1 kHz wav, ``templates.pkl``, ``BIWI.ply``, regions."""
    for folder in ("wav", "vertices_npy"):
        (root / folder).mkdir(parents=True)
    faces = faces_of(vertices)
    templates = {subject: normalised(raw_template(subject, vertices), faces) for subject in subjects}
    for subject in subjects:
        for sentence in sentences:
            length = frames or frames_of(subjects, subject, sentence)
            motion = normalised(raw_frames(subject, sentence, length, vertices), faces)
            np.save(root / "vertices_npy" / f"{subject}_{sentence}.npy", motion.reshape(length, -1))
            speech = speech_of(subject, sentence, length)
            soundfile.write(root / "wav" / f"{subject}_{sentence}.wav", speech, RATE, subtype="PCM_16")
    (root / "templates.pkl").write_bytes(pickle.dumps(templates))
    (root / "BIWI.ply").write_bytes(ply_bytes(templates[subjects[0]], faces, "double", "ushort"))
    write_regions(root, vertices, ", ")
    return root
