"""Whether the packages of a release can be relied on: built twice, read, installed as their users do, and used.

    pip install build twine
    python tools/release_check.py -o dist --extras base metrics train live all
    python tools/release_check.py -o dist --python python3.12 python3.13 --extras base live

The wheel is made from the source distribution, and both twice: the bytes must agree. `twine check` reads what a
package index shows. Then each extra is installed from the wheel alone into a fresh environment of each Python, and
what its users begin with is done there, in an empty folder: speech becomes a page, metrics are imported without
anything else, a model trains, a performance is sent, the demonstration runs. The last lines are a table; the exit
status is 1 if anything failed.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
import time
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CONSTRAINTS = ROOT / "tools" / "constraints.txt"
LARGEST = 20 * 2**20
"""Bytes of the wheel; the bundled model is most of them."""

SPEECH = str(ROOT / "docs" / "examples" / "speech.wav")
ANIMATE = ["facediff", "animate", SPEECH, "-o", "speech.html"]
USES: dict[str, list[list[str]]] = {
    "base": [
        ["facediff", "check-install"],
        ANIMATE,
        ["facediff", "animate", SPEECH, "-o", "speech.glb"],
        ["python", "-c", "import importlib.util as i, sys; sys.exit(i.find_spec('torch') is not None)"],
    ],
    "metrics": [
        ["python", "-c", "import sys, facediff.metrics; sys.exit('lightning' in sys.modules)"],
        ["python", "-c", "import facediff.metrics as m; print(m.protocol('paper'))"],
    ],
    "train": [["facediff", "fit", "--help"], ["facediff", "components", "model"]],
    "live": [f"facediff live {SPEECH} --to jsonl:frames.jsonl --shapes puppet --seconds 3 --sound off".split()],
    "all": [["python", "-m", "pip", "check"], ["facediff", "demo", "--fast"]],
}


def run(command: list[str], folder: Path, environment: Path | None = None) -> str:
    """Run a command in a folder, in an environment if one is named; what it printed, if it failed."""
    variables = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}
    if environment is not None:
        variables["PATH"] = f"{environment / ('Scripts' if os.name == 'nt' else 'bin')}{os.pathsep}{variables['PATH']}"
    done = subprocess.run(command, cwd=folder, env=variables, text=True, capture_output=True)
    return "" if done.returncode == 0 else f"{' '.join(command)}: status {done.returncode}\n{done.stdout}{done.stderr}"


def build(folder: Path) -> dict[str, str]:
    """The packages in a folder, by their names with their SHA-256."""
    if problem := run([sys.executable, "-m", "build", "-o", str(folder), str(ROOT)], ROOT):
        raise SystemExit(problem)
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(folder.iterdir())}


def problems_of_wheel(path: Path) -> list[str]:
    """Foreign and missing files of a wheel."""
    with zipfile.ZipFile(path) as wheel:
        names = wheel.namelist()
    strange = [name for name in names if not name.startswith(("facediff/", "facediff-"))]
    strange += [name for name in names if "__pycache__" in name or name.startswith("facediff/tests")]
    inside = ("py.typed", "bundled/puppet/model.json", "configs/experiment/puppet.yaml", "examples/speech.wav")
    needed = {f"facediff/{name}" for name in inside}
    problems = [f"holds {name}" for name in strange] + [f"lacks {name}" for name in sorted(needed - set(names))]
    if path.stat().st_size > LARGEST:
        problems.append(f"is {path.stat().st_size / 2**20:.1f} MB, more than {LARGEST / 2**20:.0f}")
    return problems


def size_of(folder: Path) -> int:
    """Bytes of the files in a folder, without what Python compiles and the wheels do not hold."""
    files = (path for path in folder.rglob("*") if path.is_file() and not path.is_symlink() and path.suffix != ".pyc")
    return sum(path.stat().st_size for path in files)


def try_extra(python: str, extra: str, wheel: Path) -> tuple[str, float, float]:
    """Install an extra into a fresh environment and use it: what failed, MB that were installed, seconds of use."""
    with tempfile.TemporaryDirectory() as place:
        environment, folder = Path(place) / "venv", Path(place) / "work"
        folder.mkdir()
        if problem := run([python, "-m", "venv", str(environment)], folder):
            return problem, 0.0, 0.0
        before = size_of(environment)
        name = str(wheel) if extra == "base" else f"{wheel}[{extra}]"
        if problem := run(["python", "-m", "pip", "install", "-q", "-c", str(CONSTRAINTS), name], folder, environment):
            return problem, 0.0, 0.0
        installed = (size_of(environment) - before) / 2**20
        started = time.monotonic()
        for command in USES[extra]:
            if problem := run(command, folder, environment):
                return problem, installed, time.monotonic() - started
        return "", installed, time.monotonic() - started


def main() -> int:
    """Build, check and try, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "dist", help="folder of packages (default: dist)")
    parser.add_argument("--python", nargs="+", default=[sys.executable], help="interpreters (default: this one)")
    parser.add_argument("--extras", nargs="+", choices=USES, default=["base"], help="what to install (default: base)")
    args = parser.parse_args()
    args.output = args.output.resolve()
    shutil.rmtree(args.output, ignore_errors=True)
    first = build(args.output)
    with tempfile.TemporaryDirectory() as again:
        second = build(Path(again))
    failed = [f"{name}: other bytes when it is built again" for name in first if second.get(name) != first[name]]
    if problem := run([sys.executable, "-m", "twine", "check", "--strict", *map(str, args.output.iterdir())], ROOT):
        failed.append(problem)
    (wheel,) = args.output.glob("*.whl")
    failed += [f"{wheel.name}: {problem}" for problem in problems_of_wheel(wheel)]
    for name, digest in first.items():
        print(f"{name}: {(args.output / name).stat().st_size / 2**20:.1f} MB, SHA-256 {digest}")
    rows = []
    for python in args.python:
        version = subprocess.run([python, "-V"], text=True, capture_output=True, check=True).stdout.split()[1]
        for extra in args.extras:
            problem, installed, seconds = try_extra(python, extra, wheel)
            rows.append(f"| {version} | {extra} | {'failed' if problem else 'yes'} | {installed:.0f} | {seconds:.0f} |")
            print(rows[-1], flush=True)
            failed += [f"{version}, {extra}: {problem}"] if problem else []
    print("\n| Python | extra | works | MB installed | s of use |\n|---|---|---|---:|---:|", *rows, sep="\n")
    print(*failed, sep="\n", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
