"""How small and how quick a published model is, against the checkpoint that it was made from.

    python tools/benchmarks/published.py demo/puppet.ckpt

publishes the checkpoint, in 32 and in 16 bits, into a temporary folder, and prints from this one run the bytes on disk
in shares of the weights' own, and the seconds of: importing (the same for all), loading, and the first animation of
three seconds of speech. Each is taken in a process of its own, the sources in turn; the quickest of several counts.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

CHILD = """
import json, sys, time
start = time.perf_counter()
import numpy, torch
import facediff
from facediff.models import DualPathDiffusion, load_model
from facediff import registry
for kind in registry.COMPONENTS.values():
    kind.load()
imported = time.perf_counter()
model = load_model(sys.argv[1])
loaded = time.perf_counter()
speech = torch.from_numpy(numpy.random.default_rng(0).normal(0, 0.1, 48000).astype("float32"))
model.animate(speech, identity=model.identities[0])
done = time.perf_counter()
weights = sum(value.numel() * value.element_size() for value in model.state_dict().values())
print(json.dumps([imported - start, loaded - imported, done - loaded, weights]))
"""


def bytes_of(source: Path) -> int:
    """Bytes on disk."""
    return sum(path.stat().st_size for path in source.iterdir()) if source.is_dir() else source.stat().st_size


def main(arguments: Sequence[str] | None = None) -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path, help="a trained model")
    parser.add_argument("--repeats", type=int, default=5, help="processes for each source; the quickest counts")
    args = parser.parse_args(arguments)

    import torch

    from facediff.models import load_model

    model = load_model(args.checkpoint)
    print(
        f"machine: {platform.processor() or platform.machine()}; {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} "
        f"at the start; Python {platform.python_version()}, torch {torch.__version__}"
    )
    with tempfile.TemporaryDirectory() as place:
        sources = {
            "checkpoint": args.checkpoint,
            "published": model.save_pretrained(Path(place) / "whole"),
            "published, 16 bits": model.save_pretrained(Path(place) / "half", half=True),
        }
        taken: dict[str, list[list[float]]] = {name: [] for name in sources}
        for _ in range(args.repeats):
            for name, source in sources.items():
                words = [sys.executable, "-c", CHILD, str(source)]
                done = subprocess.run(words, capture_output=True, text=True, check=True)
                taken[name].append(json.loads(done.stdout.splitlines()[-1]))
        weights = taken["checkpoint"][0][3]
        print(f"weights: {weights / 1e6:.2f} MB in memory; the quickest of {args.repeats} processes each\n")
        print(f"{'':20}{'MB':>8}{'of weights':>12}{'import s':>10}{'load s':>9}{'first animation s':>19}")
        best = {name: [min(column) for column in zip(*rows, strict=True)] for name, rows in taken.items()}
        for name, (imported, loaded, first, _) in best.items():
            size = bytes_of(sources[name])
            print(f"{name:20}{size / 1e6:8.2f}{size / weights:12.3f}{imported:10.2f}{loaded:9.3f}{first:19.3f}")
        for file in sorted(sources["published"].iterdir()):
            print(f"  of published: {file.name:20}{file.stat().st_size / 1e6:8.2f} MB")
        ratio = best["checkpoint"][1] / best["published"][1]
        print(f"\nloading is {ratio:.2f} times as quick from the folder as from the checkpoint")


if __name__ == "__main__":
    main()
