"""Which package may import which, what importing costs, and that the public names exist."""

from __future__ import annotations

import ast
import functools
import importlib
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from xml.etree import ElementTree

import pytest

PACKAGE = Path(__file__).parents[1] / "facediff"
BASE = {"errors", "utils", "registry", "hyperparameters"}
# What a package may import. What is missing here must not be imported; data flows one way.
ALLOWED: dict[str, set[str]] = {
    "__init__": {
        "version",
        "utils",
        "errors",
        "metrics",
        "animation",
        "editing",
        "pipelines",
    },  # most of it when a name is first used
    "__main__": {"cli"},
    "version": set(),
    "errors": set(),
    "registry": {"utils", "errors"},  # of utils, only what is light: see the tests of what importing loads
    "hyperparameters": {"utils", "errors", "registry"},
    "utils": {"version", "errors"},
    "metrics": {"registry", "errors"},
    "mesh": BASE,
    "spaces": {"mesh", *BASE},
    "synthetic": {"spaces", "speech", *BASE},
    "render": BASE,
    "speech": BASE,
    "animation": {"spaces", "mesh", *BASE},
    "data": {"spaces", "speech", "metrics", "mesh", "synthetic", *BASE},
    "editing": {"spaces", "animation", "speech", "metrics", "mesh", "synthetic", *BASE},
    "models": {"spaces", "version", "animation", "speech", "data", "metrics", "mesh", *BASE},
    "callbacks": {"spaces", "version", "models", "speech", "data", "metrics", "mesh", "render", *BASE},
    "export": {"spaces", "animation", "editing", "render", "mesh", *BASE},
    "runtime": {"spaces", "version", "animation", "speech", "export", *BASE},
    "live": {"spaces", "version", "runtime", "animation", "speech", "editing", "export", "mesh", *BASE},
    "reporting": BASE,
    "evaluation": {"spaces", "runtime", "reporting", "speech", "data", "metrics", "mesh", "render", *BASE},
    "benchmark": {"version", "evaluation", "reporting", "speech", "data", "metrics", "synthetic", *BASE},
    "study": {"version", "reporting", "animation", "speech", "data", "evaluation", "mesh", "render", *BASE},
    "pipelines": {
        "spaces",
        "version",
        "runtime",
        "models",
        "speech",
        "synthetic",
        "data",
        "editing",
        "export",
        "animation",
        "mesh",
        *BASE,
    },
}
ALLOWED["cli"] = set(ALLOWED) - {"__main__"}
# Packages that make do with these libraries in addition to the standard library.
THIRD_PARTY: dict[str, set[str]] = {
    "__init__": set(),
    "__main__": set(),
    "version": set(),
    "errors": set(),
    "registry": set(),
    "metrics": {"torch", "torchmetrics"},
}


def package_of(file: Path) -> str:
    return file.relative_to(PACKAGE).parts[0].removesuffix(".py")


@functools.cache
def imports_in(text: str) -> tuple[list[ast.Import | ast.ImportFrom], set[int]]:
    """The statements that import, at the top of a file or inside functions, and the lines for type checkers only."""
    statements: list[ast.Import | ast.ImportFrom] = []
    typed: set[int] = set()
    nodes: list[ast.AST] = [ast.parse(text)]
    for node in nodes:  # which grows by statements only: expressions are most of a tree, and import nothing
        for block in ("body", "orelse", "finalbody", "handlers", "cases"):
            nodes += getattr(node, block, [])
        if isinstance(node, ast.Import | ast.ImportFrom):
            statements.append(node)
        elif isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
            typed.update(range(node.lineno, (node.body[-1].end_lineno or 0) + 1))
    return statements, typed


def imported(file: Path) -> Iterator[tuple[int, str]]:
    """Line and full name of everything a file imports."""
    package = ["facediff", *file.relative_to(PACKAGE).parent.parts]
    for node in imports_in(file.read_text(encoding="utf-8"))[0]:
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        else:
            base = package[: len(package) - node.level + 1] if node.level else []
            source = ".".join([*base, *([node.module] if node.module else [])])
            # `from facediff import registry` names a module; `from facediff.data import Batch`, a package and a class.
            yield from ((node.lineno, f"{source}.{alias.name}") for alias in node.names)


FILES = sorted(PACKAGE.rglob("*.py"))


def test_every_package_is_in_the_table() -> None:
    assert {package_of(file) for file in FILES} == set(ALLOWED), "a new package: say in ALLOWED what it may import"


def test_the_table_has_no_circle() -> None:
    left = {package: set(packages) - {package} for package, packages in ALLOWED.items()}
    while free := {package for package, packages in left.items() if not packages}:
        left = {package: packages - free for package, packages in left.items() if package not in free}
    assert not left


def module_of(file: Path) -> str:
    parts = ["facediff", *file.relative_to(PACKAGE).with_suffix("").parts]
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def circle_of_files(*, types: bool) -> list[str]:
    """One circle of imports between files, those inside functions included; empty if there is none.

    Args:
        types: whether imports count that only type checkers run.
    """
    modules = {module_of(file): file for file in FILES}
    graph: dict[str, set[str]] = {}
    for module, file in modules.items():
        typed = imports_in(file.read_text(encoding="utf-8"))[1]
        names = [name for line, name in imported(file) if types or line not in typed]
        # A name is a module, or stands in one.
        targets = {name if name in modules else name.rpartition(".")[0] for name in names}
        graph[module] = (targets & modules.keys()) - {module}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


@pytest.mark.parametrize("types", [False, True])
def test_no_files_import_each_other(types: bool) -> None:
    assert circle_of_files(types=types) == []


def test_the_drawing_has_every_package_above_what_it_may_import() -> None:
    drawing = ElementTree.parse(PACKAGE.parent / "docs" / "images" / "architecture.svg")  # noqa: S314 - our own
    texts = [text for text in drawing.iter("{http://www.w3.org/2000/svg}text") if text.get("font-weight") == "bold"]
    height = {str(text.text): float(str(text.get("y"))) for text in texts}
    assert set(height) == set(ALLOWED) - {"__init__", "__main__", "version"}
    wrong = [
        f"{package} imports {other}"
        for package in height
        for other in ALLOWED[package] & set(height) - BASE
        if height[package] >= height[other]
    ]
    assert not wrong


@pytest.mark.parametrize("package", ALLOWED)
def test_packages_import_what_they_may(package: str) -> None:
    wrong = []
    for file in FILES:
        if package_of(file) != package:
            continue
        for line, name in imported(file):
            first, *rest = name.split(".")
            where = f"{file.relative_to(PACKAGE.parent)}:{line} imports {name}"
            if first == "facediff":
                target = rest[0] if rest and rest[0] in ALLOWED else "__init__"
                if target not in {package, *ALLOWED[package]}:
                    wrong.append(where)
            elif first in ("tests", "tools") or (
                package in THIRD_PARTY and first not in {*sys.stdlib_module_names, *THIRD_PARTY[package]}
            ):
                wrong.append(where)
    assert not wrong, "\n".join(wrong)


READERS = {
    r"\bjson\.(loads?|JSONDecoder)\b": {
        "utils/plain_files.py",
        # What another part of the same process, or one that it has started, wrote; Blender, without facediff; a word.
        *("speech/espeak.py", "export/glb_to_fbx.py", "models/published/importing.py"),
    },
    # Lightning's logger writes its own columns, which a resumed run continues.
    r"\bcsv\.(reader|writer|DictReader|DictWriter)\b": {"utils/plain_files.py", "callbacks/runs.py"},
    r"\bnp\.(lib\.format\.)?(load\w*|from(file|regex)|genfromtxt|read_array|\w*memmap)\((?![^()]*w\+)": {
        "utils/arrays.py"
    },
    # What goes between the processes of a cluster is pickled by Dask anyway, see the top of cluster.py.
    r"\b(pickle|torch|joblib)\.loads?\(": {"utils/torch_files.py", "utils/cluster.py"},
}
"""Readers of files, which believe them in their own ways, and the modules that may call them."""


@pytest.mark.parametrize("call", READERS)
def test_each_kind_of_file_is_read_in_one_place(call: str) -> None:
    found = {file.relative_to(PACKAGE).as_posix() for file in FILES if re.search(call, file.read_text("utf-8"))}
    assert found <= READERS[call]


def test_the_rule_would_catch_a_breach(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The walk sees imports inside functions, relative ones and those for type checkers only."""
    file = tmp_path / "facediff" / "data" / "bad.py"
    file.parent.mkdir(parents=True)
    file.write_text(
        "from ..models import base\nif TYPE_CHECKING:\n    import facediff.cli\n"
        "def f():\n    from facediff import callbacks\n"
    )
    monkeypatch.setattr(sys.modules[__name__], "PACKAGE", tmp_path / "facediff")
    assert [name for _, name in imported(file)] == ["facediff.models.base", "facediff.cli", "facediff.callbacks"]
    assert package_of(file) == "data"


PACKAGES = ["facediff", *(f"facediff.{package}" for package in ALLOWED if (PACKAGE / package).is_dir())]


@pytest.mark.parametrize("package", PACKAGES)
def test_public_names_exist(package: str) -> None:
    module = importlib.import_module(package)
    names = getattr(module, "__all__", [])
    assert len(names) == len(set(names))
    assert [name for name in names if not hasattr(module, name)] == []


def modules_after(*programs: str) -> list[set[str]]:
    """Names of the modules that a fresh interpreter has loaded after each of some programs, under ``-W error``."""
    report = "import json, sys; print('\\n' + json.dumps(sorted(sys.modules)))"
    run = subprocess.run(
        [sys.executable, "-W", "error", "-c", "\n".join(f"{program}\n{report}" for program in programs)],
        capture_output=True,
        text=True,
        timeout=120,
        cwd=PACKAGE.parent,
    )
    assert run.returncode == 0, run.stderr
    return [set(json.loads(line)) for line in run.stdout.splitlines() if line.startswith('["')]


HEAVY = {"lightning", "pytorch_lightning", "transformers", "diffusers", "jsonargparse", "omegaconf", "trimesh"}
HEAVY |= {"soundfile", "soxr", "cv2", "av", "PIL", "wandb", "rich", "beartype"}


LIGHT = HEAVY | {"torch", "numpy", "torchmetrics"}
THREADS = "from facediff.utils.jobs import run_tasks\nassert dict(run_tasks(len, ['a'], mode='threads')) == {'a': 1}"


@pytest.mark.parametrize(
    ("program", "left_out"),
    [
        ("import facediff", LIGHT),
        ("import facediff.registry, facediff.errors, facediff.models, facediff.data", LIGHT),
        ("from facediff.cli.app import main\nassert main(['--help']) == 0", LIGHT),
        ("from facediff.cli.app import main\nassert main(['--version']) == 0", LIGHT),
        ("from facediff.cli.app import main\nassert main(['fitt']) == 2\nassert main([]) == 2", LIGHT),
        ("import facediff.data.check.clip", {"torch", "lightning", "trimesh"}),
        (THREADS, {"dask", "distributed", "cloudpickle"}),
        ("from facediff import registry\nprint([kind.names() for kind in registry.COMPONENTS.values()])", HEAVY),
    ],
)
def test_the_light_parts_load_nothing_heavy(program: str, left_out: set[str]) -> None:
    assert not {name.split(".")[0] for name in modules_after(program)[0]} & left_out


def test_metrics_bring_torch_and_torchmetrics_and_nothing_else() -> None:
    before, after = modules_after("import torchmetrics", "import facediff.metrics")
    # torchmetrics itself takes transformers, matplotlib and others along where they are installed, but not these.
    assert not {name.split(".")[0] for name in before} & {"lightning", "jsonargparse", "diffusers", "jaxtyping"}
    loaded = after - before
    assert {name.split(".")[0] for name in loaded} - {"facediff"} <= set(sys.stdlib_module_names)
    ours = {name for name in loaded if name.startswith("facediff") and not name.startswith("facediff.metrics")}
    utils = {f"facediff.utils{part}" for part in ("", ".hints", ".lazy", ".limits")}
    assert ours == {"facediff", "facediff.errors", "facediff.registry", "facediff.version", *utils}
