"""Memory of a whole run does not grow with the motion, which is twenty times as large as its speech."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest

from facediff.speech.audio import read_speech, write_wav

SPEECH = Path(__file__).parents[2] / "docs" / "examples" / "speech.wav"
PEAK = """
import sys
from facediff.cli.app import main
status = main(sys.argv[1:])
# The resource module counts the process that started this one too.
print("PEAK", next(line.split()[1] for line in open("/proc/self/status") if line.startswith("VmHWM")))
sys.exit(status)
"""


def peak_of(seconds: int, output: Path, *options: str) -> float:
    """Megabytes of a process that animates speech of a length with the model that comes with facediff."""
    recording = output.with_name(f"{seconds}s.wav")
    write_wav(recording, np.resize(read_speech(SPEECH), seconds * 16_000), 16_000)
    arguments = ["animate", str(recording), "-o", str(output), "--seed", "1", "--quiet", "--yes", *options]
    run = subprocess.run([sys.executable, "-c", PEAK, *arguments], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    return int(run.stdout.rpartition("PEAK ")[2]) / 1024


@pytest.mark.skipif(sys.platform != "linux", reason="pages of files are given back on Linux")
def test_memory_grows_by_the_speech_alone(tmp_path: Path) -> None:
    short, long = (peak_of(seconds, tmp_path / "x.npz", "--blinks") for seconds in (10, 70))
    assert (tmp_path / "x.npz").stat().st_size > 120e6
    assert long - short < 40
    assert peak_of(10, tmp_path / "x.html") < 300


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.skipif(sys.platform != "linux", reason="pages of files are given back on Linux")
@pytest.mark.parametrize(("suffix", "options"), [(".npz", ()), (".glb", ()), (".html", ()), (".mp4", ("--size", "64"))])
def test_an_hour_takes_less_than_600_mb(suffix: str, options: tuple[str, ...]) -> None:
    # On a disk: pages of a file that lies in memory are never given back.
    with tempfile.TemporaryDirectory(dir="/var/tmp") as folder:  # noqa: S108
        assert peak_of(3600, Path(folder) / f"x{suffix}", *options) < 600
