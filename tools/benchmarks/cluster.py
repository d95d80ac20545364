"""The same work through processes and through a Dask cluster on the loopback: equal bytes, and how it scales.

    python tools/benchmarks/cluster.py demo/puppet.ckpt

animates recordings of the built-in corpus into .npz archives and scores made-up predictions of the same clips: with two
processes, with a cluster of one worker, with one of two, and with one of two of which one is killed in the middle. The
scheduler and each worker are programs of their own. All files, and the tables of scores, are compared byte for byte;
the exit status is 1 if any differs. Seconds include the start of the command and the loading of the model.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))

from tools.dask_processes import DaskProcesses  # noqa: E402


def facediff(*words: object, place: Path, strike: tuple[DaskProcesses, Path, int] | None = None) -> float:
    """Run a command in a folder; its seconds.

    Args:
        words: the command's.
        place: the folder.
        strike: a cluster whose last worker is killed as soon as a folder holds so many files.
    """
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    started = time.perf_counter()
    with (place / "printed.txt").open("wb") as printed:
        command = [sys.executable, "-m", "facediff", *map(str, words)]
        process = subprocess.Popen(command, cwd=place, env=environment, stdout=printed, stderr=subprocess.STDOUT)
        while strike is not None and process.poll() is None:
            cluster, folder, files = strike
            if len(list(folder.glob("*.npz"))) >= files:
                cluster.kill(cluster.programs[-1])
                strike = None
            time.sleep(0.01)
        if process.wait():
            raise RuntimeError((place / "printed.txt").read_text())
    return time.perf_counter() - started


def tree(folder: Path) -> dict[str, str]:
    """Checksum of every file below a folder, hidden ones included."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def write_predictions(corpus: Path, clips: Sequence[str], folder: Path) -> None:
    """Predictions that differ from the truth by noise of half a millimetre."""
    import numpy as np

    folder.mkdir()
    noise = np.random.default_rng(0)
    for clip in clips:
        truth = np.load(corpus / "vertices_npy" / f"{clip}.npy")
        motion = truth + noise.normal(0, 5e-4, truth.shape).astype(np.float32)
        np.save(folder / f"{clip}_condition_{clip.partition('_')[0]}.npy", motion)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run and print; 1 if anything differs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path, help="a model that was trained on the built-in corpus")
    parser.add_argument("--corpus", type=Path, help="the built-in corpus (default: that of the user's cache)")
    parser.add_argument("--recordings", type=int, default=60, help="how many clips")
    args = parser.parse_args(arguments)
    if args.corpus is None:
        from facediff.data.puppet import FirstEdition, cache_root
        from facediff.synthetic import generate

        args.corpus = cache_root(FirstEdition())
        generate(args.corpus)
    sounds = sorted((args.corpus / "wav").glob("*.wav"))[: args.recordings]
    print(
        f"machine: {platform.processor() or platform.machine()}; {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} "
        f"at the start\n{len(sounds)} recordings; scheduler and workers on the loopback"
    )
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        (place / "speech").mkdir()
        for sound in sounds:
            shutil.copy(sound, place / "speech")
        shutil.copy(args.checkpoint, place / "model.ckpt")
        write_predictions(args.corpus, [sound.stem for sound in sounds], place / "ours")
        seconds: dict[str, dict[str, float]] = {"animate": {}, "evaluate": {}}
        found: dict[str, dict[str, str]] = {}
        ways = {"2 processes": (0, False), "1 worker": (1, False), "2 workers": (2, False), "2, one killed": (2, True)}
        for way, (workers, killed) in ways.items():
            out = place / way.replace(" ", "_")
            where: list[object] = ["--scheduler", "processes", "--workers", 2]
            with DaskProcesses(place / f"{out.name}_cluster", workers) as cluster:
                where = ["--scheduler", cluster.address] if workers else where
                strike = (cluster, out / "motion", len(sounds) // 3) if killed else None
                words = ("speech", "--checkpoint", "model.ckpt", "--suffix", ".npz", "--quiet", "-o", out / "motion")
                seconds["animate"][way] = facediff("animate", *words, *where, place=place, strike=strike)
                if killed and len(sounds) > 2 and cluster.programs[-1].poll() is None:
                    raise RuntimeError("no worker was killed")
                scores = ("ours", args.corpus.absolute(), "--bootstrap", 100, "--quiet", "--json", out / "scores.json")
                seconds["evaluate"][way] = facediff("evaluate", *scores, *where, place=place)
            found[way] = tree(out)
        for command, times in seconds.items():
            for way, taken in times.items():
                print(f"{command:9} {way:14} {taken:7.1f} s  {times['2 processes'] / taken:5.2f} x two processes")
            print(f"{command:9} from 1 worker to 2: {times['1 worker'] / times['2 workers']:.2f} x")
        same = {way: found[way] == found["2 processes"] for way in ways}
        files = len(found["2 processes"])
        print(f"{files} files each: " + ", ".join(f"{way} {'equal' if same[way] else 'DIFFERENT'}" for way in ways))
        return 0 if all(same.values()) and files > 2 * len(sounds) else 1


if __name__ == "__main__":
    sys.exit(main())
