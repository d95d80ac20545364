"""How long sampling takes against the length of the speech, folded and on vertices, by sampler and steps.

Run ``python tools/benchmarks/sampling.py``: 10 s of noise as speech, 23 370 vertices as in BIWI, HuBERT base and the
dual-path network at width 512, all with random weights, so nothing is downloaded. The default sampler is run from
start to end, as is a student with the mel encoder in HuBERT's place and a few steps. A step's cost does not depend on
its number, so for the other samplers a few steps are timed and multiplied. The quickest of the repeats counts, since
other programs make work slower but never quicker, and steps that are compared take turns.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from machine import machine, peak_memory

from facediff import registry
from facediff.data import Assets, Batch, Sample, collate
from facediff.models import DualPathDiffusion
from facediff.models.audio_encoders import HubertEncoder, MelEncoder
from facediff.models.decoders import StyleTransformer
from facediff.models.folding import SamplingSpace
from facediff.models.fusions import BidirectionalCrossAttention
from facediff.models.inference import ClipNoise
from facediff.models.samplers import Sampler
from facediff.models.speaker_encoders import TcnGruTransformer
from facediff.speech.audio import samples_for

if TYPE_CHECKING:
    from facediff.models.dual_path.conditioning import Conditions

FRAME_RATE = 25.0
IDENTITIES = ["F2", "F3", "F4", "M3", "M4", "M5"]
PEER_STEPS = 500
"""Steps of a peer that encodes the speech and projects to vertices in each of them."""
STUDENT_STEPS = 3
SPACES: tuple[SamplingSpace, ...] = ("folded", "vertices")
CONFIGURATIONS = (("ddpm", 1000), ("ddim", 50), ("ddim", 25), ("ddim", 10), ("dpm_solver", 20), ("dpm_solver", 10))
TINY_HUBERT: dict[str, Any] = {
    "num_hidden_layers": 3,
    "num_attention_heads": 2,
    "hidden_size": 32,
    "intermediate_size": 64,
    "conv_dim": (16,) * 7,
    "num_conv_pos_embeddings": 16,
    "num_conv_pos_embedding_groups": 2,
}


@dataclass(frozen=True)
class Bench:
    """A model in evaluation mode and one clip to sample for it.

    Attributes:
        model: the model.
        batch: the clip.
        repeats: timed repetitions of every part; one more before them warms up.
    """

    model: DualPathDiffusion
    batch: Batch
    repeats: int

    def clock(self, work: Callable[[], object]) -> float:
        """Seconds that a call takes, with everything that it started on the device."""
        started = self._now()
        work()
        return self._now() - started

    def quickest(self, work: Callable[[], object]) -> float:
        """Seconds of the quickest of several calls, after one to warm up."""
        work()
        return min(self.clock(work) for _ in range(self.repeats))

    def in_turn(self, calls: Mapping[str, Callable[[], object]], repeats: int) -> dict[str, float]:
        """Seconds of the quickest call of each, taken in turn after two that warm up."""
        seconds: dict[str, list[float]] = {name: [] for name in calls}
        for _ in range(repeats + 2):
            for name, call in calls.items():
                seconds[name].append(self.clock(call))
        return {name: min(times[2:]) for name, times in seconds.items()}

    def conditions(self) -> Conditions:
        """The conditions of the clip, which are computed once."""
        style = self.model.encode_style(self.batch.reference, self.batch.reference_mask)
        return self.model.network.conditions(self.batch, self.batch.identity, style)

    def stepper(self, space: SamplingSpace, sampler: Sampler, conditions: Conditions) -> Callable[[], None]:
        """A call that takes one step of the sampling loop: prediction, noise, update."""
        steps = self.model.process.steps
        denoiser = self.model.network.prepare_for_inference(conditions, steps, folded=space == "folded")
        noise = ClipNoise(self.batch.names, self.batch.frame_lengths.tolist(), [0], self.model.device)
        state = denoiser.noise(
            noise(torch.empty((*self.batch.motion.shape[:2], denoiser.width), device=self.model.device))
        )
        timesteps = iter(enumerate(sampler.timesteps))
        predictions: list[torch.Tensor] = []

        def step() -> None:
            nonlocal state, predictions
            i, timestep = next(timesteps)
            predictions = [*predictions, denoiser.denoise(state, timestep)][-sampler.memory :]
            state = sampler.update(i, state, predictions, lambda like: denoiser.noise(noise(like)))

        return step

    def _now(self) -> float:
        if self.model.device.type == "cuda":
            torch.cuda.synchronize(self.model.device)
        return time.perf_counter()


def build(args: argparse.Namespace, vertices: int, *, tiny_encoder: bool, student: bool = False) -> Bench:
    """The model with random weights, its assets, and one clip of noise as speech.

    Args:
        args: the sizes, as attributes.
        vertices: number of vertices of the face.
        tiny_encoder: a tiny HuBERT instead of HuBERT base.
        student: the mel encoder in HuBERT's place.
    """
    from transformers import HubertConfig

    torch.manual_seed(0)
    config = HubertConfig(**(TINY_HUBERT if tiny_encoder else {})).to_dict()
    model = DualPathDiffusion(
        n_vertices=vertices,
        identities=IDENTITIES,
        frame_rate=FRAME_RATE,
        dim=args.dim,
        audio_encoder=MelEncoder if student else partial(HubertEncoder, config=config),
        style_encoder=partial(TcnGruTransformer, num_heads=args.heads),
        fusion=partial(BidirectionalCrossAttention, num_heads=args.heads),
        decoder=partial(StyleTransformer, num_layers=args.layers, num_heads=args.heads),
    )
    model.adopt(
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
        reference=1e-2 * torch.randn(100, vertices, 3),
        name="speech",
        identity_name=IDENTITIES[0],
        sentence="",
        reference_name="reference",
    )
    return Bench(model.eval().to(args.device), collate([sample]).to(args.device), args.repeats)


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
    parser.add_argument("--precision", default="32", choices=["32", "bf16"], help="of the network (default: 32)")
    parser.add_argument("--threads", type=int, help="threads of PyTorch (default: its own choice)")
    parser.add_argument("--tiny-encoder", action="store_true", help="a tiny HuBERT instead of HuBERT base, for trials")
    parser.add_argument("--steps", type=int, help="steps of the run in full (default: the sampler's own)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the seconds there too, unrounded")
    return parser.parse_args()


@torch.inference_mode()
def main(args: argparse.Namespace) -> None:
    """Measure and print."""
    if args.threads:
        torch.set_num_threads(args.threads)
    bench = build(args, args.vertices, tiny_encoder=args.tiny_encoder)
    millions = sum(p.numel() for p in bench.model.network.parameters()) / 1e6
    print(machine(args.device))
    print(f"model: {args.vertices} vertices, width {args.dim}, {millions:.1f} million random weights, {args.precision}")
    print(f"speech: {args.seconds:g} s; the quickest of {args.repeats} after a warm-up\n", flush=True)

    # First, since the highest memory so far is all that a process can tell.
    bench.model.choose_sampler(steps=args.steps)
    sampler = f"{bench.model.hparams['sampler']['class_path'].rpartition('.')[2]} {bench.model.sampler.steps}"
    seconds = {"default": bench.quickest(lambda: bench.model.generate(bench.batch))}
    print(f"{sampler}, folded, in full: {seconds['default']:.4f} s; peak memory {peak_memory(args.device)}", flush=True)

    encoder = bench.model.network.audio_encoder
    speech = bench.batch.audio, bench.batch.audio_lengths, bench.batch.frame_lengths
    seconds["audio encoder"] = bench.quickest(lambda: encoder(*speech))
    seconds["conditions"] = bench.quickest(bench.conditions)
    conditions = bench.conditions()
    for name in ("ddpm", "ddim", "dpm_solver"):
        sampler_of = registry.sampler.get(name)
        calls = {
            f"{name} {space}": bench.stepper(space, sampler_of(process=bench.model.process, steps=1000), conditions)
            for space in SPACES
        }
        seconds |= bench.in_turn(calls, bench.repeats)
    print("\none step in milliseconds, folded and on vertices")
    for name in ("ddpm", "ddim", "dpm_solver"):
        folded, vertices = (1e3 * seconds[f"{name} {space}"] for space in SPACES)
        print(f"  {name:<12}{folded:>10.3f}{vertices:>10.3f}   ratio {vertices / folded:.2f}")
    print("\na clip in seconds, EXTRAPOLATED from one step, and as real-time factor, folded and on vertices")
    for name, steps in CONFIGURATIONS:
        folded, vertices = (seconds["conditions"] + steps * seconds[f"{name} {space}"] for space in SPACES)
        factors = f"{folded / args.seconds:>8.4f}{vertices / args.seconds:>10.4f}"
        print(f"  {name:<12}{steps:>5}{folded:>10.3f}{vertices:>10.3f}{factors}")

    peer = seconds["conditions"] + PEER_STEPS * (seconds["audio encoder"] + seconds["ddpm vertices"])
    print(f"\nencoding the speech and projecting in each of {PEER_STEPS} steps: {peer:.1f} s (EXTRAPOLATED), "
          f"{peer / seconds['default']:.0f} times the default sampler")  # fmt: skip
    student = build(args, args.vertices, tiny_encoder=args.tiny_encoder, student=True)
    student.model.choose_sampler(steps=STUDENT_STEPS)
    seconds["student"] = student.quickest(lambda: student.model.generate(student.batch))
    taken = seconds["student"]
    print(f"the mel encoder in place of HuBERT and {STUDENT_STEPS} steps, in full: {taken:.4f} s, real-time factor "
          f"{taken / args.seconds:.4f}; the peer takes {peer / taken:.0f} times as long")  # fmt: skip
    if args.json:
        args.json.write_text(json.dumps(seconds | {"peer": peer}, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    args = options()
    with torch.autocast(args.device.partition(":")[0], torch.bfloat16, enabled=args.precision == "bf16"):
        main(args)
