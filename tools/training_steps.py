"""Prints how many optimiser steps the bundled experiments take, and what the average of the weights keeps.

    python tools/training_steps.py
    python tools/training_steps.py --root biwi=BIWI --root vocaset=VOCASET

Nothing is trained. The clips of a corpus whose folder is given have their own lengths; of the others, only the number
of clips and their mean length are published, and their lengths are spread evenly from half to one and a half of that.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from facediff.data import Biwi, Mead3D, SpeechMotionDataModule, Vocaset
from facediff.data.dataset import ClipBatches
from facediff.utils.files import config_dir

PUBLISHED: dict[str, tuple[type[SpeechMotionDataModule], int, float]] = {
    # Clips of the training split, and their mean length in frames: test A of BIWI has 3 879 frames in 24 clips, VOCASET
    # 29 minutes in 480, and a clip of MEAD about four seconds; its 32 speakers have 40 neutral and 7 x 3 x 30 others.
    "biwi": (Biwi, 192, 3879 / 24),
    "vocaset": (Vocaset, 320, 29 * 60 / 480 * 30),
    "mead3d": (Mead3D, 32 * (40 + 7 * 3 * 30), 4 * 25.0),
}

BY_SENTENCE = 32 * (32 + 7 * 3 * 24)
"""Training clips of 3DMEAD where sentences of the training speakers are kept for validation and test."""


def main(words: Sequence[str] | None = None) -> int:
    """Print the table."""
    made = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    made.add_argument("--root", action="append", default=[], metavar="CORPUS=FOLDER", help="read the clips' lengths")
    roots = dict(given.partition("=")[::2] for given in made.parse_args(words).root)
    head = ("experiment", "clips", "frames", "a batch", "batches", "epochs", "steps", "rate", "first kept", "constant")
    print(("{:14}" + "{:>13}" * (len(head) - 1)).format(*head))
    for corpus in PUBLISHED:
        for name in (f"{corpus}_paper", corpus):
            row = steps_of(name, lengths_of(name, roots.get(corpus)))
            print(f"{name:14}" + "".join(f"{value:>13}" for value in row.values()))
    return 0


def lengths_of(name: str, root: str | None) -> list[int]:
    """Frames of an experiment's training clips."""
    data, clips, mean = PUBLISHED[name.removesuffix("_paper")]
    config = composed(config_dir() / "experiment" / f"{name}.yaml")
    options = {key: value for key, value in config["data"]["init_args"].items() if key == "split"}
    if root is not None:
        return data(root=root, **options).dataset("train", training=True).frames()
    clips = BY_SENTENCE if options.get("split") in ("sentence", "both") else clips
    return [round(mean * (0.5 + (i + 0.5) / clips)) for i in range(clips)]


def steps_of(name: str, lengths: list[int]) -> dict[str, str]:
    """The row of an experiment."""
    config = composed(config_dir() / "experiment" / f"{name}.yaml")
    options, trainer = config["data"]["init_args"], config["trainer"]
    batches = len(
        ClipBatches(
            lengths,
            batch_size=options.get("batch_size", 1),
            max_frames=options.get("max_frames_per_batch"),
            training=True,
        )
    )
    epochs = trainer["max_epochs"]
    steps = batches * epochs
    averaging = [c for c in trainer["callbacks"] if c["class_path"].endswith("EmaWithWarmup")]
    kept = ["-", "-"]
    if averaging:
        decay = averaging[0]["init_args"]["decay"]
        shares = [share_of_the_first(steps, decay, warmup) for warmup in (10.0, 1.0)]
        kept = [f"{share:.0e}" if share else "0" for share in shares]
    return {
        "clips": str(len(lengths)),
        "frames": str(sum(lengths)),
        "clips a batch": f"{len(lengths) / batches:.1f}",
        "batches": str(batches),
        "epochs": str(epochs),
        "steps": str(steps),
        "rate": f"{config['model']['init_args']['learning_rate']:.0e}",
        "share of the first weights": kept[0],
        "the same with a constant decay": kept[1],
    }


def share_of_the_first(steps: int, decay: float, warmup: float) -> float:
    """The share that the weights after the first step have in the average after the last one."""
    share = 1.0
    for k in range(1, steps):
        share *= min(decay, (1 + k) / (warmup + k))
    return share if share >= sys.float_info.min else 0.0  # numbers below have lost their digits


def composed(path: Path) -> dict[str, Any]:
    """A bundled experiment with the files that it names read in."""
    config: dict[str, Any] = yaml.safe_load(path.read_text(encoding="utf-8"))
    for key, value in config.items():
        if isinstance(value, str) and value.endswith(".yaml"):
            config[key] = yaml.safe_load((path.parent / value).read_text(encoding="utf-8"))
    return config


if __name__ == "__main__":
    raise SystemExit(main())
