"""Damaged files for every reader, and the law that all readers obey.

The law: a reader gives a result or raises :class:`FaceDiffError` with one line. It takes little memory beyond the
budget (:mod:`facediff.utils.limits`) and a minute at most, imports no module that a file names, and writes nothing
outside the folder that it was given.

A long run: ``python -m tests.robustness.mutations --rounds 2000`` prints the counts for every reader.
"""

from __future__ import annotations

import argparse
import ctypes
import functools
import io
import json
import os
import pickle
import random
import re
import resource
import shutil
import signal
import struct
import sys
import tempfile
import traceback
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from facediff.errors import FaceDiffError
from facediff.utils import limits
from tests.robustness.readers import READERS

BUDGET = 256 * 2**20
"""Bytes that a file may expand to while the harness runs; the default would let a machine swap."""
MEMORY = 3 * BUDGET
"""Bytes that reading may take: what a file expands to, and copies of it in other types."""
ADDRESSES = 24 * 2**30
"""Address space for one reading, so that a broken reader fails instead of filling the machine."""
SECONDS = 60
EVIL = "evilmodule"

INTEGERS = [0, -1, 1, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, -(2**31), -(2**63), 2**24, 2**40]
FLOATS = [float("nan"), float("inf"), -float("inf"), 1e308, -1.0, 0.0, 1e-320]
LEAVES: list[Any] = [
    *INTEGERS,
    *FLOATS,
    10**400,
    None,
    True,
    "",
    "nan",
    "../../etc/passwd",
    "/dev/zero",
    "http://127.0.0.1:9/x",
    f"{EVIL}.Evil",
    "${oc.env:HOME}",
    "\x00",
    "a" * 100_000,
    [],
    {},
    [[]] * 3,
    {"a": {"b": 1}},
    {"class_path": f"{EVIL}.Evil"},
]
WORDS = [b"nan", b"inf", b"-1", b"1e308", b"9" * 400, b"99999999999999", b"1e-999", b"\x00", b"\xff\xfe", b"=cmd()"]
WORDS += [
    b"[" * 3000,
    b"(" * 3000,
    b"&a [*a]",
    f"!!python/object/apply:{EVIL}.run []".encode(),
    b"\r\n\r\n",
    b'"',
    b",",
]


# Damage


def mutate(data: bytes, rng: random.Random, suffix: str) -> tuple[str, bytes]:
    """One damaged version of a file's bytes, and what was done."""
    known = {
        ".json": json_leaf,
        ".yaml": yaml_leaf,
        ".npz": npz_member,
        ".pkl": pickle_leaf,
        ".ckpt": checkpoint_leaf,
        ".glb": glb_leaf,
        ".npy": npy_header,
        ".safetensors": safetensors_leaf,
    }
    kinds: list[Callable[[bytes, random.Random], bytes]] = [flip, cut, grow, number, number, text_number, word, repeat]
    kinds += [empty, zeros, copies, move]
    if data[:2] == b"PK":
        kinds += [zip_field, zip_field]
    if suffix in known:
        kinds += [known[suffix]] * 6
    kind = rng.choice(kinds)
    try:
        return kind.__name__, kind(data, rng)
    except Exception:  # what cannot be damaged in a special way is damaged in a plain one
        return "flip", flip(data, rng)


def flip(data: bytes, rng: random.Random) -> bytes:
    body = bytearray(data)
    for _ in range(rng.choice([1, 2, 8, 64])):
        body[rng.randrange(len(body))] ^= 1 << rng.randrange(8)
    return bytes(body)


def cut(data: bytes, rng: random.Random) -> bytes:
    return data[: rng.randrange(len(data))]


def empty(_: bytes, __: random.Random) -> bytes:
    return b""


def grow(data: bytes, rng: random.Random) -> bytes:
    return data + rng.randbytes(rng.randint(1, 4096))


def zeros(data: bytes, rng: random.Random) -> bytes:
    at = rng.choice([0, rng.randrange(len(data)), len(data)])
    return data[:at] + bytes(2**20) + data[at:]


def copies(data: bytes, rng: random.Random) -> bytes:
    return data * rng.randint(2, 20)


def repeat(data: bytes, rng: random.Random) -> bytes:
    at, length = rng.randrange(len(data)), rng.choice([1, 4, 64, 1024])
    return data[:at] + data[at : at + length] * rng.choice([2, 50, 1000]) + data[at + length :]


def move(data: bytes, rng: random.Random) -> bytes:
    """A piece taken out in the middle: all that lies behind it lies elsewhere."""
    at = rng.randrange(len(data))
    return data[:at] + data[at + rng.choice([1, 2, 4, 16, 256]) :]


def number(data: bytes, rng: random.Random) -> bytes:
    """A number of a header, of any width and byte order, with another value."""
    width = rng.choice([1, 2, 4, 4, 4, 8])
    at = rng.randrange(max(1, min(rng.choice([32, 256, 4096]), len(data) - width)))
    if width in (4, 8) and rng.random() < 0.2:
        new = struct.pack(rng.choice("<>") + {4: "f", 8: "d"}[width], rng.choice(FLOATS[:3] + FLOATS[4:]))
    else:
        new = (rng.choice(INTEGERS) % 2 ** (8 * width)).to_bytes(width, rng.choice(["little", "big"]))
    return data[:at] + new + data[at + width :]


def text_number(data: bytes, rng: random.Random) -> bytes:
    """A number that is written out, with another value."""
    found = list(re.finditer(rb"-?\d+(\.\d+)?(e-?\d+)?", data[:65536]))
    chosen = rng.choice(found)
    wild = rng.choice([*INTEGERS, *FLOATS, 10**400])
    return data[: chosen.start()] + str(wild).encode() + data[chosen.end() :]


def word(data: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(len(data) + 1)
    return data[:at] + rng.choice(WORDS) + data[at:]


def other_leaf(value: Any, rng: random.Random) -> Any:  # noqa: ANN401 - nested plain data
    """Nested data in which one leaf, key or branch is another."""
    places: list[tuple[Any, Any]] = []

    def walk(inner: object) -> None:
        items = inner.items() if isinstance(inner, dict) else enumerate(inner) if isinstance(inner, list) else ()
        for key, item in items:
            places.append((inner, key))
            walk(item)

    walk(value)
    if not places:
        return rng.choice(LEAVES)
    holder, key = rng.choice(places)
    kind = rng.choice(["replace", "replace", "replace", "remove", "rename", "more"])
    if kind == "remove":
        del holder[key]
    elif kind == "rename" and isinstance(holder, dict):
        holder[rng.choice(["", "\x00", EVIL, "class_path", "_target_"])] = holder.pop(key)
    elif kind == "more" and isinstance(holder[key], list) and holder[key]:
        holder[key] = holder[key] * rng.choice([2, 100, 10_000])
    elif kind == "more" and isinstance(holder, dict):
        holder.update({f"x{index}": index for index in range(rng.choice([1, 1000]))})
    else:
        old = holder[key]
        near = [np.full(3, np.nan), np.zeros((0, 3)), np.array(["a"]), old[:1]] if isinstance(old, np.ndarray) else []
        holder[key] = rng.choice([*near, *LEAVES])
    return value


def json_leaf(data: bytes, rng: random.Random) -> bytes:
    return json.dumps(other_leaf(json.loads(data), rng)).encode("utf-8", "surrogatepass")


def yaml_leaf(data: bytes, rng: random.Random) -> bytes:
    import yaml

    return yaml.safe_dump(other_leaf(yaml.safe_load(data), rng)).encode()


def pickle_leaf(data: bytes, rng: random.Random) -> bytes:
    value = pickle.loads(data)  # noqa: S301 - our own file
    return pickle.dumps(other_leaf(value, rng), protocol=rng.choice([0, 2, 4, 5]))


def checkpoint_leaf(data: bytes, rng: random.Random) -> bytes:
    """Another leaf of what is not a weight, or other weights."""
    import torch

    content = torch.load(io.BytesIO(data), weights_only=True)
    weights = ("state_dict", "optimizer_states", "callbacks", "loops", "lr_schedulers")
    if rng.random() < 0.2:
        name = rng.choice(sorted(content["state_dict"]))
        old = content["state_dict"][name]
        new = [torch.full_like(old, float("nan")), old[:1], old.to(torch.int64), torch.empty(2**40, device="meta"), 1]
        content["state_dict"][name] = rng.choice(new)
    elif rng.random() < 0.1:
        content[rng.choice(weights)] = rng.choice(LEAVES)
    else:
        rest = {key: value for key, value in content.items() if key not in weights}
        content = {**{key: content[key] for key in weights if key in content}, **other_leaf(rest, rng)}
    saved = io.BytesIO()
    torch.save(content, saved)
    return saved.getvalue()


def npz_member(data: bytes, rng: random.Random) -> bytes:
    """An archive in which one array is another, is missing, occurs twice, or holds other JSON."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = rng.choice(sorted(members))
    kind = rng.choice(["damage", "damage", "header", "json", "remove", "twice", "add", "other"])
    if kind == "remove":
        del members[name]
    elif kind == "header":
        members[name] = npy_header(members[name], rng)
    elif kind == "add":
        members[rng.choice(["../evil.npy", "/evil.npy", "eyeball_x.npy", "a", "version.npy"])] = members[name]
    elif kind == "other":
        wild = rng.choice(
            [np.array(2**62), np.full((4, 3), np.nan), np.zeros((0, 3)), np.zeros((3, 0, 3)), np.array("a")]
        )
        stream = io.BytesIO()
        np.save(stream, wild)
        members[name] = stream.getvalue()
    elif kind == "json":
        texts = [key for key, body in members.items() if b"'<U" in body[:80]]
        key = rng.choice(texts)
        about = json.loads(str(np.load(io.BytesIO(members[key]))))
        stream = io.BytesIO()
        np.save(stream, np.array(json.dumps(other_leaf(about, rng))))
        members[key] = stream.getvalue()
    elif kind == "damage":
        members[name] = rng.choice([flip, cut, number, text_number])(members[name], rng)
    stream = io.BytesIO()
    with (
        warnings.catch_warnings(),
        zipfile.ZipFile(stream, "w", rng.choice([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])) as out,
    ):
        warnings.simplefilter("ignore")
        for key, body in members.items():
            out.writestr(key, body)
        if kind == "twice":
            out.writestr(name, members[name][:-1])
    return stream.getvalue()


def npy_header(data: bytes, rng: random.Random) -> bytes:
    """An array whose header says something else."""
    major = data[6]
    length = struct.unpack("<H", data[8:10])[0] if major == 1 else struct.unpack("<I", data[8:12])[0]
    start = 10 if major == 1 else 12
    shapes = [
        "()",
        "(0,)",
        "(-1,)",
        "(3,)",
        f"({2**63},)",
        f"({2**33}, 3)",
        "(2, 3, 4, 5)",
        "(True,)",
        "(1e9,)",
        "None",
    ]
    kinds = ["<f4", ">f8", "<f2", "|O", "<c16", "<U3", "|V8", "<M8[s]", "|b1", "<i8", "|S0", "<f16", "[('a', '<f4')]"]
    kind = rng.choice(kinds)
    described = kind if kind.startswith("[") else repr(kind)
    order = rng.choice(["False", "False", "True"])
    header = f"{{'descr': {described}, 'fortran_order': {order}, 'shape': {rng.choice(shapes)}, }}".encode()
    header += b" " * (63 - (start + len(header)) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + data[start + length :]


def zip_field(data: bytes, rng: random.Random) -> bytes:
    """A field of an archive's directory: sizes, offsets, method, flags, lengths of names."""
    places = {b"PK\x03\x04": (6, 8, 14, 18, 22, 26, 28), b"PK\x01\x02": (8, 10, 16, 20, 24, 28, 30, 42)}
    places |= {b"PK\x05\x06": (8, 10, 12, 16, 20)}
    mark = rng.choice(list(places))
    starts = [found.start() for found in re.finditer(re.escape(mark), data)]
    offset = rng.choice(places[mark])
    width = 2 if offset in (6, 8, 10, 26, 28, 30) else 4
    at = rng.choice(starts) + offset
    new = (rng.choice(INTEGERS) % 2 ** (8 * width)).to_bytes(width, "little")
    return data[:at] + new + data[at + width :]


def glb_leaf(data: bytes, rng: random.Random) -> bytes:
    length = struct.unpack("<I", data[12:16])[0]
    text = json_leaf(data[20 : 20 + length].rstrip(), rng)
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    return data[:8] + struct.pack("<III", 20 + len(text) + len(rest), len(text), 0x4E4F534A) + text + rest


def safetensors_leaf(data: bytes, rng: random.Random) -> bytes:
    length = struct.unpack("<Q", data[:8])[0]
    text = json_leaf(data[8 : 8 + length], rng)
    return struct.pack("<Q", len(text)) + text + data[8 + length :]


@functools.cache
def bombs(suffix: str) -> tuple[tuple[str, bytes], ...]:
    """Small files that declare or expand to gigabytes, by what they do; made once for all readers of a suffix."""
    return tuple(_bombs(suffix))


def _bombs(suffix: str) -> Iterator[tuple[str, bytes]]:
    header = b"{'descr': '<f4', 'fortran_order': False, 'shape': (%d, 3), }" % 2**31
    header += b" " * (64 - (len(header) + 11) % 64) + b"\n"
    array = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header
    if suffix == ".npy":
        yield "declares 24 GB", array
    elif suffix == ".npz":
        for name, body in (("declares 24 GB", array), ("expands to 300 MB", array + bytes(300 * 2**20))):
            stream = io.BytesIO()
            with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
                for member in ("vertices.npy", "closing.npy", "source_vertices.npy", "v_template.npy"):
                    archive.writestr(member, body if member != "closing.npy" else array)
            yield name, stream.getvalue()
    elif suffix == ".wav":
        data = b"RIFF" + struct.pack("<I", 0xFFFFFFF0) + b"WAVEfmt " + struct.pack("<IHHIIHH", 16, 1, 1, 1, 2, 2, 16)
        yield "1 Hz, for hours", data + b"data" + struct.pack("<I", 80_000) + bytes(80_000)
        yield "declares 4 GB", data + b"data" + struct.pack("<I", 0xFFFFFF00) + bytes(800)
    elif suffix == ".ply":
        for form in (b"binary_little_endian", b"ascii"):
            yield (
                f"two billion vertices, {form.decode()}",
                b"ply\nformat " + form + b" 1.0\nelement vertex 2000000000\nproperty float x\nproperty float y\n"
                b"property float z\nelement face 0\nproperty list uchar int vertex_indices\nend_header\n",
            )
    elif suffix == ".pkl":
        yield "a string of a terabyte", b"\x80\x04\x8e" + struct.pack("<Q", 2**40) + b"x."
        yield "a billion laughs", b"\x80\x04]" + b"".join(b"(" + b"h\x00" * 10 + b"l\x94" for _ in range(9)) + b"."
        yield "nested 100 000 times", b"\x80\x04" + b"]" * 10**5 + b"a" * (10**5 - 1) + b"."
        yield "imports", b"cevilmodule\nEvil\n."
    elif suffix == ".json":
        yield "nested", b"[" * 200_000 + b"]" * 200_000
        yield "a large number", b'{"frame_rate": 1' + b"0" * 200_000 + b"}"
    elif suffix == ".yaml":
        laughs = "\n".join(f"x{i}: &x{i} [{', '.join([f'*x{i - 1}'] * 9)}]" for i in range(1, 12))
        yield "a billion laughs", f"x0: &x0 [lol]\n{laughs}\n".encode()
        yield "refers to itself", b"model: &a [*a]\n"
    elif suffix == ".off":
        yield "two billion vertices", b"OFF\n2000000000 1 0\n"
    elif suffix == ".stl":
        yield "four billion triangles", bytes(80) + struct.pack("<I", 2**32 - 1)


# The law


class TooLong(BaseException):
    """Reading took longer than the law allows; nothing may catch it."""


class Law:
    """Counts what a reader does with damaged files, and keeps what breaks the law."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.broken: list[str] = []

    def check(self, name: str, read: Callable[[Path], object], path: Path, what: str) -> None:
        """Read a file, and look whether the law was kept."""
        world = Path(os.environ["HOME"]).parent
        before, modules = listing(world, path.parent), set(sys.modules)
        reset_peak()
        start, outcome, problem = peak(), "read", ""
        try:
            with warnings.catch_warnings(), time_limit(SECONDS):
                warnings.simplefilter("ignore")
                read(path)
        except FaceDiffError as error:
            outcome = "refused"
            text = str(error)
            if "\n" in text.strip() or not text.strip():
                problem = f"not one line: {text!r}"
            elif len(text) > 1500:
                problem = f"a message of {len(text)} characters: {text[:200]}"
        except TooLong:
            outcome, problem = "broke", f"took more than {SECONDS} s"
        except BaseException as error:  # noqa: BLE001 - whatever else a reader raises breaks the law
            outcome = "broke"
            places = [f"{Path(each.filename).name}:{each.lineno}" for each in traceback.extract_tb(error.__traceback__)]
            problem = f"{type(error).__name__}: {error} at {' '.join(places[-4:])}"
        if peak() - start > MEMORY:
            problem = problem or f"took {(peak() - start) / 2**30:.1f} GiB"
        foreign = {
            module
            for module in set(sys.modules) - modules
            if module == EVIL or str(getattr(sys.modules[module], "__file__", "")).startswith(str(world))
        }
        if foreign:
            problem = problem or f"imported {foreign}"
        if left := listing(world, path.parent) - before:
            problem = problem or f"left {sorted(left)[:3]}"
        self.counts[outcome] += 1
        if problem:
            self.broken.append(f"{name}, {what}: {problem}"[:500])


def listing(world: Path, place: Path) -> set[str]:
    """All files of a world, except those next to the file that is read: what a reader needs is put there."""
    return {str(path) for path in world.rglob("*") if place not in path.parents and "cache" not in path.parts}


@contextmanager
def time_limit(seconds: int) -> Iterator[None]:
    """Raise in this thread after so many seconds of its processor's time: others may keep the machine busy."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise TooLong

    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


def reset_peak() -> None:
    """Let the kernel measure the peak from now on."""
    # Freed memory that the allocator keeps, as it does after a training, would be taken again unseen.
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def peak() -> int:
    """Peak memory in bytes since the last reset, or of the process where it cannot be reset."""
    with suppress(OSError, IndexError):
        status = Path("/proc/self/status").read_text()
        return int(re.findall(r"VmHWM:\s+(\d+) kB", status)[0]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


@contextmanager
def small_world(folder: Path) -> Iterator[Path]:
    """A home, temporary files and a working folder of our own, a small budget, and an address space with an end."""
    names = {"HOME": "home", "TMPDIR": "tmp", "FACEDIFF_CACHE": "cache", "MPLCONFIGDIR": "cache"}
    names |= {"TORCHINDUCTOR_CACHE_DIR": "cache"}
    saved, tmp, cwd = {name: os.environ.get(name) for name in names}, tempfile.tempdir, Path.cwd()
    budget, space = limits.LIMITS.bytes, resource.getrlimit(resource.RLIMIT_AS)
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize() if os.name == "posix" else 0
    for name, inner in names.items():
        (folder / inner).mkdir(exist_ok=True)
        os.environ[name] = str(folder / inner)
    tempfile.tempdir = None
    work = folder / "work"
    work.mkdir()
    (work / f"{EVIL}.py").write_text("import pathlib\npathlib.Path('evil-was-here').touch()\n\nclass Evil: ...\n")
    os.chdir(work)
    object.__setattr__(limits.LIMITS, "bytes", BUDGET)
    with suppress(ValueError, OSError):
        resource.setrlimit(resource.RLIMIT_AS, (size + ADDRESSES, space[1]))
    path, sys.path = sys.path, [*sys.path, str(work)]
    try:
        yield work
    finally:
        sys.path = path
        resource.setrlimit(resource.RLIMIT_AS, space)
        object.__setattr__(limits.LIMITS, "bytes", budget)
        os.chdir(cwd)
        tempfile.tempdir = tmp
        for name, value in saved.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})


def run(name: str, rounds: int, seed: int, folder: Path) -> Law:
    """Damage one format's file, and read each result; a file that is whole comes first."""
    reader, law, rng = READERS[name], Law(), random.Random(f"{name}{seed}")  # noqa: S311
    making = folder / "making"
    making.mkdir()
    valid = making / f"valid{reader.suffix}"
    reader.write(valid)
    data = valid.read_bytes()
    world = folder / "world"
    world.mkdir()
    with small_world(world) as work:

        def check(body: bytes, what: str) -> None:
            place = work / "place"
            place.mkdir()
            path = place / f"file{reader.suffix}"
            path.write_bytes(body)
            law.check(name, reader.read, path, what)
            shutil.rmtree(place)

        check(data, "whole")
        if law.counts["read"] != 1:
            law.broken.append(f"{name}: a whole file is not read: {law.counts}")
        for index in range(max(2, round(rounds * reader.share))):
            kind, body = mutate(data, rng, reader.suffix)
            check(body, f"seed {seed}, round {index}, {kind}")
        for what, body in bombs(reader.suffix):
            check(body, what)
    return law


def main() -> int:
    """Print the counts of every reader; 1 if the law was broken."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=2000, help="damaged files of each format")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--reader", choices=sorted(READERS), action="append")
    args: Any = parser.parse_args()
    broken: list[str] = []
    total: Counter[str] = Counter()
    for name in args.reader or READERS:
        with tempfile.TemporaryDirectory() as folder:
            law = run(name, args.rounds, args.seed, Path(folder))
        print(f"{name:<28}{dict(law.counts)}  {len(law.broken)} broken", flush=True)
        for line in law.broken[:5]:
            print(f"    {line}", flush=True)
        broken += law.broken
        total.update(law.counts)
    print(f"{sum(total.values())} files: {dict(total)}; {len(broken)} broke the law")
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
