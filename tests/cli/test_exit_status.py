"""Exit statuses, standard streams that are closed or full, signals, and errors that nobody expected."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from facediff.cli import app, process
from facediff.cli.app import main
from facediff.errors import FaceDiffError

ROOT = Path(__file__).parents[2]
FACEDIFF = f"{shlex.quote(sys.executable)} -m facediff"


@pytest.mark.parametrize(
    ("words", "status", "errors"),
    [
        ("--help >/dev/full", 2, 1),
        ("animate --help >/dev/full", 2, 1),
        ("--help >&-", 2, 1),
        ("frobnicate >&-", 2, 1),
        ("frobnicate 2>/dev/full", 2, 0),
        ("frobnicate 2>&-", 2, 0),
        ("--help 2>&- <&-", 0, 0),
    ],
)
def test_closed_and_full_streams(words: str, status: int, errors: int) -> None:
    run = subprocess.run(f"{FACEDIFF} {words}", shell=True, cwd=ROOT, capture_output=True, text=True, check=False)  # noqa: S602
    assert run.returncode == status
    assert len(run.stderr.splitlines()) == errors
    assert "Traceback" not in run.stderr


@pytest.mark.parametrize("encoding", ["ascii", "utf-8"])
def test_names_that_are_no_text_are_printed(tmp_path: Path, encoding: str) -> None:
    """Bytes that are no UTF-8, letters that the encoding lacks, line breaks and codes for the terminal."""
    name = os.fsdecode(b"a\xff\n\x1b[31m\xc3\xa9.npz")
    environment = {**os.environ, "PYTHONIOENCODING": encoding, "LC_ALL": "C"}
    command = [sys.executable, "-m", "facediff", "view", name, "-o", str(tmp_path / "a.html")]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, env=environment, check=False)
    assert run.returncode == 2
    assert run.stderr.startswith(b"facediff: error: animations a\\udcff\\n\\x1b[31m")
    assert len(run.stderr.splitlines()) == 1


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_signals_remove_what_is_half_written(number: signal.Signals, status: int, tmp_path: Path) -> None:
    program = (
        "import sys, time, pathlib; from facediff.cli import app; from facediff.utils.files import atomic\n"
        "def run(*_):\n"
        "    with atomic(pathlib.Path('out.npy')) as temporary:\n"
        "        temporary.touch(); print('ready', flush=True); time.sleep(60)\n"
        "import signal; signal.signal(signal.SIGHUP, signal.SIG_DFL)\n"  # as nohup would have it ignored
        "app.run = run; sys.argv = ['facediff', 'demo']; sys.exit(app.main())"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", program]
    with subprocess.Popen(
        command, cwd=tmp_path, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as started:
        assert started.stdout is not None
        assert started.stderr is not None
        assert started.stdout.readline() == "ready\n"
        started.send_signal(number)
        assert started.wait(30) == status
        (said,) = started.stderr.read().splitlines()
        assert said.startswith("facediff: error: ")
    assert list(tmp_path.iterdir()) == []


class CudaError(RuntimeError):
    """As torch raises it."""


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (FaceDiffError("a.npz: is broken"), 2),
        (KeyboardInterrupt(), 130),
        (MemoryError(), 2),
        (CudaError("CUDA out of memory. Tried to allocate 2 GiB"), 2),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory"), 2),
        (PermissionError(13, "Permission denied", "secret.npz"), 2),
        (TypeError("fault\nof two lines"), 70),
    ],
)
def test_every_error_is_one_sentence(
    error: BaseException, status: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(name: str, arguments: object) -> int:
        raise error

    monkeypatch.setattr(app, "run", run)
    monkeypatch.delenv(process.TRACEBACK, raising=False)
    assert main(["demo"]) == status
    printed = capsys.readouterr().err
    assert printed.startswith("facediff: error: ")
    assert len(printed.splitlines()) == 1
    if isinstance(error, OSError):
        assert "secret.npz" in printed
    monkeypatch.setenv(process.TRACEBACK, "1")
    if isinstance(error, FaceDiffError | KeyboardInterrupt):
        assert main(["demo"]) == status
    else:
        with pytest.raises(type(error)):
            main(["demo"])


def test_the_line_of_an_unexpected_error_may_be_in_a_file_of_the_users(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """jsonargparse puts its list of types around what a constructor raises."""

    def run(name: str, arguments: object) -> int:
        try:
            raise KeyError("weights")
        except KeyError as error:
            raise ValueError("Does not validate against any of the Union subtypes") from error

    monkeypatch.setattr(app, "run", run)
    monkeypatch.delenv(process.TRACEBACK, raising=False)
    assert main(["demo"]) == 70
    printed = capsys.readouterr().err
    assert "unexpected KeyError: 'weights'" in printed
    assert f"{__file__}, line " in printed
    assert "fault of facediff" not in printed
