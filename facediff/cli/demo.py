"""``facediff demo``: make a corpus, train, test and render, without downloads."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from facediff.cli.options import OutputFolder
from facediff.cli.process import tell
from facediff.utils import ranges
from facediff.utils.option import Option

if TYPE_CHECKING:
    from facediff.animation import Animation
    from facediff.data import SpeechMotionDataModule
    from facediff.models import AnimationModel


CONFIG = "configs/experiment/puppet.yaml"
SHEET = 12
"""Frames on a contact sheet."""
FAST = ("--data.drawn_speakers=0", "--trainer.max_epochs=8", "--model.warmup_steps=20")
"""Options of ``--fast``: the shortest training after which the lips follow the speech."""


def demo(
    *,
    output: OutputFolder = Path("demo"),
    fast: Annotated[bool, Option(without="epochs")] = False,
    epochs: Annotated[ranges.Epochs | None, Option(metavar="N")] = None,
    data_root: Annotated[Path | None, Option(metavar="FOLDER", writes="folder")] = None,
) -> None:
    """Make a corpus, train a model on it, test it and render a talking face.

    Makes the built-in synthetic corpus, trains the small dual-path model on it, distils its audio encoder for
    other voices and rooms, scores it on sentences that were not in training, and writes videos of truth next to
    prediction. About ten minutes on two CPU cores. The same command continues a training that was stopped.

    Args:
        output: folder for all results
        fast: train for a minute or two, to see that everything works; the lips follow the speech only roughly
        epochs: training epochs (default: the config's)
        data_root: where the corpus is kept (default: the user's cache folder)
    """
    from facediff.callbacks.runs import LAST
    from facediff.cli.adapt import write_distilled
    from facediff.cli.lightning import run_cli
    from facediff.export import ExportOptions, check_export

    check_export(output / "truth_and_prediction.mp4", ExportOptions())
    from facediff.models.audio_distillation import DistillationOptions
    from facediff.models.checkpoint import read_checkpoint
    from facediff.utils.files import scratch_folder

    started = time.monotonic()

    def report(step: str) -> None:
        tell(f"facediff demo, {time.monotonic() - started:.0f} s: {step}")

    options = [f"--data.root={data_root}"] if data_root else []
    options += [f"--trainer.max_epochs={epochs}"] if epochs else []
    options += FAST if fast else []
    briefly = "; --fast is far too short for the quality that the manual shows" if fast else ""
    report(f"training on the built-in synthetic corpus ({CONFIG}{briefly})")
    logger = [f"--trainer.logger.save_dir={output}", "--trainer.logger.name=training"]
    checkpoint = output / "puppet.ckpt"
    stopped = not checkpoint.exists() and any((output / "training").glob(f"*/{LAST}"))
    fitted = run_cli("fit", ["--config", CONFIG, *logger, *options, *(("--ckpt_path", "last") if stopped else ())])
    # The name stands for the finished model: a demo that is killed while it adapts leaves no other under it.
    with scratch_folder(checkpoint) as hidden:
        trained = checkpoint if fast else hidden / checkpoint.name
        fitted.trainer.save_checkpoint(trained)
        if not fast:
            report("adapting the audio encoder to other voices and rooms")
            write_distilled(trained, read_checkpoint(trained), fitted.datamodule, checkpoint, DistillationOptions())
    report("scoring sentences that were not in training")
    where = ["--trainer.accelerator=cpu", "--trainer.logger=false", f"--trainer.default_root_dir={output}"]
    tested = run_cli("test", ["--ckpt_path", str(checkpoint), *where])
    report("rendering truth next to prediction")
    videos = write_videos(output, tested.model, tested.datamodule)
    tell("", f"facediff demo: done in {time.monotonic() - started:.0f} s. Results:")
    for path in (*videos, output / "test_scores.csv", checkpoint):
        tell(f"  {path}")
    tell(f"Next: facediff animate speech.wav --checkpoint {checkpoint} --identity F1 -o speech.mp4")


def write_videos(folder: Path, model: AnimationModel, data: SpeechMotionDataModule) -> list[Path]:
    """Videos with sound, and sheets of frames, of truth next to prediction: the first clip of each test split."""
    import torch

    from facediff.animation import Animation
    from facediff.data import collate
    from facediff.export import ExportOptions, write_animations
    from facediff.pipelines.trained import facts_of

    written = []
    for split in data.test_splits:
        sample = data.dataset(split)[0]
        batch = collate([sample])
        with torch.inference_mode():
            motion = model.eval().generate(batch)[0]
        facts = facts_of(model.assets, sample.identity_name)
        animations = [
            Animation(name=name, vertices=(moved + sample.template).numpy(), speech=sample.audio.numpy(), **facts)
            for name, moved in (("truth", sample.motion), ("facediff", motion))
        ]
        path = folder / f"truth_and_prediction_{split}.mp4"
        footer = f"{model.assets.corpus}: synthetic corpus"
        write_animations(path, animations, ExportOptions(footer=footer, size=512, quiet=False))
        write_sheet(path.with_suffix(".png"), animations, footer)
        written += [path, path.with_suffix(".png")]
    return written


def write_sheet(path: Path, animations: Sequence[Animation], footer: str = "") -> None:
    """A picture of animations of one length next to each other, at moments from beginning to end."""
    from facediff.export import ExportOptions
    from facediff.export.video import drawn_frames
    from facediff.render import contact_sheet, save_image

    last = len(animations[0].vertices) - 1
    picks = [round(i * last / (SHEET + 1)) for i in range(1, SHEET + 1)]
    few = [animation.part(picks) for animation in animations]
    frames = drawn_frames(few, ExportOptions(footer=footer, size=224))
    times = [f"{pick / animations[0].frame_rate:.2f} s" for pick in picks]
    save_image(path, contact_sheet(list(frames), 4, labels=times))
