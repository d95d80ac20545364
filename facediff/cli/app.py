"""The command ``facediff``: finds the subcommand and hands over; imports nothing heavy by itself."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import facediff
from facediff.cli import process
from facediff.errors import FaceDiffError, choices


@dataclass(frozen=True)
class Command:
    """A subcommand, and what the help says of it in a line.

    The ``target``, ``module:function``, is imported only when the command is used. The function is typed and
    documented; its parser is made from that (:mod:`facediff.cli.parsing`). Functions called ``run`` or ``lightning``
    get the command's name and the words as they are.
    """

    target: str
    help: str


COMMANDS = {
    "demo": Command("facediff.cli.demo:demo", "make a corpus, train, test and render a talking face, in ten minutes"),
    "animate": Command("facediff.cli.animate:animate", "animate a face with a recording of speech"),
    "live": Command("facediff.cli.live:live", "animate a face while somebody speaks, in engines and browsers"),
    "adapt": Command("facediff.cli.adapt:adapt", "fine-tune a trained model on a new speaker, or on other voices"),
    "publish": Command("facediff.cli.publish:publish", "a trained model as a folder for others, and on the hub"),
    "export-model": Command(
        "facediff.cli.export_model:export_model", "a trained model as a folder that animates without PyTorch"
    ),
    "serve": Command("facediff.cli.serve:serve", "a page on which an exported model animates, in the browser"),
    "import-checkpoint": Command(
        "facediff.cli.import_checkpoint:import_checkpoint", "make a model of a published method's own checkpoint"
    ),
    "style extract": Command("facediff.cli.style:extract", "write a speaking style as a style vector"),
    "view": Command("facediff.cli.view:view", "one HTML file that plays animations with their speech in any browser"),
    "export": Command("facediff.cli.export:export", "animations for other programs: glb, USD, OBJ, point caches …"),
    "blendshapes": Command("facediff.cli.blendshapes:blendshapes", "animations as weights of blendshapes (ARKit)"),
    "retarget": Command("facediff.cli.retarget:retarget", "transfer animations to another mesh"),
    "fit": Command("facediff.cli.lightning:lightning", "train a model"),
    "validate": Command("facediff.cli.lightning:lightning", "score a model on the validation split"),
    "test": Command("facediff.cli.lightning:lightning", "score a model on the test splits"),
    "predict": Command("facediff.cli.lightning:lightning", "write a model's motion for a split"),
    "evaluate": Command("facediff.cli.evaluate:evaluate", "score anybody's predicted motion files by named protocols"),
    "benchmark": Command("facediff.cli.benchmark:benchmark", "train and score many methods, and write the tables"),
    "benchmark report": Command("facediff.cli.benchmark:report", "write the tables of benchmarks again"),
    "generation-metrics": Command(
        "facediff.cli.generation_metrics:generation_metrics",
        "diversity, liveliness and calibration of a model's samples",
    ),
    "figure frames": Command("facediff.cli.figure:frames", "faces of truth and methods at chosen moments"),
    "figure heatmap": Command("facediff.cli.figure:heatmap", "mean and deviation of motion at every vertex"),
    "figure error": Command("facediff.cli.figure:error", "error at every vertex"),
    "figure lips": Command("facediff.cli.figure:lips", "lip opening over time"),
    "figure training": Command("facediff.cli.figure:training", "training curves of runs"),
    "study make": Command("facediff.cli.study:make", "make a user study: videos side by side and a page of questions"),
    "study serve": Command("facediff.cli.study:serve", "serve a study's page, and store what raters answer"),
    "study report": Command("facediff.cli.study:report", "analyse the answers: preference, scores, agreement; plan"),
    "data prepare": Command("facediff.cli.data:run", "make a corpus folder from a raw distribution"),
    "data check": Command(
        "facediff.cli.data:check", "report what a folder is, what is missing and what is wrong in it"
    ),
    "data pack": Command("facediff.cli.data:pack", "pack a corpus, for object storage and small disks"),
    "data unpack": Command("facediff.cli.data:unpack", "write the corpus folder that a packed corpus holds"),
    "data regions": Command("facediff.cli.data:regions", "draw a corpus's lips and upper face on its mesh"),
    "data import-person": Command("facediff.cli.data:import_person", "make a reconstructed video a corpus entry"),
    "components": Command("facediff.cli.components:components", "list what can be chosen by name"),
}
HELP = ("-h", "--help")
GROUPS = {
    "style": "speaking styles of trained models",
    "figure": "draw the figures of a paper: faces, heat maps, lip and training curves",
    "study": "user studies: make, serve, report",
    "data": "prepare, check and pack corpora, import a reconstructed video",
}


def usage(group: str = "") -> str:
    """The help text of the program or of a group of commands."""
    if group:
        own = {name: command for name, command in COMMANDS.items() if name.startswith(f"{group} ")}
        rows = {name.partition(" ")[2]: command.help for name, command in own.items()}
    else:
        rows = {name: command.help for name, command in COMMANDS.items() if name.partition(" ")[0] not in GROUPS}
        rows |= GROUPS
    program = f"facediff {group}".strip()
    return "\n".join(
        [
            f"usage: {program} <command> [options]",
            "",
            GROUPS[group] if group else "Personalised speech-driven 3D facial animation.",
            "",
            "commands:",
            *(f"  {name:<14}{text}" for name, text in rows.items()),
            "",
            "options:",
            f"  -h, --help  show this text; `{program} <command> --help` lists the options of a command",
            *([] if group else ["  --version   show the version"]),
        ]
    )


def find(words: Sequence[str]) -> tuple[str, list[str]]:
    """The command's name, which may have two words, and the rest."""
    first, rest = words[0], list(words[1:])
    if rest and f"{first} {rest[0]}" in COMMANDS:
        return f"{first} {rest[0]}", rest[1:]
    if first in COMMANDS:
        return first, rest
    if first not in GROUPS:
        known = list(dict.fromkeys(name.partition(" ")[0] for name in COMMANDS))
        raise FaceDiffError(f'there is no command "{first}": {choices(first, known)}')
    name = f"{first} {rest[0]}"
    if name not in COMMANDS:
        known = [each.partition(" ")[2] for each in COMMANDS if each.startswith(f"{first} ")]
        raise FaceDiffError(f'there is no command "{name}": {choices(rest[0], known)}')
    return name, rest[1:]


def main(args: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        args: the words after ``facediff``; those of the process if None, whose streams and signals are then set up.

    Returns:
        the exit status: 0 for success, 2 for something the user can put right; all are in docs/command_line.md.
    """
    if args is not None:
        return answer(args)
    process.prepare_process()
    try:
        return answer(sys.argv[1:])
    finally:
        process.finish_process()


def answer(words: Sequence[str]) -> int:
    """Do what the words say, and report in one sentence what goes wrong; the exit status."""
    name = words[0] if words else ""
    try:
        try:
            rest = words[1:] if name in GROUPS else words
            if not rest or rest[0] in HELP:  # no command, a group alone, or a flag for help in place of a command
                process.tell(*usage(name if name in GROUPS else "").split("\n"))
                return 0 if words[-1:] and words[-1] in HELP else 2
            if name == "--version":
                process.tell(facediff.__version__)
                return 0
            name, rest = find(words)
            return run(name, rest)
        finally:
            process.flush()
    except BrokenPipeError:
        # Whoever read our output (`| head`) has had enough; Python would say so once more when it ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return process.READER_GONE
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] == "facediff":
            return process.report(error)
        return process.fail(
            f'`facediff {name}` needs the package "{error.name}", which is not installed: '
            f'run  pip install "facediff[all]"'
        )
    except (Exception, KeyboardInterrupt, process.StoppedBySignal) as error:
        return process.report(error)


def run(name: str, arguments: Sequence[str]) -> int:
    """Import a command and run it with its arguments."""
    from facediff.utils.destinations import reading

    function = load(name)
    with reading():  # what the parser finds to be an input is not overwritten until the command has ended
        if function.__name__ in ("run", "lightning"):  # reads its words by a parser of its own
            return int(function(name, arguments) or 0)
        from facediff.cli.parsing import arguments_of

        return int(function(**arguments_of(function, f"facediff {name}", arguments)) or 0)


def load(name: str) -> Callable[..., int | None]:
    """Import a command's function."""
    module, _, function = COMMANDS[name].target.partition(":")
    found: Callable[..., int | None] = getattr(importlib.import_module(module), function)
    return found
