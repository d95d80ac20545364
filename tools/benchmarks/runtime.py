"""Exported models without PyTorch: size, start, speed and accuracy by precision, in one table.

    python tools/benchmarks/runtime.py demo/puppet.ckpt

installs the base package in a fresh environment, exports the model in float32, float16 and int8, and animates a test
recording of the model's corpus there. The table has for each precision: megabytes of the folder; seconds from the start
of the process to the written file of that recording; seconds of computing for each second of speech; the largest
difference from PyTorch as a share of the motion's range; and the lip vertex error on the first test split as a multiple
of PyTorch's. A row of three denoising steps says what those cost and bring.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
import venv
from collections.abc import Sequence
from itertools import islice
from pathlib import Path

import numpy as np
import soundfile
from sampling_tables import processor

from facediff.models import AnimationModel, load_model
from facediff.models.checkpoint import corpus_class
from facediff.pipelines.export_model import Precision, export_model
from facediff.reporting.documents import markdown_table
from facediff.runtime import RuntimeModel
from facediff.speech.audio import SAMPLE_RATE

ROOT = Path(__file__).parents[2]
EXPORTS: tuple[tuple[Precision, int | None], ...] = (
    ("float32", None),
    ("float16", None),
    ("float16", 3),
    ("int8", None),
)
"""The precision of the weights, and the denoising steps where they are fewer than the model's own."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("--clips", type=int, default=12, help="test recordings (default: 12)")
    args = parser.parse_args(arguments)
    model = load_model(args.checkpoint)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        command, size = install(folder / "environment")
        print(f"{processor('cpu')}; facediff without extras in a fresh environment: {size:.0f} MB installed\n")
        print(table(model, folder, command, args.clips))


def install(environment: Path) -> tuple[Path, float]:
    """The installed command, and megabytes of all installed packages but pip."""
    venv.create(environment, with_pip=True)
    python = environment / "bin" / "python"
    words = ["install", "-q", "-c", str(ROOT / "tools" / "constraints.txt"), str(ROOT)]
    subprocess.run([str(python), "-m", "pip", *words], check=True)
    packages = next(environment.glob("lib/python3*/site-packages"))
    own = ("pip", "setuptools")
    sizes = (
        file.stat().st_size
        for file in packages.rglob("*")
        if file.is_file() and not file.relative_to(packages).parts[0].startswith(own)
    )
    return environment / "bin" / "facediff", sum(sizes) / 1e6


def table(model: AnimationModel, folder: Path, command: Path, clips: int) -> str:
    """The table as Markdown."""
    source = model.data_source
    if not Path(source["root"]).is_dir():
        raise SystemExit(f"the corpus of the checkpoint ({source}) is not on this machine")
    data = corpus_class("--checkpoint", source)(root=source["root"])
    samples = list(islice(data.dataset(data.test_splits[0]), clips))
    recording = samples[0].audio.numpy()
    soundfile.write(folder / "speech.wav", recording, SAMPLE_RATE)
    wanted = [model.animate(sample.audio, identity=sample.identity_name, seed=1).vertices.numpy() for sample in samples]
    truth = [(sample.motion + sample.template).numpy() for sample in samples]
    lips = model.assets.regions["lips"].numpy()
    base = lip_error(wanted, truth, lips)
    rows = []
    for precision, steps in EXPORTS:
        name = precision if steps is None else f"{precision}, {steps} steps"
        path = folder / name
        with model.choosing():
            if steps is not None:
                model.choose_sampler(steps=steps)
            sizes = export_model(model, path, precision=precision, speech=recording).sizes
        began = time.perf_counter()
        output = str(folder / f"{name}.npz")
        words = ["animate", str(folder / "speech.wav"), "--checkpoint", str(path), "-o", output]
        subprocess.run([str(command), *words], check=True, capture_output=True, env={})
        start = time.perf_counter() - began
        runtime = RuntimeModel.open(path)
        began = time.perf_counter()
        found = [
            runtime.animate(sample.audio.numpy(), identity=sample.identity_name, seed=1).vertices for sample in samples
        ]
        spent = time.perf_counter() - began
        heard = sum(len(sample.audio) for sample in samples) / SAMPLE_RATE
        apart = max(
            float(np.abs(one - other).max() / np.ptp(other - other.mean(0)))
            for one, other in zip(found, wanted, strict=True)
        )
        error = lip_error(found, truth, lips) / base
        rows.append(
            [
                name,
                f"{sum(sizes.values()) / 1e6:.1f}",
                f"{start:.2f}",
                f"{spent / heard:.3f}",
                f"{apart:.1e}",
                f"{error:.4f}",
            ]
        )
    head = ["weights", "MB", "start to file (s)", "s a second of speech", "difference / range", "LVE / PyTorch's"]
    return markdown_table(head, rows)


def lip_error(found: Sequence[np.ndarray], truth: Sequence[np.ndarray], lips: np.ndarray) -> float:
    """The mean over frames of the largest squared error of a lip vertex."""
    errors = [np.square(one[:, lips] - other[:, lips]).sum(-1).max(-1) for one, other in zip(found, truth, strict=True)]
    return float(np.concatenate(errors).mean())


if __name__ == "__main__":
    main(sys.argv[1:])
