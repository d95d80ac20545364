"""What a packed corpus of BIWI's size (23 370 vertices, 25 frames a second) costs on disk.

Run ``python tools/benchmarks/packed.py``: motion of the built-in corpus on as many vertices, with Gaussian noise at
every coordinate, as capture has it, is packed at 0.01 mm and without loss. ``loading.py`` measures how fast it is read.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np
import soundfile
from machine import machine

from facediff.data.corpus import read_templates
from facediff.data.packed.packing import pack
from facediff.data.preparation import write_templates
from facediff.data.puppet import made_root
from facediff.utils.plain_files import write_json

CLIPS, FRAMES, VERTICES = 16, 160, 23_370
NOISES = (0.0, 0.01, 0.02, 0.05)  # standard deviations in millimetres


def write_corpus(root: Path, source: Path, noise: float) -> None:
    """A corpus in BIWI's layout, in metres: each vertex is a blend of two of the source's."""
    for folder in ("wav", "vertices_npy"):
        (root / folder).mkdir(parents=True)
    rng = np.random.default_rng(0)
    templates = read_templates(source / "templates.pkl")
    count = len(next(iter(templates.values())))
    one, share = np.sort(rng.integers(0, count, VERTICES)), rng.random((VERTICES, 1)).astype(np.float32)

    def blended(vertices: np.ndarray) -> np.ndarray:
        return share * vertices[..., one, :] + (1 - share) * vertices[..., (one + 1) % count, :]

    paths = sorted((source / "vertices_npy").glob("*.npy"))
    for number, path in enumerate(paths[:: len(paths) // CLIPS][:CLIPS]):
        motion = np.resize(np.load(path).reshape(-1, count, 3), (FRAMES, count, 3))
        rows = blended(motion) + rng.normal(0, noise / 1000, (FRAMES, VERTICES, 3))
        np.save(root / "vertices_npy" / f"F2_e{number + 1:02d}.npy", rows.reshape(FRAMES, -1).astype(np.float32))
        speech, _ = soundfile.read(source / "wav" / f"{path.stem}.wav", dtype="int16")
        soundfile.write(root / "wav" / f"F2_e{number + 1:02d}.wav", np.resize(speech, FRAMES * 640), 16_000)
    write_templates(root / "templates.pkl", {"F2": blended(templates[paths[0].stem.split("_")[0]].numpy())})
    write_json(root / "manifest.json", {"format": 1, "corpus": "biwi", "unit": "m"})


def main() -> None:
    """Print the sizes."""
    source = made_root() or sys.exit("the built-in corpus is not made yet; run `facediff demo`")
    print(machine())
    for noise in NOISES:
        with tempfile.TemporaryDirectory() as name:
            root = Path(name, "corpus")
            write_corpus(root, source, noise)
            rounded, exact = (pack(root, Path(name, f"{e}.zarr"), lossless=e, workers=1) for e in (False, True))
        sizes = [3600e-9 * size / rounded.seconds for size in (rounded.after, exact.after, rounded.before)]
        print("noise {} mm: {:.2f} GB an hour, lossless {:.2f}, plain {:.1f}".format(noise, *sizes), flush=True)


if __name__ == "__main__":
    main()
