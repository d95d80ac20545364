"""Arrays on disk that are damaged, hostile or larger than the budget are refused before memory is allocated."""

from __future__ import annotations

import ast
import io
import struct
import subprocess
import sys
import textwrap
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from facediff.errors import FaceDiffError
from facediff.utils.arrays import open_array, open_vertices, read_arrays

PACKAGE = Path(__file__).parents[2] / "facediff"


def npy(header: str, body: bytes = bytes(64), version: tuple[int, int] = (1, 0)) -> bytes:
    """An array with any header."""
    text = header.encode("latin1") + b"\n"
    length = struct.pack("<H" if version == (1, 0) else "<I", len(text))
    return b"\x93NUMPY" + bytes(version) + length + text + body


def declared(shape: object, kind: str = "'<f4'", order: object = False) -> str:
    return f"{{'descr': {kind}, 'fortran_order': {order}, 'shape': {shape}, }}"


HEADERS: dict[str, bytes] = {
    "empty": b"",
    "only the magic": b"\x93NUMPY",
    "huge": npy(declared("(1099511627776, 3)")),
    "product beyond 64 bits": npy(declared("(4294967296, 4294967296, 3)")),
    "thousands of digits": npy(declared(f"({'9' * 5000}, 3)")),
    "negative": npy(declared("(-1, 3)")),
    "negative twice": npy(declared("(-4, -4)")),
    "endless and empty": npy(declared("(1000000000000000, 0, 3)"), b""),
    "truth values as a shape": npy(declared("(True, 3)")),
    "objects": npy(declared("(4,)", "'|O'")),
    "structured": npy(declared("(4,)", "[('a', '<f4'), ('b', '<i4')]")),
    "subarray": npy(declared("(1,)", "('<f4', (1000000000,))")),
    "long text": npy(declared("(1,)", "'<U2147483000'")),
    "no text at all": npy(declared("(1000000000000000,)", "'<U0'"), b""),
    "dates": npy(declared("(4,)", "'<M8[s]'")),
    "raw": npy(declared("(4,)", "'|V16'")),
    "version 3": npy(declared("(4,)"), version=(3, 0)),
    "version 9": npy(declared("(4,)"), version=(9, 9)),
    "gigabytes of header": b"\x93NUMPY\x02\x00" + struct.pack("<I", 2**31) + b" " * 99,
    "megabyte of header": npy(declared("(4,)") + " " * 2**20, version=(2, 0)),
    "nested header": npy("[" * 5000),
    "a call in the header": npy("__import__('os').mkdir('evil')"),
    "one number short": npy(declared("(17,)")),
    "one number long": npy(declared("(15,)")),
}


@pytest.mark.parametrize("content", HEADERS.values(), ids=HEADERS)
def test_hostile_headers_are_refused_by_name(content: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    bare, packed = tmp_path / "a.npy", tmp_path / "a.npz"
    bare.write_bytes(content)
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("vertices.npy", content)
    for read, path in ((open_array, bare), (open_vertices, bare), (read_arrays, packed)):
        with pytest.raises(FaceDiffError, match=path.name) as refused:
            read(path)
        assert "\n" not in str(refused.value)
        assert len(str(refused.value)) < 500
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.npy", "a.npz"]


@pytest.mark.parametrize(
    "array",
    [
        np.arange(6.0).reshape(2, 3),
        np.asfortranarray(np.arange(6, dtype="f4").reshape(2, 3)),
        np.arange(6, dtype=">f8").reshape(2, 3),
        np.array(3.5, np.float16),
        np.zeros((0, 3), np.float32),
        np.array("text ü"),
        np.array([1 + 2j]),
        np.array([True]),
    ],
    ids=lambda array: f"{array.dtype}{array.shape}",
)
def test_plain_arrays_come_back(array: np.ndarray, tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", array)
    np.savez(tmp_path / "a.npz", array=array)
    np.savez_compressed(tmp_path / "b.npz", array=array)
    for found in (open_array(tmp_path / "a.npy"), *(read_arrays(tmp_path / f"{n}.npz")["array"] for n in "ab")):
        assert (found.dtype, found.shape) == (array.dtype, array.shape)
        assert np.array_equal(found, array)


def member(array: bytes | None = None, name: str = "vertices.npy") -> tuple[str, bytes]:
    stream = io.BytesIO()
    np.save(stream, np.zeros((4, 3), np.float32))
    return name, stream.getvalue() if array is None else array


def archive_of(path: Path, *members: tuple[str, bytes], method: int = zipfile.ZIP_STORED) -> bytes:
    with zipfile.ZipFile(path, "w", method) as archive, pytest.MonkeyPatch.context() as patch:
        patch.setattr("warnings.warn", lambda *a, **k: None)  # zipfile warns of duplicate names
        for name, content in members:
            archive.writestr(name, content)
    return path.read_bytes()


def patched(path: Path, change: Callable[[bytearray, int, int], None], *, method: int = zipfile.ZIP_STORED) -> None:
    """An archive of one array whose bytes are changed, given where the central directory and its end begin."""
    data = bytearray(archive_of(path, member(), method=method))
    change(data, data.rindex(b"PK\x01\x02"), data.rindex(b"PK\x05\x06"))
    path.write_bytes(data)


def resized(size: int) -> Callable[[bytearray, int, int], None]:
    return lambda data, entry, end: struct.pack_into("<I", data, entry + 24, size)


ARCHIVES: dict[str, Callable[[Path], object]] = {
    "two of one name": lambda path: archive_of(path, member(), member()),
    "two whose suffix differs": lambda path: archive_of(path, member(), member(name="vertices")),
    "out of the folder": lambda path: archive_of(path, member(name="../../evil.npy")),
    "absolute": lambda path: archive_of(path, member(name="/evil.npy")),
    "another system's folder": lambda path: archive_of(path, member(name="..\\evil.npy")),
    "control characters": lambda path: archive_of(path, member(name="a\x1b[31m\n.npy")),
    "declares less than it holds": lambda path: patched(path, resized(100)),
    "declares more than it holds": lambda path: patched(path, resized(1 << 20)),
    "declares gigabytes": lambda path: patched(path, resized(0xFFFFFFFE)),
    "other checksum": lambda path: patched(path, lambda d, e, n: struct.pack_into("<I", d, e + 16, 1)),
    "encrypted": lambda path: patched(path, lambda d, e, n: struct.pack_into("<H", d, e + 8, 1)),
    "zip64 without its record": lambda path: patched(
        path, lambda d, e, n: struct.pack_into("<I", d, n + 16, 2**32 - 1)
    ),
    "directory elsewhere": lambda path: patched(path, lambda d, e, n: struct.pack_into("<I", d, n + 16, 7)),
    "unknown compression": lambda path: patched(path, lambda d, e, n: struct.pack_into("<H", d, e + 10, 99)),
    "lzma, whose header asks for memory": lambda path: archive_of(path, member(), method=zipfile.ZIP_LZMA),
}


@pytest.mark.parametrize("make", ARCHIVES.values(), ids=ARCHIVES)
def test_hostile_archives_are_refused_by_name(make: Callable[[Path], object], tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    make(path)
    with pytest.raises(FaceDiffError, match=r"a\.npz") as refused:
        read_arrays(path)
    assert "\n" not in str(refused.value)
    assert "\x1b" not in str(refused.value)
    assert [each.name for each in tmp_path.iterdir()] == ["a.npz"]


def test_entries_that_nobody_asked_for_are_not_read(tmp_path: Path) -> None:
    archive_of(tmp_path / "a.npz", member(), member(HEADERS["objects"], "other.npy"), member(b"text", "notes.txt"))
    assert list(read_arrays(tmp_path / "a.npz", {"vertices"})) == ["vertices"]


def test_bombs_are_refused_in_little_memory(tmp_path: Path) -> None:
    """Each of the files is small, declares much and is refused although the process may hold only a little more."""
    huge = npy(declared("(1000000000, 3)"), b"")
    (tmp_path / "cut.npy").write_bytes(huge)
    archive_of(tmp_path / "cut.npz", member(huge))
    zeros = npy(declared("(15000000,)"), bytes(60_000_000))
    archive_of(tmp_path / "zeros.npz", member(zeros), method=zipfile.ZIP_DEFLATED)
    code = f"""
        import resource, sys
        from pathlib import Path
        from facediff.errors import FaceDiffError
        from facediff.utils.arrays import open_array, read_arrays
        import numpy
        used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + 100_000_000,) * 2)
        for name, read in (("cut.npy", open_array), ("cut.npz", read_arrays), ("zeros.npz", read_arrays)):
            try:
                read(Path({str(tmp_path)!r}) / name)
            except FaceDiffError as error:
                assert name in str(error), error
                assert "MemoryError" not in repr(error.__cause__), error
            else:
                sys.exit(f"{{name}} was read")
    """
    subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)], check=True, timeout=60, env={"FACEDIFF_MAX_BYTES": "5e7"}
    )


def test_arrays_are_read_in_one_place_only() -> None:
    """NumPy's own readers believe what a file declares, so nothing but ``utils/arrays.py`` may call them."""
    readers = {"load", "fromfile", "genfromtxt", "loadtxt", "open_memmap", "read_array", "fromregex"}
    found = []
    for file in sorted(PACKAGE.rglob("*.py")):
        if file.relative_to(PACKAGE).as_posix() == "utils/arrays.py":
            continue
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Attribute):
                continue
            if node.func.attr not in {*readers, "memmap", "loads"}:
                continue
            owner, name = ast.unparse(node.func.value), node.func.attr
            modes = [ast.unparse(each) for each in (*node.args, *(keyword.value for keyword in node.keywords))]
            writes = "'w+'" in modes
            if (owner in ("np", "numpy", "np.lib.format") and name in readers and not writes) or (
                owner == "np" and name == "memmap" and not writes
            ):
                found.append(f"{file.relative_to(PACKAGE)}:{node.lineno} calls {owner}.{name}")
            loads = owner in ("pickle", "torch", "joblib") and name in ("load", "loads")
            # What goes between the processes of a cluster is pickled by Dask anyway, see the top of cluster.py.
            if loads and file.name not in ("torch_files.py", "checkpoint.py", "cluster.py"):
                found.append(f"{file.relative_to(PACKAGE)}:{node.lineno} calls {owner}.{name}")
    assert not found, "\n".join(found)
