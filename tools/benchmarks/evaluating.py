"""How quickly files are scored, and in how much memory, against the straightforward way of released scripts.

Run ``python tools/benchmarks/evaluating.py``: makes truth and prediction of the size of BIWI's test A (24 sequences of
3 879 frames in all, 23 370 vertices) in a temporary folder and computes FaceDiffuser's four numbers (MVE, LVE, FDD,
absolute FDD) from them, each way in a process of its own, with warm page cache. Types are as found in the wild: BIWI's
truth and templates, once prepared, are float64, and predictions are what a network gives, float32 (3.3 GB);
``--truth-type float32`` has everything float32 (2.2 GB).

- ``whole corpus in memory``: how the released scripts of CodeTalker and FaceDiffuser go about it, in a rendition of our
  own: every file is loaded, the frames of all sequences are put into a list and stacked, and what is taken over a
  region is made by a Python loop over its vertices, turned to frames first; the mean error of each sequence is computed
  beside that of all frames, as FaceDiffuser's does. One thread, as NumPy has it.
- ``facediff``: `facediff.evaluation` on the same files, 1000 bootstrap resamples included, one worker and all.
- ``only reading``: the same files mapped into memory and each number added up once, by as many threads: how quick
  anything can be that looks at all of them.

The column ``CPU s`` is what all threads together were busy: it says more than ``seconds`` where other programs run.

Regions are random vertices, as many as BIWI's (4 996 and 7 784). What importing costs is no part of either.
"""

from __future__ import annotations

import argparse
import json
import pickle
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from loading import Peak
from numpy.typing import NDArray

SUBJECT = "F2"
LIPS, UPPER = 4996 / 23370, 7784 / 23370
Array = NDArray[Any]


def write_corpus(root: Path, clips: int, frames: int, vertices: int, truth_type: str = "float64") -> None:
    """Truth and prediction around a template, of ragged lengths that add up to ``frames``, and regions.

    Truth and template are of type ``truth_type``, predictions are float32.
    """
    rng = np.random.default_rng(0)
    shares = rng.uniform(0.7, 1.3, clips)
    ends = np.round(np.cumsum(shares) / shares.sum() * frames).astype(int)
    lengths = np.diff(ends, prepend=0)
    template = rng.uniform(-1, 1, (vertices, 3)).astype(truth_type)
    for folder, size, kind in (("truth", 0.01, truth_type), ("predictions", 0.008, "float32")):
        (root / folder).mkdir()
        block = (rng.normal(0, size, (lengths.max(), vertices * 3)) + template.ravel()).astype(kind)
        for number, length in enumerate(lengths, start=1):
            np.save(root / folder / f"{SUBJECT}_e{number:02d}.npy", np.roll(block, 7 * number, 0)[:length])
    (root / "templates.pkl").write_bytes(pickle.dumps({SUBJECT: template}))
    for name, share in (("lve.txt", LIPS), ("fdd.txt", UPPER)):
        chosen = np.sort(rng.choice(vertices, max(1, round(share * vertices)), replace=False))
        (root / name).write_text(",".join(map(str, chosen)))


def read_indices(file: Path) -> list[int]:
    """Vertex indices separated by commas."""
    return [int(word) for word in file.read_text().split(",")]


def whole_corpus(root: Path, vertices: int) -> dict[str, float]:
    """MVE, LVE and FDD with all frames in memory and loops over the vertices of a region."""
    lips, upper = read_indices(root / "lve.txt"), read_indices(root / "fdd.txt")
    template = pickle.loads((root / "templates.pkl").read_bytes())[SUBJECT]  # noqa: S301 - written above
    true_frames: list[Array] = []
    predicted_frames: list[Array] = []
    running_error = 0.0  # FaceDiffuser's script adds up the mean error of each sequence and does not print it
    deviations = []
    for file in sorted((root / "truth").iterdir()):
        true = np.load(file).reshape(-1, vertices, 3)
        predicted = np.load(root / "predictions" / file.name).reshape(-1, vertices, 3)
        length = min(len(true), len(predicted))
        true, predicted = true[:length], predicted[:length]
        running_error += np.linalg.norm(true - predicted, axis=2).mean(axis=1).mean()
        true_frames.extend(true)
        predicted_frames.extend(predicted)
        spread = []
        for motion in (true - template, predicted - template):
            by_vertex = np.array([np.square(motion[:, vertex]) for vertex in upper]).transpose(1, 0, 2)
            spread.append(np.mean(np.std(np.sum(by_vertex, axis=2), axis=0)))
        deviations.append(spread[0] - spread[1])
    all_true, all_predicted = np.array(true_frames), np.array(predicted_frames)
    del true_frames, predicted_frames
    by_vertex = np.array([np.square(all_true[:, vertex] - all_predicted[:, vertex]) for vertex in lips])
    by_vertex = by_vertex.transpose(1, 0, 2)
    lip_errors = np.max(np.sum(by_vertex, axis=2), axis=1)
    distances = np.linalg.norm(all_true - all_predicted, axis=2)
    return {
        "mve": float(np.mean(distances)),
        "lve": float(np.mean(lip_errors)),
        "fdd": float(np.mean(deviations)),
        "fdd_absolute": float(np.mean(np.abs(deviations))),
    }


def facediff(root: Path, vertices: int, workers: int) -> dict[str, float]:
    """The same four numbers by facediff."""
    from facediff.data.corpus import read_templates
    from facediff.evaluation import evaluate, read_region

    report = evaluate(
        {"predictions": root / "predictions"},
        root / "truth",
        lips=read_region("lips", vertices, folder=root),
        upper_face=read_region("upper_face", vertices, folder=root),
        templates=read_templates(root / "templates.pkl", vertices),
        n_vertices=vertices,
        protocols=["facediffuser"],
        workers=workers,
    )
    return {score.metric: score.value for score in report.methods[0].scores}


def only_reading(root: Path, workers: int) -> dict[str, float]:
    """Every number of every file added up once, a few frames at a time, from mapped files; no scores."""
    import torch

    def read(path: Path) -> None:
        array = torch.from_numpy(np.load(path, mmap_mode="c"))
        for start in range(0, len(array), 4):
            array[start : start + 4].sum()

    torch.set_num_threads(1)
    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(read, sorted(root.glob("*/*.npy"))))
    return {}


def ways(args: argparse.Namespace) -> dict[str, Callable[[], dict[str, float]]]:
    """What is compared."""
    counts = sorted({1, args.workers})
    return {
        "whole corpus in memory": lambda: whole_corpus(args.root, args.vertices),
        **{
            f"facediff, {count} worker{'s' if count > 1 else ''}": lambda count=count: facediff(
                args.root, args.vertices, count
            )
            for count in counts
        },
        **{
            f"only reading, {count} thread{'s' if count > 1 else ''}": lambda count=count: only_reading(
                args.root, count
            )
            for count in counts
        },
    }


def measure(score: Callable[[], dict[str, float]]) -> dict[str, Any]:
    """Numbers, seconds and peak memory of one way: run twice, since watching the memory takes time."""
    with Peak() as peak:
        found = score()
    start, busy = time.perf_counter(), time.process_time()
    score()
    seconds, busy = time.perf_counter() - start, time.process_time() - busy
    return {"scores": found, "seconds": seconds, "busy": busy, "bytes": peak.bytes}


def parser() -> argparse.ArgumentParser:
    """Options of the benchmark."""
    made = argparse.ArgumentParser(description="Score a corpus of the size of BIWI's test A in two ways.")
    made.add_argument("--clips", type=int, default=24)
    made.add_argument("--frames", type=int, default=3879, help="of all clips together")
    made.add_argument("--vertices", type=int, default=23370)
    made.add_argument("--truth-type", choices=("float64", "float32"), default="float64")
    made.add_argument("--workers", type=int, help="of facediff; as many as processors")
    made.add_argument("--folder", type=Path, help="where to make the temporary folder")
    made.add_argument("--root", type=Path, help=argparse.SUPPRESS)
    made.add_argument("--way", help=argparse.SUPPRESS)
    return made


def main() -> None:
    """Measure every way in a process of its own and print ratios."""
    args = parser().parse_args()
    if args.way:
        import facediff.evaluation  # noqa: F401 - what importing costs is no part of scoring

        print(json.dumps(measure(ways(args)[args.way])))
        return
    if args.workers is None:
        from facediff.utils.workers import processors

        args.workers = processors()
    with tempfile.TemporaryDirectory(dir=args.folder) as folder:
        args.root = Path(folder)
        write_corpus(args.root, args.clips, args.frames, args.vertices, args.truth_type)
        for file in args.root.glob("*/*.npy"):  # into the page cache
            file.read_bytes()
        words = [f"--{name}={getattr(args, name)}" for name in ("clips", "frames", "vertices", "workers", "root")]
        rows = {}
        for way in ways(args):
            done = subprocess.run(
                [sys.executable, __file__, *words, f"--way={way}"], stdout=subprocess.PIPE, text=True, check=True
            )
            rows[way] = json.loads(done.stdout.splitlines()[-1])
    report(args, rows)


def report(args: argparse.Namespace, rows: dict[str, dict[str, Any]]) -> None:
    """Print the table."""
    first, *others = rows.values()
    apart = max(
        abs(row["scores"][name] / value - 1)
        for row in others
        for name, value in first["scores"].items()
        if row["scores"]
    )
    print(f"machine: {platform.processor() or platform.machine()}; Python {platform.python_version()}")
    print(
        f"corpus: {args.clips} clips, {args.frames} frames, {args.vertices} vertices; "
        f"truth {args.truth_type}, predictions float32, warm page cache"
    )
    print("memory: highest anonymous and shared memory above the start; mapped files are the page cache's")
    print("scores: " + ", ".join(f"{name} {value:.6e}" for name, value in first["scores"].items()))
    print(f"largest relative difference between the ways: {apart:.1e}\n")
    width = max(map(len, rows)) + 2
    print(f"{'way':<{width}}{'seconds':>9}{'CPU s':>8}{'MB':>8}{'times as fast':>16}{'of the memory':>16}")
    for way, row in rows.items():
        faster, memory = first["seconds"] / row["seconds"], row["bytes"] / max(first["bytes"], 1)
        times = f"{row['seconds']:>9.2f}{row['busy']:>8.2f}"
        print(f"{way:<{width}}{times}{row['bytes'] / 1e6:>8.0f}{faster:>15.1f}x{memory:>16.4f}")
    assert apart < 1e-6, "the ways do not agree"


if __name__ == "__main__":
    main()
