"""``facediff adapt``: a trained model gets to know one person more."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facediff.errors import FaceDiffError

if TYPE_CHECKING:
    from facediff.data import SpeechMotionDataModule


JOINT, FINETUNE = "joint", "finetune"


def parser() -> argparse.ArgumentParser:
    """Options of the command."""
    made = argparse.ArgumentParser(
        "facediff adapt",
        description="Train a checkpoint further on a minute of one person's motion, and write a checkpoint that knows "
        "the person by name. The corpus that the checkpoint was trained on must be on this machine.",
    )
    made.add_argument("--checkpoint", type=Path, required=True, metavar="C", help="trained model (.ckpt)")
    made.add_argument(
        "--person",
        required=True,
        metavar="DIR",
        help="folder that `facediff data import-person` wrote, or the name of a subject of the corpus who was not "
        "trained on and has clips that belong to no split",
    )
    made.add_argument("-o", "--output", type=Path, required=True, metavar="OUT", help="checkpoint to write (.ckpt)")
    made.add_argument(
        "--mode",
        choices=[FINETUNE, JOINT],
        default=FINETUNE,
        help="train on the person's clips only (finetune, default), or on theirs among all others' (joint)",
    )
    made.add_argument(
        "--train",
        choices=["all", "person"],
        default="all",
        help="train all weights (default), or those of identity and style and freeze the rest",
    )
    made.add_argument("--epochs", type=int, default=60, help="epochs over the training clips (default: 60)")
    made.add_argument("--learning-rate", type=float, default=5e-4, help="falls to 0 as a cosine (default: 5e-4)")
    made.add_argument("--data-root", type=Path, help="where the corpus is, if not where it was in training")
    made.add_argument("--seed", type=int, default=0, help="seed of all draws (default: 0)")
    made.add_argument("--accelerator", default="auto", help="Lightning's: auto (default), cpu, gpu …")
    made.add_argument("--quiet", action="store_true", help="no progress bar")
    return made


def run(name: str, arguments: Sequence[str]) -> int:
    """Adapt; every input is checked before training starts, and the checkpoint appears whole or not at all."""
    args = parser().parse_args(list(arguments))
    check_arguments(args)
    from lightning.pytorch import Trainer, seed_everything

    from facediff.models.adaptation import train_only, with_extra_identities
    from facediff.models.checkpoint import build_model, read_checkpoint
    from facediff.utils.files import atomic

    started = time.monotonic()
    checkpoint = read_checkpoint(args.checkpoint)
    person, data = adaptation_data(args, checkpoint)
    model = build_model(args.checkpoint, checkpoint)
    data.prepare_data()
    if person not in data.corpus.templates:
        known = ", ".join(sorted(data.corpus.templates))
        raise FaceDiffError(f"--person {args.person}: neither a person's folder nor a subject of the corpus ({known})")
    clips = data.clips("train")
    if not any(clip.identity == person for clip in clips):
        raise FaceDiffError(f"--person {args.person}: no clip of {person} lies outside the corpus's test split")
    seed_everything(args.seed, verbose=False)
    model = with_extra_identities(model, list(data.identities))
    model.learning_rate, model.lr_schedule, model.warmup_steps = args.learning_rate, "cosine", 0
    train_only(model.train(), args.train)
    trainer = Trainer(
        max_epochs=args.epochs,
        accelerator=args.accelerator,
        devices=1,
        gradient_clip_val=1.0,
        limit_val_batches=0,
        logger=False,
        enable_checkpointing=False,
        enable_model_summary=False,
        enable_progress_bar=not args.quiet,
    )
    trainer.fit(model, data)
    for parameter in model.parameters():
        parameter.requires_grad_(True)
    with atomic(args.output) as temporary:
        trainer.save_checkpoint(temporary)
    seconds = sum(data.corpus.frames(clip) for clip in clips if clip.identity == person) / data.frame_rate
    print(
        f"{args.output}: knows {person} from {seconds:.0f} s of motion, after {time.monotonic() - started:.0f} s; "
        f"next: facediff animate speech.wav --checkpoint {args.output} --identity {person} -o speech.mp4"
    )
    return 0


def check_arguments(args: argparse.Namespace) -> None:
    """Refuse what cannot work before anything is loaded."""
    from facediff.utils.files import check_writable

    if args.output.suffix != ".ckpt":
        raise FaceDiffError(f"--output {args.output}: expected a name that ends in .ckpt")
    check_writable(args.output)
    for flag, value in (("--epochs", args.epochs), ("--learning-rate", args.learning_rate)):
        if not value > 0:
            raise FaceDiffError(f"{flag} {value}: expected a number above 0")


def adaptation_data(args: argparse.Namespace, checkpoint: dict[str, Any]) -> tuple[str, SpeechMotionDataModule]:
    """The person's name, and the checkpoint's data module with the person put first.

    Raises:
        FaceDiffError: if the checkpoint or its data module is not known, or the person has no such folder.
    """
    from facediff.data.batch import DATA_SOURCE_KEY
    from facediff.data.datamodule import person_name
    from facediff.models.checkpoint import corpus_class, corpus_options

    module, options = corpus_class(args.checkpoint, checkpoint[DATA_SOURCE_KEY]), corpus_options(checkpoint)
    if args.data_root is not None:
        options["root"] = str(args.data_root)
    folder = Path(args.person)
    person = person_name(folder) if folder.is_dir() else args.person
    if person in checkpoint["hyper_parameters"].get("identities", []):
        raise FaceDiffError(f"--person {args.person}: the checkpoint knows {person}; train on with `facediff fit`")
    if folder.is_dir():
        options["people"] = [str(folder), *(options.get("people") or [])]
    else:
        options["extra_identities"] = [person, *(options.get("extra_identities") or [])]
    options["train_identities"] = [person] if args.mode == FINETUNE else None
    return person, module(**options)
