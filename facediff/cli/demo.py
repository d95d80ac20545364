"""``facediff demo``: the whole way from nothing to a talking face."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from facediff.data import SpeechMotionDataModule
    from facediff.models import AnimationModel


CONFIG = "configs/experiment/puppet.yaml"
SHEET = 12
"""Frames on a contact sheet."""


def parser() -> argparse.ArgumentParser:
    """Options of the command."""
    made = argparse.ArgumentParser(
        "facediff demo",
        description="Make the built-in synthetic corpus, train the small dual-path model on it, score it on sentences "
        "that it never heard, and write videos of truth beside prediction. About ten minutes on two CPU cores.",
    )
    made.add_argument("-o", "--output", type=Path, default=Path("demo"), help="folder for all results (default: demo)")
    made.add_argument("--epochs", type=int, help="training epochs (default: the config's)")
    made.add_argument("--data-root", type=Path, help="where to keep the corpus (default: the user's cache folder)")
    return made


def run(name: str, arguments: Sequence[str]) -> int:
    """Run all steps, each with its time."""
    args = parser().parse_args(list(arguments))
    from facediff.cli.lightning import run_cli
    from facediff.export import ExportOptions, check_export
    from facediff.utils.files import atomic

    check_export(args.output / "truth_and_prediction.mp4", ExportOptions())
    started = time.monotonic()
    data = [f"--data.root={args.data_root}"] if args.data_root else []
    epochs = [f"--trainer.max_epochs={args.epochs}"] if args.epochs else []
    print(f"facediff demo: training on the built-in synthetic corpus ({CONFIG})", flush=True)
    logger = [f"--trainer.logger.save_dir={args.output}", "--trainer.logger.name=training"]
    fitted = run_cli("fit", ["--config", CONFIG, *logger, *data, *epochs])
    checkpoint = args.output / "puppet.ckpt"
    with atomic(checkpoint) as temporary:
        fitted.trainer.save_checkpoint(temporary)
    print(f"facediff demo: trained in {time.monotonic() - started:.0f} s; now the test", flush=True)
    where = ["--trainer.accelerator=cpu", "--trainer.logger=false", f"--trainer.default_root_dir={args.output}"]
    tested = run_cli("test", ["--ckpt_path", str(checkpoint), *where])
    videos = write_videos(args.output, tested.model, tested.datamodule)
    print(f"\nfacediff demo: done in {time.monotonic() - started:.0f} s. Look at:")
    for path in (*videos, args.output / "test_scores.csv", checkpoint):
        print(f"  {path}")
    print(f"Next: facediff animate speech.wav --checkpoint {checkpoint} --identity F1 -o speech.mp4")
    return 0


def write_videos(folder: Path, model: AnimationModel, data: SpeechMotionDataModule) -> list[Path]:
    """Truth beside prediction of the first test clip of a seen speaker and of an unseen one.

    A video with sound, and a sheet of frames.
    """
    import torch

    from facediff.animation import Animation
    from facediff.cli.options import facts_of
    from facediff.data import collate
    from facediff.export import ExportOptions, write_animations
    from facediff.export.video import drawn_frames
    from facediff.render import contact_sheet, save_image

    written = []
    for split in data.test_splits:
        sample = data.dataset(split)[0]
        batch = collate([sample])
        with torch.inference_mode():
            motion = model.eval().generate(batch)[0]
        facts = facts_of(model.assets, sample.identity_name)
        takes = [
            Animation(name=name, vertices=(moved + sample.template).numpy(), speech=sample.audio.numpy(), **facts)
            for name, moved in (("truth", sample.motion), ("facediff", motion))
        ]
        path = folder / f"truth_and_prediction_{split}.mp4"
        footer = f"{model.assets.corpus}: synthetic corpus"
        write_animations(path, takes, ExportOptions(footer=footer, quiet=False))
        picks = [round(i * (len(motion) - 1) / (SHEET + 1)) for i in range(1, SHEET + 1)]
        few = [replace(animation, vertices=animation.vertices[picks]) for animation in takes]
        frames = drawn_frames(few, ExportOptions(footer=footer, size=224))
        times = [f"{pick / model.frame_rate:.2f} s" for pick in picks]
        save_image(path.with_suffix(".png"), contact_sheet(list(frames), 4, labels=times))
        written += [path, path.with_suffix(".png")]
    return written
