"""Files and folders that appear whole or not at all, locks, and the folders that facediff itself uses."""

from __future__ import annotations

import errno
import glob
import os
import platform
import secrets
import shutil
import sys
import tempfile
import time
import zlib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import IO
from weakref import WeakSet

from facediff.errors import FaceDiffError, printable
from facediff.utils.output_paths import destination, refuse_protected

ABANDONED_AFTER = 86_400.0  # seconds after which what nobody writes to any more is removed


def cache_dir() -> Path:
    """Where data is kept that can be computed again: ``$FACEDIFF_CACHE``, else ``~/.cache/facediff``."""
    folder = os.environ.get("FACEDIFF_CACHE")
    return Path(folder).expanduser() if folder else Path.home() / ".cache" / "facediff"


def config_dir() -> Path:
    """The folder of the bundled configs: inside an installed package, and next to the package in a checkout."""
    package = Path(__file__).parents[1]
    inside = package / "configs"
    return inside if inside.is_dir() else package.parent / "configs"


def example_recordings() -> list[Path]:
    """Synthetic recordings to try the commands with; they lie in the installed package, or in a checkout's manual."""
    package = Path(__file__).parents[1]
    folder = package / "examples" if (package / "examples").is_dir() else package.parent / "docs" / "examples"
    return [folder / f"{name}.wav" for name in ("speech", "question", "story")]


# Atomic writing.


@contextmanager
def atomic(path: Path) -> Iterator[Path]:
    r"""Write a file whole or not at all.

    Where ``path`` is a link, the file that it leads to is written and the link stays. A file that is replaced hands its
    owner and its permissions on.

    Yields:
        a path on the same disk, renamed at the end and removed if anything fails, with the same suffix, since many
        writers choose the format by it.
    """
    with _writing(path):
        target = destination(path)
        _refuse_unwritable(path, target)
        with scratch_folder(path) as scratch:
            temporary = scratch / path.name
            yield temporary
            _hand_on(target, temporary)
            os.replace(temporary, target)


def discard(path: Path) -> None:
    """Remove a file or folder, if it is there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink()


def refuse_content(path: Path, *, replace: bool = False) -> None:
    """Refuse a file, and a folder with content unless it may be replaced, where a folder shall appear."""
    if path.exists() and (not path.is_dir() or (not replace and any(path.iterdir()))):
        fault = "is not empty" if path.is_dir() else "is a file"
        raise FaceDiffError(f"{path}: {fault}; choose a new folder, or remove this one")


@contextmanager
def atomic_folder(path: Path, *, replace: bool = False) -> Iterator[Path]:
    """Write a folder whole or not at all; one with content only to ``replace`` it.

    Yields:
        a hidden folder next to ``path``, to be filled; it is renamed at the end and removed if anything fails.
    """
    refuse_content(path, replace=replace)
    with scratch_folder(path) as scratch:
        content = scratch / path.name
        content.mkdir()
        try:
            yield content
        except FaceDiffError as error:
            # A writer that fails names the folder that it was given; users know the one that they asked for.
            renamed = FaceDiffError(str(error).replace(str(content), str(path)))
            raise (renamed if str(content) in str(error) else error) from error
        put_in_place(content, path, replace=replace)


@contextmanager
def scratch_folder(path: Path) -> Iterator[Path]:
    """A hidden folder next to ``path`` (after its links), on the same disk, which is removed at the end.

    What killed processes have left there is removed first. An :class:`OSError` in the block is raised as a
    :class:`FaceDiffError` that names ``path``.
    """
    with _writing(path):
        target = destination(path)
        with _new_folders(target.parent):
            sweep(target.parent)
            with ExitStack() as stack:
                while True:
                    folder = _partial(target)
                    folder.mkdir()
                    # Another process that sweeps in between takes it for abandoned: then there is to be another one.
                    if stack.enter_context(_locked_folder(folder)) is not False and folder.is_dir():
                        break
                try:
                    yield folder
                finally:
                    try:
                        discard(folder)
                    finally:
                        discard(folder)  # a signal may have cut the first short


def put_in_place(source: Path, target: Path, *, replace: bool = True) -> None:
    """Move a finished file or folder to its name; a folder at ``target`` steps aside first and is then removed.

    As in :func:`atomic`, links are followed, and owner and permissions of a file stay. Without ``replace``, only an
    empty folder may be replaced.
    """
    path = destination(target)
    if path.is_dir():
        refuse_protected(target, folder=True)
    else:
        _refuse_unwritable(target, path)
        _hand_on(path, source)
    try:
        _rename(source, path, replace=replace)
    except OSError as error:
        if error.errno != errno.EXDEV:
            raise
        with scratch_folder(path) as scratch:  # a link leads to another disk
            copy = Path(shutil.move(source, scratch / path.name))
            _rename(copy, path, replace=replace)


def _rename(source: Path, target: Path, *, replace: bool) -> None:
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
    if _exchange(source, target):
        shutil.rmtree(source, ignore_errors=True)
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


def _exchange(first: Path, second: Path) -> bool:
    """Let two folders change their names in one step, which no kill can interrupt; False where that is impossible."""
    import ctypes

    rename = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None) if sys.platform == "linux" else None
    cwd, exchange = -100, 2  # AT_FDCWD and RENAME_EXCHANGE
    return rename is not None and rename(cwd, os.fsencode(first), cwd, os.fsencode(second), exchange) == 0


def _hand_on(old: Path, new: Path) -> None:
    """Give a new file the permissions and the owner of the one that it replaces, as far as this user may."""
    with suppress(OSError):
        before, after = old.stat(), new.stat()
        os.chmod(new, before.st_mode & 0o777)
        if (before.st_uid, before.st_gid) != (after.st_uid, after.st_gid):
            os.chown(new, before.st_uid, before.st_gid)


def _refuse_unwritable(path: Path, target: Path) -> None:
    """Refuse to replace an input, or a file that is protected against writing: renaming would not ask."""
    refuse_protected(path)
    with suppress(FileNotFoundError, NotADirectoryError):
        if not target.stat().st_mode & 0o222:  # root may write to everything, but not against the owner's wish
            raise PermissionError(errno.EACCES, "the file is write-protected", str(path))
        os.close(os.open(target, os.O_WRONLY))  # changes nothing; fails where permissions or the disk forbid to write


def check_writable(path: Path) -> None:
    """Make sure, before any work is done, that a file can be written; changes nothing and leaves nothing behind."""
    with _writing(path):
        target = destination(path)
        if target.is_dir():
            raise FaceDiffError(f"{path}: is a folder; expected the name of a file to write")
        _refuse_unwritable(path, target)
        _try_to_write(target)


def check_folder_writable(path: Path) -> None:
    """Make sure, before any work is done, that files can be written into a folder, which need not exist."""
    with _writing(path):
        folder = destination(path)
        if folder.exists() and not folder.is_dir():
            raise FaceDiffError(f"{path}: is a file; expected a folder to write to")
        _try_to_write(folder / "file")


def _try_to_write(path: Path) -> None:
    """Open a file in the nearest folder that exists: making folders would race with other processes."""
    folder = path.parent
    while not os.path.lexists(folder) and folder != folder.parent:
        folder = folder.parent
    longest = os.pathconf(folder, "PC_NAME_MAX") if hasattr(os, "pathconf") and folder.is_dir() else 255
    if any(len(os.fsencode(part)) > longest for part in path.parts):
        raise OSError(errno.ENAMETOOLONG, os.strerror(errno.ENAMETOOLONG), str(path))
    with tempfile.TemporaryFile(dir=folder):  # without a name where the system can
        pass


# What killed processes leave: .NAME.partial-TOKEN.

LONGEST = 60
"""Bytes of a name that the name of its partial file repeats; a valid name must not become too long by that."""


def _partial(path: Path) -> Path:
    return path.with_name(f".{short_name(path.stem, LONGEST)}.partial-{secrets.token_hex(8)}")


def short_name(name: str, length: int) -> str:
    """A name of at most ``length`` bytes: itself, or its beginning with a checksum of all of it."""
    encoded = os.fsencode(name)
    if len(encoded) <= length:
        return name
    mark = f"~{zlib.crc32(encoded):08x}"
    while len(os.fsencode(name)) + len(mark) > length:
        name = name[:-1]
    return name + mark


def valid_text(name: str) -> str:
    """A file's name as text that every format can hold; bytes that are no UTF-8 become the replacement character."""
    return os.fsencode(name).decode(errors="replace")


@cache
def sweep(folder: Path) -> None:
    """Remove what killed processes have left, once in a process: folders at once, by their locks, and old files."""
    with suppress(OSError):
        for entry in os.scandir(folder):
            if ".partial-" not in entry.name:
                continue
            old = time.time() - entry.stat(follow_symlinks=False).st_mtime > ABANDONED_AFTER
            if not entry.is_dir(follow_symlinks=False):
                if old:
                    os.unlink(entry)
                continue
            with _locked_folder(Path(entry.path)) as lock:
                if lock or (lock is None and old):
                    shutil.rmtree(entry, ignore_errors=True)


def reserve_room(path: Path) -> None:
    """Take the room of a file that is to be written through a memory map: a full disk would end the process then."""
    with path.open("r+b") as stream:
        if hasattr(os, "posix_fallocate") and (size := path.stat().st_size):
            os.posix_fallocate(stream.fileno(), 0, size)


def remove_partial(folder: Path, stem: str = "*", *, recursive: bool = False) -> None:
    """Remove what killed processes have left of files named ``stem``; no other process may be writing there."""
    pattern = f".{stem if stem == '*' else glob.escape(short_name(stem, LONGEST))}.partial-*"
    for left in list(folder.rglob(pattern) if recursive else folder.glob(pattern)):
        discard(left)


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
    folders = [path for path in (folder, *folder.parents) if not os.path.lexists(path)]
    try:
        for path in [*reversed(folders), folder]:  # one by one: pathlib calls itself for each of a thousand parents
            path.mkdir(exist_ok=True)
        yield
    finally:
        for path in folders:
            with suppress(OSError):  # not empty
                path.rmdir()


# Locks.


@contextmanager
def locked(path: Path, command: str) -> Iterator[None]:
    """Keep a second process out of a folder while the block runs; the lock of a killed process does not count.

    The lock file lies in the folder, names its process, and is removed at the end. If another process is at work, the
    :class:`LockedError` calls it ``command``.
    """
    with ExitStack() as stack:
        with _writing(path.parent):
            stack.enter_context(_new_folders(path.parent))
            stack.enter_context(_lock_file(path, command))
        stack.callback(path.unlink, missing_ok=True)
        yield


class LockedError(FaceDiffError):
    """Another process is at work in a folder."""


_HELD: WeakSet[IO[bytes]] = WeakSet()
"""Locks of this process. Forked ones, such as the workers of loaders, may outlive it and must not keep them."""


def _close_held() -> None:
    for stream in list(_HELD):
        stream.close()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_close_held)


def _lock_file(path: Path, command: str) -> IO[bytes]:
    while True:
        # Neither emptied nor followed as a link: a name in the folder must not destroy a file elsewhere.
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o666)
        stream = os.fdopen(descriptor, "r+b", buffering=0)
        locked = _lock(descriptor)
        if locked is False:
            holder = printable(stream.read(200).decode(errors="replace"))
            stream.close()
            raise LockedError(
                f"{path.parent}: another `{command}`{f' ({holder})' if holder else ''} is at work here; wait until it "
                f"has ended"
            )
        # The previous holder may have removed the file between our opening and locking it.
        if locked is None or (path.exists() and os.path.samestat(os.fstat(descriptor), path.stat())):
            _HELD.add(stream)
            if stream.read(7) in (b"", b"process"):
                stream.seek(0)
                stream.truncate()
                stream.write(f"process {os.getpid()} on {platform.node()}".encode())
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
        descriptor = os.open(folder, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0))
    except OSError:  # Windows cannot open folders; or the folder has just been removed
        yield None
        return
    try:
        yield _lock(descriptor)
    finally:
        os.close(descriptor)
