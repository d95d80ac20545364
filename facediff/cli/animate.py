"""``facediff animate``: speech in, animation out."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

from facediff.errors import FaceDiffError, choices
from facediff.pipelines.animate import check, parser


def run(name: str, arguments: Sequence[str]) -> int:
    """Animate; every input is checked before the model is loaded, and every output appears whole or not at all."""
    args = parser().parse_args(list(arguments))
    # What can be told at once is told before anything heavy is imported.
    if not args.checkpoint.is_file():
        raise FaceDiffError(
            f"{args.checkpoint}: no such checkpoint; expected a .ckpt file that `facediff fit` has written, or "
            f"demo/puppet.ckpt of `facediff demo`"
        )
    if args.stream or [str(path) for path in args.speech] == ["-"]:
        from facediff.pipelines.stream import run_stream

        if not args.stream:
            raise FaceDiffError("speech: - is standard input; add --stream, and send samples rather than a file")
        return run_stream(args)
    if len(args.speech) == 1 and not args.speech[0].exists():
        raise FaceDiffError(f"{args.speech[0]}: no such sound file, nor a folder of recordings")
    if len(args.speech) > 1 or args.speech[0].is_dir():
        return run_batch(args, list(arguments))
    check(args, args.output)

    from facediff.pipelines.animate import AnimationPipeline, read_checked, refuse_replacing

    refuse_replacing(args.speech, [args.output])
    speech = read_checked(args.speech[0], args.max_seconds)  # before the model, which takes longer to load
    written, animation = AnimationPipeline(args).write(speech, args.speech[0].stem, args.output, seed=args.seed)
    told = f"{len(animation.vertices)} frames, identity {animation.metadata['identity']}, style of {animation.metadata['style']}"
    procedural = "".join(
        f", {name}: {animation.metadata[name]}" for name in ("edited", "procedural") if name in animation.metadata
    )
    for path in written:
        print(f"{path}: {told}{procedural}")
        told, procedural = "beside it", ""
    return 0


def run_batch(args: argparse.Namespace, words: list[str]) -> int:
    """Many recordings into a folder.

    Raises:
        FaceDiffError: if nothing can be made at all.
    """
    from facediff.export import FORMATS
    from facediff.models.styles import style_paths
    from facediff.pipelines.folder import recordings, run_folder

    if args.suffix not in FORMATS:
        raise FaceDiffError(f"--suffix {args.suffix}: there is no such format: {choices(args.suffix, FORMATS)}")
    if args.output.suffix in FORMATS and not args.output.is_dir():
        raise FaceDiffError(
            f"--output {args.output}: several recordings go into a folder; give its name, and --suffix "
            f"{args.output.suffix}"
        )
    check(args, args.output / f"recording{args.suffix}")
    kind = FORMATS[args.suffix]
    if kind.is_folder or (args.takes > 1 and not kind.holds_several):
        fit = ".html or .mp4, which hold several takes" if args.takes > 1 else "a format of one file, such as .glb"
        raise FaceDiffError(f"--suffix {args.suffix}: a batch writes one file for each recording; choose {fit}")
    speeches = recordings(args.speech)
    if args.correspondence is not None and not args.correspondence.exists():
        write_correspondence(args)
    style_template = None if args.style_template is None else Path(args.style_template)
    files = [args.checkpoint, *style_paths(args.style)]
    files += [
        path
        for path in (args.target_mesh, args.eyes, args.correspondence, style_template)
        if path is not None and path.is_file()
    ]
    if args.shapes is not None:
        inside = sorted(args.shapes.iterdir()) if args.shapes.is_dir() else [args.shapes]
        files += [path for path in inside if path.is_file()]
    return run_folder(
        speeches,
        args.output,
        args.suffix,
        deciding(words),
        make_worker=make_worker,
        files=files,
        workers=args.workers or (None if args.device == "cpu" else 1),  # one accelerator holds one model
        retry_failed=args.retry_failed,
    )


def write_correspondence(args: argparse.Namespace) -> None:
    """Fit the target mesh, once and before a batch.

    Otherwise every process would fit it, and a second run would find a file that decides the outputs and that the
    records of the first one do not know.

    Raises:
        FaceDiffError: if a file is unreadable, or the meshes do not fit.
    """
    from facediff.animation import Animation
    from facediff.cli.options import assets_of, carried, facts_of

    facts = facts_of(assets_of(args.checkpoint), args.identity)
    neutral = Animation(name=str(args.checkpoint), vertices=facts["template"][None], **facts)
    carried(neutral, args.target_mesh, args.correspondence)


def deciding(words: Sequence[str]) -> list[str]:
    """The command without what decides nothing of a single output."""
    options = parser()
    args = options.parse_args(list(words))
    aside = ("speech", "output", "workers", "retry_failed", "quiet", "help", "stream", "suffix")
    kept = []
    for action in options._actions:
        value = getattr(args, action.dest, None)
        if action.dest in aside or value is None or value is False or not action.option_strings:
            continue
        kept += [action.option_strings[-1]] if value is True else [f"{action.option_strings[-1]}={value}"]
    return kept


def make_worker(command: list[str]) -> Callable[[Path, Path], None]:
    """What a process of a batch does with each recording; the model is loaded once."""
    from facediff.pipelines.animate import AnimationPipeline, read_checked
    from facediff.pipelines.folder import seed_of_recording

    args = parser().parse_args(["-", "-o", "-", *command, "--quiet"])
    pipeline = AnimationPipeline(args)

    def animate(recording: Path, output: Path) -> None:
        speech = read_checked(recording, args.max_seconds)
        pipeline.write(speech, recording.stem, output, seed=seed_of_recording(recording, args.seed))

    return animate
