"""How quickly files are scored, and in how much memory, against the straightforward way of released scripts.

Run ``python tools/benchmarks/evaluating.py``: makes truth and prediction of the size of BIWI's test A (24 sequences of
3 879 frames in all, 23 370 vertices, float32: twice 1.1 GB in a temporary folder) and computes FaceDiffuser's four
numbers (MVE, LVE, FDD, absolute FDD) from them, each way in a process of its own, with warm page cache.

- ``whole corpus in memory``: how the released scripts of CodeTalker and FaceDiffuser go about it, in a rendition of our
  own: every file is loaded, the frames of all sequences are put into a list and stacked, and what is taken over a
  region is made by a Python loop over its vertices, turned to frames first. One thread, as NumPy has it.
- ``facediff``: `facediff.evaluate` on the same files, 1000 bootstrap resamples included, one worker and all.

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
from pathlib import Path
from typing import Any

import numpy as np
from loading import Peak
from numpy.typing import NDArray

SUBJECT = "F2"
LIPS, UPPER = 4996 / 23370, 7784 / 23370
Array = NDArray[Any]


def write_corpus(root: Path, clips: int, frames: int, vertices: int) -> None:
    """Truth and prediction around a template, of ragged lengths that add up to ``frames``, and regions."""
    rng = np.random.default_rng(0)
    shares = rng.uniform(0.7, 1.3, clips)
    ends = np.round(np.cumsum(shares) / shares.sum() * frames).astype(int)
    lengths = np.diff(ends, prepend=0)
    template = rng.uniform(-1, 1, (vertices, 3)).astype(np.float32)
    for folder, size in (("truth", 0.01), ("predictions", 0.008)):
        (root / folder).mkdir()
        block = rng.normal(0, size, (lengths.max(), vertices * 3)).astype(np.float32) + template.ravel()
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
    deviations = []
    for file in sorted((root / "truth").iterdir()):
        true = np.load(file).reshape(-1, vertices, 3)
        predicted = np.load(root / "predictions" / file.name).reshape(-1, vertices, 3)
        length = min(len(true), len(predicted))
        true, predicted = true[:length], predicted[:length]
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
    from facediff.evaluate import evaluate, read_region

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
    }


def measure(score: Callable[[], dict[str, float]]) -> dict[str, Any]:
    """Numbers, seconds and peak memory of one way: run twice, since watching the memory takes time."""
    with Peak() as peak:
        found = score()
    start = time.perf_counter()
    score()
    return {"scores": found, "seconds": time.perf_counter() - start, "bytes": peak.bytes}


def parser() -> argparse.ArgumentParser:
    """Options of the benchmark."""
    made = argparse.ArgumentParser(description="Score a corpus of the size of BIWI's test A in two ways.")
    made.add_argument("--clips", type=int, default=24)
    made.add_argument("--frames", type=int, default=3879, help="of all clips together")
    made.add_argument("--vertices", type=int, default=23370)
    made.add_argument("--workers", type=int, help="of facediff; as many as processors")
    made.add_argument("--folder", type=Path, help="where to make the temporary folder")
    made.add_argument("--root", type=Path, help=argparse.SUPPRESS)
    made.add_argument("--way", help=argparse.SUPPRESS)
    return made


def main() -> None:
    """Measure every way in a process of its own and print ratios."""
    args = parser().parse_args()
    if args.way:
        import facediff.evaluate  # noqa: F401 - what importing costs is no part of scoring

        print(json.dumps(measure(ways(args)[args.way])))
        return
    if args.workers is None:
        from facediff.machine import processors

        args.workers = processors()
    with tempfile.TemporaryDirectory(dir=args.folder) as folder:
        args.root = Path(folder)
        write_corpus(args.root, args.clips, args.frames, args.vertices)
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
    apart = max(abs(row["scores"][name] / value - 1) for row in others for name, value in first["scores"].items())
    print(f"machine: {platform.processor() or platform.machine()}; Python {platform.python_version()}")
    print(f"corpus: {args.clips} clips, {args.frames} frames, {args.vertices} vertices, float32, warm page cache")
    print("memory: highest anonymous and shared memory above the start; mapped files are the page cache's")
    print("scores: " + ", ".join(f"{name} {value:.6e}" for name, value in first["scores"].items()))
    print(f"largest relative difference between the ways: {apart:.1e}\n")
    width = max(map(len, rows)) + 2
    print(f"{'way':<{width}}{'seconds':>9}{'MB':>8}{'times as fast':>16}{'of the memory':>16}")
    for way, row in rows.items():
        faster, memory = first["seconds"] / row["seconds"], row["bytes"] / max(first["bytes"], 1)
        print(f"{way:<{width}}{row['seconds']:>9.2f}{row['bytes'] / 1e6:>8.0f}{faster:>15.1f}x{memory:>16.4f}")
    assert apart < 1e-6, "the ways do not agree"


if __name__ == "__main__":
    main()
