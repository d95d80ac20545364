"""The command ``facediff``: finds the subcommand and hands over; imports nothing heavy by itself.

Other packages add commands of one word by entry points in the group ``facediff.command``, with a typed
function as the target, as in this package::

    [project.entry-points."facediff.command"]
    my-command = "my_package.my_module:my_command"
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import facediff
from facediff.cli import process
from facediff.errors import FaceDiffError, MissingExtraError, choices, import_failure
from facediff.utils.paths import from_home

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint


@dataclass(frozen=True)
class Command:
    """A subcommand and its line in the help.

    The ``target``, ``module:function`` in ``facediff.cli``, is imported only when it is used. The function is typed and
    documented; its parser is made from that (:mod:`facediff.cli.parsing`). Functions called ``run`` or ``lightning``
    get the command's name and its arguments as they are.

    ``extra`` is named where a package is missing, unless the code that needs the package names another one; it is empty
    for commands that the base install runs.
    """

    target: str
    help: str
    extra: str = "train"


COMMANDS = {
    "demo": Command(
        "demo:demo", "make a corpus, train, test and render a talking face, in ten minutes", "train,puppet,render"
    ),
    "animate": Command("animate:animate", "animate a face with a recording of speech"),
    "live": Command("live:live", "animate live speech, and send it to engines and browsers"),
    "person": Command("track:person", "make a model of a person from a video", "prepare,render,onnx"),
    "adapt": Command("adapt:adapt", "fine-tune a trained model on a new speaker, or on other voices"),
    "publish": Command("publish:publish", "write a trained model as a folder for others, or send it to the hub"),
    "export-model": Command(
        "export_model:export_model", "write a trained model as a folder that animates without PyTorch", "onnx"
    ),
    "serve": Command("serve:serve", "serve a page on which an exported model animates in the browser", "serve"),
    "import-checkpoint": Command(
        "import_checkpoint:import_checkpoint", "convert the checkpoint of a published method's authors"
    ),
    "style extract": Command("style:extract", "write a speaking style as a style vector"),
    "view": Command("view:view", "write one HTML file that plays animations with their speech in any browser", "mesh"),
    "export": Command("export:export", "write animations for other programs: glb, USD, OBJ, point caches …", "mesh"),
    "blendshapes": Command("blendshapes:blendshapes", "write animations as weights of blendshapes (ARKit)", "mesh"),
    "retarget": Command("retarget:retarget", "transfer animations to another mesh", "mesh"),
    "fit": Command("lightning:lightning", "train a model"),
    "validate": Command("lightning:lightning", "score a model on the validation split"),
    "test": Command("lightning:lightning", "score a model on the test splits"),
    "predict": Command("lightning:lightning", "write a model's motion for a split"),
    "evaluate": Command("evaluate:evaluate", "score predicted motion files by named protocols"),
    "benchmark": Command("benchmark:benchmark", "train and score many methods, and write the tables"),
    "benchmark report": Command("benchmark:report", "write the tables of benchmarks again"),
    "benchmark referee": Command(
        "referee:referee", "compare models of any kind on one face, by phonemes", "train,puppet"
    ),
    "generation-metrics": Command(
        "generation_metrics:generation_metrics", "diversity, liveliness and calibration of a model's samples"
    ),
    "figure frames": Command("figure:frames", "faces of truth and methods at chosen moments", "figures"),
    "figure heatmap": Command("figure:heatmap", "mean and deviation of motion at every vertex", "figures"),
    "figure lips": Command("figure:lips", "lip opening over time", "figures"),
    "study make": Command("study:make", "make a user study: videos side by side and a page of questions", "study"),
    "study serve": Command("study:serve", "serve a study's page, and store the answers", "study"),
    "study report": Command("study:report", "analyse the answers: shares of preference with intervals", "study"),
    "data prepare": Command("data:run", "make a corpus folder from a raw distribution", "prepare"),
    "data check": Command("data:check", "recognise a folder, and report missing and wrong parts"),
    "data pack": Command("data:pack", "pack a corpus, for object storage and small disks", "packed"),
    "data unpack": Command("data:unpack", "write the corpus folder that a packed corpus holds", "packed"),
    "data track": Command("track:track", "make a corpus of people from their videos", "prepare,render,onnx"),
    "data align": Command("data:align", "find the phones of people's recordings, and cut them", "align"),
    "data import-take": Command("data:import_take", "make a recording of Live Link Face a corpus entry", "prepare"),
    "data import-person": Command("data:import_person", "make a reconstructed video a corpus entry", "prepare"),
    "components": Command("components:components", "list components and other names to choose from"),
    "check-install": Command("check_install:check_install", "print versions and devices, and try the bundled model"),
}
HELP = ("-h", "--help")
GROUPS = {
    "style": "speaking styles of trained models",
    "figure": "draw the figures of a paper: faces, heat maps and lip curves",
    "study": "user studies: make, serve, report",
    "data": "track faces in videos; align recordings; prepare, check and pack corpora",
}


def installed_commands() -> dict[str, EntryPoint]:
    """The commands that installed packages add, by name; they cannot replace facediff's."""
    from importlib.metadata import entry_points

    built_in = {name.partition(" ")[0] for name in COMMANDS}
    return {point.name: point for point in entry_points(group="facediff.command") if point.name not in built_in}


def usage(group: str = "") -> str:
    """The help text of the program or of a group of commands."""
    if group:
        rows = {
            name.partition(" ")[2]: command.help for name, command in COMMANDS.items() if name.startswith(f"{group} ")
        }
    else:
        rows = {name: command.help for name, command in COMMANDS.items() if name.partition(" ")[0] not in GROUPS}
        rows |= GROUPS
        rows |= {
            name: f"of the package {point.dist.name if point.dist else point.value}"
            for name, point in sorted(installed_commands().items())
        }
    program = f"facediff {group}".strip()
    width = max(map(len, rows)) + 2
    return "\n".join(
        [
            f"usage: {program} <command> [options]",
            "",
            GROUPS[group] if group else "Personalised speech-driven 3D facial animation.",
            "",
            "commands:",
            *(f"  {name:<{width}}{text}" for name, text in rows.items()),
            "",
            "options:",
            f"  -h, --help  show this text; `{program} <command> --help` lists the options of a command",
            *([] if group else ["  --version   show the version"]),
        ]
    )


def find(arguments: Sequence[str]) -> tuple[str, list[str]]:
    """The command's name, which may have two words, and the rest."""
    first, *rest = arguments
    if rest and f"{first} {rest[0]}" in COMMANDS:
        return f"{first} {rest[0]}", rest[1:]
    if first in COMMANDS:
        return first, rest
    if first in GROUPS:
        word, name = rest[0], f"{first} {rest[0]}"
        commands = [command.partition(" ")[2] for command in COMMANDS if command.startswith(f"{first} ")]
    else:
        installed = installed_commands()
        if first in installed:
            return first, rest
        word = name = first
        commands = [*dict.fromkeys(command.partition(" ")[0] for command in COMMANDS), *installed]
    raise FaceDiffError(f'there is no command "{name}": {choices(word, commands)}')


def main(args: Sequence[str] | None = None) -> int:
    """Run the command line; the exit status, as docs/command_line.md lists them.

    ``args`` are the words after ``facediff``; if None, the process's own, with its streams and signals set up.
    """
    if args is not None:
        return answer(args)
    process.prepare_process()
    try:
        return answer(sys.argv[1:])
    finally:
        process.finish_process()


def answer(arguments: Sequence[str]) -> int:
    """Run a command, and report an error in one sentence; the exit status."""
    arguments = [from_home(word) for word in arguments]
    name = arguments[0] if arguments else ""
    try:
        try:
            rest = arguments[1:] if name in GROUPS else arguments
            if not rest or rest[0] in HELP:  # no command, a group alone, or a flag for help in place of a command
                process.tell(*usage(name if name in GROUPS else "").split("\n"))
                return 0 if arguments[-1:] and arguments[-1] in HELP else 2
            if name == "--version":
                process.tell(facediff.__version__)
                return 0
            name, rest = find(arguments)
            return run(name, rest)
        finally:
            process.flush()
    except BrokenPipeError:
        # The reader of our output (`| head`) has ended; Python would report that once more when it exits.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return process.READER_GONE
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] == "facediff":
            return process.report(error)
        return process.report(missing_extra(name, error.name.split(".")[0]))
    except MissingExtraError as error:
        return process.report(missing_extra(name, *error.arguments))
    except (Exception, KeyboardInterrupt, process.StoppedBySignal) as error:
        return process.report(error)


def missing_extra(name: str, package: str, extra: str = "", feature: str = "") -> MissingExtraError:
    """The error of a command that lacks a package: with all extras of the command, so that it is installed once."""
    extras = COMMANDS[name].extra if name in COMMANDS else "all"
    if extra and extra not in extras.split(","):
        return MissingExtraError(package, extra, feature)
    return MissingExtraError(package, extras, f"`facediff {name}`")


def run(name: str, arguments: Sequence[str]) -> int:
    """Import a command and run it with its arguments."""
    from facediff.utils.output_paths import reading

    function = load(name)
    with (
        process.notes(),
        reading(),
    ):  # files that the parser takes as inputs are not overwritten until the command has ended
        if function.__name__ in ("run", "lightning"):  # it has a parser of its own
            return int(function(name, arguments) or 0)
        from facediff.cli.parsing import arguments_of

        return int(function(**arguments_of(function, f"facediff {name}", arguments)) or 0)


def load(name: str) -> Callable[..., int | None]:
    """Import a command's function."""
    if name not in COMMANDS:
        point = installed_commands()[name]
        try:
            installed: Callable[..., int | None] = point.load()
        except Exception as error:  # another package's module may raise anything
            raise FaceDiffError(
                f"the command {name} ({point.value}) cannot be imported: {import_failure(error)}"
            ) from error
        return installed
    module, _, function = COMMANDS[name].target.partition(":")
    command: Callable[..., int | None] = getattr(importlib.import_module(f"facediff.cli.{module}"), function)
    return command
