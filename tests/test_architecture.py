"""Which room may import which, what importing costs, and that the public names exist."""

from __future__ import annotations

import ast
import importlib
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "facediff"
COMMON = {"errors", "files", "machine", "pickles", "processes"}
# A room is a folder or a module of the package; what is missing here must not be imported. Data flows one way:
# registry, metrics, topology, diffusion → data, components → systems → callbacks → commands → cli.
ALLOWED: dict[str, set[str]] = {
    "__init__": set(),
    "__main__": {"cli"},
    "errors": set(),
    "files": {"errors"},
    "plain_arrays": set(),
    "pickles": {"errors", "plain_arrays"},
    "machine": set(),
    "processes": set(),
    "shipped": set(),
    "registry": {"errors"},
    "hparams": {"registry", "errors"},
    "losses": set(),
    "metrics": set(),
    "topology": COMMON,
    "diffusion": {"registry", "errors"},
    "puppet": COMMON,
    "render": COMMON,
    "takes": COMMON,
    "export": {"takes", "viewer", "blendshapes", "render", "topology", *COMMON},
    "viewer": {"takes", "render", *COMMON},
    "blendshapes": {"takes", "topology", *COMMON},
    "retarget": {"takes", "topology", *COMMON},
    "directing": {"takes", "topology", *COMMON},
    "data": {"metrics", "topology", "puppet", "registry", "hparams", *COMMON},
    "prepare": {"data", "topology", *COMMON},
    "person": {"data", "prepare", "topology", *COMMON},
    "doctor": {"data", "metrics", "topology", *COMMON},
    "evaluate": {"data", "metrics", *COMMON},
    "figures": {"evaluate", "data", "metrics", "render", "topology", *COMMON},
    "components": {"registry", "errors"},
    "systems": {"components", "data", "diffusion", "metrics", "topology", "losses", "hparams", "registry", *COMMON},
    "callbacks": {"__init__", "systems", "data", "metrics", "topology", "render", "hparams", "registry", *COMMON},
    "cli": {"errors", "__init__"},
}
ALLOWED["commands"] = set(ALLOWED) - {"cli", "__main__"}
# Rooms that must do with these packages beside the standard library.
THIRD_PARTY: dict[str, set[str]] = {
    "__init__": set(),
    "__main__": set(),
    "cli": set(),
    "errors": set(),
    "files": set(),
    "shipped": set(),
    "registry": set(),
    "hparams": set(),
    "losses": {"torch", "jaxtyping"},
    "metrics": {"torch", "torchmetrics"},
    "components": {"torch", "jaxtyping", "transformers"},
    "diffusion": {"torch", "jaxtyping", "diffusers"},
}


def room_of(file: Path) -> str:
    return file.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imported(file: Path) -> Iterator[tuple[int, str]]:
    """Line and full name of everything a file imports, at its top or inside functions."""
    package = ["facediff", *file.relative_to(PACKAGE).parent.parts]
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            source = ".".join([*base, *([node.module] if node.module else [])])
            # `from facediff import losses` names a room; `from facediff.data import Batch` names a room and a class.
            yield from ((node.lineno, f"{source}.{alias.name}") for alias in node.names)


FILES = sorted(PACKAGE.rglob("*.py"))


def test_every_room_is_in_the_table() -> None:
    assert {room_of(file) for file in FILES} == set(ALLOWED), "a new room: say in ALLOWED what it may import"


def test_the_table_has_no_circle() -> None:
    left = {room: set(rooms) - {room} for room, rooms in ALLOWED.items()}
    while free := {room for room, rooms in left.items() if not rooms}:
        left = {room: rooms - free for room, rooms in left.items() if room not in free}
    assert not left


@pytest.mark.parametrize("room", ALLOWED)
def test_rooms_import_what_they_may(room: str) -> None:
    wrong = []
    for file in FILES:
        if room_of(file) != room:
            continue
        for line, name in imported(file):
            first, *rest = name.split(".")
            where = f"{file.relative_to(PACKAGE.parent)}:{line} imports {name}"
            if first == "facediff":
                target = rest[0] if rest and rest[0] in ALLOWED else "__init__"
                if target not in {room, *ALLOWED[room]}:
                    wrong.append(where)
            elif first in ("tests", "tools") or (
                room in THIRD_PARTY and first not in {*sys.stdlib_module_names, *THIRD_PARTY[room]}
            ):
                wrong.append(where)
    assert not wrong, "\n".join(wrong)


def test_the_rule_would_catch_a_breach(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The walk sees imports inside functions, relative ones and those for type checkers only."""
    file = tmp_path / "facediff" / "data" / "bad.py"
    file.parent.mkdir(parents=True)
    file.write_text(
        "from ..systems import base\nif TYPE_CHECKING:\n    import facediff.commands\n"
        "def f():\n    from facediff import components\n"
    )
    monkeypatch.setattr(sys.modules[__name__], "PACKAGE", tmp_path / "facediff")
    assert [name for _, name in imported(file)] == ["facediff.systems.base", "facediff.commands", "facediff.components"]
    assert room_of(file) == "data"


PACKAGES = ["facediff", *(f"facediff.{room}" for room in ALLOWED if (PACKAGE / room).is_dir())]


@pytest.mark.parametrize("package", PACKAGES)
def test_public_names_exist(package: str) -> None:
    module = importlib.import_module(package)
    names = getattr(module, "__all__", [])
    assert len(names) == len(set(names))
    assert [name for name in names if not hasattr(module, name)] == []


def modules_after(program: str) -> set[str]:
    """Names of the modules that a program has loaded in a fresh interpreter at its end, under ``-W error``."""
    report = "import json, sys; print('\\n' + json.dumps(sorted(sys.modules)))"
    run = subprocess.run(
        [sys.executable, "-W", "error", "-c", f"{program}\n{report}"],
        capture_output=True,
        text=True,
        timeout=120,
        cwd=PACKAGE.parent,
    )
    assert run.returncode == 0, run.stderr
    return set(json.loads(run.stdout.splitlines()[-1]))


HEAVY = {"lightning", "pytorch_lightning", "transformers", "diffusers", "jsonargparse", "omegaconf", "trimesh"}
HEAVY |= {"soundfile", "soxr", "cv2", "av", "PIL", "wandb", "rich", "beartype"}


@pytest.mark.parametrize(
    "program",
    [
        "import facediff",
        "import facediff.registry, facediff.errors, facediff.hparams",
        "from facediff.cli import main\nassert main(['--help']) == 0",
        "from facediff.cli import main\nassert main(['--version']) == 0",
        "from facediff.cli import main\nassert main(['fitt']) == 2\nassert main([]) == 2",
    ],
)
def test_the_light_parts_load_nothing_heavy(program: str) -> None:
    start = time.perf_counter()
    loaded = {name.split(".")[0] for name in modules_after(program)}
    assert not loaded & (HEAVY | {"torch", "numpy", "torchmetrics"})
    # Under a second on an idle machine; a loaded one may be slow, but not as slow as importing torch and Lightning.
    assert time.perf_counter() - start < 5


def test_metrics_need_torch_and_torchmetrics_only() -> None:
    before, after = modules_after("import torchmetrics"), modules_after("import facediff.metrics")
    extra = {name.split(".")[0] for name in after - before}
    assert extra - set(sys.stdlib_module_names) == {"facediff"}
    # torchmetrics itself takes transformers, matplotlib and others along where they are installed, but not these.
    assert not {name.split(".")[0] for name in after} & {"lightning", "jsonargparse", "diffusers", "jaxtyping"}
    ours = {name for name in after if name.startswith("facediff.")}
    assert ours
    assert all(name.startswith("facediff.metrics") for name in ours)


def test_components_and_samplers_import_their_libraries_late() -> None:
    program = "from facediff import registry\nprint([kind.names() for kind in registry.KINDS.values()])"
    assert not {name.split(".")[0] for name in modules_after(program)} & HEAVY
