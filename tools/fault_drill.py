"""Kills, stops and fills the disk of every command that writes, and counts losses.

    python tools/fault_drill.py --markdown results.md

Each round copies tiny inputs and an earlier output into a new folder, runs a command into a fault, looks at what is
there, runs the command again without a fault, and compares every file with those of an uninterrupted run. It counts

- lost: a file that was there before is gone, or an output does not appear when the command is run again;
- corrupt: a file under its final name is neither the earlier one nor the finished one;
- wrong: the second run fails, or its files differ from the uninterrupted run's;
- left over: files that the uninterrupted run does not have are there after the second run;
- ill-mannered: a traceback, an exit status other than the documented one, no end in a minute.

Faults of a command: ``kill`` (SIGKILL, half of them at the moment of a write, half at any time), ``stop`` (SIGTERM or
Ctrl-C) and ``full`` (a disk with room for a part of what the command writes). ``fit`` is killed and resumed by
``--ckpt_path last`` until it ends; its curve and weights must equal an uninterrupted run's bit for bit.

Runs are forks of a process that has imported everything, which saves seconds each. The small disk is a tmpfs, for which
this program must be root (``unshare --map-root-user --mount`` where users may have namespaces). The exit status is 1 if
any count is not 0.
"""

from __future__ import annotations

import argparse
import atexit
import csv
import hashlib
import importlib
import json
import os
import pkgutil
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")  # many small processes; also makes a fork of this process safe
ROOT = Path(__file__).resolve().parents[1]
if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))

from tools.drill_commands import DRILLS, FIT, WEB_RUNTIME, Drill, write_inputs  # noqa: E402

COUNTS = ("lost", "corrupt", "wrong", "left over", "ill-mannered")
FAULTS = ("kill", "stop", "full")
MINUTE = 60.0
SLACK = 4.0  # a machine that others use as well; the law's minute is for an idle one
LIBRARIES = (
    "torch torchmetrics lightning.pytorch jsonargparse omegaconf numpy scipy.sparse.linalg scipy.spatial scipy.signal"
)
LIBRARIES += " scipy.optimize trimesh pygltflib soundfile soxr cv2 av PIL.Image h5py yaml rich.table rich.progress"
LIBRARIES += " matplotlib.pyplot fast_simplification dtaidistance tensorboard pxr.Usd"


# Running a command


@dataclass
class Run:
    """How a run ended.

    Attributes:
        status: exit status; negative for a signal.
        out: standard output.
        err: standard error.
        seconds: how long it took.
        points: moments at which it opened a file to write, renamed or removed one.
        struck: whether the fault came before the end.
    """

    status: int
    out: str
    err: str
    seconds: float
    points: int = 0
    struck: bool = False


def import_everything() -> None:
    """Import all that any command imports, so that forks need not."""
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name in LIBRARIES.split():
            with suppress(ImportError):
                importlib.import_module(name)
        import facediff

        for module in pkgutil.walk_packages(facediff.__path__, "facediff."):
            if not module.name.endswith("__main__"):
                with suppress(ImportError):
                    importlib.import_module(module.name)
        importlib.import_module("tests.fakes.tiny")
    import torch

    torch.set_num_threads(1)


def execute(
    words: Sequence[str],
    place: Path,
    *,
    number: int = signal.SIGKILL,
    after: float | None = None,
    point: int | None = None,
    delay: float = 0.0,
    prepare: Callable[[], None] = lambda: None,
) -> Run:
    """Run ``facediff`` with some words in the folder ``place/work``, and strike it.

    Args:
        words: what follows ``facediff``.
        place: folder with ``work``; gets ``home`` and ``tmp``.
        number: the signal to send.
        after: seconds after which to send it.
        point: or the number of the write at which to send it.
        delay: seconds between that write and the signal.
        prepare: called in the new process.
    """
    for name in ("home", "tmp"):
        (place / name).mkdir(exist_ok=True)
    reader, writer = os.pipe()
    start = time.monotonic()
    logs = [place / "stdout", place / "stderr"]
    sys.stdout.flush()
    sys.stderr.flush()
    process = os.fork()
    if process == 0:
        os.close(reader)
        run_forked(words, place, logs, writer, point, prepare)
    os.close(writer)
    struck, points, status = False, 0, None
    os.set_blocking(reader, False)
    begun, strike_at, limit = None, None, start + MINUTE * SLACK
    while status is None:
        for word in read_pipe(reader):
            if word == "begun":
                begun = time.monotonic()
                strike_at = None if after is None else begun + after
            elif word == "point":
                strike_at = time.monotonic() + delay
            elif word.isdigit():
                points = int(word)
        if strike_at is not None and time.monotonic() >= strike_at:
            struck, strike_at = True, None
            with suppress(ProcessLookupError):
                # Ctrl-C reaches all processes of a terminal; kill -9 and SIGTERM are sent to one.
                (os.killpg if number == signal.SIGINT else os.kill)(process, number)
        if time.monotonic() > limit:
            os.killpg(process, signal.SIGKILL)
        ended, code = os.waitpid(process, os.WNOHANG)
        if ended:
            status = os.waitstatus_to_exitcode(code)
        else:
            time.sleep(0.001 if strike_at is not None else 0.005)
    seconds = time.monotonic() - (begun or start)
    for word in read_pipe(reader):
        if word.isdigit():
            points = int(word)
        struck |= word == "struck"
    os.close(reader)
    with suppress(ProcessLookupError):  # worker processes of one that was killed
        os.killpg(process, signal.SIGKILL)
    out, err = (path.read_text(errors="replace") for path in logs)
    return Run(status, out, err, seconds, points, struck or status == -number)


def read_pipe(reader: int) -> list[str]:
    """The words that the child has written so far."""
    try:
        return os.read(reader, 65536).decode().split()
    except BlockingIOError:
        return []


def environment(place: Path) -> dict[str, str]:
    """Home, caches and temporary files in the round's folder."""
    return {
        "HOME": str(place / "home"),
        "TMPDIR": str(place / "tmp"),
        "FACEDIFF_CACHE": str(place / "home" / "cache"),
        "MPLCONFIGDIR": str(place.parent / "matplotlib"),
        "PYTHONPATH": str(ROOT),
        "HF_HUB_OFFLINE": "1",
    }


def run_forked(
    words: Sequence[str],
    place: Path,
    logs: Sequence[Path],
    writer: int,
    point: int | None,
    prepare: Callable[[], None],
) -> None:
    """Run a command in a forked process, as ``python -m facediff`` would, and end the process."""
    status = 70
    try:
        os.setsid()
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        for descriptor, path in zip((1, 2), logs, strict=True):
            os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644), descriptor)
        os.environ.update(environment(place))
        tempfile.tempdir = None
        os.chdir(place / "work")
        atexit._clear()
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        random.seed(place.name)
        prepare()
        count = watch_writes(place, writer, point)
        from facediff.cli import app, demo
        from facediff.runtime import onnxruntime_web

        if Path(WEB_RUNTIME).exists():
            files = {path.name: path.resolve() for path in Path(WEB_RUNTIME).iterdir()}
            onnxruntime_web.web_runtime = lambda *_, **__: files
        if Path("demo.yaml").exists():
            demo.CONFIG = "demo.yaml"
        sys.argv = ["facediff", *words]
        sys.path[:] = [each for each in sys.path if each != ""]
        os.write(writer, b"begun ")
        try:
            code: Any = app.main()  # without words: streams and signals are set up as in a process of its own
        except SystemExit as stop:
            code = stop.code
        except KeyboardInterrupt:
            traceback.print_exc()
            code = 130
        except BaseException:  # noqa: BLE001 - as the interpreter ends
            traceback.print_exc()
            code = 1
        if isinstance(code, str):
            print(code, file=sys.stderr)
        status = code if isinstance(code, int) else int(bool(code))
        atexit._run_exitfuncs()
        sys.stdout.flush()
        sys.stderr.flush()
        os.write(writer, f"{count()} ".encode())
    except BaseException:  # noqa: BLE001 - whatever happened, this process must not return to the caller's code
        traceback.print_exc()
    finally:
        os._exit(status & 0xFF)


def watch_writes(place: Path, writer: int, point: int | None) -> Callable[[], int]:
    """Count the moments at which files below ``place`` are opened to write, renamed or removed.

    At number ``point`` the parent is told. It decides when to strike.
    """
    seen = 0
    watched = {"os.rename", "os.remove", "os.rmdir", "os.mkdir", "os.link", "os.symlink", "os.truncate"}

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        nonlocal seen
        if event == "open":
            path, mode, flags = arguments
            if not isinstance(path, str | bytes) or not (
                any(letter in (mode or "") for letter in "wax+")
                or (flags or 0) & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
            ):
                return
        elif event in watched:
            path = arguments[0]
        else:
            return
        if os.fsdecode(path).startswith("/dev/"):
            return
        seen += 1
        if seen == point:
            os.write(writer, b"point ")
            time.sleep(0.02)  # the parent strikes in this moment, or a little later

    sys.addaudithook(hook)
    return lambda: seen


# What is there


def tree(folder: Path) -> dict[str, str]:
    """All files and links below a folder: a fingerprint of each by its relative path; empty folders too."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_symlink():
            found[name] = f"link to {os.readlink(path)}"
        elif path.is_file():
            found[name] = fingerprint(path)
        elif not any(path.iterdir()):
            found[name + "/"] = "folder"
    return found


def fingerprint(path: Path) -> str:
    """A hash of a file's content without what a clock has written into it."""
    data = path.read_bytes()
    if path.suffix == ".log":
        data = b""  # a diary of all runs, the interrupted ones too
    elif path.suffix == ".csv":
        data = without_times(data)
    elif path.suffix == ".ckpt":
        with suppress(Exception):  # a damaged one is compared by its bytes
            import torch

            content = torch.load(path, map_location="cpu", weights_only=True)
            data = repr(plain(content)).encode()
    elif path.name in ("referee.md", "referee.html"):  # its table tells the real-time factor and the memory
        data = re.sub(rb"[0-9.]+\W+(?:td\W+)*[0-9]+ MiB", b"", data)
    elif path.suffix == ".json":
        with suppress(ValueError):
            data = json.dumps(plain(json.loads(data))).encode()
    return hashlib.sha256(data).hexdigest()[:16]


CLOCKS = {
    "time",
    "seconds",
    "sec",
    "created",
    "date",
    "started",
    "modified",
    "throughput",
    "duration",
    "versions",
    "memory",
    "checkpoint",
}
"""Words in the names of what differs between two equal runs.

A checkpoint's hash is one of these: the file has times and the run's folder in it. Its content is compared itself."""


def of_a_clock(name: object) -> bool:
    """Whether a column or a field tells of times."""
    return not CLOCKS.isdisjoint(re.split("[^a-z]+", str(name).lower()))


def without_times(data: bytes) -> bytes:
    """The columns of a table that are not times."""
    lines = data.decode(errors="replace").splitlines()
    rows = list(csv.reader(lines))
    keep = [i for i, name in enumerate(rows[0] if rows else []) if not of_a_clock(name)]
    return repr([[row[i] for i in keep if i < len(row)] for row in rows]).encode()


def plain(value: Any) -> Any:  # noqa: ANN401
    """Nested data with hashes in place of tensors, and without times."""
    import torch

    if isinstance(value, torch.Tensor):
        array = value.detach().contiguous()
        return [str(array.dtype), list(array.shape), hashlib.sha256(array.numpy().tobytes()).hexdigest()]
    if isinstance(value, dict):
        if value.get("metric") == "real_time_factor":
            return None
        return {str(k): plain(v) for k, v in value.items() if not of_a_clock(k)}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return re.sub(r"/\S*/(?=work/)", "", value) if isinstance(value, str) else value  # the round's folder


# The small disk


class Disk:
    """A file system of its own in memory, whose room a filler takes.

    Args:
        folder: where it is mounted.
    """

    SIZE = 96 * 2**20

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir()
        subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={self.SIZE}", "tmpfs", str(folder)], check=True)

    def fill(self, room: int) -> None:
        """Leave ``room`` bytes."""
        facts = os.statvfs(self.folder)
        size = max(facts.f_bavail * facts.f_frsize - room, 1)
        with (self.folder / "filler").open("wb") as filler:
            os.posix_fallocate(filler.fileno(), 0, size)

    def free(self) -> None:
        """Remove the filler."""
        (self.folder / "filler").unlink(missing_ok=True)

    def close(self) -> None:
        """Unmount."""
        subprocess.run(["umount", "-l", str(self.folder)], check=False)


# Rounds


@dataclass
class Score:
    """What the rounds of one command and one fault came to.

    Attributes:
        rounds: how many.
        struck: in how many the fault came before the end.
        counts: by :data:`COUNTS`.
        notes: a line for each finding.
    """

    rounds: int = 0
    struck: int = 0
    counts: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)

    def note(self, what: str, text: str) -> None:
        """Count a finding."""
        self.counts[what] += 1
        self.notes.append(f"{what}: {text}"[:600])


class Driller:
    """Drills one command.

    Args:
        drill: the command.
        inputs: the folder of all inputs.
        scratch: an empty folder.
        disk: the small disk.
        seed: of the moments, the faults and the damages.
    """

    def __init__(self, drill: Drill, inputs: Path, scratch: Path, disk: Disk, seed: int) -> None:
        self.drill = drill
        self.scratch = scratch
        self.disk = disk
        self.random = random.Random(f"{seed} {drill.name}")  # noqa: S311
        self.score = Score()
        self.what = ""
        self.number = 0
        begin = self.scratch / "begin" / "work"
        begin.mkdir(parents=True)
        (self.scratch / "matplotlib").mkdir()
        for path in drill.inputs(inputs):
            copy(path, begin / path.name)
        (begin / "bystander.txt").write_text("of somebody else\n")
        if drill.earlier:
            self.expect_success(execute(drill.argv(drill.earlier), begin.parent), "the earlier run")
        self.before = tree(begin)
        copy(self.scratch / "begin", self.scratch / "whole")
        self.whole = execute(drill.argv(), self.scratch / "whole")
        self.expect_success(self.whole, "the uninterrupted run")
        self.after = tree(self.scratch / "whole" / "work")
        self.written = sum(
            (self.scratch / "whole" / "work" / name).stat().st_size
            for name, mark in self.after.items()
            if self.before.get(name) != mark and not name.endswith("/")
        )
        if not set(self.after) - set(self.before) and self.after == self.before:
            raise RuntimeError(f"{drill.name}: the drill writes nothing")

    def expect_success(self, run: Run, what: str) -> None:
        """Stop the drill if a run without a fault fails."""
        if run.status != 0:
            raise RuntimeError(f"{self.drill.name}: {what} ended with {run.status}:\n{run.out}\n{run.err}")

    @contextmanager
    def round(self, score: Score, what: str, parent: Path | None = None) -> Iterator[Path]:
        """A new folder with the inputs and the earlier outputs."""
        self.score, self.number = score, self.number + 1
        score.rounds += 1
        self.what = f"{self.drill.name}, round {self.number}, {what}"
        place = (parent or self.scratch) / f"round{self.number}"
        copy(self.scratch / "begin", place)
        try:
            yield place
        finally:
            for folder in [place, *(each for each in place.rglob("*") if each.is_dir() and not each.is_symlink())]:
                os.chmod(folder, 0o755)  # noqa: S103
            shutil.rmtree(place, ignore_errors=True)

    # Judging

    def note(self, what: str, text: str) -> None:
        """Count a finding of this round."""
        self.score.note(what, f"{self.what}: {text}")

    def judge_manners(self, run: Run, allowed: Sequence[int]) -> None:
        """No traceback, and a documented exit status."""
        said = run.out + run.err
        if run.seconds > MINUTE * SLACK:
            self.note("ill-mannered", f"took {run.seconds:.0f} s")
        if "Traceback (most recent call last)" in said or "Exception ignored" in said:
            self.note("ill-mannered", f"traceback: {said.strip()[-300:]}")
        elif run.status not in allowed:
            self.note("ill-mannered", f"status {run.status}, expected {allowed}: {said.strip()[-200:]}")

    def judge_files(self, place: Path, *, clean: bool = False) -> None:
        """Right after a fault: every file is the earlier one or the finished one.

        Args:
            place: the round's folder.
            clean: whether nothing else may be there, since the command could tidy up.
        """
        found = tree(place / "work")
        for name in self.before:
            mine = (self.before[name], self.after.get(name, ""))
            if name.endswith("/") or self.in_pieces(name):
                continue
            if name not in found:
                self.note("lost", f"{name} is gone")
            elif found[name] not in mine:
                self.note("corrupt", f"{name} is neither the earlier nor the finished file")
        for name in found.keys() - self.before.keys():
            if name in self.after and found[name] != self.after[name] and not self.in_pieces(name):
                self.note("corrupt", f"{name} is not the finished file")
            if clean and name not in self.after and not self.drill.pieces:
                self.note("left over", f"{name} is there after an orderly end")

    def in_pieces(self, name: str) -> bool:
        """Whether a file grows during the run, or is the state of the run, which the next run shows to be whole."""
        return self.drill.pieces and name.endswith((".csv", ".yaml", ".json", ".lock", "last.ckpt"))

    def judge_again(self, place: Path) -> None:
        """Run the command again: what is there equals what an uninterrupted run leaves."""
        finished = self.drill.once and tree(place / "work") == self.after
        run = execute(self.drill.argv(), place)
        if finished and run.status == 2:
            return
        if run.status != 0:
            self.note("wrong", f"the next run ended with {run.status}: {(run.out + run.err).strip()[-300:]}")
            return
        self.judge_manners(run, (0,))
        self.judge_result(place)

    def judge_result(self, place: Path) -> None:
        """All files equal the uninterrupted run's."""
        found = tree(place / "work")
        for name, mark in self.after.items():
            if name not in found:
                self.note("lost", f"{name} is not there after the next run")
            elif found[name] != mark:
                self.note("wrong", f"{name} differs from the uninterrupted run's")
        for name in found.keys() - self.after.keys():
            self.note("left over", f"{name} is there after the next run")

    # Faults

    def kill(self, score: Score) -> None:
        """Kill -9, then run again."""
        moment = moment_of(self.whole, self.random, 0.5)
        with self.round(score, f"SIGKILL {moment}") as place:
            run = execute(self.drill.argv(), place, **moment)
            score.struck += run.status == -signal.SIGKILL
            self.judge_files(place)
            self.judge_again(place)

    def stop(self, score: Score) -> None:
        """SIGTERM or Ctrl-C, then run again."""
        number = self.random.choice([signal.SIGTERM, signal.SIGINT])
        moment = moment_of(self.whole, self.random, 0.5)
        with self.round(score, f"{signal.Signals(number).name} {moment}") as place:
            run = execute(self.drill.argv(), place, number=number, **moment)
            score.struck += run.status != 0
            # A process that a signal ends has the same status for the shell as one that ends with 128 + number.
            self.judge_manners(run, (0, 128 + number, -number))
            self.judge_files(place, clean=True)
            (self.judge_again if run.status else self.judge_result)(place)

    def full(self, score: Score) -> None:
        """A disk with room for a part of what is written; with more room, run again."""
        room = int(self.written * self.random.uniform(0, 1.2))
        with self.round(score, f"room for {room} of {self.written} bytes", self.disk_folder()) as place:
            for name in ("home", "tmp"):
                (place / name).mkdir(exist_ok=True)
            logs = self.scratch / "logs"  # what is printed must not share the full disk
            logs.mkdir(exist_ok=True)
            for name in ("stdout", "stderr"):
                (place / name).symlink_to(logs / name)
            self.disk.fill(room)
            run = execute(self.drill.argv(), place)
            self.disk.free()
            score.struck += run.status != 0
            self.judge_manners(run, (0, 1, 2))
            self.judge_files(place, clean=True)
            (self.judge_again if run.status else self.judge_result)(place)

    def disk_folder(self) -> Path:
        """A folder on the small disk for this command."""
        folder = self.disk.folder / self.scratch.name
        folder.mkdir(exist_ok=True)
        (folder / "matplotlib").mkdir(exist_ok=True)
        return folder


def moment_of(run: Run, chance: random.Random, share: float) -> dict[str, Any]:
    """When to strike: in a share of the rounds at a write or soon after one, else at any time of a whole run."""
    if chance.random() < share and run.points:
        late = chance.choice([0.0, chance.uniform(0, 0.05)])
        return {"point": chance.randint(1, run.points), "delay": late}
    return {"after": chance.uniform(0, 1.05 * run.seconds)}


def copy(source: Path, target: Path) -> None:
    """Copy a file or a folder."""
    if source.is_dir():
        shutil.copytree(source, target, symlinks=True)
    else:
        shutil.copy(source, target)


# Training


class FitDriller:
    """Kills and stops training at any moment and resumes it, until it ends.

    Args:
        inputs: the folder of all inputs.
        scratch: an empty folder.
        seed: of the moments.
    """

    WORDS = ("fit", "--config", "fit.yaml")
    MOST_ATTEMPTS = 8

    def __init__(self, inputs: Path, scratch: Path, seed: int) -> None:
        self.inputs = inputs
        self.scratch = scratch
        self.random = random.Random(f"{seed} fit")  # noqa: S311
        self.scores = {"kill": Score(), "stop": Score()}
        (scratch / "matplotlib").mkdir()
        results = []
        for name in ("whole", "twice"):
            place = self.new(name)
            self.whole = execute(self.WORDS, place)
            if self.whole.status != 0:
                raise RuntimeError(f"fit: the uninterrupted run failed: {self.whole.out} {self.whole.err}")
            results.append(tree(place / "work"))
        self.expected = results[0]
        if results[0] != results[1]:
            different = sorted(name for name in results[0] if results[0][name] != results[1].get(name))
            raise RuntimeError(f"fit: two uninterrupted runs differ in {different}")

    def new(self, name: str) -> Path:
        """A folder with the corpus and the config."""
        place = self.scratch / name
        (place / "work").mkdir(parents=True)
        for each in ("corpus", "fit.yaml"):
            copy(self.inputs / each, place / "work" / each)
        return place

    def drill(self, kills: int, stops: int) -> dict[str, Score]:
        """Train until so many kills and stops have come before the end of a run."""
        wanted = {"kill": kills, "stop": stops}
        for run in range(1, 10 * (kills + stops)):
            if all(self.scores[fault].struck >= wanted[fault] for fault in wanted):
                break
            self.train(f"run{run}", wanted)
        return self.scores

    def train(self, name: str, wanted: Mapping[str, int]) -> None:
        """Train once, from the start to the end, with several strikes between."""
        place = self.new(name)
        story: list[str] = []
        for attempt in range(self.MOST_ATTEMPTS + 1):
            missing = [fault for fault in wanted if self.scores[fault].struck < wanted[fault]]
            fault = self.random.choice(missing) if missing and attempt < self.MOST_ATTEMPTS else ""
            number = signal.SIGKILL if fault != "stop" else self.random.choice([signal.SIGTERM, signal.SIGINT])
            moment = moment_of(self.whole, self.random, 0.7) if fault else {}
            resumes = any(place.rglob("last.ckpt"))
            words = [*self.WORDS, *(["--ckpt_path", "last"] if resumes else [])]
            run = execute(words, place, number=number, **moment)
            story.append(f"{fault} {moment} {'resumed ' if resumes else ''}{run.status}")
            score = self.scores[fault or "kill"]
            if run.status == 0:
                break
            if fault == "" or (fault == "kill" and run.status != -number):
                said = (run.out + run.err).strip()[-500:]
                score.note("wrong", f"fit, {name}: a run failed: {said}; {story}")
                break
            score.rounds += 1
            score.struck += 1
            if fault == "stop":
                manners = run.status in (128 + number, -number) and "Traceback" not in run.out + run.err
                if not manners:
                    score.note("ill-mannered", f"fit, {name}: {(run.out + run.err).strip()[-300:]}; {story}")
        found = tree(place / "work")
        score = self.scores["kill" if any("kill" in each for each in story) else "stop"]
        for file, mark in self.expected.items():
            if file not in found:
                score.note("lost", f"fit, {name}: {file}; {story}")
            elif found[file] != mark:
                score.note("wrong", f"fit, {name}: {file} differs from the uninterrupted run's; {story}")
        for file in found.keys() - self.expected.keys():
            score.note("left over", f"fit, {name}: {file}; {story}")
        shutil.rmtree(place)


# The whole drill


def drill_one(drill: Drill, inputs: Path, scratch: Path, args: argparse.Namespace) -> dict[str, Score]:
    """All faults of one command."""
    disk = Disk(scratch / "disk")
    try:
        return drill_on(drill, inputs, scratch, disk, args)
    finally:
        disk.close()


def drill_on(drill: Drill, inputs: Path, scratch: Path, disk: Disk, args: argparse.Namespace) -> dict[str, Score]:
    """The rounds, on a disk."""
    driller = Driller(drill, inputs, scratch, disk, args.seed)
    wanted = {"kill": args.kills, "stop": args.stops, "full": args.full}
    scores = {}
    for fault in FAULTS:
        score = scores[fault] = Score()
        index = 0
        # A strike that comes after the end is none; but a command may be too short to be struck so often.
        while (score.struck if fault in ("kill", "stop") else index) < wanted[fault] and index < 3 * wanted[fault]:
            index += 1
            try:
                getattr(driller, fault)(score)
            finally:
                disk.free()
    return scores


def separately(
    tasks: dict[str, Callable[[], dict[str, Score]]], jobs: int, folder: Path
) -> dict[str, dict[str, Score]]:
    """Do tasks in forks of this process, some at a time; each hands its scores over in a file."""
    waiting, running, results = list(tasks), {}, {}
    while waiting or running:
        while waiting and len(running) < jobs:
            name = waiting.pop(0)
            file = folder / f"{len(waiting)}.json"
            process = os.fork()
            if process == 0:
                try:
                    scores = {fault: vars(score) for fault, score in tasks[name]().items()}
                    file.write_text(json.dumps(scores))
                    os._exit(0)
                except BaseException:  # noqa: BLE001 - reported by the parent
                    file.write_text(json.dumps(traceback.format_exc()))
                    os._exit(1)
            running[process] = (name, file)
        process, _ = os.wait()
        if process not in running:
            continue
        name, file = running.pop(process)
        content = json.loads(file.read_text()) if file.exists() else "the drill was killed"
        if isinstance(content, str):
            scores = {"kill": Score()}
            scores["kill"].note("wrong", f"{name}: the drill failed: …{content[-500:]}")
        else:
            scores = {fault: Score(**{**facts, "counts": Counter(facts["counts"])}) for fault, facts in content.items()}
        results[name] = scores
        found = sum(sum(score.counts.values()) for score in scores.values())
        rounds = sum(score.rounds for score in scores.values())
        print(f"{time.strftime('%H:%M:%S')} {name}: {rounds} rounds, {found} findings", file=sys.stderr, flush=True)
        for score in scores.values():
            for note in score.notes[:6]:
                print(f"  {note}", file=sys.stderr, flush=True)
    return {name: results[name] for name in tasks}


def table(results: dict[str, dict[str, Score]]) -> str:
    """The counts as Markdown: a line for each command, with rounds by fault."""
    from facediff.reporting.documents import markdown_table

    head = ["command", *FAULTS, *COUNTS]
    rows, totals = [], Counter[str]()
    for name, scores in results.items():
        row = Counter[str]()
        for fault, score in scores.items():
            row[fault] += score.struck if fault in ("kill", "stop") else score.rounds
            row.update(score.counts)
        totals.update(row)
        rows.append([f"`{name}`", *(row[key] for key in head[1:])])
    return markdown_table(head, [*rows, ["all", *(totals[key] for key in head[1:])]])


def options(words: Sequence[str] | None = None) -> argparse.Namespace:
    """The options."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=6, metavar="N", help="kill -9 of each command (default: 6)")
    parser.add_argument("--stops", type=int, default=2, metavar="N", help="SIGTERM or Ctrl-C of each command")
    parser.add_argument("--full", type=int, default=3, metavar="N", help="full disks of each command")
    parser.add_argument(
        "--fit-kills", type=int, default=50, metavar="N", help="kill -9 of fit, each followed by a resume"
    )
    parser.add_argument("--fit-stops", type=int, default=10, metavar="N", help="SIGTERM or Ctrl-C of fit")
    parser.add_argument("--only", action="append", metavar="TEXT", help="commands whose name contains this; repeatable")
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="commands drilled at a time")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--markdown", type=Path, metavar="FILE", help="write the table there as well")
    return parser.parse_args(words)


def main(words: Sequence[str] | None = None) -> int:
    """Drill, and print the table; 1 if anything was lost, corrupt, wrong, left over or ill-mannered."""
    args = options(words)
    started = time.monotonic()
    import_everything()
    with tempfile.TemporaryDirectory(prefix="fault-drill-") as name:
        folder = Path(name)
        inputs = folder / "inputs"
        inputs.mkdir()
        separately({"inputs": lambda: make_inputs(inputs, folder)}, 1, folder)
        tasks: dict[str, Callable[[], dict[str, Score]]] = {}
        if (args.fit_kills or args.fit_stops) and (not args.only or FIT in args.only):
            scratch = folder / "fit"
            scratch.mkdir()
            tasks[FIT] = lambda: FitDriller(inputs, scratch, args.seed).drill(args.fit_kills, args.fit_stops)
        for index, drill in enumerate(DRILLS):
            if args.only and not any(text in drill.name for text in args.only):
                continue
            place = folder / f"drill{index}"
            place.mkdir()
            tasks[drill.name] = lambda drill=drill, place=place: drill_one(drill, inputs, place, args)
        results = separately(tasks, args.jobs, folder)
    text = table(results)
    text += f"\n\nSeed {args.seed}; {time.monotonic() - started:.0f} s.\n"
    print(text)
    if args.markdown is not None:
        args.markdown.write_text(text, encoding="utf-8")
    return int(any(sum(score.counts.values()) for scores in results.values() for score in scores.values()))


def make_inputs(inputs: Path, folder: Path) -> dict[str, Score]:
    """Write the inputs, in a process of its own: this one must never compute, since it is forked."""
    place = folder / "making"
    (place / "work").mkdir(parents=True)
    (folder / "matplotlib").mkdir()
    inputs.rmdir()
    (place / "work").rename(inputs)
    (place / "work").symlink_to(inputs)

    def run(words: Sequence[str], _: Path) -> None:
        done = execute(words, place)
        if done.status:
            raise RuntimeError(f"{words}: {done.err}")

    write_inputs(inputs, run)
    return {}


if __name__ == "__main__":
    sys.exit(main())
