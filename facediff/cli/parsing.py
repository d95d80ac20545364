"""Parsers made from the signatures and docstrings of the command functions.

A command is a typed function. Its parameters are its options: the name, the type hint, the default and the docstring's
``Args:`` entry become flag, type, default and help text. A parameter that may be given by position in Python is a
positional argument of the command, too. A parameter with a dataclass as its type is a group of options, which several
commands may share: the dataclass's fields are the options, and the function receives an instance.

It is the standard library's argparse that splits the words; this module adds the conversion to the declared types
(:mod:`facediff.utils.hints`), groups, errors of one or two sentences, and checks of the files and folders that options
declare; files with names that a command finds later are checked where they are written (:mod:`facediff.utils.files`).
"""

from __future__ import annotations

import argparse
import collections.abc
import dataclasses
import inspect
import os
import re
import types
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn, Union, get_args, get_origin

from facediff.errors import FaceDiffError, choices, refuse_idle
from facediff.utils.files import check_folder_writable, check_writable
from facediff.utils.hints import Range, extras_of, range_of, read, shown
from facediff.utils.option import Option
from facediff.utils.output_paths import protect, refuse_equal, refuse_overwriting

MISSING = inspect.Parameter.empty


@dataclass(frozen=True)
class Parameter:
    """One option or positional argument of a command, read from a signature."""

    name: str
    hint: Any
    default: Any
    help: str
    option: Option
    positional: bool
    range: Range | None = None

    @property
    def flag(self) -> str:
        """The name as it is typed; the opposite's for a switch that is on by default."""
        if self.positional:
            return self.name
        return f"--{'no-' if self.is_switch and self.default is True else ''}{self.name.replace('_', '-')}"

    @property
    def is_path(self) -> bool:
        """Whether a value is a path; texts may hold one as well."""
        return self.value_type is Path

    @property
    def is_switch(self) -> bool:
        """Whether the option is a flag without a value."""
        return self.hint is bool

    @property
    def length(self) -> int | None:
        """How many values a tuple has; None for other types."""
        hint = without_none(self.hint)
        return len(get_args(hint)) if get_origin(hint) is tuple else None

    @property
    def is_list(self) -> bool:
        """Whether any number of values may be given."""
        return get_origin(without_none(self.hint)) in (list, collections.abc.Sequence)

    @property
    def has_commas(self) -> bool:
        """Whether one word holds all values of a list, separated by commas: so for a ``Sequence``."""
        return get_origin(without_none(self.hint)) is collections.abc.Sequence

    @property
    def value_type(self) -> Any:  # noqa: ANN401 - a type or a type hint
        """The type of a single value."""
        hint = without_none(self.hint)
        if get_origin(hint) in (Union, types.UnionType):  # Python takes more; the command line, the first of them
            return get_args(hint)[0]
        return get_args(hint)[0] if self.is_list or self.length else hint

    @property
    def is_number(self) -> bool:
        """Whether values are numbers, which need a range."""
        return self.value_type in (int, float)

    @property
    def given_once(self) -> bool:
        """Whether a second value would replace the first one without a word."""
        repeated = self.is_list and not self.has_commas and not self.option.many
        return not (self.positional or self.is_switch or repeated)

    def read(self, word: str) -> Any:  # noqa: ANN401 - the type of the hint
        """One word of the command line as a value."""
        hint = Annotated[self.value_type, self.range or Range()] if self.is_number else self.value_type
        value, expected = None, "a path" if self.is_path else "text"
        try:
            if self.is_number or get_origin(hint) is Literal:
                value = read(hint, word)
            elif word.strip():
                value = Path(word) if self.is_path else word
        except ValueError as error:
            expected = str(error)
        if self.has_commas and value is not None:
            names = [name.strip() for name in word.split(",")]
            value = names if "" not in names and len({*names}) == len(names) else None
            expected = "different names with commas between"
        if value is None:
            bare = f"; {self.flag} without a value goes to the end" if self.option.bare is not None else ""
            raise FaceDiffError(f"{self.flag} {shown(word)}: expected {expected}{bare}")
        return value


Parameters = Mapping[str, "Parameter | OptionGroup"]
"""A command's parameters by name."""


@dataclass(frozen=True)
class OptionGroup:
    """A dataclass parameter: options that several commands share."""

    dataclass: type
    title: str
    details: str
    parameters: list[Parameter]


def without_none(hint: Any) -> Any:  # noqa: ANN401
    """``X`` for ``X | None``; any other hint as it is."""
    if get_origin(hint) in (Union, types.UnionType):
        parts = [part for part in get_args(hint) if part is not type(None)]
        return parts[0] if len(parts) == 1 else hint
    return hint


def parameters_of(function: Callable[..., Any]) -> dict[str, Parameter | OptionGroup]:
    """The parameters of a command function, or the fields of a dataclass."""
    import docstring_parser

    parsed = docstring_parser.parse(inspect.getdoc(function) or "", docstring_parser.DocstringStyle.GOOGLE)
    helps = {entry.arg_name: plain_text(entry.description or "") for entry in parsed.params}
    hints, annotations = typing.get_type_hints(function), typing.get_type_hints(function, include_extras=True)
    parameters: dict[str, Parameter | OptionGroup] = {}
    for name, parameter in inspect.signature(function).parameters.items():
        if parameter.kind in (parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL):
            continue
        hint, annotated = hints[name], annotations[name]
        if dataclasses.is_dataclass(hint):
            group = typing.cast(type, hint)
            fields = [field for field in parameters_of(group).values() if isinstance(field, Parameter)]
            fields = [field for field in fields if not field.option.hidden]
            parameters[name] = OptionGroup(group, *summary_of(group), fields)
            continue
        option = next((extra for extra in extras_of(annotated) if isinstance(extra, Option)), Option())
        # The fields of a dataclass may be given by position in Python, but are options of the command line.
        positional = parameter.kind is not parameter.KEYWORD_ONLY and not inspect.isclass(function)
        parameters[name] = Parameter(
            name, hint, parameter.default, helps.get(name, ""), option, positional, range_of(annotated)
        )
    return parameters


def flat(parameters: Parameters) -> list[Parameter]:
    """All parameters, also in groups."""
    entries = ([entry] if isinstance(entry, Parameter) else entry.parameters for entry in parameters.values())
    return [parameter for entry in entries for parameter in entry]


def plain_text(text: str) -> str:
    """A docstring's text for a terminal: no double backquotes, no escapes, no roles, one space between words."""
    text = re.sub(r":\w+:`~?(?:[\w.]*\.)?(\w+)`", r"\1", text)
    return " ".join(text.replace("``", "").replace("\\|", "|").split())


def summary_of(documented: object) -> tuple[str, str]:
    """A docstring's first line, and the text between it and its sections."""
    import docstring_parser

    parsed = docstring_parser.parse(inspect.getdoc(documented) or "", docstring_parser.DocstringStyle.GOOGLE)
    details = inspect.cleandoc(parsed.long_description or "").replace("``", "")
    return plain_text(parsed.short_description or ""), details


class HelpFormatter(argparse.RawDescriptionHelpFormatter):
    """Help with defaults, where they are informative."""

    def _get_help_string(self, action: argparse.Action) -> str:
        text = action.help or ""
        # By type, since 0 and 1 equal False and True.
        says_nothing = action.default is None or isinstance(action.default, bool)
        quiet = says_nothing or action.default in ([], argparse.SUPPRESS) or not action.option_strings
        return text if quiet or "(default" in text else f"{text} (default: %(default)s)"


def make_parser(parameters: Parameters, program: str, summary: str, details: str = "") -> argparse.ArgumentParser:
    """The parser of a command, such as ``facediff export``; its help begins with a summary and ends with details."""

    class CommandParser(argparse.ArgumentParser):
        def error(self, message: str) -> NoReturn:
            raise FaceDiffError(f"{message}; see `{program} --help`")

    parser = CommandParser(
        prog=program, description=summary, epilog=details, formatter_class=HelpFormatter, allow_abbrev=False
    )
    for entry in parameters.values():
        if isinstance(entry, Parameter):
            add(parser, entry)
        else:
            group = parser.add_argument_group(entry.title.rstrip("."), entry.details or None)
            for parameter in entry.parameters:
                add(group, parameter)
    return parser


def add(parser: Any, parameter: Parameter) -> None:  # noqa: ANN401 - argparse's groups have no public type
    """Add one parameter to a parser or to a group of it."""
    option = parameter.option
    flags = [*([option.also] if option.also else []), parameter.flag]
    text = parameter.help if parameter.range is None else f"{parameter.help}; {parameter.range}"
    keywords: dict[str, Any] = {"help": text.replace("%", "%%")}
    if parameter.is_switch:
        action = "store_false" if parameter.default else "store_true"
        parser.add_argument(*flags, dest=parameter.name, action=action, **keywords)
        return
    # argparse calls the function with defaults that are texts, too; type hints' defaults are values already.
    keywords["type"] = lambda word: word if word == parameter.default else parameter.read(word)
    if option.metavar:
        keywords["metavar"] = option.metavar
    elif get_origin(parameter.value_type) is Literal:
        keywords["metavar"] = "{" + ",".join(str(value) for value in get_args(parameter.value_type)) + "}"
    if parameter.length:
        keywords["nargs"] = parameter.length
    elif parameter.is_list and not parameter.has_commas:
        keywords |= {"nargs": "+"} if option.many or parameter.positional else {"action": "append"}
    if option.bare is not None:
        keywords |= {"nargs": "?", "const": option.bare}
    if parameter.positional:
        if parameter.default is not MISSING:
            keywords |= {"nargs": "*" if parameter.is_list else "?", "default": parameter.default}
        parser.add_argument(parameter.name, **keywords)
        return
    if parameter.default is MISSING:
        keywords["required"] = True
    else:
        keywords["default"] = list(parameter.default) if isinstance(parameter.default, tuple) else parameter.default
    parser.add_argument(*flags, dest=parameter.name, **keywords)


def parse(
    parameters: Parameters, arguments: Sequence[str], program: str, summary: str = "", details: str = ""
) -> dict[str, Any]:
    """The values of a command's parameters; a group is an instance of its dataclass."""
    options = flat(parameters)
    end = arguments.index("--") if "--" in arguments else len(arguments)
    arguments = [*map(with_dashes, arguments[:end]), *arguments[end:]]
    refuse_repeated(options, arguments)
    namespace, rest = make_parser(parameters, program, summary, details).parse_known_args(arguments)
    if rest:
        word = rest[0].partition("=")[0]
        near = choices(word, [p.flag for p in options if not p.positional]).partition("known are")[0].strip()
        hint = f"there is no such option; {near}" if word.startswith("-") else "one argument too many;"
        raise FaceDiffError(f"{word}: {hint} see `{program} --help`")
    values = vars(namespace)
    for parameter in options:
        value = values[parameter.name]
        if parameter.length and value is not None:
            values[parameter.name] = tuple(value)
        if parameter.option.check is not None:
            parameter.option.check(value)
    refuse_ineffective(options, values)
    check_paths(options, values)
    return {
        name: values[name]
        if isinstance(entry, Parameter)
        else entry.dataclass(**{p.name: values[p.name] for p in entry.parameters})
        for name, entry in parameters.items()
    }


def with_dashes(word: str) -> str:
    """An option as the command spells it: ``--frame_rate`` is ``--frame-rate``."""
    flag, equals, value = word.partition("=")
    return f"{flag.replace('_', '-')}{equals}{value}" if word.startswith("--") else word


def refuse_repeated(parameters: Sequence[Parameter], arguments: Sequence[str]) -> None:
    """Refuse an option that is given twice: argparse would drop the first value without a word."""
    once = {flag: p for p in parameters if p.given_once for flag in (p.flag, p.option.also)}
    names: set[str] = set()
    for word in arguments[: arguments.index("--") if "--" in arguments else None]:
        parameter = once.get(word.partition("=")[0] if word.startswith("--") else word[:2])
        if parameter is not None and parameter.name in names:
            fix = "give all its values after one" if parameter.is_list else "give it once"
            raise FaceDiffError(f"{parameter.flag}: is given twice; {fix}")
        names |= {parameter.name} if parameter is not None else set()


def refuse_ineffective(parameters: Sequence[Parameter], values: Mapping[str, Any]) -> None:
    """Refuse options that are given, but would change nothing beside the others, or for want of another one."""
    present = {p.name: p for p in parameters if values[p.name] not in (p.default, None, [])}
    for parameter in present.values():
        needed, excluding = parameter.option.needs.split(), present.keys() & parameter.option.without.split()
        if needed and not present.keys() & needed:
            flags = " or ".join(p.flag for p in parameters if p.name in needed)
            refuse_idle(f"has no effect without {flags}", **{parameter.name: True})
        for name in excluding:
            refuse_idle(f"has no effect with {present[name].flag}", **{parameter.name: True})


def changed(options: Any) -> dict[str, bool]:  # noqa: ANN401 - an instance of a dataclass
    """Which fields of a group of options differ from their defaults."""
    return {field.name: getattr(options, field.name) != field.default for field in dataclasses.fields(options)}


def arguments_of(function: Callable[..., Any], program: str, arguments: Sequence[str]) -> dict[str, Any]:
    """The arguments of a command function, read from a command line."""
    return parse(parameters_of(function), arguments, program, *summary_of(function))


def check_paths(parameters: Sequence[Parameter], values: Mapping[str, Any]) -> None:
    """Refuse, before any work is done, files that cannot be read or written, and outputs that are inputs.

    The inputs are protected from then on: no output of the command replaces one of them.
    """
    inputs: list[Path] = []
    outputs: list[Path] = []
    for parameter in parameters:
        option = parameter.option
        for path in given_paths(parameter, values.get(parameter.name)):
            problem, cause = "", typing.cast(Exception | None, None)
            try:
                written = option.writes and not (option.reads and path.exists())
                if str(path) == "-" and (written or option.dash):
                    problem = "" if option.dash else "is not standard output here; expected the name of a file"
                elif option.suffixes and path.suffix.lower() not in option.suffixes:
                    problem = f"expected a name that ends in {' or '.join(option.suffixes)}"
                elif written:
                    problem = output_problem(option, path)
                    outputs.append(path)
                elif parameter.is_path or path.exists():  # a text may be a name, or a path
                    problem = input_problem(option, path)
                    inputs.append(path)
            except FaceDiffError as error:
                problem, cause = str(error).removeprefix(f"{path}: "), error
            except OSError as error:
                problem, cause = str(error.strerror), error
            if problem:
                raise FaceDiffError(f"{parameter.flag} {path}: {problem}") from cause
    refuse_equal(outputs)
    refuse_overwriting(inputs, outputs)
    protect(inputs)


def given_paths(parameter: Parameter, value: Any) -> Iterator[Path]:  # noqa: ANN401
    """The paths in a value; in a text, such as ``NAME=FOLDER`` or ``a.npy:0.3,b.npy:0.7``, all that may be one."""
    option = parameter.option
    if value is None or not (parameter.is_path or option.reads or option.writes):
        return
    for entry in value if isinstance(value, list | tuple) else [value]:
        if isinstance(entry, Path):
            yield entry
        elif isinstance(entry, str) and option.writes:
            yield Path(entry)
        elif isinstance(entry, str):
            parts = [entry, *entry.split(",")]
            parts += [part.partition("=")[2] for part in parts]
            parts += [re.split(r"[:>]", part)[0] for part in parts]
            yield from (Path(part) for part in dict.fromkeys(parts) if part and exists(part))


def exists(text: str) -> bool:
    """Whether a text is the path of a file or folder; no text is too long for that."""
    try:
        return os.path.lexists(text)
    except (OSError, ValueError):
        return False


def output_problem(option: Option, path: Path) -> str:
    """Why a file or a folder cannot be written; empty if it can."""
    if option.new and path.exists() and (not path.is_dir() or any(path.iterdir())):
        return "exists already; choose another folder, or remove it"
    if option.writes == "folder" or (option.writes == "file or folder" and path.is_dir()):
        check_folder_writable(path)
    else:
        check_writable(path)
    return ""


def input_problem(option: Option, path: Path) -> str:
    """Why a file or a folder cannot be read; empty if it can."""
    present = {"file": path.is_file, "folder": path.is_dir}.get(option.exists, path.exists)()
    if option.exists and not present:
        return f"no such {option.exists}"
    if path.exists() and not path.is_file() and not path.is_dir():
        return "is a device or a pipe; expected a file, or a folder of files"
    return "cannot be read (permission denied)" if path.exists() and not os.access(path, os.R_OK) else ""
