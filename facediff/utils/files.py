"""Files and folders that appear whole or not at all, locks, manifests, and the folders that facediff itself uses."""

from __future__ import annotations

import csv
import glob
import hashlib
import json
import math
import os
import re
import secrets
import shutil
import socket
import tempfile
import time
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from facediff.errors import FaceDiffError
from facediff.utils.jobs import run_tasks
from facediff.utils.limits import LIMITS, check_nesting

BYTES_OF_A_CHARACTER = 32  # memory that a character of JSON can take: "[]," makes a list of 56 bytes and a pointer
_ESCAPES = re.compile(r"\\u(?:0000|d[89a-f])", re.IGNORECASE)
_ZERO = re.compile(rb"(?<!\\)(?:\\\\)*\\u0000")
ABANDONED_AFTER = 86_400.0  # seconds; a half-written folder is removed then even where the file system has no locks


def cache_dir() -> Path:
    """Where data is kept that can be computed again: ``$FACEDIFF_CACHE``, else ``~/.cache/facediff``."""
    return Path(os.environ.get("FACEDIFF_CACHE") or Path.home() / ".cache" / "facediff")


def config_dir() -> Path:
    """The folder of the bundled configs (``experiment/``, ``model/``, ``data/``, ``trainer/``).

    It lies inside an installed package, and next to the package in a checkout.
    """
    package = Path(__file__).parents[1]
    inside = package / "configs"
    return inside if inside.is_dir() else package.parent / "configs"


# Atomic writing.


@contextmanager
def atomic(path: Path) -> Iterator[Path]:
    r"""Write a file whole or not at all.

    Yields:
        a temporary path next to ``path``, which is renamed to ``path`` at the end and removed if anything fails. Its
        suffix is that of ``path``, since many writers choose the format by it.

    Raises:
        FaceDiffError: if the folder cannot be made or the file cannot be written.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "results" / "table.csv"
        >>> with atomic(path) as temporary:
        ...     _ = temporary.write_text("clip,lve\n")
        >>> path.read_text()
        'clip,lve\n'
    """
    if path.is_symlink():
        path = Path(os.path.realpath(path))  # the file that the link names is written, the link stays
    device = path.exists() and not path.is_file() and not path.is_dir()
    # A device or a pipe (/dev/stdout, /dev/null) cannot be replaced: it gets the bytes of a whole file.
    place = Path(tempfile.gettempdir()) / path.name if device else path
    temporary = _partial(place, path.suffix)
    with _writing(path), _new_folders(place.parent):
        if not device:
            _sweep(path)
        try:
            yield temporary
            if device:
                with temporary.open("rb") as source, path.open("wb") as target:
                    shutil.copyfileobj(source, target)
            else:
                os.replace(temporary, path)
        finally:
            with suppress(OSError):  # never written, or renamed
                temporary.unlink()


@contextmanager
def atomic_folder(path: Path, *, replace: bool = False) -> Iterator[Path]:
    """Write a folder whole or not at all.

    Args:
        path: the folder that shall appear.
        replace: whether a folder with content may be replaced; an empty one always is.

    Yields:
        a hidden folder next to ``path``, to be filled. It is renamed to ``path`` at the end and removed if anything
        fails; what a killed process has left of the same folder is removed by the next one that writes it.

    Raises:
        FaceDiffError: if the folder cannot be written, or ``path`` is in the way.
    """
    if path.exists() and (not path.is_dir() or (not replace and any(path.iterdir()))):
        what = "is not empty" if path.is_dir() else "is a file"
        raise FaceDiffError(f"{path}: {what}; choose a new folder, or remove this one")
    with scratch_folder(path) as scratch:
        content = scratch / path.name
        content.mkdir()
        try:
            yield content
        except FaceDiffError as error:
            # A writer that fails names the folder that it was given; users know the one that they asked for.
            if str(content) not in str(error):
                raise
            raise FaceDiffError(str(error).replace(str(content), str(path))) from error
        put_in_place(content, path, replace=replace)


@contextmanager
def scratch_folder(path: Path) -> Iterator[Path]:
    """A hidden folder next to ``path``, on the same disk, which is removed at the end.

    What killed processes have left under the same name is removed first. An :class:`OSError` in the block is raised as
    a :class:`FaceDiffError` that names ``path``.
    """
    with _writing(path), _new_folders(path.parent):
        _remove_abandoned(path)
        folder = _partial(path)
        # The folder is locked before it gets its name, so that no other process removes it as abandoned.
        unnamed = folder.with_name(f"{folder.name}.new")
        unnamed.mkdir()
        with _locked_folder(unnamed):
            unnamed.rename(folder)
            try:
                yield folder
            finally:
                shutil.rmtree(folder, ignore_errors=True)


def put_in_place(source: Path, target: Path, *, replace: bool = True) -> None:
    """Rename a file or folder on its disk; a folder at ``target`` steps aside first and is then removed.

    Without ``replace``, only an empty folder may be replaced.

    Raises:
        OSError: if that fails; what was at ``target`` is there again.
    """
    if not target.is_dir():
        try:
            os.replace(source, target)
            return
        except OSError:
            if not target.is_dir():  # unless another process has just made it
                raise
    if not replace:
        target.rmdir()  # fails if it is not empty
        os.rename(source, target)
        return
    aside = source.with_name(f"{source.name}.replaced-{secrets.token_hex(4)}")
    with suppress(FileNotFoundError):  # another process has just moved it away
        os.rename(target, aside)
    try:
        os.rename(source, target)
    except OSError:
        if aside.exists():
            os.rename(aside, target)
        raise
    shutil.rmtree(aside, ignore_errors=True)


def _sweep(path: Path) -> None:
    """Remove what killed processes of this machine have left of a file; others may still be writing."""
    start = f".{path.stem}.partial-{_host()}-"
    for left in path.parent.glob(f"{glob.escape(start)}*{glob.escape(path.suffix)}"):
        number = left.name.removeprefix(start).partition("-")[0]
        if number.isdigit() and not _is_running(int(number)):
            left.unlink(missing_ok=True)


def _host() -> str:
    """A short name of this machine, for folders that several machines share."""
    return f"{zlib.crc32(socket.gethostname().encode()):08x}"


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:  # somebody else's process
        return True
    return True


def refuse_overwriting(inputs: Iterable[Path], outputs: Iterable[Path]) -> None:
    """Refuse outputs that are inputs, also by another name or through a link.

    Raises:
        FaceDiffError: naming the file.
    """
    read = {os.path.realpath(path) for path in inputs if path.exists()}
    for path in outputs:
        if path.is_file() and os.path.realpath(path) in read:
            raise FaceDiffError(f"{path}: is read by this command and would be overwritten; choose another output")


def check_writable(path: Path) -> None:
    """Make sure, before any work is done, that a file can be written; leaves nothing behind.

    Raises:
        FaceDiffError: if the folder cannot be made or written, or if the path is a folder.
    """
    if path.is_dir():
        raise FaceDiffError(f"{path}: is a folder; expected the name of a file to write")
    if path.exists() and not path.is_file():
        return  # a device or a pipe
    probe = _partial(path)
    with _writing(path), _new_folders(path.parent):
        probe.touch()
        probe.unlink()


def remove_partial(folder: Path, stem: str = "*", *, recursive: bool = False) -> None:
    """Remove what killed processes have left of files named ``stem``; no other process may be writing there."""
    pattern = f".{stem if stem == '*' else glob.escape(stem)}.partial-*"
    for left in list(folder.rglob(pattern) if recursive else folder.glob(pattern)):
        if left.is_dir():
            shutil.rmtree(left, ignore_errors=True)
        else:
            left.unlink(missing_ok=True)


def _partial(path: Path, suffix: str = "") -> Path:
    # Containers that share a folder may have equal process numbers, hence the token.
    name = path.stem if suffix else path.name
    return path.with_name(f".{name}.partial-{_host()}-{os.getpid()}-{secrets.token_hex(4)}{suffix}")


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Turn errors of the operating system into a sentence that names the path."""
    try:
        yield
    except OSError as error:
        raise FaceDiffError(
            f"{path}: cannot be written ({error.strerror or error}); choose a folder that you may write to and that "
            f"has room"
        ) from error


@contextmanager
def _new_folders(folder: Path) -> Iterator[None]:
    """Make a folder and its parents; those that are still empty at the end are removed."""
    made = [each for each in (folder, *folder.parents) if not each.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield
    finally:
        for each in made:
            with suppress(OSError):  # not empty
                each.rmdir()


# Locks.


@contextmanager
def locked(path: Path, command: str) -> Iterator[None]:
    """Keep a second process out of a folder while the block runs; the lock of a killed process does not count.

    The lock file lies in the folder and is removed at the end; errors call the other process ``command``.

    Raises:
        FaceDiffError: if another process holds the lock, or the folder cannot be written.
    """
    with ExitStack() as stack:
        with _writing(path.parent):
            stack.enter_context(_new_folders(path.parent))
            stack.enter_context(_lock_file(path, command))
        stack.callback(path.unlink, missing_ok=True)
        yield


def _lock_file(path: Path, command: str) -> IO[str]:
    while True:
        stream = path.open("w")
        locked = _lock(stream.fileno())
        if locked is False:
            stream.close()
            raise FaceDiffError(f"{path.parent}: another `{command}` is at work here; wait until it has ended")
        # The previous holder may have removed the file between our opening and locking it.
        if locked is None or (path.exists() and os.path.samestat(os.fstat(stream.fileno()), path.stat())):
            return stream
        stream.close()


def _lock(descriptor: int) -> bool | None:
    """Whether this process now holds the lock; None where there are no locks (Windows, some network disks)."""
    try:
        import fcntl

        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except (ImportError, OSError):
        return None
    return True


@contextmanager
def _locked_folder(folder: Path) -> Iterator[bool | None]:
    """Hold a lock on a folder itself, which ends with the process at the latest; yields as :func:`_lock`."""
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError:  # Windows cannot open folders; or the folder has just been removed
        yield None
        return
    try:
        yield _lock(descriptor)
    finally:
        os.close(descriptor)


def _remove_abandoned(path: Path) -> None:
    """Remove the scratch folders of processes that have ended without removing them."""
    for left in path.parent.glob(f".{glob.escape(path.name)}.partial-*"):
        with suppress(OSError), _locked_folder(left) as free:
            if free or (free is None and time.time() - left.stat().st_mtime > ABANDONED_AFTER):
                shutil.rmtree(left, ignore_errors=True)


# What files hold: checksums, manifests, tables.


def sha256(path: Path) -> str:
    """SHA-256 of a file's bytes, in hexadecimal."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def describe_files(
    folder: Path, names: Iterable[str] | None = None, *, workers: int = 1, progress: str = ""
) -> dict[str, dict[str, int | str]]:
    """Size and SHA-256 of files as manifests record them, ``{"bytes": …, "sha256": …}`` by name, sorted.

    ``names`` are paths relative to the folder; None stands for all files in it and its subfolders.
    """
    if names is None:
        names = [path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()]
    ordered = sorted(names)
    digests = dict(
        run_tasks(lambda name: sha256(folder / name), ordered, workers=workers, mode="threads", progress=progress)
    )
    return {name: {"bytes": (folder / name).stat().st_size, "sha256": digests[name]} for name in ordered}


def same_sizes(folder: Path, files: Mapping[str, Mapping[str, Any]]) -> bool:
    """Whether all files that a manifest describes are there with their sizes; their content is not read."""
    try:
        return all((folder / name).stat().st_size == facts["bytes"] for name, facts in files.items())
    except (OSError, KeyError, TypeError):
        return False


def parse_json(text: bytes | str, source: object, *, remedy: str = "expected a JSON file") -> Any:  # noqa: ANN401
    """Plain data of a JSON text from elsewhere; no other module parses one.

    Stricter than Python's parser, so that whoever reads a value need not expect the worst: numbers are finite, keys
    are unique, text can be printed, written and used as a file's name, and all fits into the budget.

    Args:
        text: the text; of bytes, UTF-8, UTF-16 or UTF-32 with or without a mark.
        source: what messages call it.
        remedy: how messages end.

    Raises:
        FaceDiffError: if it is anything else.
    """
    LIMITS.check("bytes", BYTES_OF_A_CHARACTER * len(text), source)
    try:
        if isinstance(text, bytes):
            text = text.decode(json.detect_encoding(text))
        value = json.loads(
            text,
            parse_constant=_finite,
            parse_float=_finite,
            parse_int=_whole,
            object_pairs_hook=_unique,
        )
        # Escapes can state what no text should hold: zero bytes, and halves of a character, which cannot be encoded.
        if _ESCAPES.search(text) and _ZERO.search(json.dumps(value, ensure_ascii=False).encode()):
            raise ValueError("a text in it has a zero byte")
    except (ValueError, RecursionError) as error:  # thousands of brackets exceed Python's depth
        reason = "nested too deeply" if isinstance(error, RecursionError) else str(error)
        raise FaceDiffError(f"{source}: not readable as JSON ({reason}); {remedy}") from error
    check_nesting(value, source)
    return value


def load_json(path: Path, *, name: str = "", remedy: str = "expected a JSON file") -> Any:  # noqa: ANN401
    """Plain data that a JSON file holds, as :func:`parse_json` reads it.

    Args:
        path: the file.
        name: what messages call it; its path if empty.
        remedy: how messages end.

    Raises:
        FaceDiffError: if there is no such file, or it cannot be read.
    """
    name = name or str(path)
    try:
        LIMITS.check("bytes", BYTES_OF_A_CHARACTER * path.stat().st_size, name)
        if not path.is_file():
            raise FaceDiffError(f"{name}: not a regular file; {remedy}")
        return parse_json(path.read_bytes(), name, remedy=remedy)
    except OSError as error:
        raise FaceDiffError(f"{name}: cannot be read ({error.strerror or error}); {remedy}") from error


def read_json(path: Path) -> dict[str, Any] | None:
    """The object that a JSON file holds; None if there is no such file, or it holds anything else."""
    try:
        content = load_json(path)
    except FaceDiffError:
        return None
    return content if isinstance(content, dict) else None


def _finite(number: str) -> float:
    value = float(number)
    if not math.isfinite(value):
        raise ValueError(f"the number {number[:20]} is not finite")
    return value


def _whole(number: str) -> int:
    _finite(number)
    return int(number)


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        keys = [key for key, _ in pairs]
        raise ValueError(f'the key "{next(key for key in keys if keys.count(key) > 1)}" occurs twice')
    return found


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write an object as JSON, whole or not at all; equal objects give equal bytes."""
    with atomic(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def write_rows(path: Path, rows: Sequence[Mapping[str, Any]], *, line_end: str = "\r\n") -> None:
    """Write rows with equal keys as CSV, whole or not at all."""
    with atomic(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, fieldnames=list(rows[0]), lineterminator=line_end)
        writer.writeheader()
        writer.writerows(rows)
