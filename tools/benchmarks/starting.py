"""How long a training run takes until its first step where every file that is opened costs time.

Run ``python tools/benchmarks/starting.py``: makes 1 600 clips of the tests' miniature corpus and starts training on
them three times, each in a process of its own. Every opened file below the corpus folder costs 2 ms more, as on network
storage; how many were opened is printed next to the seconds.

- ``first start``: nothing has been measured yet.
- ``second start``: scale and components of the motion are kept from the first one.
- ``packed``: the same corpus packed by ``facediff data pack``, first start.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import Any

SECONDS = 20.0
"""Until the first step, at most."""


def write_corpus(root: Path, clips: int) -> None:
    """A corpus of the tests' topology: two speakers, ``clips`` recordings of two seconds."""
    import numpy as np
    import soundfile

    from tests.fakes.tiny import write_tiny

    write_tiny(root, sentences=7)
    rng = np.random.default_rng(0)
    (root / "clips.csv").unlink()
    for number in range(clips):
        name = f"{'AB'[number % 2]}_s{number:05d}{1 + number % 4:02d}"  # all in the training split
        template = np.load(root / "vertices_npy" / f"{name[0]}_e01.npy")[0]
        motion = template + 0.01 * np.sin(np.arange(50)[:, None] / 5 + rng.uniform(0, 6, template.shape))
        np.save(root / "vertices_npy" / f"{name}.npy", motion.astype(np.float32))
        soundfile.write(root / "wav" / f"{name}.wav", rng.uniform(-0.1, 0.1, 32_000), 16_000)


def start(root: Path, cost: float) -> dict[str, float]:
    """Seconds from the data module to the end of the first training step, and how many files were opened."""
    opened = [0]

    def slow(event: str, arguments: tuple[Any, ...]) -> None:
        if (
            event == "open"
            and isinstance(arguments[0], str | bytes)
            and os.fsdecode(arguments[0]).startswith(str(root))
        ):
            opened[0] += 1
            time.sleep(cost)

    import lightning.pytorch as pl

    from facediff import registry
    from facediff.models import DualPathDiffusion
    from tests.fakes.tiny import SEEN, VERTICES, Tiny

    sys.addaudithook(slow)
    began = time.perf_counter()
    data = Tiny(root=str(root), batch_size=8, window=25)
    model = DualPathDiffusion(
        n_vertices=VERTICES,
        identities=SEEN,
        frame_rate=25.0,
        dim=16,
        diffusion_steps=20,
        audio_encoder=partial(registry.audio_encoder.mel, hidden_dim=16, num_layers=1),
        style_encoder=partial(registry.style_encoder.tcn_gru_transformer, num_layers=1),
        decoder=partial(registry.decoder.style_transformer, num_layers=1),
        mesh_encoder=partial(registry.mesh_encoder.components, count=4),
    )
    trainer = pl.Trainer(
        max_steps=1,
        accelerator="cpu",
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
        limit_val_batches=0,
    )
    trainer.fit(model, datamodule=data)
    assert trainer.global_step == 1
    return {"seconds": time.perf_counter() - began, "opened": opened[0]}


def main() -> int:
    """Print the table; 1 if a start took too long."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--clips", type=int, default=1600)
    parser.add_argument("--milliseconds", type=float, default=2.0, help="that every opened file costs")
    parser.add_argument("--start", type=Path, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.start is not None:
        print(json.dumps(start(asked.start, asked.milliseconds / 1000)))
        return 0
    worst = 0.0
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "corpus"
        write_corpus(root, asked.clips)
        packed = Path(folder) / "corpus.zarr"
        pack = ["data", "pack", str(root), str(packed), "--corpus", "tests.fakes.tiny.Tiny", "--quiet"]
        subprocess.run([sys.executable, "-m", "facediff", *pack], check=True, stdout=subprocess.DEVNULL)
        print(f"{asked.clips} clips, {asked.milliseconds:g} ms for each opened file")
        for name, place in (("first start", root), ("second start", root), ("packed", packed)):
            words = [sys.executable, __file__, "--milliseconds", str(asked.milliseconds), "--start", str(place)]
            environment = {**os.environ, "FACEDIFF_CACHE": str(Path(folder) / "cache")}
            run = subprocess.run(words, check=True, capture_output=True, text=True, env=environment)
            found = json.loads(run.stdout.splitlines()[-1])
            worst = max(worst, found["seconds"])
            print(f"{name:>12}: {found['seconds']:5.1f} s, {found['opened']:.0f} files opened", flush=True)
    print(f"longest: {worst:.1f} s of {SECONDS:g} s allowed")
    return 0 if worst <= SECONDS else 1


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
    sys.exit(main())
