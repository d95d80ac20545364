"""The one error that facediff shows to people as a plain sentence instead of a traceback."""

from __future__ import annotations

import difflib
import re
import traceback
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial

MANY = 40
"""Names that are no longer listed in full."""


def number(value: int) -> str:
    """A whole number with spaces between thousands.

    Example:
        >>> number(23370)
        '23 370'
    """
    return f"{value:,}".replace(",", " ")


def counted(value: int, one: str, many: str | None = None) -> str:
    """A number and its noun.

    Example:
        >>> counted(1, "clip"), counted(3879, "frame"), counted(2, "vertex", "vertices")
        ('1 clip', '3 879 frames', '2 vertices')
    """
    return f"{number(value)} {one if value == 1 else many or one + 's'}"


def choices(name: str, candidates: Iterable[str]) -> str:
    """The words after "there is no …": the nearest of the known names, then all of them, unless they are very many."""
    names = list(candidates)
    near = difflib.get_close_matches(name, names, n=1)
    hint = f'did you mean "{near[0]}"? ' if near else ""
    if near and len(names) > MANY:
        near = difflib.get_close_matches(name, names, n=5, cutoff=0.3)
        return f"{hint}the nearest of {len(names)} are {', '.join(near)}"
    return f"{hint}known are {', '.join(names)}"


def check_known(source: object, kind: str, names: Iterable[str], candidates: Collection[str]) -> None:
    """Refuse names of a ``kind`` (a noun) that are no candidates; a source that is an option stands in braces."""
    for name in names:
        if name not in candidates:
            raise OptionError.naming(f'{source}: there is no {kind} "{name}": {choices(name, candidates)}')


def lacking(cls: object) -> str:
    """The fault of a class with undefined abstract methods; empty if it has none.

    Example:
        >>> from collections.abc import Sized
        >>> lacking(Sized), lacking(list)
        ('the class lacks __len__; define them', '')
    """
    names = sorted(getattr(cls, "__abstractmethods__", ()))
    return f"the class lacks {', '.join(names)}; define them" if names else ""


def import_failure(error: BaseException) -> str:
    """Why importing a module has failed, with the file and the line that are to be corrected."""
    text = error.msg if isinstance(error, SyntaxError) else " ".join(str(error).split())
    reason = f"{type(error).__name__}: {text}"
    if isinstance(error, SyntaxError):
        return f"{error.filename}, line {error.lineno}: {reason}"
    frames = [(frame.f_code.co_filename, line) for frame, line in traceback.walk_tb(error.__traceback__)][1:]
    frames = [frame for frame in frames if "importlib" not in frame[0]]  # the machinery that runs a module
    frames = [frame for frame in frames if "site-packages" not in frame[0]] or frames
    return f"{frames[-1][0]}, line {frames[-1][1]}: {reason}" if frames else reason


def printable(text: object) -> str:
    r"""Text for a terminal: names of files may hold anything, so that what does not print is escaped.

    Example:
        >>> printable("clip\x1b[2J\n")
        'clip\\x1b[2J\\n'
    """
    message = str(text)
    if message.isprintable():
        return message
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in message)


LONGEST = 1400
"""Characters of a message, which may quote a damaged file of megabytes."""


LONGEST_REASON = 200
"""Characters of a library's own words in a message."""


def shortened(text: str) -> str:
    """The text, or its beginning and its end."""
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 400]} … {text[-390:]}"


class FaceDiffError(Exception):
    """Something that the user can put right: a file, an argument or an installation.

    The message names the file or the field, the expectation and the next step. The command line
    prints it without a traceback and exits with code 2.
    """

    def __init__(self, message: object = "") -> None:
        super().__init__(shortened(printable(message)))

    @property
    def on_command_line(self) -> str:
        """The message with options as the command line calls them."""
        return str(self)

    def within(self, location: object) -> FaceDiffError:
        """The same error with the place it comes from, such as a file and its line, in front of the message."""
        return FaceDiffError(f"{location}: {self}")


_OPTION_NAME = re.compile(r"\{([a-z]+(?:_[a-z]+)*)\}")


class OptionError(FaceDiffError):
    """The value of an option cannot be used. The option is carried as data, since it has two spellings.

    In Python an option is called ``target_mesh``, which is how the message says it; on the command line it is
    ``--target-mesh``, see :attr:`on_command_line`.

    Args:
        option: name of the option as in Python; empty if the message is about something else.
        problem: the fault, the expectation and the remedy. Other options stand in braces: "give {style} as well".
        value: the wrong value, if it is to be shown.
        location: where the option was read, if not from the user directly: stands in front of the message.

    Example:
        >>> error = OptionError("target_mesh", "no such file; omit {correspondence} too", "face.obj")
        >>> print(error)
        target_mesh face.obj: no such file; omit correspondence too
        >>> print(error.on_command_line)
        --target-mesh face.obj: no such file; omit --correspondence too
    """

    def __init__(self, option: str, problem: str, value: object = None, *, location: str = "") -> None:
        self.problem, self.value, self.place = problem, value, location
        self.option = option or next(iter(_OPTION_NAME.findall(problem)), "")
        self._in_front = option
        super().__init__(self._sentence(str))

    @classmethod
    def naming(cls, sentence: str) -> OptionError:
        """The error of a sentence that names its options in braces: "face.obj: has no triangles; give {mesh}".

        Example:
            >>> OptionError.naming("face.obj: has no triangles; give {mesh}").on_command_line
            'face.obj: has no triangles; give --mesh'
        """
        return cls("", sentence)

    @property
    def on_command_line(self) -> str:
        """The message with options as the command line calls them."""
        return shortened(printable(self._sentence(lambda name: f"--{name.replace('_', '-')}")))

    def within(self, location: object) -> OptionError:
        """The same error with the place it comes from in front of the message."""
        return OptionError(self._in_front, self.problem, self.value, location=f"{location}: {self.place}")

    def _sentence(self, spelled: Callable[[str], str]) -> str:
        value = "" if self.value is None else f" {self.value}"
        subject = f"{spelled(self._in_front)}{value}: " if self._in_front else ""
        return self.place + subject + _OPTION_NAME.sub(lambda match: spelled(match[1]), self.problem)

    def __reduce__(self) -> tuple[Callable[..., OptionError], tuple[str, str, str | None]]:
        """Pickling, by which worker processes hand errors over."""
        value = None if self.value is None else str(self.value)
        return partial(OptionError, location=self.place), (self._in_front, self.problem, value)


def refuse_idle(reason: str, **options: bool) -> None:
    """Refuse options without an effect, such as options of batches for one recording."""
    for name, is_given in options.items():
        if is_given:
            raise OptionError(name, f"{reason}; omit it")


class ArgumentError(FaceDiffError, ValueError):
    """A constructor's argument has an impossible value, or one that does not go with another argument's.

    Where it is raised, only the argument's own name is known. The caller of that constructor knows which option it is,
    and replaces the name by a path such as ``model.decoder.num_heads``; the command line writes it as an option.
    """

    def __init__(self, values: Mapping[str, object], problem: str, *, located: bool = False) -> None:
        self.values = dict(values)
        self.problem = problem
        self.located = located
        super().__init__(self.sentence())

    def sentence(self, prefix: str = "") -> str:
        """The message with a prefix before every name; ``--`` makes options of them."""

        def shown(value: object) -> str:
            text = "null" if value is None else str(value) or '""'
            return text if len(text) <= 60 else f"{text[:60]}…"

        arguments = " with ".join(f"{prefix}{name} {shown(value)}" for name, value in self.values.items())
        return f"{arguments}: {self.problem}"

    def at(self, path: Callable[[str], str]) -> ArgumentError:
        """The same error with a path in place of each name."""
        return type(self)({path(name): value for name, value in self.values.items()}, self.problem, located=True)

    def __reduce__(self) -> tuple[Callable[..., ArgumentError], tuple[Mapping[str, object], str]]:
        """Pickling, by which worker processes hand errors over."""
        values = {name: str(value) for name, value in self.values.items()}
        return partial(ArgumentError, located=self.located), (values, self.problem)


class NotFiniteError(FaceDiffError, ValueError):
    """Numbers that are about to be scored are NaN or infinite."""


class MissingExtraError(FaceDiffError):
    """The optional packages of a feature are not installed."""

    def __init__(self, package: str, extra: str, feature: str) -> None:
        self.arguments = package, extra, feature
        super().__init__(
            f'{feature} needs the package "{package}", which is not installed: run  pip install "facediff[{extra}]"'
        )

    def __reduce__(self) -> tuple[type[MissingExtraError], tuple[str, str, str]]:
        """Pickling, by which worker processes hand errors over, must not call the class with the message alone."""
        return type(self), self.arguments


class Note(UserWarning):
    """A remark on an input that is read otherwise than its user may expect; the command line prints it as a note."""


def note(text: object) -> None:
    """Say a :class:`Note`, once a text."""
    warnings.warn(printable(text), Note, stacklevel=3)


@contextmanager
def needs_extra(package: str, extra: str, feature: str) -> Iterator[None]:
    """A context that imports an optional package; :class:`MissingExtraError` says how to install a missing one."""
    try:
        yield
    except ImportError as error:
        raise MissingExtraError(package, extra, feature) from error


@contextmanager
def located(place: object) -> Iterator[None]:
    """A context whose errors name a place in front, such as a file and its line."""
    try:
        yield
    except FaceDiffError as error:
        raise error.within(place) from error


@contextmanager
def damaged(source: object, remedy: str, *errors: type[Exception]) -> Iterator[None]:
    """The door of a file: within it, content of another form than expected is an error that names the file.

    The code inside takes its fields (``content["sizes"][0]``) and raises ValueError for values that would otherwise
    pass without a word; it needs no check where Python refuses by itself.

    Example:
        >>> with damaged("take.json", "export it again"):
        ...     {}["frames"]
        Traceback (most recent call last):
        facediff.errors.FaceDiffError: take.json: has no 'frames'; export it again
    """
    refusals: tuple[type[Exception], ...] = (
        LookupError,
        TypeError,
        ValueError,
        AttributeError,
        ArithmeticError,
        *errors,
    )
    try:
        yield
    except FaceDiffError as error:
        names_source = isinstance(error, MissingExtraError) or str(source) in str(error)
        raise error if names_source else error.within(source) from error
    except refusals as error:
        problem = " ".join(str(getattr(error, "strerror", None) or error).split()) or type(error).__name__
        problem = f"has no {problem}" if isinstance(error, KeyError) else problem
        raise FaceDiffError(f"{source}: {problem[:LONGEST_REASON]}; {remedy}") from error
