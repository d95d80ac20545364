"""``facediff study``: a user study from animations to its table."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from facediff.cli.options import (
    File,
    Folder,
    FrameRate,
    OutputFolder,
    PageServer,
    Seed,
    Truth,
    WorkOptions,
    named_folders,
)
from facediff.cli.process import confirm_cost, tell
from facediff.errors import counted
from facediff.study.options import StudyOptions
from facediff.utils import ranges
from facediff.utils.option import Option


def make(
    methods: Annotated[list[str], Option(metavar="NAME=FOLDER", reads=True)],
    *,
    output: OutputFolder,
    truth: Truth | None = None,
    style_references: Folder = None,
    identity: Annotated[str, Option(metavar="NAME")] = "own",
    speech: Annotated[Path | None, Option(metavar="FOLDER", reads=True)] = None,
    mesh: File = None,
    frame_rate: FrameRate = None,
    unit: Annotated[str | None, Option(metavar="U")] = None,
    yes: bool = False,
    work: WorkOptions,
    options: StudyOptions,
) -> None:
    """Make a user study from folders of animations: videos side by side, and a page that asks raters about them.

    Methods are folders with <clip>.npz of `facediff animate`, or <clip>.npy or <clip>_condition_<identity>.npy of
    `facediff predict`; clips are matched by name. The first method is compared with the others and with the truth.
    Videos are kept, so that the same command continues after an interruption. OUT/page is for the raters;
    OUT/study.json is the key: it says which method is on which side.

    Args:
        methods: folders of animations, each NAME=FOLDER
        output: folder of the study
        truth: corpus folder, folder of animations, or puppet; compared like a method, and used in controls
        style_references: folder of animations, <speaker>_….npz, shown with questions of style (default: other clips
            of the truth)
        identity: whose style predictions were given: own, or an identity's name
        speech: folder of recordings named like the clips (default: the corpus's, or the sound in the animations)
        mesh: triangles of .npy files: .ply, .obj … (default: the corpus's)
        frame_rate: frames a second of .npy files (default: the corpus's)
        unit: unit of length of .npy files (default: the corpus's)
        yes: start without a question, however long it takes
        work: where the work is done
        options: clips, design and questions.
    """
    folders = named_folders(methods)
    from facediff.study import plan_study

    plan = plan_study(
        folders,
        options,
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
    redrawn = plan.make(output, workers=work.workers, scheduler=work.scheduler, progress=not work.quiet)
    study = plan.study
    trials = study.trials_of(0)
    controls = sum(trial.kind != "pair" for trial in trials)
    tell(
        f"{output}: {counted(len(plan.videos), 'video')} ({redrawn} drawn, {len(plan.videos) - redrawn} up to date) of "
        f"{counted(len(plan.clips), 'clip')} of {', '.join(study.conditions)}",
        f"a rater sees {counted(len(trials), 'video')}, {controls} of them controls, in about "
        f"{plan.minutes:.0f} minutes; sides and orders are balanced over {len(study.schedules)} raters",
        f"hand out {output / 'page'}, or run  facediff study serve {output}",
    )


def serve(
    study: Annotated[Path, Option(metavar="STUDY", reads=True, writes="folder")],
    *,
    name: Annotated[str | None, Option(metavar="HOST")] = None,
    max_raters: Annotated[ranges.Raters | None, Option(metavar="N")] = None,
    page: PageServer,
) -> None:
    """Serve a study to raters, until Ctrl-C. Answers go to STUDY/answers.sqlite, and nowhere else.

    By default only this machine can open the page. --host 0.0.0.0 opens it to the network, without encryption: put a
    web server with HTTPS in front of it, and give its name by --name.

    Args:
        study: folder that `facediff study make` has finished
        name: name under which a web server in front offers the page, such as study.lab.example; requests under other
            names are refused
        max_raters: raters that are let in (default: any number)
        page: where it is served.
    """
    from facediff.study import serve as run

    announce = page.announce(f"serves {study}; Ctrl-C ends it", "answer")
    port = 8000 if page.port is None else page.port
    raters = run(study, host=page.host, port=port, name=name, most_raters=max_raters, ready=announce).raters()
    complete = sum(rater.finished is not None for rater in raters)
    tell(
        f"{study}: {counted(len(raters), 'rater')}, {complete} of them finished; "
        f"`facediff study report {study}` analyses them"
    )


def report(
    studies: Annotated[list[str], Option(metavar="STUDY", reads=True)],
    *,
    answers: Annotated[list[Path] | None, Option(metavar="FILE", many=True, reads=True)] = None,
    output: Annotated[Path | None, Option(also="-o", metavar="OUT", writes="folder")] = None,
    level: Annotated[ranges.Level, Option(metavar="P")] = 0.95,
    bootstrap: Annotated[ranges.Resamples, Option(metavar="N")] = 1000,
    seed: Seed = 0,
    json: Annotated[str | None, Option(metavar="FILE", writes="file", dash=True)] = None,
) -> int:
    """Analyse the answers to studies.

    It prints shares of preference with intervals, and excluded raters; with -o, it writes the table for a paper
    (Markdown, LaTeX, CSV), a page, and every answer (CSV). Several studies, such as biwi=FOLDER mead=FOLDER, become
    columns of one table. Exit status: 0 done, 1 answers had to be set aside.

    Args:
        studies: folders of `facediff study make`, each FOLDER or NAME=FOLDER
        answers: files that raters have downloaded, and folders of them; answers stored by `study serve` are always used
        output: folder for all tables
        level: of intervals
        bootstrap: resamples for intervals between raters; 0: none
        seed: of the resamples
        json: write everything as JSON; - prints it instead of the tables
    """
    folders = named_folders(studies)
    from facediff.study.analysis import analyse_folder
    from facediff.study.definition import read_study
    from facediff.study.report_files import text, write_report
    from facediff.utils.plain_files import json_text, write_json

    options = {"level": level, "resamples": bootstrap, "seed": seed}
    ids = [read_study(folder).id for folder in folders.values()]
    reports = [
        analyse_folder(folder, answers or (), name=name, ignored=ids[:i] + ids[i + 1 :], **options)
        for i, (name, folder) in enumerate(folders.items())
    ]
    everything = {"studies": [analysis.as_dict() for analysis in reports]}
    if json == "-":
        tell(*json_text("--json -", everything, ensure_ascii=True).split("\n"))
    else:
        if json is not None:
            write_json(Path(json), everything)
        for analysis in reports:
            tell(*text(analysis).split("\n"), "")
    if output is not None:
        written = write_report(reports, output)
        if json != "-":
            tell(f"written: {', '.join(str(path) for path in written)}")
    return int(any(note.startswith("set aside") for analysis in reports for note in analysis.notes))
