"""Do the tests feel every term? Change the mathematics a little, one place at a time, and see whether a test fails.

    python tools/mutation_run.py --count 200 --seed 0 --state mutations

A *mutant* is the package with one small change: a plus that became a minus, a term or a square root left out, a mean
that became a sum, a condition negated, a statement removed, and so on. It is *killed* if a test fails (or hangs), and
it *survives* if all of them pass; then either the change makes no difference, or a test is missing.

The mutants are a seeded sample of all that can be made of the sources, and are written into a copy of the project.
First, every test is run once and the functions that it calls are noted; a mutant is then shown only to the tests that
call the changed function, and those that killed neighbours before go first. The libraries are imported once, in this
process; each mutant is tested in a fork of it, which imports the project. What was tried is kept in the folder
``--state``, so that a later call tries others only, and ``--again`` the survivors.
"""

# ruff: noqa: D102 - methods of visitors and plugins are named by ast and pytest

from __future__ import annotations

import argparse
import collections
import contextlib
import hashlib
import importlib
import importlib.util
import itertools
import json
import os
import shutil
import signal
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from tools.mutants import Mutant, sample  # noqa: E402

ROOT = Path(__file__).resolve().parents[1]
MODELS = ["dual_path/model", "dual_path/network", "samplers", "losses", "losses_fused", "motion_space", "principal"]
MODELS += ["folding", "layers", "decoders", "fusions", "speaker_encoders", "mesh_encoders", "audio_encoders"]
MODELS += ["inference", "style_content/losses", "style_content/model", "style_content/network"]
SOURCES = [f"facediff/models/{name}.py" for name in MODELS] + ["facediff/metrics/*.py"]
TESTS = ["tests/models", "tests/metrics", "tests/test_published_numbers.py", "facediff/models", "facediff/metrics"]
# They start processes or try thousands of arguments, and compute little.
WITHOUT = [f"tests/models/test_{name}.py" for name in ("checkpoint_door", "constructor_arguments", "identity_policy")]
WITHOUT += [f"tests/metrics/test_{name}.py" for name in ("metric_processes", "metric_import", "metrics_only_project")]
PRELOADED = "torch torch._dynamo torchmetrics lightning.pytorch lightning.pytorch.cli jsonargparse jaxtyping beartype"
PRELOADED += " scipy.optimize scipy.spatial scipy.signal rich hypothesis.strategies soundfile soxr transformers"
FIRST = 4
"""How many files of tests are imported before all others are."""
LIMIT = 60.0
"""Seconds after which a test hangs, besides ten times its usual time; importing is in them."""

# --- Tests -----------------------------------------------------------------------------------------------------------


@dataclass
class Test:
    """One test: how long it takes, and what it calls."""

    __test__ = False

    seconds: float = 0.0
    passed: bool = True
    calls: list[str] = field(default_factory=list)

    def touches(self, mutant: Mutant) -> bool:
        """Whether it calls the changed function; for a class's or a module's own lines, anything in it."""
        name = f"{mutant.file}:{mutant.function}"
        within = f"{name}." if mutant.function else name
        return any(call == name or call.startswith(within) for call in self.calls)


class Recorder:
    """A plugin of pytest that notes which functions of some files each test calls, its shared fixtures' too."""

    def __init__(self, files: dict[str, str]) -> None:
        self.files = files
        self.tests: dict[str, Test] = {}
        self.calls: set[str] = set()
        self.of_fixture: dict[int, set[str]] = {}
        self.names: dict[CodeType, str | None] = {}

    def trace(self, frame: FrameType, event: str, argument: object) -> None:
        code = frame.f_code
        if code not in self.names:
            file = self.files.get(code.co_filename)
            self.names[code] = file and f"{file}:{code.co_qualname.split('.<locals>')[0]}"
        if name := self.names[code]:
            self.calls.add(name)

    @contextlib.contextmanager
    def tracing(self) -> Iterator[set[str]]:
        outer, self.calls = self.calls, set()
        before = sys.gettrace()
        threading.settrace(self.trace)
        sys.settrace(self.trace)
        try:
            yield self.calls
        finally:
            sys.settrace(before)
            threading.settrace(before)  # type: ignore[arg-type]
            outer |= self.calls
            self.calls = outer

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any) -> Iterator[None]:  # noqa: ANN401
        with self.tracing() as calls:
            try:
                return (yield)  # type: ignore[return-value]
            finally:
                self.of_fixture[id(fixturedef)] = calls

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: Any) -> Iterator[None]:  # noqa: ANN401
        started = sum(os.times()[:4])  # of the processor, also children's: what else the machine does is no matter
        with self.tracing() as calls:
            result = yield
        # A fixture of a module or session runs with the first of its tests, but is part of all of them.
        for definitions in getattr(getattr(item, "_fixtureinfo", None), "name2fixturedefs", {}).values():
            for definition in definitions:
                calls |= self.of_fixture.get(id(definition), set())
        test = self.tests.setdefault(item.nodeid, Test())
        test.seconds, test.calls = sum(os.times()[:4]) - started, sorted(calls)
        return result  # type: ignore[return-value]

    def pytest_runtest_logreport(self, report: Any) -> None:  # noqa: ANN401
        if report.failed:
            self.tests.setdefault(report.nodeid, Test()).passed = False


class Chosen:
    """A plugin of pytest that runs some tests only, in a given order, and notes which fails."""

    def __init__(self, tests: Sequence[str], note: Path) -> None:
        self.place = {name: i for i, name in enumerate(tests)}
        self.note = note

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[Any]) -> None:
        items[:] = sorted((i for i in items if i.nodeid in self.place), key=lambda item: self.place[item.nodeid])

    def pytest_runtest_logreport(self, report: Any) -> None:  # noqa: ANN401
        if report.failed:
            self.note.write_text(report.nodeid)

    def pytest_collectreport(self, report: Any) -> None:  # noqa: ANN401
        if report.failed:
            self.note.write_text(f"{report.nodeid} (import)")


def forked(work: Callable[[], int], limit: float) -> int | None:
    """The exit status of some work in a process of its own, which ends with all that it started; None after a limit."""
    child = os.fork()
    if child == 0:
        status = 99
        try:
            os.setsid()
            status = work()
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(status)
    ends = time.monotonic() + limit
    status: int | None = None
    while status is None and time.monotonic() < ends:
        done, code = os.waitpid(child, os.WNOHANG)
        status = os.waitstatus_to_exitcode(code) if done else None
        time.sleep(0 if done else 0.01)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)  # the hanging test, or what a test left running
    if status is None:
        os.waitpid(child, 0)
    return status


@dataclass
class Outcome:
    """What became of a mutant: killed, survived, or no test calls it."""

    file: str
    line: int
    function: str
    what: str
    diff: str
    result: str
    by: str = ""
    seconds: float = 0.0
    tests: int = 0


class Workshop:
    """A copy of the project in which mutants are made and tested, each in a fork of this process.

    Args:
        root: the project.
        folder: where the copy is made.
        state: where outcomes and the calls of tests are kept.
        files: files of tests.
        seconds: how long the tests shown to one mutant may take together, measured without the change.
    """

    def __init__(self, root: Path, folder: Path, state: Path, files: Sequence[str], seconds: float) -> None:
        self.root, self.copy, self.folder, self.state, self.seconds = root, folder / "copy", folder, state, seconds
        hidden = shutil.ignore_patterns(".git", "__pycache__", "*.pyc", ".venv", "node_modules", state.name)
        shutil.copytree(root, self.copy, ignore=hidden)
        self.files = files
        self.tests: dict[str, Test] = {}
        self.killers: dict[str, collections.Counter[str]] = collections.defaultdict(collections.Counter)

    def pytest(self, arguments: Sequence[str], plugin: object) -> int:
        """One run of pytest in the copy, quietly, on this process; the project's own options stay."""
        output = os.open(self.folder / "pytest.log", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(output, 1)
        os.dup2(output, 2)
        os.chdir(self.copy)
        sys.path[:] = [str(self.copy), *(p for p in sys.path if Path(p or ".").resolve() != self.root)]
        os.environ["PYTHONPATH"] = str(self.copy)
        sys.dont_write_bytecode = True
        os.environ["PYTHONDONTWRITEBYTECODE"] = "1"
        # Libraries that this process has imported already cannot be rewritten; nothing depends on it.
        words = ["-q", "-W", "ignore::pytest.PytestAssertRewriteWarning", f"--basetemp={self.folder / 'temp'}"]
        words += ["-n", "0"] if importlib.util.find_spec("xdist") else []
        return int(pytest.main([*words, *arguments], plugins=[plugin]))

    def record(self, again: bool = False) -> None:
        """Run the unchanged tests and note what each calls; files of tests that did not change are not run again."""
        store, result = self.state / "tests.json", self.state / "recorded.json"
        stored: dict[str, Any] = json.loads(store.read_text()) if store.exists() and not again else {}
        sources = {str(path): str(path.relative_to(self.copy)) for path in self.copy.rglob("*.py")}

        def work(file: str) -> int:
            recorder = Recorder(sources)
            status = self.pytest([file], recorder)
            result.write_text(json.dumps({name: asdict(test) for name, test in recorder.tests.items()}))
            return status

        for file in self.files:
            digest = hashlib.sha256((self.copy / file).read_bytes()).hexdigest()
            if stored.get(file, {}).get("digest") != digest:
                result.unlink(missing_ok=True)
                status = forked(partial(work, file), 1800)
                tests = json.loads(result.read_text()) if result.exists() else {}
                print(f"noted what {len(tests)} tests of {file} call (status {status})", flush=True)
                for name in (name for name, test in tests.items() if not test["passed"]):
                    print(f"not used, since it fails without any change: {name}")
                stored[file] = {"digest": digest, "tests": tests}
                store.write_text(json.dumps(stored))
            self.tests |= {name: Test(**test) for name, test in stored[file]["tests"].items() if test["passed"]}

    def tests_for(self, mutant: Mutant) -> list[str]:
        """The tests for a mutant: those that killed its neighbours, then one variant of every test, then the others."""
        killers = [name for name, _ in self.killers[mutant.file].most_common(FIRST)]
        touching = {name: test for name, test in self.tests.items() if test.touches(mutant)}
        variants: collections.Counter[str] = collections.Counter()
        turn: dict[str, int] = {}
        for name in sorted(touching, key=lambda name: touching[name].seconds):
            function = name.split("[")[0]
            turn[name] = variants[function]
            variants[function] += 1
        order = sorted(touching, key=lambda name: (name not in killers, turn[name], touching[name].seconds))
        spent = itertools.accumulate(touching[name].seconds for name in order)
        return [
            name for i, (name, total) in enumerate(zip(order, spent, strict=True)) if i == 0 or total <= self.seconds
        ]

    def try_out(self, mutant: Mutant) -> Outcome:
        """Make the mutant and show it to the tests."""
        started = time.monotonic()
        path, note = self.copy / mutant.file, self.folder / "failed"
        source = path.read_bytes()
        outcome = Outcome(mutant.file, mutant.line, mutant.function, mutant.what, mutant.diff(source), "not called")
        tests = self.tests_for(mutant)
        outcome.tests = len(tests)
        note.unlink(missing_ok=True)

        def work(part: Sequence[str]) -> int:
            return self.pytest(["-x", *dict.fromkeys(name.split("::")[0] for name in part)], Chosen(part, note))

        # A few files first, since importing all of them takes a while.
        few = set(list(dict.fromkeys(name.split("::")[0] for name in tests))[:FIRST])
        parts = [[name for name in tests if (name.split("::")[0] in few) == first] for first in (True, False)]
        path.write_bytes(mutant.applied(source))
        for part in filter(None, parts):
            status = forked(partial(work, part), LIMIT + 10 * sum(self.tests[name].seconds for name in part))
            # A mutant that cannot even be imported by a conftest is a usage error to pytest, and killed.
            if status == pytest.ExitCode.NO_TESTS_COLLECTED:
                raise RuntimeError(f"the tests could not be run:\n{(self.folder / 'pytest.log').read_text()[-3000:]}")
            outcome.result = "survived" if status == pytest.ExitCode.OK else "killed"
            if outcome.result == "killed":
                outcome.by = "time limit" if status is None else note.read_text() if note.exists() else "crash"
                self.killers[mutant.file][outcome.by] += 1
                break
        path.write_bytes(source)
        outcome.seconds = round(time.monotonic() - started, 2)
        return outcome


def test_files(root: Path, names: Iterable[str]) -> list[str]:
    """Files with tests or examples in docstrings below some folders."""
    files: list[str] = []
    for name in names:
        path = root / name
        for file in [path] if path.is_file() else sorted(path.rglob("*.py")):
            if file.name.startswith("test_") or ">>>" in file.read_text() and "test" not in file.parts[-2]:
                files.append(str(file.relative_to(root)))
    return files


# --- Command line ----------------------------------------------------------------------------------------------------


def report(outcomes: Sequence[Outcome]) -> str:
    """A table by file, and the survivors with what was changed, in markdown."""
    lines = ["| file | mutants | killed | survived | not called |", "|---|---|---|---|---|"]
    groups: dict[str, list[Outcome]] = collections.defaultdict(list)
    for outcome in outcomes:
        groups[outcome.file].append(outcome)
    for file, group in [*sorted(groups.items()), ("all", list(outcomes))]:
        counts = collections.Counter(outcome.result for outcome in group)
        lines.append(f"| {file} | {len(group)} | {counts['killed']} | {counts['survived']} | {counts['not called']} |")
    alive = [outcome for outcome in outcomes if outcome.result != "killed"]
    share = len(alive) / max(len(outcomes), 1)
    seconds = sum(outcome.seconds for outcome in outcomes)
    lines += ["", f"{len(alive)} of {len(outcomes)} survive ({100 * share:.1f} %); {seconds:.0f} s of tests."]
    for outcome in sorted(alive, key=lambda o: (o.file, o.line)):
        lines += ["", f"{outcome.file}:{outcome.line} {outcome.function}: {outcome.what} ({outcome.result})", "```diff"]
        lines += [outcome.diff, "```"]
    return "\n".join(lines)


def parser() -> argparse.ArgumentParser:
    """The options."""
    made = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    made.add_argument("--count", type=int, default=200, help="mutants in the sample; 0 for all")
    made.add_argument("--seed", type=int, default=0, help="of the sample")
    made.add_argument("--only", nargs="+", default=SOURCES, metavar="FILE", help="files to change, or patterns of them")
    made.add_argument("--tests", nargs="+", default=TESTS, metavar="PATH", help="files and folders of tests")
    made.add_argument("--without", nargs="*", default=WITHOUT, metavar="FILE", help="tests that are left out")
    made.add_argument("--seconds", type=float, default=40, help="of tests that one mutant is shown to, at most")
    made.add_argument("--state", type=Path, default=Path("mutations"), help="folder of what was tried")
    made.add_argument("--again", action="store_true", help="try the survivors of the sample again")
    made.add_argument("--record", action="store_true", help="run all tests to note again what they call")
    made.add_argument("--root", type=Path, default=ROOT, help="the project")
    made.add_argument("--preload", nargs="*", default=PRELOADED.split(), help="libraries to import once")
    made.add_argument("--markdown", type=Path, help="write the report to this file, too")
    made.add_argument("--list", action="store_true", help="print the sample only")
    return made


def main(words: Sequence[str] | None = None) -> int:
    """Try the mutants; 1 if any survived."""
    options = parser().parse_args(words)
    root, state = options.root.resolve(), options.state.resolve()
    mutants = sample(root, options.only, options.count, options.seed)
    if options.list:
        for mutant in mutants:
            print(f"{mutant.file}:{mutant.line} {mutant.function}: {mutant.what}")
            print(mutant.diff((root / mutant.file).read_bytes()))
        return 0
    state.mkdir(parents=True, exist_ok=True)
    kept = state / "outcomes.jsonl"
    tried: dict[str, Outcome] = {}
    if kept.exists():
        for line in kept.read_text().splitlines():
            entry = json.loads(line)
            key = entry.pop("key")
            tried[key] = Outcome(**entry)
    alive = [m for m in mutants if m.key in tried and tried[m.key].result != "killed"]
    todo = (alive if options.again else []) + [m for m in mutants if m.key not in tried]
    if todo:
        for name in options.preload:
            with contextlib.suppress(ImportError):
                importlib.import_module(name)
        with tempfile.TemporaryDirectory() as folder:
            files = [file for file in test_files(root, options.tests) if file not in options.without]
            shop = Workshop(root, Path(folder), state, files, options.seconds)
            shop.record(options.record)
            for outcome in tried.values():
                shop.killers[outcome.file][outcome.by] += outcome.result == "killed"
            for i, mutant in enumerate(todo):
                outcome = tried[mutant.key] = shop.try_out(mutant)
                with kept.open("a") as file:
                    file.write(json.dumps({"key": mutant.key, **asdict(outcome)}) + "\n")
                place = f"{outcome.file}:{outcome.line} {outcome.what}"
                print(f"{i + 1}/{len(todo)} {outcome.result:<10} {outcome.seconds:5.1f} s  {place}", flush=True)
    outcomes = [tried[mutant.key] for mutant in mutants]
    text = report(outcomes)
    print(text)
    if options.markdown is not None:
        options.markdown.write_text(text + "\n")
    return int(any(outcome.result != "killed" for outcome in outcomes))


if __name__ == "__main__":
    sys.exit(main())
