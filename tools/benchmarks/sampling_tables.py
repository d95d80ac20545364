"""What the sampling benchmark prints: machine, a step, the configurations; used by ``sampling.py``."""

from __future__ import annotations

import argparse
import os
import platform
import resource
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from sampling_parts import FRAME_RATE, Bench, Costs


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
    network = bench.model.network
    millions = sum(p.numel() for p in network.parameters()) / 1e6
    speech = sum(p.numel() for p in network.audio_encoder.parameters()) / 1e6
    encoder = "tiny HuBERT" if args.tiny_encoder else "HuBERT base"
    packages = ", ".join(f"{name} {version(name)}" for name in ("torch", "transformers"))
    return "\n".join(
        [
            f"machine: {processor(args.device)}; {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} at the start; "
            f"{torch.get_num_threads()} threads; device {args.device}",
            f"software: Python {platform.python_version()}, {packages}",
            f"model: {args.vertices} vertices, width {args.dim}, {args.layers} blocks, {args.heads} heads, {encoder}; "
            f"{millions:.1f} million weights, {speech:.1f} of them in the audio encoder; random, "
            f"{'bfloat16 between float32 ends' if args.precision == 'bf16' else 'float32'}",
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
        f"of which fusion and decoder {1e3 * costs.core:.3f}, or {1e3 * costs.core_unprepared:.3f} with what does not "
        f"depend on the step computed in every step;",
        f"the map to vertices {1e3 * costs.leave:.3f}, once a clip where folded",
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
