"""How good a checkpoint's motion is by sampler and steps, and which sampler is the fastest that loses nothing.

    python tools/sampler_table.py --checkpoint demo/puppet.ckpt

Every sampler makes the test clips once for each seed; a seed gives a clip the same first noise whatever the sampler,
so samplers are compared clip by clip and seed by seed. LVE and FDD are the protocol's scores of one seed, mean and
standard deviation over seeds. Diversity is the mean distance between two seeds' motions of a clip. The fastest sampler
whose LVE exceeds the first one's by no more than the tolerance and whose diversity is kept is named.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shlex
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from itertools import combinations
from pathlib import Path
from statistics import fmean, stdev

import torch

from facediff.data import Batch, Sample, SpeechMotionDataModule, collate
from facediff.errors import FaceDiffError
from facediff.metrics import Region, SampleDiversity
from facediff.models import DualPathDiffusion, load_model
from facediff.models.checkpoint import corpus_class
from facediff.speech.audio import SAMPLE_RATE, samples_for

SAMPLERS = ("ddpm:1000", "ddim:50", "ddim:25", "ddim:10", "dpm_solver:20", "dpm_solver:10", "dpm_solver:5")
TIMED_SECONDS = 10.0


@dataclass
class Scores:
    """What one sampler reached.

    Attributes:
        sampler: its name.
        steps: its steps.
        lve: by split, one number a seed.
        fdd: by split, one number a seed.
        diversity: by split, one number a seed: its mean distance from the other seeds' motions.
        real_time_factor: time for ten seconds of speech, by that time.
    """

    sampler: str
    steps: int
    lve: dict[str, list[float]] = field(default_factory=dict)
    fdd: dict[str, list[float]] = field(default_factory=dict)
    diversity: dict[str, list[float]] = field(default_factory=dict)
    real_time_factor: float = 0.0

    @property
    def name(self) -> str:
        """Sampler and steps."""
        return f"{self.sampler} {self.steps}"

    def excess(self, split: str, full: Scores) -> tuple[float, float]:
        """By what share LVE exceeds another sampler's, seed by seed: the mean, and its standard error."""
        reference = fmean(full.lve[split])
        shares = [(mine - theirs) / reference for mine, theirs in zip(self.lve[split], full.lve[split], strict=True)]
        return fmean(shares), spread(shares) / len(shares) ** 0.5

    def kept(self, split: str, full: Scores) -> float:
        """Diversity as a share of another sampler's."""
        return fmean(self.diversity[split]) / fmean(full.diversity[split])


def spread(values: Sequence[float]) -> float:
    """Standard deviation; 0 of a single value."""
    return stdev(values) if len(values) > 1 else 0.0


def fastest(rows: Sequence[Scores], *, tolerance: float, kept: float) -> Scores:
    """The sampler of the fewest steps that is as good as the first one, of equal steps the one with the lowest LVE.

    Args:
        rows: all samplers; the first is the one that others are held against.
        tolerance: by what share LVE may exceed the first one's, on every split.
        kept: share of the first one's diversity that must be left, on every split.
    """
    full = rows[0]
    good = [
        row for row in rows if all(row.excess(s, full)[0] <= tolerance and row.kept(s, full) >= kept for s in full.lve)
    ]
    # A step costs the same with every sampler, but for less than what a machine's timings vary by.
    return min(good, key=lambda row: (row.steps, sum(fmean(row.lve[s]) / fmean(full.lve[s]) for s in full.lve)))


def measure(model: DualPathDiffusion, batches: dict[str, list[Batch]], scores: Scores, seeds: int) -> None:
    """Make every clip with every seed, and score it."""
    model.choose_sampler(scores.sampler, scores.steps)
    regions = {
        name: Region.from_indices(name, indices, n_vertices=model.n_vertices)
        for name, indices in model.assets.regions.items()
    }
    pairs = list(combinations(range(seeds), 2))
    for split, some in batches.items():
        metrics = [model.evaluation.protocol.build(regions["lips"], regions["upper_face"]) for _ in range(seeds)]
        distances = {pair: SampleDiversity(n_samples=2, pairing="all") for pair in pairs}
        for batch in some:
            told = {"lengths": batch.frame_lengths, "clip_names": batch.names}
            made = [model.generate(batch, seed=seed) for seed in range(seeds)]
            for metric, motion in zip(metrics, made, strict=True):
                metric.update(motion, batch.motion, **told)
            for (one, other), distance in distances.items():
                distance.update(torch.stack([made[one], made[other]], 1), **told)
        found = [metric.compute() for metric in metrics]
        scores.lve[split], scores.fdd[split] = ([float(each[name]) for each in found] for name in ("lve", "fdd"))
        apart = {pair: float(distance.compute()) for pair, distance in distances.items()}
        scores.diversity[split] = [fmean(d for pair, d in apart.items() if seed in pair) for seed in range(seeds)]


def ten_seconds(sample: Sample, frame_rate: float) -> Batch:
    """A clip's speech over and over, ten seconds long."""
    frames = round(TIMED_SECONDS * frame_rate)
    needed = samples_for(frames, frame_rate)
    speech = sample.audio.repeat(-(-needed // len(sample.audio)))[:needed]
    motion = sample.motion.new_zeros(frames, *sample.motion.shape[1:])
    return collate([replace(sample, audio=speech, motion=motion, decoy_audio=None, features=None)])


def real_time_factor(model: DualPathDiffusion, batch: Batch, scores: Scores, repeats: int = 5) -> float:
    """The quickest of several, the speech's encoding included, by the length of the speech."""
    model.choose_sampler(scores.sampler, scores.steps)
    taken = []
    for _ in range(repeats):
        started = time.perf_counter()
        model.generate(batch)
        taken.append(time.perf_counter() - started)
    return min(taken) * SAMPLE_RATE / batch.audio.shape[1]


def table(rows: Sequence[Scores], split: str, unit: str) -> str:
    """One split's scores in Markdown."""
    full = rows[0]
    lines = [
        f"| sampler | steps | LVE [{unit}²] | LVE against {full.name} | FDD [{unit}²] | diversity [{unit}] | "
        f"diversity kept | real-time factor |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        cells = [shown(each[split]) for each in (row.lve, row.fdd, row.diversity)]
        excess, error = row.excess(split, full)
        against = "–" if row is full else f"{100 * excess:+.2f} ± {100 * error:.2f} %"
        lines.append(
            f"| `{row.sampler}` | {row.steps} | {cells[0]} | {against} | {cells[1]} | {cells[2]} | "
            f"{100 * row.kept(split, full):.1f} % | {row.real_time_factor:.3g} |"
        )
    return "\n".join(lines)


def shown(values: Sequence[float]) -> str:
    """Mean ± standard deviation, both to the power of ten of the mean."""
    mean = fmean(values)
    power = int(f"{mean:e}".partition("e")[2])
    return f"({mean / 10**power:.3f} ± {spread(values) / 10**power:.3f})·10^{power}"


def verdict(rows: Sequence[Scores], args: argparse.Namespace) -> str:
    """Which sampler is named, and whether so many seeds can tell."""
    full, best = rows[0], fastest(rows, tolerance=args.tolerance, kept=args.kept)
    doubt = max((sum(best.excess(split, full)[i] * (1, 2)[i] for i in (0, 1)) for split in full.lve), default=0.0)
    sure = "" if doubt <= args.tolerance else "; with two standard errors it is not: take more seeds to be sure"
    return (
        f"Fastest sampler whose LVE is within {100 * args.tolerance:g} % of {full.name}'s and that keeps at least "
        f"{100 * args.kept:g} % of its diversity, on every split: **{best.name}**{sure}."
    )


def heading(args: argparse.Namespace, model: DualPathDiffusion, batches: dict[str, list[Batch]]) -> str:
    """What is measured, where and how."""
    packages = ", ".join(f"{name} {version(name)}" for name in ("facediff", "torch"))
    clips = ", ".join(f"{split} {sum(map(len, some))} clips" for split, some in batches.items())
    synthetic = " (synthetic: says nothing about real people)" if model.assets.synthetic else ""
    millions = sum(p.numel() for p in model.parameters()) / 1e6
    return "\n".join(
        [
            f"- corpus: {model.assets.corpus}{synthetic}; {clips}; {args.seeds} seeds; protocol "
            f"{model.evaluation.protocol.name}; {millions:.1f} million weights",
            f"- machine: {processor()}, {torch.get_num_threads()} threads, load {os.getloadavg()[0]:.1f} at the start; "
            f"Python {platform.python_version()}, {packages}",
            f"- command: `{shlex.join(['python', 'tools/sampler_table.py', *args.words])}`",
            "- ± is the standard deviation over seeds; of the differences in LVE the mean's standard error",
        ]
    )


def processor() -> str:
    """Name of the processor."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.is_file() else []
    names = (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor() or platform.machine())


def corpus_of(model: DualPathDiffusion, root: str | None) -> SpeechMotionDataModule:
    """The corpus that a checkpoint was trained on.

    Raises:
        FaceDiffError: if its class is not known.
    """
    data = corpus_class("--checkpoint", model.data_source)(root=root or model.data_source["root"])
    data.prepare_data()
    return data


def options(words: Sequence[str]) -> argparse.Namespace:
    """The command line."""
    made = argparse.ArgumentParser(description=str(__doc__).partition("\n")[0])
    add = made.add_argument
    add("--checkpoint", type=Path, required=True, help="a checkpoint of DualPathDiffusion")
    add("--data-root", help="the corpus folder (default: the one that the checkpoint was trained on)")
    add("--sampler", nargs="+", default=SAMPLERS, metavar="NAME:STEPS", help="the first is what others are held to")
    add("--split", nargs="+", help="test splits (default: all of the corpus's)")
    add("--clips", type=int, help="clips of each split, spread evenly over it (default: all)")
    add("--seeds", type=int, default=10, help="motions of each clip (default: 10)")
    add("--tolerance", type=float, default=0.01, help="by what share LVE may exceed the first's (default: 0.01)")
    add("--kept", type=float, default=0.95, help="share of the first's diversity to be left (default: 0.95)")
    add("--batch-size", type=int, default=10, help="clips at once (default: 10)")
    add("--threads", type=int, help="threads of PyTorch (default: its own choice)")
    add("--json", type=Path, metavar="FILE", help="write the numbers there too, unrounded")
    args = made.parse_args(words)
    args.words = list(words)
    if args.seeds < 2:
        made.error(f"--seeds: {args.seeds} cannot show diversity; give 2 or more")
    return args


@torch.inference_mode()
def main(words: Sequence[str] | None = None) -> int:
    """Measure, print as Markdown."""
    args = options(sys.argv[1:] if words is None else words)
    if args.threads:
        torch.set_num_threads(args.threads)
    model = load_model(args.checkpoint)
    if not isinstance(model, DualPathDiffusion):
        raise FaceDiffError(f"{args.checkpoint}: {type(model).__name__} has no sampler; give one of DualPathDiffusion")
    data = corpus_of(model, args.data_root)
    batches = {split: clips_of(data, split, args) for split in args.split or data.test_splits}
    print(heading(args, model, batches), flush=True)
    timed = ten_seconds(data.dataset(next(iter(batches)))[0], model.frame_rate)
    rows = []
    for word in args.sampler:
        name, _, steps = word.partition(":")
        rows.append(Scores(name, int(steps)))
        started = time.monotonic()
        measure(model, batches, rows[-1], args.seeds)
        rows[-1].real_time_factor = real_time_factor(model, timed, rows[-1])
        print(f"{rows[-1].name}: {time.monotonic() - started:.0f} s", file=sys.stderr, flush=True)
    for split in batches:
        print(f"\n{split}:\n\n{table(rows, split, model.assets.unit)}")
    print(f"\n{verdict(rows, args)}")
    if args.json:
        args.json.write_text(json.dumps([asdict(row) for row in rows], indent=1) + "\n", encoding="utf-8")
    return 0


def clips_of(data: SpeechMotionDataModule, split: str, args: argparse.Namespace) -> list[Batch]:
    """A split's clips in batches, like lengths together."""
    dataset = data.dataset(split)
    count = min(args.clips or len(dataset), len(dataset))
    samples = [dataset[i * len(dataset) // count] for i in range(count)]
    samples.sort(key=lambda sample: len(sample.motion))
    return [collate(samples[i : i + args.batch_size]) for i in range(0, count, args.batch_size)]


if __name__ == "__main__":
    raise SystemExit(main())
