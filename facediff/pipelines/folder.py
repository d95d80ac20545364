"""Batch mode of ``facediff animate``: many recordings, on all processors, resumable, past failures."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import numpy as np

from facediff.animation.options import AnimationOptions, ExportOptions
from facediff.animation.styles import style_paths
from facediff.editing.controls import keys_file
from facediff.errors import FaceDiffError, OptionError, check_known, printable
from facediff.export import FORMATS, check_export
from facediff.mesh.textures import mesh_files
from facediff.pipelines.animate import check_options
from facediff.pipelines.trained import open_pipeline
from facediff.speech.audio import read_recording
from facediff.utils import SAMPLE_RATE
from facediff.utils.batch import RECORDS, FileTask, Recipe, run_batch
from facediff.utils.files import check_folder_writable, check_writable, locked, remove_partial
from facediff.utils.hub import is_exported, may_have_weights, model_files
from facediff.utils.jobs import PerWorker, is_cluster
from facediff.utils.output_paths import refuse_overwriting
from facediff.utils.text_tables import print_table

LOCK = ".facediff-batch.lock"
"""Next to the outputs while a batch is running."""

TABLE = 40
"""Recordings that the table at the end shows; of more, only the failed ones."""

FEW = 20
"""Recordings of which workers of a cluster are asked beforehand whether they see them."""

FITTED_SECONDS = 10
"""Speech that the fit of a target mesh is judged by."""

Animate = Callable[[Path, Path], list[Path] | None]
"""Animates a recording (first) and writes a file (second), whole or not at all; returns all files that it wrote."""
MakeWorker = Callable[[list[str]], Animate]
"""Takes the options and loads what all recordings have in common."""


def animate_folder(
    options: AnimationOptions,
    speech: Sequence[Path],
    output: Path,
    suffix: str = ".mp4",
    *,
    export: ExportOptions = ExportOptions(),  # noqa: B008 - frozen
    workers: int | None = None,
    scheduler: str | None = "",
    retry_failed: bool = False,
) -> int:
    """Animate recordings and folders of them into a folder; the exit status, 1 if a recording failed.

    A recording's seed follows from the options' seed and the name of its file. Without ``workers``, as many recordings
    are animated at a time as there are processors, one on an accelerator, or all that a cluster's workers take.
    """
    check_known("{suffix}", "format", [suffix], FORMATS)
    if output.suffix in FORMATS and not output.is_dir():
        raise OptionError(
            "output", f"several recordings go into a folder; give its name, and {{suffix}} {output.suffix}", output
        )
    check_options(options)
    check_export(output / f"recording{suffix}", export, options.samples, weights=may_have_weights(options.checkpoint))
    if FORMATS[suffix].is_folder or (options.samples > 1 and not FORMATS[suffix].holds_several):
        fit = ".html or .mp4, which show several" if options.samples > 1 else "a format of one file, such as .glb"
        raise OptionError("suffix", f"a batch writes one file for each recording; choose {fit}", suffix)
    files = recordings(speech)
    correspondence = None if options.correspondence is None else Path(options.correspondence)
    if options.target_mesh is not None and correspondence is not None and not correspondence.exists():
        # Otherwise every process would fit the mesh, and a second run would see a file that decides the outputs and
        # that the records of the first one do not know.
        write_correspondence(replace(options, quiet=True, samples=1), files)
    quiet, export = replace(options, quiet=True), replace(export, quiet=True)
    decides = {**asdict(quiet), "export": asdict(export)}
    del decides["commercial_only"]  # refuses a model, and changes no animation
    return run_folder(
        files,
        output,
        suffix,
        [f"{name}={json.dumps(value, default=_in_words)}" for name, value in decides.items()],
        make_worker=partial(_load_pipeline, quiet, export),
        files=_deciding_files(options, export),
        workers=workers or (None if computes_on_processor(options) or is_cluster(scheduler) else 1),
        scheduler=scheduler,
        retry_failed=retry_failed,
    )


def _in_words(value: object) -> str:
    """A value of Python as text; of an array the checksum of its numbers, since its text leaves out its middle."""
    if not hasattr(value, "__array__"):
        return str(value)
    numbers = np.asarray(value)
    return f"{numbers.dtype} {numbers.shape} {hashlib.sha256(numbers.tobytes()).hexdigest()}"


def _deciding_files(options: AnimationOptions, export: ExportOptions) -> list[Path]:
    """The files that decide the animations."""
    source = Path(options.checkpoint)
    # A download from the hub or a clone leaves folders among the files.
    inside = sorted(path for path in source.iterdir() if path.is_file()) if is_exported(source) else model_files(source)
    files = [*inside, *style_paths(None if options.style is None else str(options.style))]
    optional = (
        options.mesh,
        options.eyes,
        options.correspondence,
        options.style_template,
        keys_file(options.direction),
    )
    files += [Path(path) for path in optional if path is not None and Path(path).is_file()]
    for path in (options.target_mesh, export.surface):
        files += mesh_files(Path(path)) if path is not None and Path(path).is_file() else []
    shapes = None if export.shapes is None else Path(export.shapes)
    if shapes is not None and shapes.exists():
        inside = sorted(shapes.iterdir()) if shapes.is_dir() else [shapes]
        files += [path for path in inside if path.is_file()]
    return files


def computes_on_processor(options: AnimationOptions) -> bool:
    """Whether the model computes on the processor, of which every process has a share."""
    if is_exported(options.checkpoint):
        return True
    from facediff.pipelines.trained import on_processor

    return on_processor(options.device)


def write_correspondence(options: AnimationOptions, files: Sequence[Path]) -> None:
    """Fit the target mesh and write its correspondence, judged by how the first readable recording moves it."""
    problems = []
    for file in files:
        try:
            recording = read_recording(file, options.max_seconds)
        except FaceDiffError as error:  # the batch will say so of this recording, and goes on with others
            problems.append(error)
            continue
        start = replace(recording, speech=recording.speech[: FITTED_SECONDS * SAMPLE_RATE])
        with open_pipeline(options).animations(start):
            return
    raise problems[0]


def _load_pipeline(options: AnimationOptions, export: ExportOptions, _command: list[str]) -> Animate:
    """Load what all recordings have in common, once in each process."""
    pipeline = open_pipeline(options)

    def animate(recording: Path, output: Path) -> list[Path]:
        speech = read_recording(recording, options.max_seconds)
        seed = seed_of_recording(recording, pipeline.seed)
        return list(pipeline.write(speech, output, export, seed=seed)[0])

    return animate


def recordings(paths: Sequence[Path]) -> list[Path]:
    """Recordings, and those that lie in folders (not deeper), each once."""
    from facediff.speech.audio import CONTAINERS, SUFFIXES

    suffixes = SUFFIXES + CONTAINERS
    unique: dict[Path, Path] = {}
    for path in paths:
        files = [path]
        if path.is_dir():
            files = [file for file in sorted(path.iterdir()) if file.suffix.lower() in suffixes and file.is_file()]
            files = [file for file in files if not file.name.startswith(".")]
            if not files:
                raise FaceDiffError(f"{path}: holds no recording; expected {', '.join(suffixes)}")
        for file in files:
            unique.setdefault(file.resolve(), file)
    return list(unique.values())


def output_names(speeches: Sequence[Path], suffix: str) -> list[str]:
    """Names of the outputs: ``a.wav`` gives ``a.mp4``; where two would be equal, ``a.wav.mp4`` and ``a.flac.mp4``.

    Letters' case does not distinguish names, as on many disks.
    """
    stems = Counter(speech.stem.lower() for speech in speeches)
    names = [(speech.stem if stems[speech.stem.lower()] == 1 else speech.name) + suffix for speech in speeches]
    first: dict[str, Path] = {}
    for name, speech in zip(names, speeches, strict=True):
        if (namesake := first.setdefault(name.lower(), speech)) is not speech:
            raise FaceDiffError(
                f"{namesake} and {speech} would both give {name}; rename one, or animate them one by one"
            )
    return names


def seed_of_recording(speech: Path, seed: int) -> int:
    """The seed of a recording in a batch: it follows from the file's name, not from its folder or its worker."""
    digest = hashlib.sha256(f"{seed}/{speech.name}".encode(errors="surrogateescape")).digest()
    return int.from_bytes(digest[:4], "big") >> 1


def run_folder(
    speeches: Sequence[Path],
    output: Path,
    suffix: str,
    command: Sequence[str],
    *,
    make_worker: MakeWorker,
    files: Sequence[Path] = (),
    workers: int | None = None,
    scheduler: str | None = "",
    retry_failed: bool = False,
) -> int:
    """Animate recordings into a folder by a worker that is made once in each process, with the command.

    Outputs that an earlier run has made of the same recording, command (the options) and files (checkpoint, styles …)
    are kept, and a recording that failed is tried again only if something has changed or ``retry_failed`` is given.
    """
    check_folder_writable(output)
    names = output_names(speeches, suffix)
    refuse_overwriting(speeches, [output / name for name in names])
    recipe = Recipe.of(command, files)
    check_writable(output / names[0])
    states: dict[Path, tuple[str, str]] = {}  # by recording: "made", "up to date" or "failed", and a remark
    with locked(output / LOCK, "facediff animate"):
        tasks = [FileTask(speech, output / name, recipe) for speech, name in zip(speeches, names, strict=True)]
        if not (output / RECORDS).exists() and (strangers := [task.output for task in tasks if task.output.exists()]):
            raise FaceDiffError(f"{strangers[0]}: would be replaced, and no batch has written it; choose a new folder")
        (output / RECORDS).mkdir(exist_ok=True)
        for task in tasks:
            if state := _earlier_state(task, retry_failed):
                states[task.source] = state
            else:
                remove_partial(output, task.output.stem)
        try:
            to_do = [task for task in tasks if task.source not in states]
            work = PerWorker(partial(_set_up, make_worker, list(command)))
            outcomes = run_batch(
                work,
                to_do,
                workers=workers,
                scheduler=scheduler,
                writes=output,
                reads=[*files, *(task.source for task in to_do[:FEW])],
                record=FileTask.record,
                survive_bugs=True,
            )
            with closing(outcomes):
                for count, (task, outcome) in enumerate(outcomes, start=1):
                    if outcome.problem:
                        stale = f" ({task.output} is of an earlier run)" if task.output.exists() else ""
                        states[task.source] = "failed", outcome.problem + stale
                        print(f"[{count}/{len(to_do)}] failed: {printable(outcome.problem)}", flush=True)
                    else:
                        states[task.source] = "made", f"{outcome.seconds:.1f} s"
                        print(f"[{count}/{len(to_do)}] {printable(task.output)}, {outcome.seconds:.1f} s", flush=True)
            if is_cluster(scheduler):
                remove_partial(output)  # of a worker that was lost on another machine
        finally:
            for task in tasks:
                if task.source not in states and (state := _state_after_stop(task)):
                    states[task.source] = state
            _print_states(tasks, states)
    return int(any(state == "failed" for state, _ in states.values()))


def _set_up(make_worker: MakeWorker, command: list[str]) -> Callable[[FileTask], list[Path] | None]:
    animate = make_worker(command)
    return lambda task: animate(task.source, task.output)


def _earlier_state(task: FileTask, retry_failed: bool) -> tuple[str, str] | None:
    """What an earlier run has left of a recording; None if it is to be animated."""
    if reason := task.change():
        print(printable(f"note: {task.output}: is made again, since {reason}"))
        return None
    problem = task.earlier_problem()
    if problem == "":
        return "up to date", ""
    if problem is None or retry_failed:
        return None
    return "failed", f"{problem} (in an earlier run; --retry-failed tries again)"


def _state_after_stop(task: FileTask) -> tuple[str, str] | None:
    """What has become of a recording that was being animated when the batch was stopped; None if it is left to do."""
    # Recordings that run after Ctrl-C come to their end and record it, but their result is not taken any more.
    if task.earlier_problem() == "" and not task.change():
        return "made", "while the batch was being stopped"
    return None


def _print_states(tasks: Sequence[FileTask], states: dict[Path, tuple[str, str]]) -> None:
    rows = [(task.source.name, *states.get(task.source, ("left", ""))) for task in tasks]
    table = rows if len(rows) <= TABLE else [row for row in rows if row[1] == "failed"]
    if table:
        print_table([], table, left=3)
    counts = Counter(state for _, state, _ in rows)
    summary = ", ".join(f"{count} {state}" for state, count in counts.items())
    print(f"{len(rows)} recording{'s' * (len(rows) != 1)}: {summary}", flush=True)
    if counts["left"]:
        print("the same command continues where this one stopped", flush=True)
