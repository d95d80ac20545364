"""How long sampling takes against the length of the speech, folded and on vertices, by sampler and steps.

Run ``python tools/benchmarks/sampling.py``: 10 s of noise as speech, 23 370 vertices as in BIWI, HuBERT base and the
dual-path network at width 512, all with random weights, so nothing is downloaded. The default sampler is run from
start to end. A step's cost does not depend on its number, so for the others a few steps are timed and multiplied.
The quickest of the repeats counts, since other programs make work slower but never quicker, and steps that are
compared take turns, so that whatever else the machine does meets them alike.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import sys
import time
from collections.abc import Callable, Mapping
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
from facediff.diffusion.folding import fold
from facediff.diffusion.samplers import Sampler
from facediff.systems import DualPathDiffusion
from facediff.systems.dual_path.network import Conditions
from facediff.systems.dual_path.spaces import SamplingSpace, Space, choose_space
from facediff.systems.dual_path.system import ClipNoise

FRAME_RATE = 25.0
REFERENCE_FRAMES = 100
IDENTITIES = ["F2", "F3", "F4", "M3", "M4", "M5"]
SPACES: tuple[SamplingSpace, ...] = ("folded", "vertices")
PEER_STEPS = 500
SAMPLERS = ("ddpm", "ddim", "dpm_solver")
FLAME = 5023
CONFIGURATIONS = (("ddpm", 1000), ("ddim", 50), ("ddim", 25), ("ddim", 10), ("dpm_solver", 20), ("dpm_solver", 10))


@dataclass
class Costs:
    """Seconds that the parts of sampling take; each is the quickest of the repeats.

    Attributes:
        audio_encoder: speech to features, once a clip.
        conditions: identity and style, once a clip.
        fold: the products of the linear ends, once a model.
        look: whether the weights are those that were folded; once a clip.
        core: fusion and decoder, in every step.
        leave: features to vertices: once a clip where folded, in every step otherwise.
        rest: undoing the motion scale; once a clip.
        step: a whole step with the noise that it draws, by sampling space and sampler.
    """

    audio_encoder: float
    conditions: float
    fold: float
    look: float
    core: float
    leave: float
    rest: float
    step: dict[str, dict[str, float]] = field(default_factory=dict)

    def row(self, space: str, sampler: str, steps: int, seconds: float) -> dict[str, Any]:
        """What one configuration costs: parts, total and real-time factor."""
        step = self.step[space][sampler]
        rest = self.rest + (self.look + self.leave if space == "folded" else 0.0)
        total = self.audio_encoder + self.conditions + steps * step + rest
        return {
            "space": space,
            "sampler": sampler,
            "steps": steps,
            "audio_encoder": self.audio_encoder,
            "conditions": self.conditions,
            "per_step": step,
            "all_steps": steps * step,
            "rest": rest,
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

    def quickest(self, work: Callable[[], object]) -> float:
        """Seconds of the quickest of several calls, after one to warm up."""
        work()
        return min(self.clock(work) for _ in range(self.repeats))

    def conditions(self) -> Conditions:
        """Everything that is computed once a clip."""
        batch = self.batch
        style = self.system.encode_style(batch.reference, batch.reference_mask)
        return self.system.network.conditions(
            batch.audio, batch.audio_lengths, batch.frame_lengths, batch.identity, style
        )

    def once_a_clip(self) -> tuple[float, float]:
        """Seconds of the audio encoder, and of all other conditions."""
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
        return min(audio[1:]), min(others[1:])

    def space(self, name: SamplingSpace, sampler: Sampler) -> Space:
        """A sampling space, with the system's own cache."""
        return choose_space(self.system.network, name, sampler, self.system._fold_cache)

    def stepper(self, name: SamplingSpace, sampler: Sampler, conditions: Conditions) -> Callable[[], None]:
        """A call that takes one step of the real loop: prediction, noise, update."""
        space, unit = self.space(name, sampler), ClipNoise(self.batch, 0)
        shape = (*self.batch.motion.shape[:2], space.width)
        state = space.noise(unit(torch.empty(shape, device=self.system.device)))
        scheduler = sampler.make_scheduler()
        places = iter(scheduler.timesteps.tolist())

        def step() -> None:
            nonlocal state
            place = next(places)
            prediction = space.predict(state, torch.full((1,), place, device=state.device), conditions)
            state = sampler.advance(scheduler, prediction, place, state, lambda like: space.noise(unit(like)))

        return step

    def in_turn(
        self,
        steppers: Mapping[str, Callable[[], None]],
        repeats: int,
    ) -> dict[str, float]:
        """Seconds of the quickest step of each, taken in turn after two that warm up."""
        spent: dict[str, list[float]] = {name: [] for name in steppers}
        for _ in range(repeats + 2):
            for name, step in steppers.items():
                spent[name].append(self.clock(step))
        return {name: min(times[2:]) for name, times in spent.items()}

    def measure(self, samplers: dict[str, Sampler]) -> Costs:
        """Time every part."""
        network, batch = self.system.network, self.batch
        audio_encoder, others = self.once_a_clip()
        conditions = self.conditions()
        first = next(iter(samplers.values()))
        step = torch.full((len(batch),), self.system.process.steps // 2, device=self.system.device)
        entered = torch.randn(*batch.motion.shape[:2], network.embed.out_features, device=self.system.device)
        decoded = network.core(entered, step, conditions)
        vertices = network.leave(decoded)
        maps = network.embed.weight.detach(), network.unembed.weight.detach(), network.unembed.bias.detach()
        costs = Costs(
            audio_encoder=audio_encoder,
            conditions=others,
            fold=self.clock(lambda: fold(*maps)),
            look=self.quickest(lambda: self.space("folded", first)),
            core=self.quickest(lambda: network.core(entered, step, conditions)),
            leave=self.quickest(lambda: network.leave(decoded)),
            rest=self.quickest(lambda: vertices / self.system.scale),
        )
        costs.step = {space: {} for space in SPACES}
        for name, sampler in samplers.items():
            found = self.in_turn({s: self.stepper(s, sampler, conditions) for s in SPACES}, self.repeats)
            for space, seconds in found.items():
                costs.step[space][name] = seconds
        return costs


def build(args: argparse.Namespace, vertices: int, *, tiny_encoder: bool) -> Bench:
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
    config = HubertConfig(**(tiny if tiny_encoder else {})).to_dict()
    system = DualPathDiffusion(
        n_vertices=vertices,
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
            templates={name: torch.zeros(vertices, 3) for name in IDENTITIES},
            faces=None,
            regions={name: torch.arange(3) for name in ("lips", "upper_face")},
            motion_scale=100.0,
        )
    )
    frames = max(1, round(args.seconds * FRAME_RATE))
    sample = Sample(
        audio=torch.randn(samples_for(frames, FRAME_RATE)),
        motion=torch.zeros(frames, vertices, 3),
        template=torch.zeros(vertices, 3),
        identity=0,
        reference=1e-2 * torch.randn(REFERENCE_FRAMES, vertices, 3),
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
            f"the quickest of {args.repeats} after a warm-up",
        ]
    )


def tables(costs: Costs, rows: list[dict[str, Any]]) -> str:
    """Both tables: a step, and the configurations."""
    lines = ["", "one step with its noise and update, in milliseconds, and in vertices / folded"]
    lines.append(f"{'sampler':<12}{'folded':>10}{'vertices':>10}{'ratio':>8}")
    for name, folded in costs.step["folded"].items():
        plain = costs.step["vertices"][name]
        lines.append(f"{name:<12}{1e3 * folded:>10.3f}{1e3 * plain:>10.3f}{plain / folded:>8.2f}")
    lines += [
        f"of which fusion and decoder {1e3 * costs.core:.3f}; the map to vertices {1e3 * costs.leave:.3f}, once a clip "
        f"where folded",
        f"folding the ends: {costs.fold:.3f} s, once a model; looking whether the weights changed: "
        f"{1e3 * costs.look:.3f} ms, once a clip",
        "",
        "a clip, in seconds; all steps = steps x one step (EXTRAPOLATED from a few timed steps)",
        f"{'space':<10}{'sampler':<12}{'steps':>6}{'audio encoder':>15}{'conditions':>12}{'all steps':>12}{'rest':>10}"
        f"{'total':>12}{'real-time factor':>18}",
    ]
    lines += [
        f"{row['space']:<10}{row['sampler']:<12}{row['steps']:>6}{row['audio_encoder']:>15.4f}{row['conditions']:>12.4f}"
        f"{row['all_steps']:>12.4f}{row['rest']:>10.4f}{row['total']:>12.4f}{row['real_time_factor']:>18.4f}"
        for row in rows
    ]
    return "\n".join(lines)


def ratios(costs: Costs, rows: list[dict[str, Any]]) -> tuple[str, dict[str, float]]:
    """What one run says about the relations, which carry over to other machines better than seconds do."""
    by = {(row["space"], row["sampler"], row["steps"]): row for row in rows}
    peer_step = costs.audio_encoder + costs.step["vertices"]["ddpm"]
    peer = costs.conditions + PEER_STEPS * peer_step
    usual, few = by["folded", "ddim", 25], by["folded", "dpm_solver", 10]
    found = {
        "step": costs.step["vertices"]["ddpm"] / costs.step["folded"]["ddpm"],
        "peer_seconds": peer,
        "peer_to_ddim_25": peer / usual["total"],
        "peer_to_dpm_solver_10": peer / few["total"],
        "peer_to_folded_ddpm_500": peer
        / (costs.audio_encoder + costs.conditions + PEER_STEPS * costs.step["folded"]["ddpm"] + usual["rest"]),
    }
    lines = [
        "",
        "ratios, from this run alone",
        f"  (a) a step of ddpm on vertices takes {found['step']:.1f} times as long as folded",
        f"  (c) encoding the speech and projecting in each of {PEER_STEPS} steps takes {peer:.1f} s (EXTRAPOLATED):",
        f"      {found['peer_to_ddim_25']:.0f} times as long as folded ddim 25, "
        f"{found['peer_to_dpm_solver_10']:.0f} times as long as folded dpm_solver 10,",
        f"      {found['peer_to_folded_ddpm_500']:.1f} times as long as folded ddpm with as many steps",
    ]
    return "\n".join(lines), found


def sizes(args: argparse.Namespace, bench: Bench) -> dict[str, float]:
    """Seconds of a folded step at two sizes of mesh, the quickest of many that take turns."""
    steppers = {}
    for vertices in (FLAME, args.vertices):
        one = bench if vertices == args.vertices else build(args, vertices, tiny_encoder=True)
        sampler = registry.sampler.get("ddpm")(process=one.system.process)
        steppers[str(vertices)] = one.stepper("folded", sampler, one.conditions())
    found = bench.in_turn(steppers, 3 * bench.repeats)
    small, large = found[str(FLAME)], found[str(args.vertices)]
    print(
        f"  (d) the quickest folded step takes {1e3 * small:.3f} ms at {FLAME} vertices, {1e3 * large:.3f} ms at "
        f"{args.vertices}: ratio {large / small:.3f}"
    )
    return found


def options() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--vertices", type=int, default=23370, help="vertices of the face (default: BIWI's 23370)")
    parser.add_argument("--seconds", type=float, default=10.0, help="length of the speech (default: 10)")
    parser.add_argument("--dim", type=int, default=512, help="model width (default: 512)")
    parser.add_argument("--layers", type=int, default=6, help="decoder blocks (default: 6)")
    parser.add_argument("--heads", type=int, default=8, help="attention heads (default: 8)")
    parser.add_argument("--repeats", type=int, default=10, help="timed repetitions of every part (default: 10)")
    parser.add_argument("--device", default="cpu", help="cpu (default), cuda …")
    parser.add_argument("--threads", type=int, help="threads of PyTorch (default: its own choice)")
    parser.add_argument("--tiny-encoder", action="store_true", help="a tiny HuBERT instead of HuBERT base, for trials")
    parser.add_argument("--quick", action="store_true", help="one repetition of every part and no full run")
    parser.add_argument("--full", type=int, default=25, help="steps of the ddim run in full (default: 25; 0: none)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the numbers there too, unrounded")
    args = parser.parse_args()
    if args.quick:
        args.repeats, args.full = 1, 0
    return args


def in_full(args: argparse.Namespace, bench: Bench, seconds: float) -> dict[str, float]:
    """The default sampler from start to end, the first time with folding, and memory before anything else ran."""
    bench.system.choose_sampler("ddim", args.full)
    first = bench.clock(lambda: bench.system.generate(bench.batch))
    again = min(bench.clock(lambda: bench.system.generate(bench.batch)) for _ in range(bench.repeats))
    print(
        f"\n(b) ddim {args.full}, folded, in full: {again:.4f} s, real-time factor {again / seconds:.4f}; "
        f"the first time, with folding and warming up, {first:.4f} s\n"
        f"(e) peak memory of that: {peak_memory(args.device)}",
        flush=True,
    )
    return {"steps": args.full, "measured": again, "first": first, "real_time_factor": again / seconds}


@torch.inference_mode()
def main() -> None:
    """Measure and print."""
    args = options()
    if args.threads:
        torch.set_num_threads(args.threads)
    bench = build(args, args.vertices, tiny_encoder=args.tiny_encoder)
    print(heading(args, bench), flush=True)
    seconds = bench.batch.audio.shape[1] / SAMPLE_RATE
    process = bench.system.process
    # First, since the highest memory so far is all that a process can tell.
    full = in_full(args, bench, seconds) if args.full else None
    costs = bench.measure({name: registry.sampler.get(name)(process=process, steps=1000) for name in SAMPLERS})
    rows = [costs.row(space, name, steps, seconds) for space in SPACES for name, steps in CONFIGURATIONS]
    print(tables(costs, rows))
    text, relations = ratios(costs, rows)
    print(text, flush=True)
    relations |= {"vertices_" + name: value for name, value in sizes(args, bench).items()}
    found = {"seconds": seconds, "costs": asdict(costs), "rows": rows, "ratios": relations, "full": full}
    if full is not None:
        expected = costs.row("folded", "ddim", args.full, seconds)["total"]
        print(f"  ddim {args.full} in full: measured / extrapolated {full['measured'] / expected:.3f}")
    print(f"peak memory with sampling on vertices: {peak_memory(args.device)}")
    if args.json:
        args.json.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
