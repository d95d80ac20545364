"""What a machine with a GPU does with facediff, in one command and at most eight minutes; nothing is downloaded.

Run ``python tools/gpu_check.py -o report.md`` in a clone with the extras ``all`` and ``test``. It prints a line for
each check, with its figure and its mark, and writes them as a table. The status is 1 if a check failed, 0 otherwise.
What eight minutes do not suffice for is left out and named. Weights are random and the corpus is noise: speed needs no
others.

Without CUDA it says so and runs the same at toy size on the processor, where marks that ask for speed do not count.
"""

from __future__ import annotations

import argparse
import os
import platform
import re
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tools" / "benchmarks"))

LIMIT = 480.0
"""Seconds that the whole check may take."""
FULL = {"vertices": 23370, "dim": 512, "heads": 8, "layers": 6, "clips": 16, "frames": 120, "max_frames": 800}
TOY = {"vertices": 120, "dim": 16, "heads": 2, "layers": 1, "clips": 8, "frames": 12, "max_frames": 60}
RESERVE = 0.25
"""Share of the time that is kept for the tests, which come last."""


@dataclass(frozen=True)
class Row:
    """A line of the report.

    Attributes:
        check: what was looked at.
        figure: what was found, in words.
        mark: what it is held to; empty for what is only told.
        passed: whether it is kept; None where it does not count.
    """

    check: str
    figure: str
    mark: str = ""
    passed: bool | None = None

    def word(self) -> str:
        """The outcome."""
        return {True: "pass", False: "FAIL", None: "-"}[self.passed]


class Check:
    """The machine, the sizes, and the checks; each yields rows."""

    def __init__(self, options: argparse.Namespace, folder: Path) -> None:
        self.device = torch.device(options.device)
        self.cuda = self.device.type == "cuda"
        sizes = FULL if self.cuda else TOY
        self.sizes = argparse.Namespace(
            **sizes, root=folder / "corpus", device=options.device, tiny_encoder=not self.cuda, repeats=3, seconds=4.0
        )
        self.rounds = 4 if self.cuda else 1
        self.clips_per_second: dict[str, float] = {}
        self._training: Any = None

    def speed(self, kept: bool) -> bool | None:
        """A mark that asks for speed: it counts on a GPU only."""
        return kept if self.cuda else None

    def finish(self) -> None:
        """Wait for the device."""
        if self.cuda:
            torch.cuda.synchronize(self.device)

    def clock(self, work: Callable[[], object], repeats: int = 3) -> float:
        """Seconds of the quickest of several calls, after one that warms up."""
        found = []
        for _ in range(repeats + 1):
            self.finish()
            started = time.perf_counter()
            work()
            self.finish()
            found.append(time.perf_counter() - started)
        return min(found[1:])

    def peak(self) -> str:
        """The most memory since the last call, in words."""
        if not self.cuda:
            return "memory not measured"
        most = torch.cuda.max_memory_allocated(self.device)
        torch.cuda.reset_peak_memory_stats(self.device)
        return f"{most / 2**30:.2f} GiB"

    @property
    def training(self) -> Any:  # noqa: ANN401 - the benchmark's
        """A model and a corpus of the benchmark of training."""
        if self._training is None:
            from training import Bench, write_corpus

            write_corpus(self.sizes.root, self.sizes.clips, self.sizes.frames, self.sizes.vertices)
            self._training = Bench(self.sizes, frozen=2)
        return self._training

    def environment(self) -> Iterator[Row]:
        """Versions and the device."""
        import lightning
        import transformers

        import facediff

        yield Row("facediff, Python", f"{facediff.__version__}, {platform.python_version()}")
        versions = f"{torch.__version__}, {lightning.__version__}, {transformers.__version__}"
        yield Row("PyTorch, Lightning, Transformers", versions)
        if not self.cuda:
            yield Row("device", f"no CUDA: toy size on the processor, {os.cpu_count()} cores")
            return
        device = torch.cuda.get_device_properties(self.device)
        about = f"{torch.cuda.device_count()} × {device.name}, {device.total_memory / 2**30:.0f} GiB"
        yield Row("device", f"{about}, capability {device.major}.{device.minor}, CUDA {torch.version.cuda}")
        yield Row("bfloat16", str(torch.cuda.is_bf16_supported()), "supported", torch.cuda.is_bf16_supported())
        nccl = torch.distributed.is_nccl_available()
        yield Row("NCCL", ".".join(map(str, torch.cuda.nccl.version())) if nccl else "missing", "there", nccl)

    def distributed(self) -> Iterator[Row]:
        """Two processes, or as many as there are GPUs, train as one process does with all of the batch."""
        count = torch.cuda.device_count() if self.cuda else 2
        backend = "nccl" if self.cuda else "gloo"
        node = ["-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={count}"]
        words = [sys.executable, *node, str(Path(__file__).resolve()), "--part=ddp", f"--device={self.device}"]
        started = time.perf_counter()
        done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=150)  # noqa: S603
        found = re.search(r"largest difference ([\d.e+-]+)", done.stdout)
        figure = f"{count} processes, largest difference of weights {found[1]}" if found else done.stderr[-200:]
        seconds = f", {time.perf_counter() - started:.0f} s"
        kept = done.returncode == 0 and found is not None and float(found[1]) < 1e-5
        yield Row(f"DDP on {backend}", figure + seconds, "as one process: < 1e-5", kept)

    def train(self) -> Iterator[Row]:
        """Clips a second of each way of training, and what batches of a frame budget, bf16 and compiling bring."""
        from training import COMPILED, FLOAT32, MIXED, PEERS, in_turn

        single = 3 if self.cuda else 1
        size = f"{self.sizes.vertices} vertices"
        for way in (PEERS, FLOAT32, MIXED):
            row = in_turn(self.training, [way], self.rounds, single)[way.name]
            self.clips_per_second[way.name] = row["clips"] / row["seconds"]
        loop, full, half = (self.clips_per_second[way.name] for way in (PEERS, FLOAT32, MIXED))
        yield Row(f"training, one clip a step, float32, {size}", f"{loop:.2f} clips/s, {self.peak()}")
        yield Row("training, frame budget, float32", f"{full:.2f} clips/s, {full / loop:.1f} × the one-clip loop",
                  "≥ 2 × the loop", self.speed(full >= 2 * loop))  # fmt: skip
        yield Row("training, frame budget, bf16-mixed", f"{half:.2f} clips/s, {half / full:.2f} × float32, "
                  f"{half / loop:.1f} × the loop", "≥ 1 × float32", self.speed(half >= full))  # fmt: skip
        finite = all(torch.isfinite(parameter).all() for parameter in self.training.model.parameters())
        yield Row("weights after these steps", "finite" if finite else "not finite", "finite", bool(finite))
        if not self.cuda:
            return  # compiling takes minutes of a processor
        row = in_turn(self.training, [COMPILED], self.rounds, single)[COMPILED.name]
        compiled = row["clips"] / row["seconds"]
        yield Row("training, bf16-mixed, compiled", f"{compiled:.2f} clips/s, {compiled / half:.2f} × uncompiled",
                  "≥ 0.95 × uncompiled", compiled >= 0.95 * half)  # fmt: skip

    def loader(self) -> Iterator[Row]:
        """Whether batches are read as quickly as they are trained on."""
        from training import MIXED

        batches = self.training.batches(MIXED)
        next(batches)
        started, clips = time.perf_counter(), 0
        for _ in range(8):
            clips += len(next(batches).to(self.device))
            self.finish()
        read = clips / (time.perf_counter() - started)
        trained = self.clips_per_second.get(MIXED.name)
        if trained is None:
            yield Row("loading", f"{read:.1f} clips/s")
            return
        yield Row("loading, to the device", f"{read:.1f} clips/s, {read / trained:.1f} × training", "≥ 1 × training",
                  self.speed(read >= trained))  # fmt: skip

    def sampling(self) -> Iterator[Row]:
        """Real-time factors and memory by sampler."""
        from sampling import build

        bench = build(self.sizes, self.sizes.vertices, tiny_encoder=self.sizes.tiny_encoder)
        model, batch, seconds = bench.model, bench.batch, self.sizes.seconds
        for name, steps in (("ddpm", None), ("ddim", 25), ("ddim", 10), ("dpm_solver", 10)):
            model.choose_sampler(name, steps if steps is not None else (100 if self.cuda else 10))
            factor = self.clock(lambda: model.generate(batch), 2) / seconds
            told = f"real-time factor {factor:.4f}, {self.peak()}"
            yield Row(f"sampling, {name}, {model.sampler.steps} steps", told, "< 1", self.speed(factor < 1))

    def tests(self) -> Iterator[Row]:
        """The tests that need CUDA."""
        words = [
            sys.executable,
            "-m",
            "pytest",
            "-q",
            "-n",
            "0",
            "-m",
            "cuda",
            "--durations=0",
            "tests/models/test_cuda.py",
        ]
        done = subprocess.run(words, capture_output=True, text=True, check=False, cwd=ROOT, timeout=200)  # noqa: S603
        last = next((line for line in reversed(done.stdout.splitlines()) if " in " in line), done.stderr[-200:])
        yield Row("tests that need CUDA (pytest -m cuda)", last.strip("= "), "none fails", done.returncode in (0, 5))


def train_distributed(device: str) -> None:
    """One process of a DDP training, which compares itself with training on the whole batch; started by torchrun."""
    import torch.distributed as dist
    from torch.nn.parallel import DistributedDataParallel

    cuda = device.startswith("cuda")
    dist.init_process_group("nccl" if cuda else "gloo")
    rank, world = dist.get_rank(), dist.get_world_size()
    place = torch.device("cuda", rank) if cuda else torch.device("cpu")
    if cuda:
        torch.cuda.set_device(place)

    def network() -> torch.nn.Module:
        torch.manual_seed(0)
        return torch.nn.Sequential(torch.nn.Linear(32, 64), torch.nn.GELU(), torch.nn.Linear(64, 8)).to(place)

    alone, together = network(), DistributedDataParallel(network(), device_ids=[rank] if cuda else None)
    data = torch.randn(5, 4 * world, 32, generator=torch.Generator().manual_seed(1)).to(place)
    for trained, mine in ((alone, slice(None)), (together, slice(4 * rank, 4 * rank + 4))):
        optimizer = torch.optim.AdamW(trained.parameters(), lr=1e-2)
        for batch in data:
            trained(batch[mine]).square().mean().backward()
            optimizer.step()
            optimizer.zero_grad()
    pairs = zip(alone.parameters(), together.module.parameters(), strict=True)
    largest = torch.stack([(one - other).abs().max() for one, other in pairs]).max()
    dist.all_reduce(largest, op=dist.ReduceOp.MAX)
    if rank == 0:
        print(f"largest difference {largest.item():.3g}", flush=True)
    dist.destroy_process_group()


def run(check: Check, limit: float) -> Iterator[Row]:
    """Rows of all checks; a check that breaks is a row of its own, and one that there is no time for too."""
    started = time.monotonic()
    parts = ("environment", "distributed", "train", "loader", "sampling", "tests")
    for name in parts:
        used = (time.monotonic() - started) / limit
        if used > (1 - RESERVE if name != "tests" else 0.9):
            yield Row(name, f"left out: {used:.0%} of {limit:.0f} s are used", "there is time", False)
            continue
        try:
            yield from getattr(check, name)()
        except Exception as error:  # noqa: BLE001 - the report goes on
            traceback.print_exc()
            yield Row(name, f"{type(error).__name__}: {' '.join(str(error).split())[:200]}", "runs", False)


def table(rows: list[Row], seconds: float) -> str:
    """The report as Markdown."""
    lines = ["# GPU check", "", f"`python tools/gpu_check.py`, {seconds:.0f} s", ""]
    lines += ["| check | figure | mark | outcome |", "|---|---|---|---|"]
    lines += [f"| {row.check} | {row.figure.replace('|', '/')} | {row.mark} | {row.word()} |" for row in rows]
    failed = sum(row.passed is False for row in rows)
    passed = sum(row.passed is True for row in rows)
    return "\n".join([*lines, "", f"{passed} passed, {failed} failed."]) + "\n"


def main() -> int:
    """Check, print and write."""
    from facediff.utils.files import atomic

    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("-o", "--output", type=Path, help="write the report there, as Markdown")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu", help="cuda or cpu")
    parser.add_argument("--limit", type=float, default=LIMIT, help="seconds for all (default: 480)")
    parser.add_argument("--part", choices=["ddp"], help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.part == "ddp":
        train_distributed(options.device)
        return 0
    if not options.device.startswith("cuda"):
        print("no CUDA here: the same at toy size on the processor; marks of speed do not count", flush=True)
    started = time.monotonic()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for row in run(Check(options, Path(folder)), options.limit):
            rows.append(row)
            print(f"{row.word():<5} {row.check}: {row.figure}{f' ({row.mark})' if row.mark else ''}", flush=True)
    text = table(rows, time.monotonic() - started)
    print(text.splitlines()[-1])
    if options.output:
        with atomic(options.output) as temporary:
            temporary.write_text(text, encoding="utf-8")
    return int(any(row.passed is False for row in rows))


if __name__ == "__main__":
    sys.exit(main())
