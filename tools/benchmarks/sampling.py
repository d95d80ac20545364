"""How long sampling takes against the length of the speech, folded and on vertices, by sampler and steps.

Run ``python tools/benchmarks/sampling.py``: 10 s of noise as speech, 23 370 vertices as in BIWI, HuBERT base and the
dual-path network at width 512, all with random weights, so nothing is downloaded. The default sampler is run from
start to end. A step's cost does not depend on its number, so for the others a few steps are timed and multiplied.
A student, with the mel encoder that ``facediff adapt --low-latency --audio-encoder mel`` puts in HuBERT's place and a
few steps, is run too; how good it is, random weights cannot tell (docs/streaming.md, docs/generation.md).
The quickest of the repeats counts, since other programs make work slower but never quicker, and steps that are
compared take turns, so that whatever else the machine does meets them alike.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from sampling_parts import SPACES, Bench, Costs, build
from sampling_tables import heading, peak_memory, tables

from facediff import registry
from facediff.speech.audio import SAMPLE_RATE

PEER_STEPS = 500
STUDENT_STEPS = 3
SAMPLERS = ("ddpm", "ddim", "dpm_solver")
FLAME = 5023
CONFIGURATIONS = (("ddpm", 1000), ("ddim", 50), ("ddim", 25), ("ddim", 10), ("dpm_solver", 20), ("dpm_solver", 10))


def ratios(costs: Costs, rows: list[dict[str, Any]], usual: dict[str, Any]) -> tuple[str, dict[str, float]]:
    """What one run says about the relations, which carry over to other machines better than seconds do.

    Args:
        costs: of all parts.
        rows: all configurations.
        usual: the default sampler's row.
    """
    by = {(row["space"], row["sampler"], row["steps"]): row for row in rows}
    peer_step = costs.audio_encoder + costs.step["vertices"]["ddpm"]
    peer = costs.conditions + PEER_STEPS * peer_step
    middle, few = by["folded", "ddim", 25], by["folded", "dpm_solver", 10]
    found = {
        "step": costs.step["vertices"]["ddpm"] / costs.step["folded"]["ddpm"],
        "peer_seconds": peer,
        "peer_to_default": peer / usual["total"],
        "peer_to_ddim_25": peer / middle["total"],
        "peer_to_dpm_solver_10": peer / few["total"],
        "peer_to_folded_ddpm_500": peer
        / (costs.audio_encoder + costs.conditions + PEER_STEPS * costs.step["folded"]["ddpm"] + usual["rest"]),
    }
    lines = [
        "",
        "ratios, from this run alone",
        f"  (a) a step of ddpm on vertices takes {found['step']:.1f} times as long as folded",
        f"  (c) encoding the speech and projecting in each of {PEER_STEPS} steps takes {peer:.1f} s (EXTRAPOLATED):",
        f"      {found['peer_to_default']:.0f} times as long as the default sampler, folded {usual['sampler']} "
        f"{usual['steps']}; {found['peer_to_ddim_25']:.0f} times as long as folded ddim 25,",
        f"      {found['peer_to_dpm_solver_10']:.0f} times as long as folded dpm_solver 10,",
        f"      {found['peer_to_folded_ddpm_500']:.1f} times as long as folded ddpm with as many steps",
    ]
    return "\n".join(lines), found


def sizes(args: argparse.Namespace, bench: Bench) -> dict[str, float]:
    """Seconds of a folded step at two sizes of mesh, the quickest of many that take turns."""
    steppers = {}
    for vertices in (FLAME, args.vertices):
        one = bench if vertices == args.vertices else build(args, vertices, tiny_encoder=True)
        sampler = registry.sampler.get("ddpm")(process=one.model.process)
        steppers[str(vertices)] = one.stepper("folded", sampler, one.conditions())
    found = bench.in_turn(steppers, 3 * bench.repeats)
    small, large = found[str(FLAME)], found[str(args.vertices)]
    print(
        f"  (d) the quickest folded step takes {1e3 * small:.3f} ms at {FLAME} vertices, {1e3 * large:.3f} ms at "
        f"{args.vertices}: ratio {large / small:.3f}"
    )
    return found


def student(args: argparse.Namespace, seconds: float, peer: float) -> dict[str, Any]:
    """The student from start to end, and how many times as long a peer takes that encodes the speech in each step."""
    bench = build(args, args.vertices, tiny_encoder=args.tiny_encoder, student=True)
    bench.model.choose_sampler(steps=STUDENT_STEPS)
    took = bench.quickest(lambda: bench.model.generate(bench.batch))
    print(
        f"  (f) the mel encoder in place of HuBERT and {STUDENT_STEPS} steps, in full: {took:.4f} s, real-time factor "
        f"{took / seconds:.4f}; the {PEER_STEPS} steps of (c) take {peer / took:.0f} times as long",
        flush=True,
    )
    return {"steps": STUDENT_STEPS, "measured": took, "real_time_factor": took / seconds, "peer": peer / took}


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
    parser.add_argument("--quick", action="store_true", help="one repetition of every part and no full run")
    parser.add_argument("--full", type=int, help="steps of the run in full (default: the sampler's own; 0: none)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the numbers there too, unrounded")
    args = parser.parse_args()
    if args.quick:
        args.repeats, args.full = 1, 0
    return args


def in_full(args: argparse.Namespace, bench: Bench, seconds: float) -> dict[str, Any]:
    """The default sampler from start to end, the first time with folding, and memory before anything else ran."""
    bench.model.choose_sampler(steps=args.full)
    name, steps = bench.usual()
    first = bench.clock(lambda: bench.model.generate(bench.batch))
    again = min(bench.clock(lambda: bench.model.generate(bench.batch)) for _ in range(bench.repeats))
    print(
        f"\n(b) {name} {steps}, folded, in full: {again:.4f} s, real-time factor {again / seconds:.4f}; "
        f"the first time, with folding and warming up, {first:.4f} s\n"
        f"(e) peak memory of that: {peak_memory(args.device)}",
        flush=True,
    )
    return {"sampler": name, "steps": steps, "measured": again, "first": first, "real_time_factor": again / seconds}


@torch.inference_mode()
def main(args: argparse.Namespace) -> None:
    """Measure and print."""
    if args.threads:
        torch.set_num_threads(args.threads)
    bench = build(args, args.vertices, tiny_encoder=args.tiny_encoder)
    print(heading(args, bench), flush=True)
    seconds = bench.batch.audio.shape[1] / SAMPLE_RATE
    process = bench.model.process
    # First, since the highest memory so far is all that a process can tell.
    full = in_full(args, bench, seconds) if args.full != 0 else None
    costs = bench.measure({name: registry.sampler.get(name)(process=process, steps=1000) for name in SAMPLERS})
    rows = [costs.row(space, name, steps, seconds) for space in SPACES for name, steps in CONFIGURATIONS]
    print(tables(costs, rows))
    usual = costs.row("folded", *bench.usual(), seconds)
    text, relations = ratios(costs, rows, usual)
    print(text, flush=True)
    relations |= {"vertices_" + name: value for name, value in sizes(args, bench).items()}
    found = {"seconds": seconds, "costs": asdict(costs), "rows": rows, "ratios": relations, "full": full}
    if full is not None:
        found["student"] = student(args, seconds, relations["peer_seconds"])
        print(f"  the default sampler in full: measured / extrapolated {full['measured'] / usual['total']:.3f}")
    print(f"peak memory with sampling on vertices: {peak_memory(args.device)}")
    if args.json:
        args.json.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    args = options()
    with torch.autocast(args.device.partition(":")[0], torch.bfloat16, enabled=args.precision == "bf16"):
        main(args)
