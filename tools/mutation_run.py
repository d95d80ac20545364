"""Do the tests feel every term? Change the mathematics a little, one place at a time, and see whether a test fails.

    python tools/mutation_run.py --count 200 --seed 0 --state mutations

A *mutant* is the package with one small change: a plus that became a minus, a term or a square root left out, a mean
that became a sum, a condition negated, a statement removed, and so on. It is *killed* if a test fails (or hangs), and
it *survives* if all of them pass; then either the change makes no difference, or a test is missing.

The mutants are a seeded sample of all that can be made of the sources, and are written into a copy of the project.
First, every test is run once and the functions that it calls are noted; a mutant is then shown only to the tests that
call the changed function, and those that killed neighbours before go first. The libraries are imported once, in this
process; each mutant is tested in a fork of it. What was tried is kept in the folder ``--state``, so that a later call
tries others only, and ``--again`` the survivors.
"""

# ruff: noqa: D102 - methods of visitors and plugins are named by ast and pytest

from __future__ import annotations

import argparse
import collections
import contextlib
import gc
import hashlib
import importlib
import importlib.util
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
from types import CodeType, FrameType, FunctionType
from typing import Any, TextIO

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
"""How many of the best killers are tried first; how many files are imported before all others are."""
QUICK = 0.1
"""Seconds of a quick test."""
SIGNATURES = "facediff/registry.py:defaults"
"""What a test calls that looks at the defaults of arguments, and perhaps never at the function that has them."""
IMPORTING = 60.0
"""Seconds that a new process may take to import what it tests."""

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
        return self.reads(mutant) or any(call == name or call.startswith(within) for call in self.calls)

    def reads(self, mutant: Mutant) -> bool:
        """Whether it may feel a changed default by reading signatures alone; every test that makes a model does so."""
        of_default = mutant.function != "" and not mutant.exchangeable
        return of_default and self.seconds < QUICK and SIGNATURES in self.calls


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


class Session:
    """A plugin of pytest that imports all tests and then runs some of them, in forks, for whoever asks.

    A request is one line of JSON: ``tests`` to run, and either ``record``, a file for what they call, or the changed
    ``source`` of a ``file`` with the name of the ``function`` that is changed.
    """

    def __init__(self, requests: int, replies: int, root: Path) -> None:
        self.requests, self.replies, self.root = requests, replies, root
        self.failed = ""
        self.functions: dict[tuple[str, str], list[FunctionType]] = {}

    def pytest_runtest_logreport(self, report: Any) -> None:  # noqa: ANN401
        if report.failed:
            self.failed = report.nodeid

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: Any) -> bool:  # noqa: ANN401
        if session.testsfailed:
            raise session.Interrupted("some tests cannot be imported")
        gc.collect()
        self.functions = functions_below(str(self.root))
        gc.freeze()
        items = {item.nodeid: item for item in session.items}
        with open(self.requests) as requests, open(self.replies, "w") as replies:
            print(json.dumps(list(items)), file=replies, flush=True)
            for line in requests:
                request = json.loads(line)
                note = self.root.parent / "failed"
                note.unlink(missing_ok=True)
                status = forked(partial(self.work, items, request, note), request["limit"])
                found = "time limit" if status is None else note.read_text() if note.exists() else "crash"
                print(json.dumps([status, found]), file=replies, flush=True)
        return True

    def work(self, items: dict[str, Any], request: dict[str, Any], note: Path) -> int:
        """In the fork: 0 if all tests pass, 1 if one fails, 2 if the change cannot be made in a living process."""
        chosen = [items[name] for name in request["tests"] if name in items]
        recorder = None
        if record := request.get("record"):
            recorder = Recorder({str(path): str(path.relative_to(self.root)) for path in self.root.rglob("*.py")})
            chosen[0].config.pluginmanager.register(recorder)
        else:
            path, name = str(self.root / request["file"]), request["function"]
            if not exchange(self.functions.get((path, name), []), request["source"]):
                return 2
        for item, following in zip(chosen, [*chosen[1:], None], strict=True):
            item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
            if self.failed and recorder is None:
                note.write_text(self.failed)
                return 1
        if recorder is not None:
            Path(record).write_text(json.dumps({name: asdict(test) for name, test in recorder.tests.items()}))
        return 0


def functions_below(root: str) -> dict[tuple[str, str], list[FunctionType]]:
    """All living functions from files below a folder, by file and qualified name; decorated ones too."""
    found: dict[tuple[str, str], list[FunctionType]] = collections.defaultdict(list)
    for each in gc.get_objects():
        # The exact type: asking anything else for its class may run code of its own, which warns.
        if type(each) is FunctionType and each.__code__.co_filename.startswith(root):
            found[each.__code__.co_filename, each.__code__.co_qualname].append(each)
    return found


def exchange(found: Sequence[FunctionType], source: str) -> bool:
    """Give a function of the living process the code of a changed source; False if that cannot be done."""

    def codes(code: CodeType) -> Iterator[CodeType]:
        for constant in code.co_consts:
            if isinstance(constant, CodeType):
                yield constant
                yield from codes(constant)

    if not found:
        return False
    path, function = found[0].__code__.co_filename, found[0].__code__.co_qualname
    new = [code for code in codes(compile(source, path, "exec", dont_inherit=True)) if code.co_qualname == function]
    # A property's getter and setter share a name.
    if len(new) != 1 or len({each.__code__.co_firstlineno for each in found}) != 1:
        return False
    try:
        for each in found:
            each.__code__ = new[0]
    except ValueError:  # it closes over other variables
        return False
    return True


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
    """A copy of the project in which mutants are made and tested.

    Functions are changed in a living process that has imported all tests, in a fork of it: that takes no time but the
    tests'. What is run at import only (constants, defaults) is changed in the copied file, which a new process imports.

    Args:
        root: the project.
        folder: where the copy is made.
        state: where outcomes and the calls of tests are kept.
        files: files of tests.
        seconds: how long the tests shown to one mutant may take together, measured without the change.
        limit: seconds after which a test hangs, besides ten times its usual time.
    """

    def __init__(
        self, root: Path, folder: Path, state: Path, files: Sequence[str], seconds: float, limit: float
    ) -> None:
        self.root, self.copy, self.folder, self.state, self.seconds = root, folder / "copy", folder, state, seconds
        hidden = shutil.ignore_patterns(".git", "__pycache__", "*.pyc", ".venv", "node_modules", state.name)
        shutil.copytree(root, self.copy, ignore=hidden)
        self.files, self.limit = files, limit
        self.tests: dict[str, Test] = {}
        self.killers: dict[str, collections.Counter[str]] = collections.defaultdict(collections.Counter)
        self.requests, self.replies = self.open_session()
        line = self.replies.readline()
        if not line:
            raise RuntimeError(f"the tests cannot be imported:\n{(folder / 'session.log').read_text()[-3000:]}")
        self.names: list[str] = json.loads(line)

    def enter(self, log: str) -> None:
        """In a fork: into the copy, quietly."""
        output = os.open(self.folder / log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(output, 1)
        os.dup2(output, 2)
        os.chdir(self.copy)
        sys.path[:] = [str(self.copy), *(p for p in sys.path if Path(p or ".").resolve() != self.root)]
        os.environ["PYTHONPATH"] = str(self.copy)

    def pytest(self, arguments: Sequence[str], plugin: object) -> int:
        """One run of pytest on one process; the project's own options stay."""
        # Libraries that this process has imported already cannot be rewritten; nothing depends on it.
        words = ["-q", "-W", "ignore::pytest.PytestAssertRewriteWarning", f"--basetemp={self.folder / 'temp'}"]
        words += ["-n", "0"] if importlib.util.find_spec("xdist") else []
        return int(pytest.main([*words, *arguments], plugins=[plugin]))

    def open_session(self) -> tuple[TextIO, TextIO]:
        """Start the process that has imported all tests; where to ask it, and where it answers."""
        (ask, asked), (answers, answer) = os.pipe(), os.pipe()
        if os.fork() == 0:
            os.close(asked)
            os.close(answers)
            try:
                self.enter("session.log")
                self.pytest(self.files, Session(ask, answer, self.copy))
            except BaseException:
                traceback.print_exc()
            finally:
                os._exit(0)
        os.close(ask)
        os.close(answer)
        return open(asked, "w"), open(answers)  # noqa: SIM115 - open until this process ends

    def ask(self, **request: Any) -> tuple[int | None, str]:  # noqa: ANN401
        """Have the session do something: the exit status, and which test failed."""
        print(json.dumps(request), file=self.requests, flush=True)
        status, by = json.loads(self.replies.readline())
        return status, by

    def record(self, again: bool = False) -> None:
        """Run the unchanged tests and note what each calls; files of tests that did not change are not run again."""
        kept, result = self.state / "tests.json", self.state / "recorded.json"
        stored: dict[str, Any] = json.loads(kept.read_text()) if kept.exists() and not again else {}
        for file in self.files:
            digest = hashlib.sha256((self.copy / file).read_bytes()).hexdigest()
            if stored.get(file, {}).get("digest") == digest:
                continue
            result.unlink(missing_ok=True)
            names = [name for name in self.names if name.split("::")[0] == file]
            status = self.ask(record=str(result), tests=names, limit=1800)[0] if names else 0
            found = json.loads(result.read_text()) if result.exists() else {}
            print(f"noted what {len(found)} tests of {file} call (status {status})", flush=True)
            for name, test in found.items():
                if not test["passed"]:
                    print(f"not used, since it fails without any change: {name}")
            stored[file] = {"digest": digest, "tests": found}
            kept.write_text(json.dumps(stored))
        for file in self.files:
            self.tests |= {name: Test(**test) for name, test in stored[file]["tests"].items() if test["passed"]}

    def chosen(self, mutant: Mutant) -> list[str]:
        """The tests for a mutant: those that killed its neighbours, then one variant of every test, then the others.

        All that may read a changed default come before those.
        """
        killers = self.killers[mutant.file]
        touching = {name: test for name, test in self.tests.items() if test.touches(mutant)}
        variants: collections.Counter[str] = collections.Counter()
        turn: dict[str, int] = {}
        for name in sorted(touching, key=lambda name: touching[name].seconds):
            function = name.split("[")[0]
            turn[name] = variants[function]
            variants[function] += 1
        found, spent = [], 0.0
        for name in sorted(
            touching, key=lambda name: (not touching[name].reads(mutant), turn[name], touching[name].seconds)
        ):
            spent += touching[name].seconds
            if found and spent > self.seconds:
                break
            found.append(name)
        first = [name for name, _ in killers.most_common(FIRST) if name in touching]
        rest = [name for name in found if name not in first]
        # By file, since fixtures are shared within one.
        rest.sort(
            key=lambda name: (
                not touching[name].reads(mutant),
                turn[name] > 0,
                touching[name].seconds > QUICK,
                name.split("::")[0],
            )
        )
        return first + rest

    def try_out(self, mutant: Mutant) -> Outcome:
        """Make the mutant and show it to the tests."""
        started = time.monotonic()
        source = (self.copy / mutant.file).read_bytes()
        outcome = Outcome(mutant.file, mutant.line, mutant.function, mutant.what, mutant.diff(source), "not called")
        tests = self.chosen(mutant)
        outcome.tests = len(tests)
        if tests:
            limit = self.limit + 10 * sum(self.tests[name].seconds for name in tests)
            status: int | None = 2
            if mutant.exchangeable:
                changed = mutant.applied(source).decode()
                request = {"file": mutant.file, "function": mutant.function, "source": changed}
                status, outcome.by = self.ask(**request, tests=tests, limit=limit)
            if status == 2:
                status, outcome.by = self.imported(mutant, tests, limit)
            outcome.result = "killed" if status != 0 else "survived"
            if status == 0:
                outcome.by = ""
            else:
                self.killers[mutant.file][outcome.by] += 1
        outcome.seconds = round(time.monotonic() - started, 2)
        return outcome

    def imported(self, mutant: Mutant, tests: Sequence[str], limit: float) -> tuple[int | None, str]:
        """The same in a process that imports the changed file."""
        path, note = self.copy / mutant.file, self.folder / "failed"
        source, before = path.read_bytes(), path.stat()
        note.unlink(missing_ok=True)

        def work(some: Sequence[str]) -> int:
            self.enter("import.log")
            sys.dont_write_bytecode = True
            os.environ["PYTHONDONTWRITEBYTECODE"] = "1"
            files = list(dict.fromkeys(name.split("::")[0] for name in some))
            return self.pytest(["-x", *files], Chosen(some, note))

        try:
            path.write_bytes(mutant.applied(source))
            # Bytecode of the unchanged file must not be taken for this one's: it is known by size and whole seconds.
            os.utime(path, (before.st_atime, before.st_mtime + 1000))
            # A few files first, since importing all of them takes a while.
            few = set(list(dict.fromkeys(name.split("::")[0] for name in tests))[:FIRST])
            parts = [[name for name in tests if (name.split("::")[0] in few) == wanted] for wanted in (True, False)]
            status: int | None = 0
            for some in filter(None, parts):
                status = forked(partial(work, some), limit + IMPORTING)
                if status != pytest.ExitCode.OK:
                    break
        finally:
            path.write_bytes(source)
            os.utime(path, (before.st_atime, before.st_mtime))
        if status in (pytest.ExitCode.NO_TESTS_COLLECTED, pytest.ExitCode.USAGE_ERROR):
            raise RuntimeError(f"the tests could not be run:\n{(self.folder / 'import.log').read_text()[-3000:]}")
        return status, "time limit" if status is None else note.read_text() if note.exists() else "crash"


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
    made.add_argument(
        "--limit", type=float, default=60, help="seconds after which a test hangs, besides its usual time"
    )
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
    todo.sort(key=lambda mutant: not mutant.exchangeable)  # what takes longest last
    if todo:
        for name in options.preload:
            with contextlib.suppress(ImportError):
                importlib.import_module(name)
        with tempfile.TemporaryDirectory() as folder:
            files = [file for file in test_files(root, options.tests) if file not in options.without]
            shop = Workshop(root, Path(folder), state, files, options.seconds, options.limit)
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
