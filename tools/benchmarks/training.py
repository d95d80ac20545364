"""How many clips a second are trained on, by facediff's way and by that of released scripts, change by change.

Run ``python tools/benchmarks/training.py``: a corpus of BIWI's size (23 370 vertices, 25 frames a second, clips of
about 120 frames, low-rank motion; half a gigabyte in a temporary folder), HuBERT base with random weights, the network
of ``configs/model/dual_path.yaml``. All ways train the same model, with gradients clipped, and read their batches by
facediff's loader; they take turns, so that whatever else the machine does meets them alike.

- ``peers``: how FaceFormer, CodeTalker and FaceDiffuser train: one clip a step, the audio encoder run in full in every
  step, float32, each loss a pass of its own, PyTorch's usual optimiser.
- each line below it changes one thing more; ``cached frozen features`` is facediff in float32, ``bf16-mixed`` as it
  trains on a GPU, and with ``--compile`` a last line has fusion and decoder compiled, once that is done.

Frozen layers are neither trained nor given gradients by any way. Memory is measured in processes of their own. Loss
curves are those of one training by batches, and of the same training clip by clip: the same clips, steps and noise, no
dropout, and gradients summed over a batch's clips before the optimiser's step.

``clips/s`` is by the clock; ``clips/CPU s`` by what all threads together were busy, which says more than the clock
where other programs run, above all with ``--threads 1``.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from sampling_tables import processor
from training_parts import COMPILED, FLOAT32, MIXED, PEERS, WAYS, Bench, Way, curve, in_turn, memory, write_corpus

TOLERANCE = {"float32": 1e-3, "bf16-mixed": 3e-2}


def heading(args: argparse.Namespace) -> str:
    """What is measured, and where."""
    packages = ", ".join(f"{name} {version(name)}" for name in ("torch", "transformers", "lightning"))
    encoder = "tiny HuBERT" if args.tiny_encoder else "HuBERT base"
    return "\n".join(
        [
            f"machine: {processor('cpu')}; {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} at the start; "
            f"{torch.get_num_threads()} threads; device cpu",
            f"software: Python {platform.python_version()}, {packages}",
            f"model: {args.vertices} vertices, width {args.dim}, {args.layers} blocks, {args.heads} heads, {encoder}, "
            f"random weights",
            f"corpus: {args.clips} clips of about {args.frames} frames; frame budget {args.max_frames}; "
            f"{args.rounds} rounds after a warm-up",
        ]
    )


def table(frozen: int, rows: dict[str, dict[str, float]]) -> str:
    """One line a way, with ratios to the first and to the line before."""
    lines = [
        f"\n{'the whole audio encoder' if frozen < 0 else f'the lower {frozen} layers of the audio encoder'} frozen",
        f"{'way':<28}{'clips/s':>9}{'frames/s':>10}{'clips/CPU s':>13}{'x peers':>9}{'x peers, CPU':>14}"
        f"{'x before, CPU':>15}",
    ]
    first = before = next(iter(rows.values()))
    for name, row in rows.items():
        ratio = [
            (row["clips"] / row[key]) / (other["clips"] / other[key])
            for other, key in ((first, "seconds"), (first, "busy"), (before, "busy"))
        ]
        lines.append(
            f"{name:<28}{row['clips'] / row['seconds']:>9.3f}{row['frames'] / row['seconds']:>10.1f}"
            f"{row['clips'] / row['busy']:>13.3f}{ratio[0]:>9.2f}{ratio[1]:>14.2f}{ratio[2]:>15.2f}"
        )
        before = row
    return "\n".join(lines)


def compared(args: argparse.Namespace, curves: dict[str, list[float]]) -> str:
    """The loss curves, and how far they are apart."""
    truth = curves["clip by clip"]
    lines = [f"\nloss curves: the same clips, steps and noise, batches of {args.max_frames // 2} frames"]
    for label, values in curves.items():
        line = f"{label:<14}" + "".join(f"{value:>10.5f}" for value in values)
        if label in TOLERANCE:
            off = max(abs(one - other) / other for one, other in zip(values, truth, strict=True))
            verdict = "within" if off <= TOLERANCE[label] else "BEYOND"
            line += f"   largest relative difference {off:.1e}, {verdict} {TOLERANCE[label]:g}"
        lines.append(line)
    return "\n".join(lines)


def kept(held: dict[str, dict[str, float]]) -> str:
    """Peak memory in words."""
    weights = held[PEERS.name]["weights"] / 2**30
    labels = {PEERS.name: "peers", FLOAT32.name: "facediff float32", MIXED.name: "facediff bf16-mixed"}
    parts = (f"{label} {held[name]['peak'] / 2**30:.2f} GiB" for name, label in labels.items())
    return (
        f"peak memory, mapped files left out (weights {weights:.2f} GiB, trained ones four times with gradients and "
        f"AdamW's averages): {', '.join(parts)}"
    )


def options() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--vertices", type=int, default=23370, help="vertices of the face (default: BIWI's 23370)")
    parser.add_argument("--clips", type=int, default=16, help="clips of the corpus (default: 16)")
    parser.add_argument("--frames", type=int, default=120, help="mean frames of a clip (default: 120)")
    parser.add_argument("--max-frames", type=int, default=800, help="frame budget (default: 800, as configs have it)")
    parser.add_argument("--dim", type=int, default=512, help="model width (default: 512)")
    parser.add_argument("--layers", type=int, default=6, help="decoder blocks (default: 6)")
    parser.add_argument("--heads", type=int, default=8, help="attention heads (default: 8)")
    parser.add_argument("--frozen", type=int, nargs="+", default=[2, -1], help="frozen layers, each in turn; -1: all")
    parser.add_argument("--rounds", type=int, default=4, help="turns of each way (default: 4)")
    parser.add_argument(
        "--single", type=int, default=3, help="clips a turn of ways that take single clips (default: 3)"
    )
    parser.add_argument("--curve-steps", type=int, default=8, help="steps of the loss curves (default: 8; 0: none)")
    parser.add_argument("--no-memory", action="store_true", help="leave memory out, which takes six processes")
    parser.add_argument("--compile", action="store_true", help="a further line with compiled parts; wants a compiler")
    parser.add_argument("--threads", type=int, help="threads of PyTorch (default: its own choice)")
    parser.add_argument("--tiny-encoder", action="store_true", help="a tiny HuBERT instead of HuBERT base, for trials")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the numbers there too, unrounded")
    parser.add_argument("--root", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--part", choices=("turns", "memory", "curves"), help=argparse.SUPPRESS)
    parser.add_argument("--way", type=int, help=argparse.SUPPRESS)
    return parser.parse_args()


def work(args: argparse.Namespace) -> Any:  # noqa: ANN401
    """One part of the measurement, in this process."""
    if args.part == "curves":
        ways = {"clip by clip": PEERS, "float32": FLOAT32, "bf16-mixed": MIXED}
        return {name: curve(args, way) for name, way in ways.items()}
    bench = Bench(args, args.frozen[0])
    if args.part == "memory":
        return memory(bench, WAYS[args.way])
    return in_turn(bench, [*WAYS, COMPILED] if args.compile else WAYS, args.rounds, args.single)


def in_process(args: argparse.Namespace, root: Path, part: str, frozen: int, way: Way = PEERS) -> Any:  # noqa: ANN401
    """The result of a part measured in a process of its own."""
    words = [*sys.argv[1:], "--root", str(root), "--part", part, "--frozen", str(frozen), "--way", str(WAYS.index(way))]
    done = subprocess.run([sys.executable, __file__, *words], stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    """Measure and print."""
    args = options()
    if args.threads:
        torch.set_num_threads(args.threads)
    if args.part:
        print(json.dumps(work(args)))
        return
    print(heading(args), flush=True)
    found: dict[str, Any] = {"turns": {}, "memory": {}, "curves": {}}
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "corpus"
        write_corpus(root, args.clips, args.frames, args.vertices)
        for frozen in args.frozen:
            found["turns"][frozen] = in_process(args, root, "turns", frozen)
            print(table(frozen, found["turns"][frozen]), flush=True)
            if not args.no_memory:
                held = {way.name: in_process(args, root, "memory", frozen, way) for way in (PEERS, FLOAT32, MIXED)}
                found["memory"][frozen] = held
                print(kept(held), flush=True)
            print(f"load now {os.getloadavg()[0]:.1f}", flush=True)
        if args.curve_steps:
            found["curves"] = in_process(args, root, "curves", args.frozen[0])
            print(compared(args, found["curves"]))
    if args.json:
        args.json.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
