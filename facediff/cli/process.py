"""The process of a command: standard streams, output, questions, signals and exit statuses.

A command is stopped by an exception in any case, so that half-written files are removed on the way out.
"""

from __future__ import annotations

import errno
import io
import os
import signal
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

import facediff
from facediff.errors import FaceDiffError, Note, printable

USAGE, FAULT, INTERRUPTED, READER_GONE = 2, 70, 130, 141
"""Exit statuses in addition to 0 and to 1, which means that a part of the work failed; see docs/command_line.md."""
LONGEST = 900
"""Characters of an error that are printed."""
TRACEBACK = "FACEDIFF_TRACEBACK"
"""Environment variable that shows the traceback of an unexpected error in place of a sentence."""
LONG, LARGE = 3600.0, 8 * 2**30
"""Seconds and bytes above which a command names its cost and waits for a yes."""


class StandardOutputError(FaceDiffError):
    """The output of a command cannot be printed."""

    def __init__(self, error: OSError) -> None:
        super().__init__(
            f"standard output: cannot be written ({error.strerror}); redirect it to a place with room, or to /dev/null"
        )
        self.status = READER_GONE if error.errno == errno.EPIPE else USAGE


def prepare_process() -> None:
    """Set up the streams and signals of a process that does nothing but run a command."""
    # A file that is opened while the number of a standard stream is free would get that number, and the output.
    for number, mode in ((0, os.O_RDONLY), (1, os.O_RDONLY), (2, os.O_WRONLY)):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, mode)  # standard output read-only: printing is an error
    if sys.stderr is None:
        sys.stderr = open(2, "w", closefd=False, errors="backslashreplace")  # noqa: SIM115 - open to the end
    before = sys.stdout
    sys.stdout = io.TextIOWrapper(
        io.BufferedWriter(_StandardOutput(1, "w", closefd=False)),
        encoding=getattr(before, "encoding", None) or "utf-8",
        errors="backslashreplace",  # names of files may have characters that the terminal's encoding lacks
        line_buffering=bool(getattr(before, "line_buffering", False)),
        write_through=bool(getattr(before, "write_through", False)),
    )
    for name in ("SIGTERM", "SIGHUP"):
        signal_number = getattr(signal, name, None)
        if signal_number is not None and signal.getsignal(signal_number) is signal.SIG_DFL:
            signal.signal(signal_number, _stop)


def finish_process() -> None:
    """Let Ctrl-C end the process without a word from now on."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)


class StoppedBySignal(SystemExit):  # noqa: N818 - like the class that it extends, it is no error
    """A signal asks the process to end; its status is 128 and the signal's number."""

    def __init__(self, number: int) -> None:
        super().__init__(128 + number)
        self.sentence = f"stopped by {signal.Signals(number).name}"


def _stop(number: int, _frame: FrameType | None) -> NoReturn:
    signal.signal(number, signal.SIG_DFL)  # the second one does not wait for anything to be tidied up
    raise StoppedBySignal(number)


class _StandardOutput(io.FileIO):
    """Standard output with an error of its own, not of the file being written meanwhile."""

    def write(self, data: Any) -> int:  # noqa: ANN401 - any buffer
        try:
            return super().write(data)
        except OSError as error:
            # Later output, such as the rest of the buffer at the end of the process, goes nowhere.
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            raise StandardOutputError(error) from error


def tell(*lines: object) -> None:
    """Print lines to standard output; names of files in them may hold line breaks or bytes that are no text.

    Everything that the commands print goes this way; where standard output is a pipe, it is flushed immediately.
    """
    encoding = sys.stdout.encoding or "utf-8"
    for line in lines:
        print(printable(line).encode(encoding, errors="backslashreplace").decode(encoding))
    sys.stdout.flush()


@contextmanager
def notes() -> Iterator[None]:
    """A context in which notes of the library are lines on standard error, once each."""
    with warnings.catch_warnings():
        warnings.simplefilter("default", Note)
        standard = warnings.showwarning

        def show(message: Warning | str, category: type[Warning], *place: Any, **more: Any) -> None:  # noqa: ANN401
            if issubclass(category, Note):
                print(f"note: {message}", file=sys.stderr, flush=True)
            else:
                standard(message, category, *place, **more)

        warnings.showwarning = show
        yield


def confirm_cost(yes: bool, lower: str, *, seconds: float = 0.0, size: float = 0.0) -> None:
    """Name a high cost, in seconds on two processor cores and in bytes, and start only if the user agrees."""
    if yes or (seconds <= LONG and size <= LARGE):
        return
    costs = [f"{seconds / 3600:.3g} hours on two processor cores"] if seconds > LONG else []
    costs += [f"{size / 2**30:.3g} GiB of memory or disk"] if size > LARGE else []
    cost = f"this takes about {' and '.join(costs)}"
    if sys.stdin is not None and sys.stdin.isatty() and sys.stderr.isatty():
        print(f"facediff: {cost}; start? [y/N] ", end="", file=sys.stderr, flush=True)
        if sys.stdin.readline().strip().lower() in ("y", "yes"):
            return
    raise FaceDiffError(f"{cost}; lower {lower}, or add --yes to start all the same")


def flush() -> None:
    """Flush the output, so that a failure is noticed before the process ends."""
    if sys.stdout is not None:
        sys.stdout.flush()


def fail(message: str, status: int = USAGE) -> int:
    """Print one sentence to standard error and give back the exit status."""
    # Names of files may hold line breaks and the codes by which terminals are controlled, or be as long as a page.
    text = printable(message)
    text = text if len(text) <= LONGEST else f"{text[:LONGEST]}…"
    with suppress(OSError, ValueError):  # standard error is closed or full: the status has to do
        print(f"facediff: error: {text}", file=sys.stderr, flush=True)
    return status


def report(error: BaseException) -> int:
    """Print the error that has ended a command, in one sentence; the exit status.

    An unexpected error is raised again where ``FACEDIFF_TRACEBACK`` is set.
    """
    if any(isinstance(cause, KeyboardInterrupt) for cause in chain(error)):
        return fail("interrupted", INTERRUPTED)
    if isinstance(error, StoppedBySignal):
        return fail(error.sentence, int(str(error.code)))
    if isinstance(error, StandardOutputError):
        return error.status if error.status == READER_GONE else fail(str(error), error.status)
    if isinstance(error, FaceDiffError):
        return fail(error.on_command_line)
    if os.environ.get(TRACEBACK):
        raise error
    more = f"{TRACEBACK}=1 shows where"
    text = " ".join(str(error).split())
    out_of_memory = ("out of memory" in text, "allocate memory" in text, "Unable to allocate" in text)
    if isinstance(error, MemoryError) or any(out_of_memory):
        return fail(f"there is not enough memory ({text or 'none left'}); use shorter inputs or --workers 1 ({more})")
    if isinstance(error, OSError):
        name = "" if error.filename is None else f"{os.fsdecode(error.filename)}: "
        return fail(f"{name}{error.strerror or text}; check that it exists, may be used and has room ({more})")
    if isinstance(error, UnicodeError):
        return fail(f"a name or a text is not valid UTF-8 ({text}); rename or convert it ({more})")
    if isinstance(error, RecursionError):
        return fail(f"an input is nested too deeply; expected plain data ({more})")
    refusal = next((cause for cause in chain(error) if _refuses(cause)), None)
    if refusal is not None:
        return fail(f"{' '.join(str(refusal).split())} ({more})")
    if text.startswith("Does not validate"):  # jsonargparse's list of types, around a constructor's error
        error = list(chain(error))[-1]
        text = " ".join(str(error).split())
    position, is_bug = _position(error)
    return fail(
        f"unexpected {type(error).__name__}: {text[:300]} ({position}, facediff {facediff.__version__}); "
        f"{'this is a fault of facediff: ' if is_bug else ''}run the command again with {TRACEBACK}=1"
        f"{' and report its output' if is_bug else ', which shows where'}",
        FAULT,
    )


def chain(error: BaseException | None) -> Iterator[BaseException]:
    """An exception and its causes, outermost first."""
    visited: set[int] = set()
    while error is not None and id(error) not in visited:
        visited.add(id(error))
        yield error
        error = error.__cause__ or error.__context__


LIBRARIES = ("lightning", "omegaconf", "wandb", "torch.distributed", "torch.utils.data", "torch.autograd")
"""Their own messages name the option, or the process that has gone."""


def _refuses(error: BaseException) -> bool:
    """Whether a statement of one of these libraries has raised an error on purpose."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    module = "" if trace is None else str(trace.tb_frame.f_globals.get("__name__"))
    fault = isinstance(error, AttributeError | KeyError | IndexError | AssertionError | OSError)
    return module.startswith(LIBRARIES) and not fault


def _position(error: BaseException) -> tuple[str, bool]:
    """The innermost line outside the libraries, and whether it is facediff's rather than a user's."""
    import traceback

    package, libraries = Path(__file__).parents[1], ("site-packages", os.path.dirname(os.__file__))
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if not frame.filename.startswith("<")]
    frames = [frame for frame in frames if not any(library in frame.filename for library in libraries)] or frames
    is_bug = not frames or package in Path(frames[-1].filename).parents
    return (f"{frames[-1].filename}, line {frames[-1].lineno}" if frames else "in a library"), is_bug
