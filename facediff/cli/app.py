"""The command ``facediff``: finds the subcommand and hands over; imports nothing heavy by itself."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass

import facediff
from facediff.errors import FaceDiffError, choices


@dataclass(frozen=True)
class Command:
    """A subcommand.

    Attributes:
        module: where its ``run(name, arguments)`` lives; imported only when the command is used.
        help: one line.
    """

    module: str
    help: str


COMMANDS = {
    "demo": Command("facediff.cli.demo", "make a corpus, train, test and render a talking face, in ten minutes"),
    "animate": Command("facediff.cli.animate", "animate a face with a recording of speech"),
    "adapt": Command("facediff.cli.adapt", "let a trained model get to know one person more"),
    "style": Command("facediff.cli.style", "write how a person moves as a style vector"),
    "view": Command("facediff.cli.view", "one HTML file that plays animations with their speech in any browser"),
    "export": Command("facediff.cli.export", "animations for other programs: glb, USD, OBJ, point caches …"),
    "blendshapes": Command("facediff.cli.blendshapes", "animations as weights of blendshapes (ARKit)"),
    "retarget": Command("facediff.cli.retarget", "carry animations over to another mesh"),
    "fit": Command("facediff.cli.lightning", "train a model"),
    "validate": Command("facediff.cli.lightning", "score a model on the validation split"),
    "test": Command("facediff.cli.lightning", "score a model on the test splits"),
    "predict": Command("facediff.cli.lightning", "write a model's motion for a split"),
    "evaluate": Command("facediff.cli.evaluate", "score anybody's predicted motion files by named protocols"),
    "figure": Command("facediff.cli.figure", "draw the figures of a paper: faces, heat maps, lip and training curves"),
    "data": Command("facediff.cli.data", "prepare and check corpora, import a person's video"),
    "components": Command("facediff.cli.components", "list what can be chosen by name"),
}


def usage() -> str:
    """The top-level help."""
    lines = [
        "usage: facediff <command> [options]",
        "",
        "Personalised speech-driven 3D facial animation.",
        "",
        "commands:",
        *(f"  {name:<12}{command.help}" for name, command in COMMANDS.items()),
        "",
        "options:",
        "  -h, --help  this text; `facediff <command> --help` tells a command's options",
        "  --version   the version",
    ]
    return "\n".join(lines)


def main(args: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        args: the words after ``facediff``; those of the process if None.

    Returns:
        the exit status: 0 for success, 2 for something the user can put right.
    """
    words = list(sys.argv[1:] if args is None else args)
    if not words or words[0] in ("-h", "--help"):
        print(usage())
        return 0 if words else 2
    if words[0] == "--version":
        print(facediff.__version__)
        return 0
    name, rest = words[0], words[1:]
    if name not in COMMANDS:
        return fail(f'there is no command "{name}": {choices(name, COMMANDS)}')
    try:
        status: int = importlib.import_module(COMMANDS[name].module).run(name, rest)
        sys.stdout.flush()
    except FaceDiffError as error:
        return fail(str(error))
    except KeyboardInterrupt:
        return fail("interrupted", 130)
    except BrokenPipeError:
        # Whoever read our output (`| head`) has had enough; Python would say so once more when it ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] == "facediff":
            raise
        return fail(
            f'`facediff {name}` needs the package "{error.name}", which is not installed: '
            f'run  pip install "facediff[all]"'
        )
    return status


def fail(message: str, status: int = 2) -> int:
    """Print one sentence to standard error and give back the exit status."""
    print(f"facediff: error: {message}", file=sys.stderr)
    return status
