"""How long sampling takes against the length of the speech: the real-time factor, by sampler and steps.

Run ``python tools/benchmarks/sampling.py``: 10 s of noise as speech, 23 370 vertices as in BIWI, HuBERT base and the
dual-path network at width 512, all with random weights, so nothing is downloaded. A step's cost
does not depend on its number, so a few steps are timed and multiplied; one configuration (``--full``) is also run
from start to end, to compare.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

from facediff import registry
from facediff.components.audio_encoder.hubert import HubertEncoder
from facediff.components.decoder.style_transformer import StyleTransformer
from facediff.components.fusion.cross_attention import BidirectionalCrossAttention
from facediff.components.style_encoder.tcn_gru_transformer import TcnGruTransformer
from facediff.data import Assets, Batch, Sample, collate
from facediff.data.audio import SAMPLE_RATE, samples_for
from facediff.diffusion.samplers import Sampler
from facediff.systems import DualPathDiffusion
from facediff.systems.dual_path.network import Conditions

FRAME_RATE = 25.0
REFERENCE_FRAMES = 100
IDENTITIES = ["F2", "F3", "F4", "M3", "M4", "M5"]
CONFIGURATIONS = (("ddpm", 1000), ("ddim", 50), ("ddim", 25), ("ddim", 10), ("dpm_solver", 20), ("dpm_solver", 10))


@dataclass
class Costs:
    """Seconds that the parts of sampling take; each is a median over repeats.

    Attributes:
        audio_encoder: speech to features, once a clip.
        conditions: identity and style, once a clip.
        embed: noisy motion to C channels, once a step.
        core: fusion and decoder, once a step.
        unembed: C channels to clean motion, once a step.
        update: the scheduler's step with the noise that it draws, once a step, by sampler.
        rest: first noise, making the scheduler, undoing the motion scale; once a clip.
    """

    audio_encoder: float
    conditions: float
    embed: float
    core: float
    unembed: float
    rest: float
    update: dict[str, float] = field(default_factory=dict)

    def row(self, sampler: str, steps: int, seconds: float) -> dict[str, Any]:
        """What one configuration costs: parts, total and real-time factor."""
        step = self.embed + self.core + self.unembed + self.update[sampler]
        total = self.audio_encoder + self.conditions + steps * step + self.rest
        return {
            "sampler": sampler,
            "steps": steps,
            "audio_encoder": self.audio_encoder,
            "conditions": self.conditions,
            "per_step": step,
            "all_steps": steps * step,
            "rest": self.rest,
            "total": total,
            "real_time_factor": total / seconds,
        }


@dataclass(frozen=True)
class Bench:
    """A system and one clip to sample for it.

    Attributes:
        system: the system, in evaluation mode.
        batch: one clip.
        repeats: timed repetitions of every part; one more before them warms up.
    """

    system: DualPathDiffusion
    batch: Batch
    repeats: int

    def now(self) -> float:
        """The time in seconds, once the device has finished what it was given."""
        if self.system.device.type == "cuda":
            torch.cuda.synchronize(self.system.device)
        return time.perf_counter()

    def clock(self, work: Callable[[], object]) -> float:
        """Seconds that a call takes, with everything that it started on the device."""
        start = self.now()
        work()
        return self.now() - start

    def median(self, work: Callable[[], object]) -> float:
        """Median seconds of a call, after one to warm up."""
        work()
        return statistics.median(self.clock(work) for _ in range(self.repeats))

    def conditions(self) -> Conditions:
        """Everything that is computed once a clip."""
        batch = self.batch
        reference = batch.reference.flatten(2) * self.system.scale
        return self.system.network.conditions(
            batch.audio, batch.audio_lengths, batch.frame_lengths, batch.identity, reference, batch.reference_mask
        )

    def once_a_clip(self) -> tuple[float, float]:
        """Median seconds of the audio encoder, and of all other conditions."""
        encoder = self.system.network.audio_encoder
        entered: list[float] = []
        left: list[float] = []
        hooks = [
            encoder.register_forward_pre_hook(lambda *_: entered.append(self.now())),
            encoder.register_forward_hook(lambda *_: left.append(self.now())),
        ]
        whole = [self.clock(self.conditions) for _ in range(self.repeats + 1)]
        for hook in hooks:
            hook.remove()
        audio = [end - start for start, end in zip(entered, left, strict=True)]
        others = [total - part for total, part in zip(whole, audio, strict=True)]
        return statistics.median(audio[1:]), statistics.median(others[1:])

    def start(self) -> torch.Tensor:
        """The noise that sampling starts from."""
        return torch.randn(self.batch.motion.flatten(2).shape, device=self.system.device)

    def measure(self, samplers: dict[str, Sampler]) -> Costs:
        """Time every part."""
        network, batch = self.system.network, self.batch
        audio_encoder, others = self.once_a_clip()
        conditions, noisy = self.conditions(), self.start()
        step = torch.full((len(batch),), self.system.process.steps // 2, device=noisy.device)
        embedded = network.embed(noisy)
        decoded = network.core(embedded, step, conditions)
        first = next(iter(samplers.values()))
        costs = Costs(
            audio_encoder=audio_encoder,
            conditions=others,
            embed=self.median(lambda: network.embed(noisy)),
            core=self.median(lambda: network.core(embedded, step, conditions)),
            unembed=self.median(lambda: network.unembed(decoded)),
            rest=self.median(lambda: (first.make_scheduler(), self.start() / self.system.scale)),
        )
        clean = network.unembed(decoded)
        costs.update = {name: self.update(sampler, noisy, clean) for name, sampler in samplers.items()}
        return costs

    def update(self, sampler: Sampler, noisy: torch.Tensor, clean: torch.Tensor) -> float:
        """Median seconds of the scheduler's step, after two that warm up."""
        scheduler, spent = sampler.make_scheduler(), []
        for step in scheduler.timesteps[: self.repeats + 2].tolist():
            work = partial(sampler.advance, scheduler, clean, step, noisy, torch.randn_like)
            spent.append(self.clock(work))
        return statistics.median(spent[2:] or spent)


def build(args: argparse.Namespace) -> Bench:
    """The system with random weights, its assets, and one clip of noise as speech."""
    from transformers import HubertConfig

    torch.manual_seed(0)
    tiny: dict[str, Any] = {
        "num_hidden_layers": 2,
        "num_attention_heads": 2,
        "hidden_size": 32,
        "intermediate_size": 64,
    }
    tiny |= {"conv_dim": (16,) * 7, "num_conv_pos_embeddings": 16, "num_conv_pos_embedding_groups": 2}
    config = HubertConfig(**(tiny if args.tiny_encoder else {})).to_dict()
    system = DualPathDiffusion(
        n_vertices=args.vertices,
        identities=IDENTITIES,
        frame_rate=FRAME_RATE,
        dim=args.dim,
        audio_encoder=partial(HubertEncoder, config=config),
        style_encoder=partial(TcnGruTransformer, num_heads=args.heads),
        fusion=partial(BidirectionalCrossAttention, num_heads=args.heads),
        decoder=partial(StyleTransformer, num_layers=args.layers, num_heads=args.heads),
    )
    system.adopt(
        Assets(
            corpus="random weights",
            synthetic=True,
            unit="m",
            frame_rate=FRAME_RATE,
            identities=IDENTITIES,
            templates={name: torch.zeros(args.vertices, 3) for name in IDENTITIES},
            faces=None,
            regions={name: torch.arange(3) for name in ("lips", "upper_face")},
            motion_scale=100.0,
        )
    )
    frames = max(1, round(args.seconds * FRAME_RATE))
    sample = Sample(
        audio=torch.randn(samples_for(frames, FRAME_RATE)),
        motion=torch.zeros(frames, args.vertices, 3),
        template=torch.zeros(args.vertices, 3),
        identity=0,
        reference=1e-2 * torch.randn(REFERENCE_FRAMES, args.vertices, 3),
        name="speech",
        subject=IDENTITIES[0],
        sentence="",
        reference_name="reference",
    )
    return Bench(system.eval().to(args.device), collate([sample]).to(args.device), args.repeats)


def processor(device: str) -> str:
    """Name of the processor, and of the accelerator if one is used."""
    name = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        lines = info.read_text(encoding="utf-8").splitlines()
        name = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), name)
    return f"{name}; {torch.cuda.get_device_name(device)}" if device.startswith("cuda") else name


def peak_memory(device: str) -> str:
    """Most memory that the process has held so far."""
    # Linux counts in KiB, macOS in bytes.
    size = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**30 if sys.platform == "darwin" else 2**20)
    text = f"{size:.2f} GiB resident"
    if device.startswith("cuda"):
        text += f", {torch.cuda.max_memory_allocated(device) / 2**30:.2f} GiB on the device"
    return text


def heading(args: argparse.Namespace, bench: Bench) -> str:
    """What is measured, and where."""
    network = bench.system.network
    millions = sum(p.numel() for p in network.parameters()) / 1e6
    speech = sum(p.numel() for p in network.audio_encoder.parameters()) / 1e6
    encoder = "tiny HuBERT" if args.tiny_encoder else "HuBERT base"
    packages = ", ".join(f"{name} {version(name)}" for name in ("torch", "diffusers", "transformers"))
    return "\n".join(
        [
            f"machine: {processor(args.device)}; {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} at the start; "
            f"{torch.get_num_threads()} threads; device {args.device}",
            f"software: Python {platform.python_version()}, {packages}",
            f"model: {args.vertices} vertices, width {args.dim}, {args.layers} blocks, {args.heads} heads, {encoder}; "
            f"{millions:.1f} million weights, {speech:.1f} of them in the audio encoder; random, float32",
            f"speech: {bench.batch.motion.shape[1] / FRAME_RATE:g} s, {bench.batch.motion.shape[1]} frames; "
            f"medians of {args.repeats} after a warm-up",
        ]
    )


def tables(costs: Costs, rows: list[dict[str, Any]]) -> str:
    """Both tables: a step's parts, and the configurations."""
    lines = ["", "one step, in milliseconds", f"{'sampler':<12}{'embed':>10}{'core':>10}{'unembed':>10}"]
    lines[-1] += f"{'noise+update':>14}{'step':>10}"
    for name, update in costs.update.items():
        parts = (costs.embed, costs.core, costs.unembed)
        cells = "".join(f"{1e3 * part:>10.3f}" for part in parts)
        lines.append(f"{name:<12}{cells}{1e3 * update:>14.3f}{1e3 * (sum(parts) + update):>10.3f}")
    lines += ["", "a clip, in seconds; all steps = steps x one step (EXTRAPOLATED from a few timed steps)"]
    lines.append(
        f"{'sampler':<12}{'steps':>6}{'audio encoder':>15}{'conditions':>12}{'all steps':>12}{'rest':>10}{'total':>12}"
        f"{'real-time factor':>18}"
    )
    for row in rows:
        lines.append(
            f"{row['sampler']:<12}{row['steps']:>6}{row['audio_encoder']:>15.4f}{row['conditions']:>12.4f}"
            f"{row['all_steps']:>12.4f}{row['rest']:>10.4f}{row['total']:>12.4f}{row['real_time_factor']:>18.4f}"
        )
    return "\n".join(lines)


def ratios(rows: list[dict[str, Any]]) -> str:
    """What one run says about the relations, which carry over to other machines better than seconds do."""
    by = {(row["sampler"], row["steps"]): row for row in rows}
    slow, usual, few = by["ddpm", 1000], by["ddim", 25], by["dpm_solver", 10]
    again = usual["total"] + (usual["steps"] - 1) * usual["audio_encoder"]
    return "\n".join(
        [
            "",
            "ratios, from this run alone",
            f"  ddpm 1000 takes {slow['total'] / usual['total']:.1f} times as long as ddim 25, "
            f"{slow['total'] / few['total']:.1f} times as long as dpm_solver 10",
            f"  share of the audio encoder: {usual['audio_encoder'] / usual['total']:.1%} with ddim 25, "
            f"{few['audio_encoder'] / few['total']:.1%} with dpm_solver 10",
            f"  encoding the speech anew in every step would make ddim 25 {again / usual['total']:.1f} times as slow",
        ]
    )


def options() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--vertices", type=int, default=23370, help="vertices of the face (default: BIWI's 23370)")
    parser.add_argument("--seconds", type=float, default=10.0, help="length of the speech (default: 10)")
    parser.add_argument("--dim", type=int, default=512, help="model width (default: 512)")
    parser.add_argument("--layers", type=int, default=6, help="decoder blocks (default: 6)")
    parser.add_argument("--heads", type=int, default=8, help="attention heads (default: 8)")
    parser.add_argument("--repeats", type=int, default=5, help="timed repetitions of every part (default: 5)")
    parser.add_argument("--device", default="cpu", help="cpu (default), cuda …")
    parser.add_argument("--threads", type=int, help="threads of PyTorch (default: its own choice)")
    parser.add_argument("--tiny-encoder", action="store_true", help="a tiny HuBERT instead of HuBERT base, for trials")
    parser.add_argument("--quick", action="store_true", help="one repetition of every part and no full run")
    parser.add_argument("--full", type=int, default=10, help="steps of the ddim run in full (default: 10; 0: none)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the numbers there too, unrounded")
    args = parser.parse_args()
    if args.quick:
        args.repeats, args.full = 1, 0
    return args


@torch.inference_mode()
def main() -> None:
    """Measure and print."""
    args = options()
    if args.threads:
        torch.set_num_threads(args.threads)
    bench = build(args)
    print(heading(args, bench), flush=True)
    seconds = bench.batch.audio.shape[1] / SAMPLE_RATE
    process = bench.system.process
    costs = bench.measure({name: registry.sampler.get(name)(process=process) for name, _ in CONFIGURATIONS})
    rows = [costs.row(name, steps, seconds) for name, steps in CONFIGURATIONS]
    print(tables(costs, rows))
    print(ratios(rows), flush=True)
    found: dict[str, Any] = {"seconds": seconds, "costs": asdict(costs), "rows": rows}
    if args.full:
        bench.system.choose_sampler("ddim", args.full)
        measured = bench.clock(lambda: bench.system.generate(bench.batch))
        expected = costs.row("ddim", args.full, seconds)["total"]
        print(
            f"\nddim {args.full} in full: measured {measured:.4f} s, extrapolated {expected:.4f} s, "
            f"measured/extrapolated {measured / expected:.3f}"
        )
        found["full"] = {"steps": args.full, "measured": measured, "extrapolated": expected}
    print(f"peak memory: {peak_memory(args.device)}")
    if args.json:
        args.json.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
