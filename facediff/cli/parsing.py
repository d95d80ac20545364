"""Parsers made from the signatures and docstrings of the command functions.

A command is a typed function. Its parameters are its options: the name, the type hint, the default and the docstring's
``Args:`` entry become flag, type, default and help text. Parameters without a default that may be given by position
are positional arguments. A parameter whose type is a dataclass is a group of options that several commands share; its
fields are options as well, and the function gets an instance.

Type conversion is jsonargparse's; this module adds what that library leaves open: flags with dashes, options that may
stand without a value, ranges of numbers, and one-sentence errors.
"""

from __future__ import annotations

import argparse
import dataclasses
import inspect
import math
import re
import types
import typing
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NoReturn, Union, get_args, get_origin

from facediff.errors import FaceDiffError, choices

MISSING = inspect.Parameter.empty


@dataclass(frozen=True)
class Option:
    """What a type hint cannot say about an option; used as ``Annotated[float, Option(...)]``.

    Attributes:
        short: a short flag such as ``-o``.
        metavar: the value's name in the help text.
        many: for lists, whether one flag takes several values; else the flag is repeated.
        bare: the value if the option is given without one; None if a value is needed.
        least: smallest number allowed; infinity and NaN are never allowed.
        most: largest number allowed.
        above: number that the value must exceed.
    """

    short: str = ""
    metavar: str = ""
    many: bool = False
    bare: Any = None
    least: float | None = None
    most: float | None = None
    above: float | None = None


@dataclass(frozen=True)
class Parameter:
    """One option or positional argument of a command, read from a signature."""

    name: str
    hint: Any
    default: Any
    help: str
    option: Option
    positional: bool

    @property
    def flag(self) -> str:
        """The name as it is typed."""
        if self.positional:
            return self.name
        negative = self.default is True and self.is_switch
        return f"--{'no-' if negative else ''}{self.name.replace('_', '-')}"

    @property
    def is_switch(self) -> bool:
        """Whether the option is a flag without a value."""
        return self.hint is bool

    @property
    def is_list(self) -> bool:
        """Whether several values may be given."""
        return get_origin(without_none(self.hint)) in (list, tuple, Sequence)

    def check(self, value: Any) -> None:  # noqa: ANN401
        """Refuse numbers outside the range.

        Raises:
            FaceDiffError: naming the option and the range.
        """
        for number in value if isinstance(value, list) else [value]:
            if isinstance(number, bool) or not isinstance(number, int | float):
                continue
            o = self.option
            inside = (
                math.isfinite(number)
                and (o.least is None or number >= o.least)
                and (o.most is None or number <= o.most)
                and (o.above is None or number > o.above)
            )
            if not inside:
                raise FaceDiffError(f"{self.flag} {number}: out of range; expected {self.expected()}")

    def expected(self) -> str:
        """What values the parameter takes, in words."""
        hint, o = without_none(self.hint), self.option
        if self.is_list:
            hint = get_args(hint)[0]
        if get_origin(hint) is Literal:
            return f"one of {', '.join(str(value) for value in get_args(hint))}"
        noun = {int: "a whole number", float: "a finite number", str: "text"}.get(hint, "a path")
        limits = [f"above {o.above:g}"] if o.above is not None else []
        limits += [f"of at least {o.least:g}"] if o.least is not None else []
        limits += [f"at most {o.most:g}"] if o.most is not None else []
        return " ".join([noun, " and ".join(limits)]).strip()


def without_none(hint: Any) -> Any:  # noqa: ANN401
    """``X`` for ``X | None``; any other hint as it is."""
    if get_origin(hint) in (Union, types.UnionType):
        kept = [part for part in get_args(hint) if part is not type(None)]
        return kept[0] if len(kept) == 1 else hint
    return hint


def parameters_of(function: Callable[..., Any]) -> dict[str, list[Parameter] | Parameter]:
    """The parameters of a command function; those of a dataclass parameter as a list."""
    helps = help_texts(function)
    hints = typing.get_type_hints(function, include_extras=True)
    found: dict[str, list[Parameter] | Parameter] = {}
    for name, parameter in inspect.signature(function).parameters.items():
        if name == "return" or parameter.kind in (parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL):
            continue
        hint = hints[name]
        if dataclasses.is_dataclass(hint):
            group = parameters_of(typing.cast(type, hint))
            found[name] = [each for each in group.values() if isinstance(each, Parameter)]
            continue
        option = Option()
        if get_origin(hint) is Annotated:
            hint, *extras = get_args(hint)
            option = next((extra for extra in extras if isinstance(extra, Option)), option)
        # A required parameter that may be given by position is a positional argument of the command, too.
        positional = parameter.default is MISSING and parameter.kind is not parameter.KEYWORD_ONLY
        found[name] = Parameter(name, hint, parameter.default, helps.get(name, ""), option, positional)
    return found


def help_texts(function: Callable[..., Any]) -> dict[str, str]:
    """What a docstring's ``Args:`` or ``Attributes:`` section says of each parameter, without reST marks."""
    import docstring_parser

    parsed = docstring_parser.parse(inspect.getdoc(function) or "", docstring_parser.DocstringStyle.GOOGLE)
    return {p.arg_name: plain_text(p.description or "") for p in parsed.params}


def plain_text(text: str) -> str:
    """A docstring's text for a terminal: no double backquotes, no roles, one space between words."""
    text = re.sub(r":\w+:`~?(?:[\w.]*\.)?(\w+)`", r"\1", text)
    return " ".join(text.replace("``", "").split())


def summary_of(function: Callable[..., Any]) -> tuple[str, str]:
    """A docstring's first line, and what stands between it and its sections."""
    import docstring_parser

    parsed = docstring_parser.parse(inspect.getdoc(function) or "", docstring_parser.DocstringStyle.GOOGLE)
    long = inspect.cleandoc(parsed.long_description or "").replace("``", "")
    return plain_text(parsed.short_description or ""), long


class HelpFormatter(argparse.RawDescriptionHelpFormatter):
    """Help without type names: metavars and texts say what a value is; defaults are added where they say something."""

    def _get_help_string(self, action: argparse.Action) -> str:
        text = action.help or ""
        quiet = action.default in (None, False, True, [], argparse.SUPPRESS) or not action.option_strings
        return text if quiet or "(default" in text else f"{text} (default: %(default)s)"

    def _format_action_invocation(self, action: argparse.Action) -> str:
        # The spelling with underscores is accepted, but not advertised twice.
        strings = [flag for flag in action.option_strings if not flag.startswith("--") or "_" not in flag]
        shown = argparse.Action(strings or action.option_strings, action.dest, action.nargs, metavar=action.metavar)
        shown.choices = action.choices
        return super()._format_action_invocation(shown if action.option_strings else action)


def make_parser(function: Callable[..., Any], program: str) -> Any:  # noqa: ANN401 - jsonargparse is imported late
    """The parser of a command function.

    Args:
        function: the command.
        program: what is typed for it, such as ``facediff export``.
    """
    import jsonargparse

    class Parser(jsonargparse.ArgumentParser):
        def error(self, message: str, ex: Exception | None = None) -> NoReturn:
            raise FaceDiffError(readable(message, parameters, program)) from ex

    summary, details = summary_of(function)
    parser = Parser(
        prog=program,
        description=summary,
        epilog=details or None,
        formatter_class=HelpFormatter,
        allow_abbrev=False,
    )
    grouped = parameters_of(function)
    parameters = [p for entry in grouped.values() for p in (entry if isinstance(entry, list) else [entry])]
    hints = typing.get_type_hints(function)
    for name, entry in grouped.items():
        if isinstance(entry, Parameter):
            add(parser, entry)
        else:
            title, details = summary_of(hints[name])
            group = parser.add_argument_group(title.rstrip("."), details or None)
            for parameter in entry:
                add(group, parameter)
    return parser


def add(parser: Any, parameter: Parameter) -> None:  # noqa: ANN401
    """Add one parameter to a parser or to a group of it."""
    option, optional = parameter.option, parameter.default is not MISSING
    words: dict[str, Any] = {"help": parameter.help.replace("%", "%%")}
    if parameter.is_switch:
        action = "store_false" if parameter.default else "store_true"
        flags = dict.fromkeys([parameter.flag, parameter.flag.replace("-", "_").replace("__", "--", 1)])
        parser.add_argument(*flags, dest=parameter.name, action=action, **words)
        return
    hint = parameter.hint
    if parameter.is_list:
        inner = get_args(without_none(hint))[0]
        if parameter.positional:
            parser.add_argument(parameter.name, type=inner, nargs="+", metavar=option.metavar or None, **words)
            return
        words |= {"type": inner, "nargs": "+"} if option.many else {"type": inner, "action": "append"}
    else:
        words |= {"type": hint}
    if option.bare is not None:
        words |= {"nargs": "?", "const": option.bare}
    if option.metavar:
        words["metavar"] = option.metavar
    if parameter.positional:
        parser.add_argument(parameter.name, **words)
        return
    words |= {"default": parameter.default} if optional else {"required": True}
    if parameter.is_list and optional and not isinstance(parameter.default, type(None)):
        words["default"] = list(parameter.default)
    flags = dict.fromkeys([*([option.short] if option.short else []), parameter.flag, f"--{parameter.name}"])
    parser.add_argument(*flags, dest=parameter.name, **words)


def run_function(function: Callable[..., Any], program: str, arguments: Sequence[str]) -> int:
    """Parse the arguments of a command and call its function.

    Args:
        function: the command; what it returns is the exit status, None means 0.
        program: what is typed for it.
        arguments: the words after it.

    Raises:
        FaceDiffError: if the arguments are wrong; the message names the option.
    """
    parser = make_parser(function, program)
    values = vars(parser.parse_args(list(arguments)))
    status = function(**arguments_from(function, values))
    return int(status or 0)


def arguments_from(function: Callable[..., Any], values: typing.Mapping[str, Any]) -> dict[str, Any]:
    """A command function's arguments from parsed values: dataclass parameters made, numbers checked.

    Raises:
        FaceDiffError: if a number is out of range.
    """
    hints = typing.get_type_hints(function)
    made: dict[str, Any] = {}
    for name, entry in parameters_of(function).items():
        for parameter in entry if isinstance(entry, list) else [entry]:
            parameter.check(values[parameter.name])
        if isinstance(entry, list):
            made[name] = hints[name](**{parameter.name: values[parameter.name] for parameter in entry})
        else:
            made[name] = values[name]
    return made


def readable(message: str, parameters: Collection[Parameter], program: str) -> str:
    """One sentence for what argparse and jsonargparse say in several lines."""
    see = f"see `{program} --help`"
    key = re.search(r'Parser key "(\w+)"', message)
    parameter = next((p for p in parameters if key is not None and p.name == key.group(1)), None)
    if parameter is not None:
        given = re.search(r"(?:Got|Given) value: (.*)", message)
        value = given.group(1).strip("'\"") if given is not None else ""
        return f"{parameter.flag} {value}: not valid; expected {parameter.expected()} ({see})"
    unknown = re.search(r"[Uu]nrecognized arguments?: (\S+)", message)
    if unknown is not None and unknown.group(1).startswith("-"):
        word = unknown.group(1).partition("=")[0]
        known = [p.flag for p in parameters if not p.positional]
        hint = choices(word, known).partition("known are")[0].strip()
        return f"{word}: there is no such option; {hint + ' ' if hint else ''}{see}".replace("? see", "? See")
    first = " ".join(message.split())
    return f"{first[:1].lower()}{first[1:]}; {see}"
