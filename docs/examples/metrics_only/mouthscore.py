"""Scores a folder of predicted motion against a folder of true motion: NAME.npy, (frames, 3 * vertices), absolute.

Usage: mouthscore PREDICTIONS TRUTHS TEMPLATE.npy LIPS.txt UPPER.txt
"""

import sys
from pathlib import Path

import numpy as np
import torch

from facediff.metrics import LipSpeedCorrelation, Region, protocol


def read(path: Path) -> torch.Tensor:
    """Vertices of a file, (frames, vertices, 3)."""
    vertices = np.load(path)
    return torch.from_numpy(vertices).reshape(len(vertices), -1, 3)


def main() -> None:
    """Print the scores and what they are."""
    predictions, truths, template, lips_file, upper_file = map(Path, sys.argv[1:])
    still = torch.from_numpy(np.load(template)).reshape(-1, 3)
    lips, upper = Region.from_file(lips_file), Region.from_file(upper_file)
    errors = protocol("codetalker").build(lips, upper)
    correlation = LipSpeedCorrelation(lips, length_rule="prediction")
    for path in sorted(truths.glob("*.npy")):
        prediction, truth = read(predictions / path.name), read(path)
        errors.update(prediction, truth, template=still, clip_names=[path.stem])
        correlation.update(prediction, truth, clip_names=[path.stem])
    for name, score in {**errors.compute(), "lip_pcc": correlation.compute()}.items():
        print(f"{name:<8}{score.item():.6g}")
    print(errors.describe(), errors.summary(), correlation.describe(), sep="\n")


if __name__ == "__main__":
    main()
