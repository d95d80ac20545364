"""How quickly a BIWI-sized corpus is read, and in how much memory, against the way other projects read it.

Run ``python tools/benchmarks/loading.py``: makes 24 clips of 160 frames and 23 370 vertices, float64 as
CodeTalker writes them (2.2 GB in a temporary folder), and reads them in several ways, each in a process of its own. All
of them hand out float32 tensors, one clip (or window) a batch, with its speech.

- ``file by file``: ``np.load`` of the whole file for each sample, as FaceDiffuser's training loop does.
- ``facediff, …``: the data module's own loader on the same files; with a window, as one trains under limited memory;
  ``packed`` at 0.01 mm by ``facediff data pack``, of noise, which compresses worst.

Style references, which other projects do not read, are cut to one frame; ``with references`` shows what they cost.
"""

from __future__ import annotations

import argparse
import gc
import json
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from machine import machine

SUBJECT = "F2"
RATE = 25
STORE = "packed.zarr"


def write_corpus(root: Path, clips: int, frames: int, vertices: int) -> None:
    """A corpus in the circulating layout with noise as motion and speech."""
    import pickle

    import soundfile

    rng = np.random.default_rng(0)
    for folder in ("wav", "vertices_npy"):
        (root / folder).mkdir()
    template = rng.normal(size=(vertices, 3))
    block = rng.normal(0, 0.01, (frames, vertices * 3)) + template.ravel()
    for number in range(1, clips + 1):
        np.save(root / "vertices_npy" / f"{SUBJECT}_e{number:02d}.npy", np.roll(block, number, 0))
        speech = rng.uniform(-0.1, 0.1, frames * 16000 // RATE)
        soundfile.write(root / "wav" / f"{SUBJECT}_e{number:02d}.wav", speech, 16000)
    (root / "templates.pkl").write_bytes(pickle.dumps({SUBJECT: template}))


def processes() -> list[Path]:
    """This process and its children in /proc."""
    children = Path("/proc/self/task").glob("*/children")
    return [Path("/proc/self"), *(Path("/proc") / pid for file in children for pid in file.read_text().split())]


def resident() -> int:
    """Memory in bytes that this process and its loader processes hold for themselves or share among them.

    Pages of mapped files are left out: they belong to the model's page cache, which gives them up when asked.
    """
    total = 0
    for process in processes():
        try:
            lines = (process / "status").read_text().splitlines()
        except OSError:  # it has just ended
            continue
        total += sum(int(line.split()[1]) * 1024 for line in lines if line.startswith(("RssAnon", "RssShmem")))
    return total


class Peak:
    """The highest memory of the process's own while something runs, above what it was before."""

    def __enter__(self) -> Peak:
        gc.collect()
        self.base = self.highest = resident()
        self.done = threading.Event()
        self.thread = threading.Thread(target=self._watch)
        self.thread.start()
        return self

    def _watch(self) -> None:
        while not self.done.wait(0.002):
            self.highest = max(self.highest, resident())

    def __exit__(self, *_: object) -> None:
        self.done.set()
        self.thread.join()

    @property
    def bytes(self) -> int:
        """How much came on top."""
        return self.highest - self.base


def peers(root: Path, *, epochs: int) -> Iterator[int]:
    """Frames of each batch, read as other projects read them."""
    import pickle

    import soundfile
    import torch

    files = sorted((root / "vertices_npy").iterdir())
    with (root / "templates.pkl").open("rb") as stream:
        template = torch.from_numpy(pickle.load(stream)[SUBJECT].ravel()).float()  # noqa: S301 - written above
    speech = [soundfile.read(root / "wav" / f"{file.stem}.wav", dtype="float32")[0] for file in files]
    for _ in range(epochs):
        for place in np.random.default_rng(0).permutation(len(files)):
            vertices = np.load(files[place])
            motion = torch.FloatTensor(vertices) if vertices.dtype == np.float32 else torch.from_numpy(vertices).float()
            motion = (motion - template)[None]
            audio = torch.from_numpy(speech[place])[None]
            assert audio.shape[1]
            yield motion.shape[1]


def ours(
    root: Path, *, epochs: int, vertices: int, window: int | None, reference_frames: int, workers: int
) -> Iterator[int]:
    """Frames of each batch, read by facediff's loader."""
    from facediff.data import Biwi

    class Fake(Biwi):
        n_vertices: ClassVar[int] = vertices  # type: ignore[misc]

    data = Fake(root=str(root), window=window, reference_frames=reference_frames, num_workers=workers)
    loader = data.train_dataloader()
    for epoch in range(epochs):
        loader.sampler.set_epoch(epoch)  # type: ignore[attr-defined]
        for batch in loader:
            yield batch.motion.shape[1]


def measure(read: Callable[[], Iterator[int]]) -> dict[str, float]:
    """Clips a second, frames a second and peak memory of one way of reading, its start included.

    Read twice, since watching the memory takes time.
    """
    with Peak() as peak:
        list(read())
    start = time.perf_counter()
    counts = list(read())
    seconds = time.perf_counter() - start
    return {"clips": len(counts) / seconds, "frames": sum(counts) / seconds, "bytes": float(peak.bytes)}


def ways(args: argparse.Namespace) -> dict[str, Callable[[], Iterator[int]]]:
    """What is compared."""
    root, epochs = args.root, args.epochs

    facediff = partial(ours, root, epochs=epochs, vertices=args.vertices)
    stored = partial(ours, root.with_name(STORE), epochs=epochs, vertices=args.vertices)
    short = {"window": args.window, "workers": 0}
    return {
        "file by file": partial(peers, root, epochs=epochs),
        "facediff, whole clips": partial(facediff, window=None, reference_frames=1, workers=0),
        f"facediff, windows of {args.window}": partial(facediff, reference_frames=1, **short),
        f"facediff, windows of {args.window}, packed": partial(stored, reference_frames=1, **short),
        f"facediff, windows of {args.window} with references": partial(facediff, reference_frames=args.window, **short),
        "facediff, whole clips, 2 workers": partial(facediff, window=None, reference_frames=1, workers=2),
    }


def parser() -> argparse.ArgumentParser:
    """Options of the benchmark."""
    made = argparse.ArgumentParser(description="Read a BIWI-sized corpus as other projects do and as facediff does.")
    made.add_argument("--clips", type=int, default=24)
    made.add_argument("--frames", type=int, default=160)
    made.add_argument("--vertices", type=int, default=23370)
    made.add_argument("--window", type=int, default=25, help="frames of a training window")
    made.add_argument("--epochs", type=int, default=4)
    made.add_argument("--only", default="", help="leave out the ways of facediff whose names do not hold this")
    made.add_argument("--root", type=Path, help=argparse.SUPPRESS)
    made.add_argument("--way", help=argparse.SUPPRESS)
    return made


def main() -> None:
    """Measure every way in a process of its own and print ratios."""
    args = parser().parse_args()
    if args.way:
        import torch

        from facediff.data import Biwi  # noqa: F401 - what importing costs is no part of reading

        torch.set_num_threads(1)
        print(json.dumps(measure(ways(args)[args.way])))
        return
    from facediff.data.packed.packing import pack

    with tempfile.TemporaryDirectory() as folder:
        args.root = Path(folder, "corpus")
        args.root.mkdir()
        write_corpus(args.root, args.clips, args.frames, args.vertices)
        pack(args.root, args.root.with_name(STORE), corpus="biwi")
        words = [
            f"--{name}={getattr(args, name)}" for name in ("clips", "frames", "vertices", "window", "epochs", "root")
        ]
        rows = {}
        for way in [way for way in ways(args) if args.only in way or not way.startswith("facediff")]:
            done = subprocess.run(
                [sys.executable, __file__, *words, f"--way={way}"], capture_output=True, text=True, check=True
            )
            rows[way] = json.loads(done.stdout.splitlines()[-1])
    report(args, rows)


def report(args: argparse.Namespace, rows: dict[str, dict[str, Any]]) -> None:
    """Print the table."""
    print(machine())
    print(f"corpus: {args.clips} clips of {args.frames} frames, {args.vertices} vertices, float64")
    print(f"time: {args.epochs} epochs, the start included")
    print("memory: highest anonymous and shared memory above the start; mapped files are the page cache's\n")
    width = max(map(len, rows)) + 2
    head = f"{'way':<{width}}{'clips/s':>9}{'frames/s':>10}{'MB':>8}"
    print(f"{head}{'against file by file':>34}")
    base = rows["file by file"]
    for way, row in rows.items():
        line = f"{way:<{width}}{row['clips']:>9.1f}{row['frames']:>10.0f}{row['bytes'] / 1e6:>8.0f}"
        ratio = f"{row['clips'] / base['clips']:.2f} x clips/s, {row['bytes'] / max(base['bytes'], 1):.3f} x memory"
        print(f"{line}{ratio:>34}")


if __name__ == "__main__":
    main()
