"""``facediff adapt``: fine-tune a model on a new speaker, or adapt its audio encoder to other voices."""

from __future__ import annotations

import shlex
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from facediff.animation.options import LicenceOptions
from facediff.cli.lightning import corpus_and_folder, prepared
from facediff.cli.options import Checkpoint, CheckpointFile, Corpus, Folder, Seed
from facediff.cli.process import confirm_cost, tell
from facediff.errors import FaceDiffError
from facediff.utils import ranges
from facediff.utils.hub import check_model_source, model_name
from facediff.utils.option import Option

if TYPE_CHECKING:
    from facediff.data import SpeechMotionDataModule
    from facediff.models.audio_distillation import DistillationOptions

CLIP_SECONDS = 0.05  # Training time of a clip with the built-in corpus's small model, on two processor cores
Mode = Literal["finetune", "joint"]


@dataclass(frozen=True)
class TrainingOptions:
    """Training on a person.

    Attributes:
        mode: train on the new speaker's clips only (finetune), or on theirs among all others' (joint)
        train: all weights, or identity and style only (person)
        epochs: epochs over the training clips
        learning_rate: falls to 0 as a cosine
        yes: start without a question, however long it takes
    """

    mode: Annotated[Mode, Option(needs="person")] = "finetune"
    train: Annotated[Literal["all", "person"], Option(needs="person")] = "all"
    epochs: Annotated[ranges.Epochs, Option(metavar="N", needs="person")] = 60
    learning_rate: Annotated[ranges.LearningRate, Option(metavar="RATE", needs="person")] = 5e-4
    yes: bool = False


@dataclass(frozen=True)
class EncoderOptions:
    """Distillation of the audio encoder.

    Attributes:
        augmentation: how --voices changes speech, such as room:share=0.5,seconds=0.8; once for each (default: see
            docs/voices.md)
        people: with --voices: folder of people's recordings, .wav or .flac, which the encoder also learns to hear
            in other rooms and with noise
        interpolation: share of the distilled weights in the audio encoder's (default: 0.85): less changes clean
            speech less
    """

    augmentation: Annotated[list[str] | None, Option(metavar="NAME[:OPTION=VALUE,…]", needs="voices")] = None
    people: Annotated[Path | None, Option(metavar="DIR", reads=True, needs="voices")] = None
    interpolation: Annotated[ranges.Interpolation | None, Option(metavar="SHARE", needs="voices")] = None


def adapt(
    *,
    checkpoint: Checkpoint,
    person: Annotated[str | None, Option(metavar="DIR", reads=True, without="voices")] = None,
    voices: Annotated[ranges.Steps | None, Option(metavar="STEPS", bare=ranges.USUAL_VOICE_STEPS)] = None,
    output: CheckpointFile,
    data_root: Folder = None,
    corpus: Corpus = None,
    seed: Seed = 0,
    accelerator: str = "auto",
    quiet: bool = False,
    training: TrainingOptions,
    encoder: EncoderOptions,
    licence: LicenceOptions,
) -> None:
    """Fine-tune a checkpoint on a new speaker, or adapt its audio encoder to voices.

    With --person, the model is trained on a minute of the new speaker's motion, and knows them by name. With --voices,
    its audio encoder is distilled to be robust to other voices, rooms and noise. The corpus that the checkpoint was
    trained on must be on this machine.

    Args:
        checkpoint: trained model (.ckpt)
        person: folder that `facediff data import-person` wrote, or the name of a speaker of the corpus who was not
            trained on and has clips that belong to no split
        voices: distil the audio encoder to be robust to other voices, rooms and noise, in so many steps (600 if no
            number)
        output: checkpoint to write (.ckpt)
        data_root: where the corpus is, if not where it was in training
        corpus: the corpus's class, if it is your own and no installed package registers it: package.module.Class; it
            may be a file of the working folder
        seed: seed of all random numbers
        accelerator: Lightning's: auto, cpu, gpu …
        quiet: no progress bar
        training: how the model learns a person.
        encoder: how the audio encoder is distilled.
        licence: which models are refused.
    """
    check_model_source(checkpoint, "--checkpoint")
    where = (data_root, corpus)
    started = time.monotonic()
    if voices is not None:
        from facediff.models.audio_distillation import DistillationOptions

        options = DistillationOptions(steps=voices, seed=seed, people=encoder.people)
        options = replace(
            options,
            augmentations=encoder.augmentation or options.augmentations,
            interpolation=encoder.interpolation or options.interpolation,
        )
        device = {"gpu": "cuda"}.get(accelerator, accelerator)
        report = adapt_audio_encoder(checkpoint, output, where, device, licence, options, quiet=quiet)
    elif person is None:
        raise FaceDiffError("--person, --voices: expected one of them: a new speaker, or robustness to other voices")
    else:
        report = train_on(checkpoint, output, person, where, training, licence, accelerator, seed, quiet=quiet)
    tell(f"{output}: {report.format(seconds=time.monotonic() - started)}")


def train_on(
    checkpoint: Path,
    output: Path,
    person: str,
    where: tuple[Path | None, str | None],
    options: TrainingOptions,
    licence: LicenceOptions,
    accelerator: str,
    seed: int,
    *,
    quiet: bool,
) -> str:
    """Write a checkpoint that knows a new person; the report has ``{seconds}`` to fill in."""
    from lightning.pytorch import Trainer, seed_everything

    from facediff.callbacks.checkpoints import AtomicCheckpointIO, requeue_on_signal, slurm_plugins
    from facediff.cli.lightning import exit_statuses
    from facediff.cli.lightning_cli import IDLE_WARNINGS, without_warnings
    from facediff.models.adaptation import train_only, with_extra_identities
    from facediff.models.base import build_model
    from facediff.models.checkpoint import read_checkpoint
    from facediff.models.checkpoint_content import IMPORTED
    from facediff.utils.licences import require_cleared
    from facediff.utils.progress import on_terminal

    content = read_checkpoint(checkpoint)
    name, data = adaptation_data(checkpoint, content, person, options.mode, *where)
    model = build_model(checkpoint, content)
    if licence.commercial_only:
        require_cleared(checkpoint, model.licences)
    prepared(data)
    clips = data.clips("train")
    if not any(clip.identity == name for clip in clips):
        speakers = ", ".join(sorted(data.corpus.templates))
        raise FaceDiffError(
            f"--person {person}: neither a person's folder nor a speaker with clips outside the test splits; the "
            f"corpus has {speakers}"
        )
    confirm_cost(options.yes, "--epochs", seconds=CLIP_SECONDS * options.epochs * len(clips))
    seed_everything(seed, verbose=False)
    model = with_extra_identities(model, list(data.identities))
    imported = {key: value for key, value in model.provenance.items() if key == IMPORTED}
    model.provenance = {**imported, "parent": model_name(checkpoint)}
    model.learning_rate, model.lr_schedule, model.warmup_steps = options.learning_rate, "cosine", 0
    model.parameter_groups = None
    train_only(model.train(), options.train)
    trainer = Trainer(
        max_epochs=options.epochs,
        accelerator=accelerator,
        devices=1,
        gradient_clip_val=1.0,
        limit_val_batches=0,
        logger=False,
        enable_checkpointing=False,
        enable_model_summary=False,
        enable_progress_bar=not quiet and on_terminal(),
        plugins=slurm_plugins([AtomicCheckpointIO()]),
    )
    requeue_on_signal(trainer)
    with exit_statuses(), without_warnings(*IDLE_WARNINGS):
        trainer.fit(model, data)
    for parameter in model.parameters():
        parameter.requires_grad_(True)
    trainer.save_checkpoint(output, weights_only=False)
    seconds = sum(data.corpus.frames(clip) for clip in clips if clip.identity == name) / data.frame_rate
    # Pictures need a mesh, which a corpus may lack.
    target = "speech.npz" if model.assets.faces is None else "speech.mp4"
    command = ["facediff", "animate", "speech.wav", "--checkpoint", str(output), "--identity", name, "-o", target]
    return f"adapted to {name} by {seconds:.0f} s of motion, in {{seconds:.0f}} s; next: {shlex.join(command)}"


def adapt_audio_encoder(
    checkpoint: Path,
    output: Path,
    where: tuple[Path | None, str | None],
    device: str,
    licence: LicenceOptions,
    options: DistillationOptions,
    *,
    quiet: bool,
) -> str:
    """Write a checkpoint with a distilled audio encoder; see :func:`adapt` and :func:`train_on`."""
    from facediff.models.base import build_model
    from facediff.models.checkpoint import read_checkpoint
    from facediff.models.checkpoint_content import PROVENANCE_KEY
    from facediff.pipelines.trained import usable_device
    from facediff.utils.licences import require_cleared

    device = usable_device(device, "accelerator")
    content = read_checkpoint(checkpoint)
    if licence.commercial_only:
        require_cleared(checkpoint, build_model(checkpoint, content).licences)
    module, arguments = corpus_and_folder(checkpoint, content, where[1], where[0])
    data = prepared(module(**arguments))
    content[PROVENANCE_KEY] = {**content.get(PROVENANCE_KEY, {}), "parent": model_name(checkpoint)}
    error = write_distilled(checkpoint, content, data, output, options, device=device, quiet=quiet)
    result = f"its features err by {error:.2f} of their variance"
    return f"audio encoder adapted to other voices in {{seconds:.0f}} s; {result}"


def write_distilled(
    checkpoint: Path,
    content: dict[str, Any],
    data: SpeechMotionDataModule,
    output: Path,
    options: DistillationOptions,
    *,
    device: str = "cpu",
    quiet: bool = False,
) -> float:
    """Write a checkpoint's content with a distilled audio encoder; the remaining error of its features."""
    from facediff.callbacks.checkpoints import AtomicCheckpointIO
    from facediff.models.audio_distillation import distil_audio_encoder, encoder_weights
    from facediff.models.base import build_model
    from facediff.utils.progress import progress_bar

    model = build_model(checkpoint, content).to(device)
    with progress_bar("other voices", options.steps, shown=not quiet) as step:
        error = distil_audio_encoder(model, data, options, step)
    weights = {**encoder_weights(model), **model.fit_to_features(data)}
    # Beside averaged weights, the last step's are kept for further training.
    for key in ("state_dict", "current_model_state"):
        if key in content:
            content[key] = {**content[key], **weights}
    AtomicCheckpointIO().save_checkpoint(content, output)
    return error


def adaptation_data(
    checkpoint: Path, content: dict[str, Any], person: str, mode: Mode, data_root: Path | None, corpus: str | None
) -> tuple[str, SpeechMotionDataModule]:
    """The new speaker's name, and the checkpoint's data module with that speaker put first."""
    from facediff.data.datamodule import person_name

    module, options = corpus_and_folder(checkpoint, content, corpus, data_root)
    folder = Path(person)
    name = person_name(folder) if folder.is_dir() else person
    if name in content["hyper_parameters"].get("identities", []):
        raise FaceDiffError(f"--person {person}: the checkpoint knows {name}; train on with `facediff fit`")
    if folder.is_dir():
        options["people"] = [str(folder.absolute()), *(options.get("people") or [])]
    else:
        options["extra_identities"] = [name, *(options.get("extra_identities") or [])]
    options["train_identities"] = [name] if mode == "finetune" else None
    return name, module(**options)
