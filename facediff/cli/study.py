"""``facediff study``: a user study from animations to its table."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from facediff.cli.options import (
    File,
    Folder,
    FrameRate,
    OutputFolder,
    Scheduler,
    Seed,
    Size,
    View,
    Workers,
    check_folders,
    named_folders,
)
from facediff.cli.parsing import refuse_idle
from facediff.cli.process import confirm_cost, tell
from facediff.errors import FaceDiffError, counted
from facediff.utils import ranges
from facediff.utils.jobs import check_scheduler
from facediff.utils.option import Option
from facediff.utils.ranges import Range
from facediff.utils.server import LOOPBACK

Controls = Annotated[int, Range(0, 50)]
LEVEL = 0.95


def make(
    methods: Annotated[list[str], Option(metavar="NAME=FOLDER", reads=True)],
    *,
    output: OutputFolder,
    truth: File = None,
    style_references: Folder = None,
    identity: Annotated[str, Option(metavar="NAME")] = "own",
    speech: Annotated[Path | None, Option(metavar="FOLDER", reads=True)] = None,
    mesh: File = None,
    frame_rate: FrameRate = None,
    unit: Annotated[str | None, Option(metavar="U")] = None,
    clips: Annotated[list[str] | None, Option(metavar="CLIP", many=True)] = None,
    max_clips: Annotated[ranges.Samples, Option(metavar="N")] = 12,
    design: Literal["latin", "all"] = "latin",
    pairs: Literal["first", "all"] = "first",
    still_controls: Annotated[Controls, Option(metavar="N")] = 3,
    same_controls: Annotated[Controls, Option(metavar="N")] = 1,
    repeats: Annotated[Controls, Option(metavar="N")] = 1,
    questions: File = None,
    languages: Annotated[Sequence[str] | None, Option(metavar="CODE,…")] = None,
    seed: Seed = 0,
    size: Size = 384,
    view: View = "front",
    video: Literal["mp4", "webm"] = "mp4",
    workers: Workers = None,
    scheduler: Scheduler = None,
    quiet: bool = False,
    yes: bool = False,
) -> None:
    """Make a user study from folders of animations: videos side by side, and a page that asks raters about them.

    Methods are folders with <clip>.npz of `facediff animate`, or <clip>.npy or <clip>_condition_<identity>.npy of
    `facediff predict`; clips are matched by name. The first method is compared with the others and with the truth.
    What is drawn is kept, so that the same command continues after an interruption. OUT/page is what raters get;
    OUT/study.json is the key, which says what is on which side.

    Args:
        methods: folders of animations, each NAME=FOLDER
        output: folder of the study
        truth: corpus folder, folder of animations, or puppet; compared like a method, and used in controls
        style_references: folder of animations, <speaker>_….npz, shown with questions of style (default: other clips
            of the truth)
        identity: whose style predictions were given: own, or an identity's name
        speech: folder of recordings named like the clips (default: the corpus's, or those that the animations hold)
        mesh: triangles of .npy files: .ply, .obj … (default: the corpus's)
        frame_rate: frames a second of .npy files (default: the corpus's)
        unit: unit of length of .npy files (default: the corpus's)
        clips: clips to show (default: a seeded choice of those that all have, even among speakers)
        max_clips: clips that are chosen at most
        design: latin: every rater sees every clip once, with a pair that changes from rater to rater; all: every clip
            with every pair
        pairs: first: the first method with each other one and the truth; all: all with all
        still_controls: videos of the truth against a still face, for each rater
        same_controls: videos of one animation on both sides, for each rater
        repeats: videos that come again with their sides exchanged, for each rater
        questions: .yaml with questions, consent, title and the rule of exclusion (default: realism, lip_sync, style,
            comments)
        languages: of the page, en,de,es,fr,zh (default: all)
        seed: of the choice of clips, of sides, orders and references
        size: height and width of a face in pixels
        view: camera
        video: format; webm (VP9) for browsers without H.264
        workers: videos drawn at a time (default: as many as processors)
        scheduler: where tasks run: processes, threads, tcp://HOST:PORT of a Dask cluster, or slurm (docs/cluster.md)
        quiet: no progress bar
        yes: start without a question, however long it takes
    """
    check_scheduler(scheduler)
    folders = named_folders(methods)
    check_folders(folders)
    if truth is not None and not truth.is_dir() and str(truth) != "puppet":
        raise FaceDiffError(f"--truth {truth}: no such folder; expected a corpus, a folder of animations, or puppet")
    if questions is not None and not questions.is_file():
        raise FaceDiffError(f"--questions {questions}: no such file; expected a .yaml file of questions")
    from facediff.study import StudyOptions, plan_study

    plan = plan_study(
        folders,
        StudyOptions(
            clips=clips,
            max_clips=max_clips,
            design=design,
            pairs=pairs,
            still=still_controls,
            same=same_controls,
            repeats=repeats,
            questions=questions,
            languages=languages,
            seed=seed,
            size=size,
            view=view,
            video=video,
        ),
        truth=truth,
        references=style_references,
        identity=identity,
        speech=speech,
        mesh=mesh,
        frame_rate=frame_rate,
        unit=unit,
    )
    for note in plan.notes:
        tell(f"note: {note}")
    confirm_cost(yes, "--max-clips or --size", seconds=plan.seconds / 2)
    drawn = plan.make(output, workers=workers, scheduler=scheduler, progress=not quiet)
    study = plan.study
    trials = study.trials_of(0)
    controls = sum(trial.kind != "pair" for trial in trials)
    tell(
        f"{output}: {counted(len(plan.videos), 'video')} ({drawn} drawn, {len(plan.videos) - drawn} up to date) of "
        f"{counted(len(plan.clips), 'clip')} of {', '.join(study.conditions)}",
        f"a rater sees {counted(len(trials), 'video')}, {controls} of them controls, in about "
        f"{plan.minutes:.0f} minutes; sides and orders are balanced over {len(study.schedules)} raters",
        f"hand out {output / 'page'}, or run  facediff study serve {output}",
    )


def serve(
    study: Annotated[Path, Option(metavar="STUDY", reads=True, writes="folder")],
    *,
    host: Annotated[str, Option(metavar="ADDRESS")] = "127.0.0.1",
    port: Annotated[ranges.Port, Option(metavar="N")] = 8000,
    name: Annotated[str | None, Option(metavar="HOST")] = None,
    max_raters: Annotated[ranges.Raters | None, Option(metavar="N")] = None,
    open: bool = False,  # noqa: A002 - the option's name
) -> None:
    """Serve a study to raters, until Ctrl-C. Answers go to STUDY/answers.sqlite, and nowhere else.

    By default only this machine can open the page; --host 0.0.0.0 lets everybody in who reaches this machine, without
    encryption: put a web server with HTTPS in front of it, and give its name by --name.

    Args:
        study: folder that `facediff study make` has finished
        host: address to listen at
        port: to listen at; 0 for any free one
        name: name under which a web server in front offers the page, such as study.lab.example; requests under other
            names are refused
        max_raters: raters that are let in (default: any number)
        open: open the page in the browser
    """
    from facediff.study import serve as run

    def ready(address: str) -> None:
        tell(f"{address} serves {study}; Ctrl-C ends it")
        if host not in LOOPBACK:
            tell(f"note: everybody who reaches {host} may answer, without encryption")
        if open:
            import webbrowser

            webbrowser.open(address)

    raters = run(study, host=host, port=port, name=name, most_raters=max_raters, ready=ready).raters()
    finished = sum(rater.finished is not None for rater in raters)
    tell(
        f"{study}: {counted(len(raters), 'rater')}, {finished} of them finished; "
        f"`facediff study report {study}` analyses them"
    )


def report(
    studies: Annotated[list[str] | None, Option(metavar="STUDY", reads=True)] = None,
    *,
    answers: Annotated[list[Path] | None, Option(metavar="FILE", many=True, reads=True)] = None,
    output: Annotated[Path | None, Option(also="-o", metavar="OUT", writes="folder")] = None,
    interval: Literal["wilson", "binomial"] = "wilson",
    level: Annotated[ranges.Level, Option(metavar="P")] = LEVEL,
    bootstrap: Annotated[ranges.Resamples, Option(metavar="N")] = 1000,
    seed: Seed = 0,
    json: Annotated[str | None, Option(metavar="FILE", writes="file", dash=True)] = None,
    plan: Annotated[ranges.Preference | None, Option(metavar="D")] = None,
    power: Annotated[ranges.Power, Option(metavar="P")] = 0.8,
    per_rater: Annotated[ranges.PerRater | None, Option(metavar="N")] = None,
    correlation: Annotated[ranges.Correlation, Option(metavar="R")] = 0.1,
    comparisons: Annotated[ranges.PerRater | None, Option(metavar="N")] = None,
) -> int:
    """Analyse the answers to studies, or say how many raters one needs.

    Printed are shares of preference with intervals, Bradley-Terry scores, agreement and who is not counted; with -o,
    also the table for a paper (Markdown, LaTeX, CSV), a page, and every answer (CSV, JSON). Several studies, such as
    biwi=FOLDER mead=FOLDER, become columns of one table. Exit status: 0 done, 1 answers had to be set aside.

    Args:
        studies: folders of `facediff study make`, each FOLDER or NAME=FOLDER
        answers: files that raters have downloaded, and folders of them; those that `study serve` has stored are always
            used
        output: folder for all tables
        interval: of shares: Wilson's, or the exact binomial one
        level: of intervals
        bootstrap: resamples for intervals between raters and of agreement; 0: none
        seed: of the resamples
        json: write everything as JSON; - prints it instead of the tables
        plan: how many raters notice a share that lies by D above one half: 0.1 for 60 to 40
        power: for --plan: the chance to notice it
        per_rater: for --plan: answers of one rater to one comparison (default: as in the study, else 1)
        correlation: for --plan: of two answers of one rater to one comparison
        comparisons: for --plan: comparisons that are made (default: as in the study, else 1)
    """
    if plan is None:
        idle = {"power": power != 0.8, "per_rater": per_rater is not None, "correlation": correlation != 0.1}
        refuse_idle("is for --plan", **idle, comparisons=comparisons is not None)
    else:
        idle = {"answers": answers is not None, "output": output is not None, "json": json is not None}
        refuse_idle("is not for --plan, which analyses no answers", **idle, interval=interval != "wilson")
    folders = named_folders(studies or [])
    for folder in folders.values():
        if not folder.is_dir():
            raise FaceDiffError(f"{folder}: no such folder; expected a study that `facediff study make` has made")
    if plan is not None:
        return print_plan(folders, plan, power, level, per_rater, correlation, comparisons)
    if not folders:
        raise FaceDiffError("studies: missing; give the folder of a study, or --plan D")
    from facediff.study.definition import read_study
    from facediff.study.report import analyse_folder
    from facediff.study.tables import json_report, text, write_report
    from facediff.utils.files import atomic

    options = {"interval": interval, "level": level, "resamples": bootstrap, "seed": seed}
    ids = [read_study(folder).id for folder in folders.values()]
    reports = [
        analyse_folder(folder, answers or (), name=name, others=ids[:i] + ids[i + 1 :], **options)
        for i, (name, folder) in enumerate(folders.items())
    ]
    if json is not None and json != "-":
        with atomic(Path(json)) as temporary:
            temporary.write_text(json_report(reports) + "\n", encoding="utf-8")
    if json == "-":
        tell(*json_report(reports).split("\n"))
    else:
        for analysis in reports:
            tell(*text(analysis).split("\n"), "")
    if output is not None:
        written = write_report(reports, output)
        if json != "-":
            tell(f"written: {', '.join(str(path) for path in written)}")
    return int(any(note.startswith("set aside") for analysis in reports for note in analysis.notes))


def print_plan(
    folders: dict[str, Path],
    difference: float,
    power: float,
    level: float,
    per_rater: int | None,
    correlation: float,
    comparisons: int | None,
) -> int:
    """Print how many raters are needed."""
    from facediff.study import raters_needed, read_study
    from facediff.study.report import design_of

    for name, folder in folders.items() or {"": None}.items():
        defaults = (1, 1) if folder is None else design_of(read_study(folder))
        answers, pairs = per_rater or defaults[0], comparisons or defaults[1]
        needed = raters_needed(
            difference, power=power, level=level, per_rater=answers, correlation=correlation, comparisons=pairs
        )
        worth = f"correlated by {correlation:g}, count as {answers / needed.design_effect:.2f}"
        repeated = f"{answers} of a rater, {worth}; " if answers > 1 else ""
        tell(
            f"{name}{': ' if name else ''}{needed.raters} raters notice a preference of {50 + 100 * difference:g} to "
            f"{50 - 100 * difference:g} with a chance of {power:.0%} at the level {level:g}",
            f"({needed.answers} independent answers to each of {counted(pairs, 'comparison')}; {repeated}those that "
            f"are not counted come on top)",
        )
    return 0
