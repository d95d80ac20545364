"""Weights of blendshapes while a face moves: milliseconds a frame, and how far they are from those of the whole motion.

    python tools/benchmarks/live_solve.py

solves for ARKit's 52 shapes on a face of 5 023 vertices: those of the built-in face, carried over by the nearest of its
vertices, and 20 s of their motion at 30 frames a second, with 0.1 mm of noise that no weights explain. The table has
one row for each way to solve: milliseconds that a frame costs, also as a multiple of those in the solve of the whole
motion; what the weights leave of the motion, as a root mean square over vertices and frames; and how far the weights
are from those of the whole motion. Times are of the processor, which other programs do not lengthen.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence

import numpy as np
from sampling_tables import processor

from facediff.animation import Animation
from facediff.editing.blendshapes import SolveOptions, solve
from facediff.editing.live_weights import FrameSolver
from facediff.editing.shapes import ShapeSet
from facediff.reporting.documents import markdown_table
from facediff.spaces.arkit import ARKIT
from facediff.synthetic.arkit import puppet_shapes

VERTICES, FRAME_RATE = 5_023, 30.0
NOISE_MM = 0.1


def main(arguments: Sequence[str] | None = None) -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0, help="of motion (default: 20)")
    args = parser.parse_args(arguments)
    shapes = dense_shapes()
    motion = some_motion(shapes, round(args.seconds * FRAME_RATE))
    print(f"{processor('cpu')}, one thread; {len(shapes.names)} shapes of {len(shapes.neutral)} vertices\n")
    rows = []
    for name, options in (("usual options", SolveOptions()), ("sparsity 0", SolveOptions(sparsity=0.0))):
        began = time.process_time()
        found = solve(motion, shapes, options)
        whole = found.values
        offline = 1000 * (time.process_time() - began) / len(motion.vertices)
        rows.append([f"whole motion, {name}", f"{offline:.2f}", "1", "", "", left(found.residual_rms_mm), "", ""])
        live, taken, rms = frame_by_frame(motion, shapes, options)
        median, late, worst = np.quantile(taken, [0.5, 0.95, 1.0])
        apart = np.abs(live - whole)
        times = [f"{median:.2f}", f"{median / offline:.2f}", f"{late:.2f}", f"{worst:.2f}"]
        rows.append([f"frame by frame, {name}", *times, left(rms), f"{apart.mean():.4f}", f"{apart.max():.3f}"])
    times = ["ms a frame (median)", "ratio", "95 %", "worst"]
    head = ["solve", *times, "left (mm)", "mean difference of weights", "largest"]
    print(markdown_table(head, rows))


def dense_shapes() -> ShapeSet:
    """The built-in shapes on a mesh of as many vertices as FLAME's, in ARKit's order."""
    rest, faces, shapes = puppet_shapes(None)
    random = np.random.default_rng(0)
    corners = faces[random.integers(0, len(faces), VERTICES)]
    shares = random.dirichlet([1.0, 1.0, 1.0], VERTICES)

    def dense(points: np.ndarray) -> np.ndarray:
        return np.einsum("vk,vkc->vc", shares, points[corners])

    return ShapeSet(ARKIT, dense(rest), np.stack([dense(shapes[name] - rest) for name in ARKIT]))


def some_weights(frames: int) -> np.ndarray:
    """Weights (T, 52): each shape comes and goes a few times; a third of them works at a time."""
    random = np.random.default_rng(1)
    at = np.arange(frames)[:, None] / FRAME_RATE
    waves = np.sin(2 * np.pi * (at * random.uniform(0.3, 2.0, len(ARKIT)) + random.uniform(size=len(ARKIT))))
    return np.clip(1.5 * waves - 0.7, 0.0, 1.0)


def some_motion(shapes: ShapeSet, frames: int, noise_mm: float = NOISE_MM) -> Animation:
    """The motion of :func:`some_weights` with noise."""
    offsets = np.einsum("tk,kvc->tvc", some_weights(frames), shapes.deltas)
    offsets += 0.001 * noise_mm * np.random.default_rng(2).normal(size=offsets.shape)
    rest = shapes.neutral.astype(np.float32)
    return Animation("motion", rest + offsets.astype(np.float32), rest, FRAME_RATE)


def frame_by_frame(
    motion: Animation, shapes: ShapeSet, options: SolveOptions
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weights (T, K), milliseconds for each frame (T,), and millimetres that its weights leave (T,)."""
    solver = FrameSolver(shapes, FRAME_RATE, options=options)
    weights, taken, rms = [], [], []
    for offsets in motion.vertices - motion.template:
        began = time.process_time()
        weights.append(solver.solve(offsets))
        taken.append(1000 * (time.process_time() - began))
        rms.append(solver.residual_mm(offsets, weights[-1]))
    return np.array(weights), np.array(taken), np.array(rms)


def left(rms: np.ndarray) -> str:
    """The root mean square of all frames."""
    return f"{np.sqrt(np.square(rms).mean()):.4f}"


if __name__ == "__main__":
    main()
