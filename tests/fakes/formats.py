"""Writes ``tests/formats/VERSION.tar.xz``: what this version writes of the miniature corpus, for versions to come.

python -m tests.fakes.formats 1.0
"""

from __future__ import annotations

import sys
import tarfile
import tempfile
from pathlib import Path

import lightning.pytorch as pl

from facediff.cli.app import main
from facediff.models import DualPathDiffusion
from tests.fakes.tiny import Tiny, tiny_model_options, write_tiny

ROOT = Path(__file__).parents[2]


def write(folder: Path) -> None:
    """A checkpoint after two epochs, its model folder, its exported folder and an animation of it."""
    checkpoint = folder / "tiny.ckpt"
    pl.seed_everything(0)
    with tempfile.TemporaryDirectory() as corpus:
        data = Tiny(root=str(write_tiny(Path(corpus) / "tiny")))
        model = DualPathDiffusion(**tiny_model_options() | {"dim": 8})
        trainer = pl.Trainer(accelerator="cpu", max_epochs=2, logger=False, enable_checkpointing=False)
        trainer.fit(model, data)
        trainer.save_checkpoint(checkpoint)
    animate = ["animate", str(ROOT / "docs/examples/question.wav"), "--checkpoint", str(checkpoint)]
    animate += ["--identity", "A", "--style", "A_e01", "--seed", "0", "-o", str(folder / "animation.npz")]
    for command in (
        ["publish", str(checkpoint), str(folder / "folder")],
        ["export-model", str(checkpoint), "-o", str(folder / "exported")],
        animate,
    ):
        if main(command):
            sys.exit(f"failed: {' '.join(command)}")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        write(Path(place))
        with tarfile.open(ROOT / "tests" / "formats" / f"{sys.argv[1]}.tar.xz", "w:xz", preset=9) as archive:
            for path in sorted(Path(place).iterdir()):
                archive.add(path, path.name)
