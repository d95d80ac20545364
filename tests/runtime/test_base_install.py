"""The base install in a fresh environment: its size, its start, and what an exported model does in it."""

from __future__ import annotations

import os
import resource
import socket
import subprocess
import venv
from pathlib import Path

import pytest
import soundfile

from tests.runtime.test_runtime import folder, model, sound

__all__ = ["folder", "model"]  # fixtures

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_base_install_is_small_starts_quickly_and_animates(folder: Path, tmp_path: Path) -> None:
    """As in a new environment of a user: ``pip install facediff``, then with the extra ``live``."""
    venv.create(tmp_path / "fresh", with_pip=True)
    programs = tmp_path / "fresh" / ("Scripts" if os.name == "nt" else "bin")
    soundfile.write(tmp_path / "speech.wav", sound(1.0), 16_000)

    def run(program: str, *arguments: str) -> str:
        outside = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "PYTEST"))}
        done = subprocess.run(
            [str(programs / program), *arguments], cwd=tmp_path, env=outside, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stdout[-5000:] + done.stderr[-5000:]
        return done.stdout

    def install(extras: str) -> None:
        run("pip", "install", "-q", "-c", str(ROOT / "tools" / "constraints.txt"), f"{ROOT}{extras}")

    install("")
    packages = next((tmp_path / "fresh").glob("lib/python3*/site-packages"))
    assert not (packages / "torch").exists()
    # Without pip's own packages, and without the bytecode that Python writes next to the files.
    own = ("pip", "setuptools", "pkg_resources", "_distutils_hack")
    files = [path for path in packages.rglob("*") if path.is_file() and "__pycache__" not in path.parts]
    size = sum(path.stat().st_size for path in files if not path.relative_to(packages).parts[0].startswith(own))
    assert size < 150e6
    run("facediff", "--help")  # writes the bytecode
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    run("facediff", "--help")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < 0.25
    for name in ("out.html", "out.glb"):
        run("facediff", "animate", "speech.wav", "--checkpoint", str(folder), "-o", name)
        assert (tmp_path / name).stat().st_size > 1000
    install("[live]")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        page = f"browser:{free.getsockname()[1]}"
    run("facediff", "live", str(folder), "speech.wav", "--to", page, "--to", "jsonl:out.jsonl?weights=false")
    assert '"type":"end"' in (tmp_path / "out.jsonl").read_text()
