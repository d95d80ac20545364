"""What the sparsity of `facediff blendshapes` costs: weights that are known, and what is solved from their motion.

    python tools/benchmarks/sparsity.py

moves ARKit's 52 shapes on a face of 5 023 vertices by weights of which a third works at a time (as in live_solve.py),
without noise and with 0.1 mm of it, and solves for them with several sparsities. A row has, for both, the root mean
square error of the weights, the millimetres that they leave of the motion, and the share of weights above 0.001 among
those that are 0 in truth.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import numpy as np
from live_solve import FRAME_RATE, NOISE_MM, dense_shapes, left, some_motion, some_weights

from facediff.editing.blendshapes import SolveOptions, solve
from facediff.reporting.documents import markdown_table

SPARSITIES = (0.0, 0.001, 0.003, 0.01, 0.02, 0.05)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=4.0, help="of motion (default: 4)")
    args = parser.parse_args(arguments)
    frames = round(args.seconds * FRAME_RATE)
    shapes, truth = dense_shapes(), some_weights(frames)
    motions = [some_motion(shapes, frames, noise_mm) for noise_mm in (0.0, NOISE_MM)]
    moving = np.abs(shapes.deltas).max(axis=(1, 2)) > 0  # tongueOut moves no vertex
    rows = []
    for sparsity in SPARSITIES:
        row = [f"{sparsity:g}"]
        for motion in motions:
            found = solve(motion, shapes, SolveOptions(sparsity=sparsity))
            error = np.sqrt(np.square(found.values - truth)[:, moving].mean())
            idle = (found.values > 0.001)[:, moving][truth[:, moving] == 0].mean()
            row += [f"{error:.4f}", left(found.residual_rms_mm), f"{idle:.0%}"]
        rows.append(row)
    facts = ["error of weights", "left (mm)", "idle shapes in use"]
    print(markdown_table(["sparsity", *facts, *(f"{fact}, noise" for fact in facts)], rows))


if __name__ == "__main__":
    main()
