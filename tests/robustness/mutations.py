"""Damaged files for every reader, and the law that all readers obey.

The law: a reader gives a result or raises :class:`FaceDiffError` with one sentence that names the file. It takes at
most :data:`MEMORY` beyond what it had and :data:`SECONDS`, imports no module that a file names, and writes nothing.

A long run: ``python -m tests.robustness.mutations --rounds 2000`` prints the counts for every reader.
"""

from __future__ import annotations

import argparse
import json
import os
import pickle
import random
import resource
import struct
import sys
import tempfile
import time
import traceback
import warnings
import wave
import zipfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from facediff.errors import FaceDiffError

MEMORY = 1.5 * 2**30
SECONDS = 60.0
EVIL = "evilmodule"


@dataclass(frozen=True)
class Reader:
    """A format: how a valid file is written, and what reads it."""

    suffix: str
    write: Callable[[Path], None]
    read: Callable[[Path], object]


def wav(path: Path) -> None:
    with wave.open(str(path), "wb") as out:
        out.setnchannels(1)
        out.setsampwidth(2)
        out.setframerate(16_000)
        out.writeframes((3000 * np.sin(np.arange(8000) * 0.2)).astype("<i2").tobytes())


def sound(path: Path) -> None:
    import soundfile

    soundfile.write(path, 0.1 * np.sin(np.arange(8000) * 0.2), 16_000)


def read_sound(path: Path) -> object:
    from facediff.data.audio import read_speech

    return read_speech(path)


def mesh(path: Path) -> None:
    import trimesh

    trimesh.creation.icosphere(subdivisions=1).export(path)


def read_a_mesh(path: Path) -> object:
    from facediff.mesh import read_mesh

    return read_mesh(path)


def animation(path: Path) -> None:
    from facediff.animation import write_archive
    from tests.fakes.clicks import clicks

    write_archive(path, clicks())


def read_an_animation(path: Path) -> object:
    from facediff.animation import read_animation

    return read_animation(path)


def templates(path: Path) -> None:
    path.write_bytes(pickle.dumps({"A": np.zeros((9, 3)), "B": np.ones((9, 3))}))


def read_the_templates(path: Path) -> object:
    from facediff.data.corpus import read_templates

    return read_templates(path, 9)


def vertices(path: Path) -> None:
    np.save(path, np.zeros((5, 27), np.float32))


def read_the_vertices(path: Path) -> object:
    from facediff.data.corpus import open_vertices

    return np.asarray(open_vertices(path, 9)).sum()


def indices(path: Path) -> None:
    path.write_text("1, 2, 3, 4, 8")


def read_the_indices(path: Path) -> object:
    from facediff.data.corpus import find_region

    return find_region(path.parent, [path.name], "lips", 9)


def flame(path: Path) -> None:
    from tests.fakes.flame import write_flame

    write_flame(path)


def read_flame(path: Path) -> object:
    from facediff.mesh.flame import Flame

    return Flame.read(path)


def vl(path: Path) -> None:
    path.write_bytes(struct.pack("<I", 9) + np.zeros((9, 3), "<f4").tobytes())


def read_a_vl(path: Path) -> object:
    from facediff.data.prepare.biwi import read_vl

    return read_vl(path)


def checkpoint(path: Path) -> None:
    import torch

    from facediff.data.batch import ASSETS_KEY, FORMAT, FORMAT_KEY

    torch.save({"state_dict": {}, "hyper_parameters": {"_class_path": "x.Y"}, ASSETS_KEY: {}, FORMAT_KEY: FORMAT}, path)


def read_a_checkpoint(path: Path) -> object:
    from facediff.models.checkpoint import read_checkpoint

    return read_checkpoint(path)


def correspondence(path: Path) -> None:
    import trimesh

    from facediff.editing.correspondence import correspond
    from facediff.editing.retargeting import save_correspondence

    ball = trimesh.creation.icosphere(subdivisions=1)
    save_correspondence(path, correspond(ball.vertices, ball.faces, ball.vertices, ball.faces))


def read_correspondence(path: Path) -> object:
    from facediff.editing.retargeting import load_correspondence

    return load_correspondence(path)


def landmarks(path: Path) -> None:
    path.write_text("source,target\n1,2\n3,4\n5,6\n")


def read_the_landmarks(path: Path) -> object:
    from facediff.editing.retargeting import read_landmarks

    return read_landmarks(path)


def phonemes(path: Path) -> None:
    path.write_text("start,end,ipa\n0.0,0.1,b\n0.1,0.3,a\n")


def read_the_phonemes(path: Path) -> object:
    from facediff.data.phonemes import read_phonemes

    return read_phonemes(path)


def manifest(path: Path) -> None:
    path.write_text(json.dumps({"frame_rate": 25, "unit": "m", "motion": {"a": [1, 2, {"b": 3}]}}))


def read_the_manifest(path: Path) -> object:
    from facediff.data.corpus import read_manifest

    target = path.with_name("manifest.json")
    os.replace(path, target)
    return read_manifest(target.parent)


READERS = {
    "wav": Reader(".wav", wav, read_sound),
    "flac": Reader(".flac", sound, read_sound),
    "ogg": Reader(".ogg", sound, read_sound),
    "aiff": Reader(".aiff", sound, read_sound),
    "obj": Reader(".obj", mesh, read_a_mesh),
    "ply": Reader(".ply", mesh, read_a_mesh),
    "stl": Reader(".stl", mesh, read_a_mesh),
    "glb": Reader(".glb", mesh, read_a_mesh),
    "animation": Reader(".npz", animation, read_an_animation),
    "templates": Reader(".pkl", templates, read_the_templates),
    "vertices": Reader(".npy", vertices, read_the_vertices),
    "indices": Reader(".txt", indices, read_the_indices),
    "flame": Reader(".pkl", flame, read_flame),
    "vl": Reader(".vl", vl, read_a_vl),
    "checkpoint": Reader(".ckpt", checkpoint, read_a_checkpoint),
    "correspondence": Reader(".npz", correspondence, read_correspondence),
    "landmarks": Reader(".csv", landmarks, read_the_landmarks),
    "phonemes": Reader(".csv", phonemes, read_the_phonemes),
    "manifest": Reader(".json", manifest, read_the_manifest),
}

WILD = [0, 1, 0x7F, 0x80, 0xFF]
WORDS = [
    b"nan",
    b"inf",
    b"-1",
    b"1e308",
    b"99999999999999",
    b"\x00",
    b"\xff\xfe",
    b"=cmd()",
    b"[" * 3000,
    b"evilmodule",
]


def mutate(data: bytes, rng: random.Random) -> bytes:
    """One damaged version of a file's bytes: flipped, cut, grown, or with other numbers in its header."""
    kind = rng.choice(["flip", "cut", "grow", "header", "size", "word", "repeat", "empty"])
    body = bytearray(data)
    if kind == "flip":
        for _ in range(rng.randint(1, 8)):
            body[rng.randrange(len(body))] ^= 1 << rng.randrange(8)
    elif kind == "cut":
        del body[rng.randrange(len(body)) :]
    elif kind == "grow":
        body += rng.randbytes(rng.randint(1, 4096))
    elif kind == "header":
        body[rng.randrange(min(128, len(body)))] = rng.choice(WILD)
    elif kind == "size":
        # A length field somewhere near the front becomes huge or negative.
        at = rng.randrange(max(1, min(256, len(body) - 8)))
        body[at : at + 4] = struct.pack("<I", rng.choice([0, 0x7FFFFFFF, 0xFFFFFFFF, 0x80000000, 1 << 24]))
    elif kind == "word":
        at = rng.randrange(len(body) + 1)
        body[at:at] = rng.choice(WORDS)
    elif kind == "repeat":
        at = rng.randrange(len(body))
        body[at:at] = body[at : at + 64] * rng.randint(2, 50)
    else:
        body = bytearray()
    return bytes(body)


def bombs(path: Path, suffix: str) -> list[Path]:
    """Small files that declare gigabytes."""
    made = []
    if suffix == ".npz":
        header = b"{'descr': '<f4', 'fortran_order': False, 'shape': (%d,), }" % 2**33
        header += b" " * (64 - (len(header) + 11) % 64) + b"\n"
        array = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            for name in ("vertices.npy", "template.npy", "about.npy", "source_vertices.npy"):
                archive.writestr(name, array)
        made.append(path)
    elif suffix == ".wav":
        data = b"RIFF" + struct.pack("<I", 0xFFFFFFF0) + b"WAVEfmt " + struct.pack("<IHHIIHH", 16, 1, 1, 1, 2, 2, 16)
        path.write_bytes(data + b"data" + struct.pack("<I", 40_000) + bytes(40_000))  # 1 Hz: five hours
        made.append(path)
    elif suffix == ".ply":
        path.write_bytes(
            b"ply\nformat binary_little_endian 1.0\nelement vertex 2000000000\nproperty float x\nproperty float y\n"
            b"property float z\nelement face 0\nproperty list uchar int vertex_indices\nend_header\n"
        )
        made.append(path)
    elif suffix == ".pkl":
        path.write_bytes(b"\x80\x04\x8e" + struct.pack("<Q", 2**40) + b"x.")
        made.append(path)
    return made


class Law:
    """Counts what a reader does with damaged files, and keeps what breaks the law."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.broken: list[str] = []

    def check(self, name: str, read: Callable[[Path], object], path: Path, what: str) -> None:
        before, start = peak(), time.perf_counter()
        others = {file.name for file in path.parent.iterdir()}
        outcome = "read"
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                read(path)
        except FaceDiffError as error:
            outcome = "refused"
            if "\n" in str(error).strip():
                self.broken.append(f"{name} {what}: more than one line: {error}")
        except BaseException as error:  # noqa: BLE001 - whatever else a reader raises breaks the law
            outcome = "broke"
            line = traceback.extract_tb(error.__traceback__)[-1]
            self.broken.append(f"{name} {what}: {type(error).__name__}: {error} at {line.filename}:{line.lineno}"[:400])
        self.counts[outcome] += 1
        if peak() - before > MEMORY:
            self.broken.append(f"{name} {what}: took {(peak() - before) / 2**30:.1f} GiB")
        if time.perf_counter() - start > SECONDS:
            self.broken.append(f"{name} {what}: took {time.perf_counter() - start:.0f} s")
        if EVIL in sys.modules:
            self.broken.append(f"{name} {what}: imported {EVIL}")
        left = {file.name for file in path.parent.iterdir()} - others - {"manifest.json"}
        if left:
            self.broken.append(f"{name} {what}: left {left}")


def peak() -> int:
    """Peak memory of this process in bytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def run(name: str, rounds: int, seed: int, folder: Path) -> Law:
    """Damage one format's file ``rounds`` times, and read each result."""
    reader, law, rng = READERS[name], Law(), random.Random(f"{name}{seed}")  # noqa: S311
    valid = folder / f"valid{reader.suffix}"
    reader.write(valid)
    data = valid.read_bytes()
    for i in range(rounds):
        place = folder / f"{name}-{i}"
        place.mkdir()
        path = place / f"file{reader.suffix}"
        path.write_bytes(mutate(data, rng))
        law.check(name, reader.read, path, f"seed {seed} round {i}")
    for path in bombs(folder / f"bomb{reader.suffix}", reader.suffix):
        law.check(name, reader.read, path, "bomb")
    return law


def main() -> int:
    """Print the counts of every reader; 1 if the law was broken."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--rounds", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--reader", choices=sorted(READERS), action="append")
    args: Any = parser.parse_args()
    broken: list[str] = []
    for name in args.reader or READERS:
        with tempfile.TemporaryDirectory() as folder:
            law = run(name, args.rounds, args.seed, Path(folder))
        print(f"{name:<16}{dict(law.counts)}", flush=True)
        broken += law.broken
    print("\n".join(broken) or "the law holds")
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
