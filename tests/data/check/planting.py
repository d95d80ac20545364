"""How flaws are planted into the tiny corpus."""

from __future__ import annotations

import json
import os
import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import soundfile

CLIP = "A_e07"
FRAMES = 26


def motion(root: Path, clip: str = CLIP) -> Path:
    return root / "vertices_npy" / f"{clip}.npy"


def sound(root: Path, clip: str = CLIP) -> Path:
    return root / "wav" / f"{clip}.wav"


def change(path: Path, how: Callable[[np.ndarray], np.ndarray]) -> None:
    """Read, change and write a file of motion."""
    np.save(path, how(np.load(path)))


def change_sound(path: Path, how: Callable[[np.ndarray], np.ndarray], subtype: str = "PCM_16") -> None:
    samples, rate = soundfile.read(path)
    soundfile.write(path, how(samples), rate, subtype=subtype)


def change_templates(root: Path, how: Callable[[dict], object]) -> None:
    path = root / "templates.pkl"
    templates = pickle.loads(path.read_bytes())  # noqa: S301 - written by the test
    path.write_bytes(pickle.dumps(how(templates) or templates))


def cut_bytes(path: Path, missing: int) -> None:
    path.write_bytes(path.read_bytes()[:-missing])


def set_rows(array: np.ndarray, rows: list[int], value: float) -> np.ndarray:
    array[rows, 4] = value
    return array


class Bomb:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.mkdir, ("bomb-went-off",)


def other_clip(root: Path, name: str) -> None:
    """A further clip whose files are nobody's copy."""
    np.save(motion(root, name), np.load(motion(root)) + np.float32(1e-5))
    samples, rate = soundfile.read(sound(root))
    soundfile.write(sound(root, name), 0.9 * samples, rate)


def add_stranger(root: Path) -> None:
    other_clip(root, "Z_e01")
    change_templates(root, lambda t: t.update(Z=t["A"] + 1e-5))


def write_manifest(root: Path, **fields: object) -> None:
    (root / "manifest.json").write_text(json.dumps(fields))


def swap_for_pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def wide(array: np.ndarray) -> np.ndarray:
    """The same motion with six vertices more."""
    return np.concatenate([array, array[:, :18]], 1)


def remove_training_clips(root: Path) -> None:
    for path in (*root.glob("wav/[AB]_e0[1-4].wav"), *root.glob("vertices_npy/[AB]_e0[1-4].npy")):
        path.unlink()
    (root / "clips.csv").unlink()  # its rows would be of clips that are not here


def silent_header(root: Path) -> None:
    """A wav whose header promises more than there is, as an interrupted copy has it."""
    cut_bytes(sound(root), 20_000)


def write_region(root: Path, text: str) -> None:
    (root / "regions" / "lve.txt").write_text(text)
