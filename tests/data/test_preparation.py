"""The runner of data preparation: kills, resumption, refusals, the manifest."""

from __future__ import annotations

import errno
import hashlib
import importlib
import inspect
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import soundfile

from facediff.cli.app import run
from facediff.cli.data import CORPORA, options_of
from facediff.cli.parsing import Parameter
from facediff.data.preparation import Job, PreparationPlan, prepare, write_motion, write_speech, write_templates
from facediff.data.prepare import biwi
from facediff.errors import FaceDiffError, MissingExtraError
from tests.fakes.biwi import vl_bytes, write_raw_biwi
from tests.fakes.waiting import PATIENCE, wait_until, wait_until_signalled

CLIPS = ["A_e01", "A_e02", "B_e01"]


def contents(folder: Path) -> dict[str, bytes]:
    """Every file of a folder, hidden ones too."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def write_toy(name: str, frames: int, out: Path) -> int:
    motion = np.full((frames, 2, 3), frames, np.float64) + np.arange(6).reshape(2, 3)
    write_motion(out / "vertices_npy" / f"{name}.npy", motion)
    write_speech(out / "wav" / f"{name}.wav", np.linspace(-0.5, 0.5, 640 * frames))
    return frames


def raising(error: Exception, out: Path) -> int:
    raise error


def write_toy_templates(out: Path) -> list[str]:
    write_templates(out / "templates.pkl", {"A": np.zeros((2, 3))})
    return ["templates.pkl"]


def toy_plan(
    works: dict[str, Callable[[Path], int]] | None = None, options: dict[str, object] | None = None, **facts: object
) -> PreparationPlan:
    works = works or {name: partial(write_toy, name, 3 + i) for i, name in enumerate(CLIPS)}
    jobs = [Job(name, work) for name, work in works.items()]
    return PreparationPlan("toy", 25.0, "m", 2, options or {"dtype": "float32"}, jobs, write_toy_templates, **facts)  # type: ignore[arg-type]


def test_the_manifest_says_what_is_there(tmp_path: Path) -> None:
    out = tmp_path / "out"
    report = prepare(toy_plan(missing={"C": "expected C"}, notes=["look"]), out, workers=1)
    assert report.sound
    assert report.written == 3
    manifest = json.loads((out / "manifest.json").read_text())
    files = contents(out)
    assert set(files) == {"manifest.json", *manifest["files"]}
    for name, facts in manifest["files"].items():
        assert facts == {"bytes": len(files[name]), "sha256": hashlib.sha256(files[name]).hexdigest()}
    assert manifest["clips"] == {"A_e01": 3, "A_e02": 4, "B_e01": 5} == report.clips
    total = sum(len(data) for name, data in files.items() if name != "manifest.json")
    assert manifest["totals"] == {"clips": 3, "frames": 12, "seconds": 0.48, "bytes": total}
    facts = {"corpus": "toy", "frame_rate": 25.0, "unit": "m", "n_vertices": 2, "options": {"dtype": "float32"}}
    assert {name: manifest[name] for name in facts} == facts
    assert manifest["missing"] == {"C": "expected C"}
    assert manifest["notes"] == ["look"]
    assert manifest["failed"] == {}


def test_a_second_run_changes_nothing(tmp_path: Path) -> None:
    out = tmp_path / "out"
    prepare(toy_plan(), out, workers=1)
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*")}
    report = prepare(toy_plan(), out, workers=1)
    assert report.written == 0
    assert report.clips == {"A_e01": 3, "A_e02": 4, "B_e01": 5}
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*") if path != out} == {
        path: stamp for path, stamp in before.items() if path != out
    }
    assert prepare(toy_plan(notes=["A_e01: frames are missing"]), out, workers=1).written == 1, "of other raw files"


@pytest.mark.parametrize(
    "flaw", ["npy cut", "npy gone", "wav empty", "wav cut", "wav grown", "wav gone", "templates gone", "other type"]
)
def test_damaged_files_are_written_again(tmp_path: Path, flaw: str) -> None:
    out = tmp_path / "out"
    prepare(toy_plan(), out, workers=1)
    whole = contents(out)
    motion, speech = out / "vertices_npy" / "A_e02.npy", out / "wav" / "A_e02.wav"
    if flaw == "npy cut":
        motion.write_bytes(motion.read_bytes()[:-5])
    elif flaw == "other type":
        np.save(motion, np.load(motion).astype("f8"))
    elif flaw == "wav empty":
        speech.write_bytes(b"")
    elif flaw == "wav cut":
        speech.write_bytes(speech.read_bytes()[:-500])
    elif flaw == "wav grown":
        speech.write_bytes(speech.read_bytes() + b"more")
    else:
        {"npy gone": motion, "wav gone": speech, "templates gone": out / "templates.pkl"}[flaw].unlink()
    report = prepare(toy_plan(), out, workers=1)
    assert report.written == (0 if flaw == "templates gone" else 1)
    assert contents(out) == whole


def test_a_failing_clip_does_not_stop_the_others_and_can_be_repaired(tmp_path: Path) -> None:
    out = tmp_path / "out"
    works = {name: partial(write_toy, name, 3 + i) for i, name in enumerate(CLIPS)}
    report = prepare(toy_plan({**works, "A_e02": partial(raising, FaceDiffError("x.vl: bad"))}), out, workers=1)
    assert not report.sound
    assert report.failed == {"A_e02": "x.vl: bad"}
    assert set(report.clips) == {"A_e01", "B_e01"}
    assert json.loads((out / "manifest.json").read_text())["failed"] == {"A_e02": "x.vl: bad"}
    repaired = prepare(toy_plan(works), out, workers=1)
    assert repaired.sound
    assert repaired.written == 1
    prepare(toy_plan(works), tmp_path / "at once", workers=1)
    assert contents(out) == contents(tmp_path / "at once")


def full_disk() -> FaceDiffError:
    """As writers of several files raise it, which name the file that was asked for."""
    error, first = FaceDiffError("out: cannot be written (No space left on device)"), FaceDiffError("hidden")
    first.__cause__ = OSError(errno.ENOSPC, "No space left on device")
    error.__cause__ = first
    return error


@pytest.mark.parametrize("error", [full_disk(), MissingExtraError("av", "prepare", "reading flv")])
def test_errors_that_concern_every_clip_stop_the_run(tmp_path: Path, error: FaceDiffError) -> None:
    out = tmp_path / "out"
    plan = toy_plan({"A_e01": partial(raising, error), "A_e02": partial(write_toy, "A_e02", 3)})
    with pytest.raises(FaceDiffError, match="No space left|facediff\\[prepare\\]"):
        prepare(plan, out, workers=1)
    assert (out / "prepare.json").is_file()
    assert not (out / "vertices_npy" / "A_e02.npy").exists()
    assert not (out / "manifest.json").exists()


def test_other_options_are_refused(tmp_path: Path) -> None:
    out = tmp_path / "out"
    prepare(toy_plan(options={"dtype": "float32", "subjects": ["A", "B"]}), out, workers=1)
    before = contents(out)
    with pytest.raises(FaceDiffError, match=r"--dtype was 'float32' and is 'float64'; --subjects was .* and is "):
        prepare(toy_plan(options={"dtype": "float64", "subjects": ["A"]}), out, workers=1)
    assert contents(out) == before


def test_other_regions_replace_those_of_before(tmp_path: Path) -> None:
    def regions(text: str, out: Path) -> list[str]:
        (out / "lips.txt").write_text(text)
        return ["lips.txt"]

    for text in ("1, 2", "3, 4"):
        report = prepare(replace(toy_plan(), shared=partial(regions, text)), tmp_path / "out", workers=1)
        assert report.written == 3 * (text == "1, 2")
        assert (tmp_path / "out" / "lips.txt").read_text() == text


def test_another_version_may_read_but_not_write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "out"
    prepare(toy_plan(), out, workers=1)
    monkeypatch.setattr("facediff.data.preparation.version", lambda: "99.0")
    assert prepare(toy_plan(), out, workers=1).written == 0
    (out / "wav" / "A_e01.wav").unlink()
    with pytest.raises(FaceDiffError, match=r"facediff was .* and is '99\.0'"):
        prepare(toy_plan(), out, workers=1)


def test_foreign_folders_and_strays_are_refused(tmp_path: Path) -> None:
    other = tmp_path / "other"
    (other / "wav").mkdir(parents=True)
    with pytest.raises(FaceDiffError, match=r"other: holds other files \(wav\)"):
        prepare(toy_plan(), other, workers=1)
    assert [path.name for path in other.iterdir()] == ["wav"]
    out = tmp_path / "out"
    prepare(toy_plan(), out, workers=1)
    with pytest.raises(FaceDiffError, match=r"A_e02\.npy: is no clip of the raw folder"):
        prepare(toy_plan({"A_e01": partial(write_toy, "A_e01", 3)}), out, workers=1)


def test_speech_of_16_bit_goes_through_unchanged_and_loud_speech_is_clipped(tmp_path: Path) -> None:
    samples = np.arange(-32768, 32768, 7).astype(np.int16)
    write_speech(tmp_path / "a.wav", samples.astype(np.float32) / 32768)
    read, rate = soundfile.read(tmp_path / "a.wav", dtype="int16")
    assert rate == 16000
    assert np.array_equal(read, samples)
    write_speech(tmp_path / "b.wav", np.array([1.5, -1.5, 0.0], np.float32))
    assert soundfile.read(tmp_path / "b.wav", dtype="int16")[0].tolist() == [32767, -32768, 0]


def test_motion_that_is_not_finite_is_not_written(tmp_path: Path) -> None:
    motion = np.zeros((4, 2, 3), np.float32)
    motion[2, 1, 0] = np.inf
    with pytest.raises(FaceDiffError, match=r"a: frame 2 \(counted from 0\)"):
        write_motion(tmp_path / "a.npy", motion)
    assert list(tmp_path.iterdir()) == []


PROGRAM = """
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from facediff.data import preparation as runner
from facediff.data.prepare import biwi
from slow import slow
if __name__ == "__main__":
    plan = biwi.plan(Path(sys.argv[1]))
    jobs = [replace(job, work=partial(slow, job.work)) for job in plan.jobs]
    try:
        runner.prepare(replace(plan, jobs=jobs), Path(sys.argv[2]), workers=2, quiet=True)
    except KeyboardInterrupt:
        sys.exit(130)
"""
SLOW = """
import os, time
jobs = 0
def slow(work, out):
    global jobs
    (out.parent / f"pid-{os.getpid()}").touch()
    frames = work(out)
    jobs += 1
    while jobs > 3 and not (out.parent / "go on").exists():  # the signal comes long before the end
        time.sleep(0.02)
    return frames
"""


@pytest.mark.parametrize("how", [signal.SIGKILL, pytest.param(signal.SIGINT, marks=pytest.mark.slow)])
def test_a_stopped_run_is_resumed_to_equal_bytes(tmp_path: Path, how: signal.Signals) -> None:
    raw, out = write_raw_biwi(tmp_path / "raw", sentences=[f"e{i:02d}" for i in range(1, 12)]), tmp_path / "out"
    (tmp_path / "program.py").write_text(PROGRAM)
    (tmp_path / "slow.py").write_text(SLOW)
    process = subprocess.Popen(
        [sys.executable, str(tmp_path / "program.py"), str(raw), str(out)],
        env={**os.environ, "PYTHONPATH": f"{Path(__file__).parents[2]}:{tmp_path}"},
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    wait_until(lambda: len(list(out.glob("wav/[FM]*.wav"))) == 8, lambda: process.poll() is None)
    # Ctrl-C reaches every process of the terminal; the kill reaches the first only, and the workers must notice.
    os.killpg(process.pid, how) if how == signal.SIGINT else process.kill()
    if how == signal.SIGINT:
        wait_until_signalled(process.pid)
        (tmp_path / "go on").touch()
    assert "Traceback" not in process.communicate(timeout=PATIENCE)[1]
    assert process.returncode == (130 if how == signal.SIGINT else -signal.SIGKILL)
    workers = [int(path.name.partition("-")[2]) for path in tmp_path.glob("pid-*")]
    assert len(workers) == 2
    wait_until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in workers))
    kept = len(list(out.glob("wav/[FM]*.wav")))
    assert 4 <= kept < 33
    assert (out / "prepare.json").is_file()
    assert not (out / "manifest.json").exists()
    (out / "vertices_npy" / ".F1_e01.partial-4711.npy").write_bytes(b"half")
    report = prepare(biwi.plan(raw), out, workers=1)
    assert 0 < report.written <= 33 - kept + 2
    prepare(biwi.plan(raw), tmp_path / "at once", workers=1)
    assert contents(out) == contents(tmp_path / "at once")


def test_the_command_reports_the_result(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    raw = write_raw_biwi(tmp_path / "raw", regions=False)
    frame = raw / "faces" / "M3" / "e33" / "frame_002.vl"
    frame.write_bytes(vl_bytes(np.zeros((3, 3))))
    arguments = ["biwi", str(raw), str(tmp_path / "out"), "--subjects", "F2,M3", "--workers", "1"]
    assert run("data prepare", arguments) == 1
    shown = capsys.readouterr().out
    assert "7 clips" in shown
    assert "7 written now" in shown
    assert f"M3_e33: {frame}: has 40 bytes" in shown
    assert "regions/lve.txt: expected in a folder given by --regions" in shown
    assert "F2_e03: expected frames in" in shown
    shutil.rmtree(frame.parent)
    shutil.copytree(raw / "faces" / "M3" / "e37", frame.parent)
    assert run("data prepare", arguments) == 0
    assert "1 written now" in capsys.readouterr().out


@pytest.mark.parametrize("corpus", CORPORA)
def test_every_option_of_a_corpus_is_explained_and_reaches_its_plan(corpus: str, tmp_path: Path) -> None:
    module = importlib.import_module(f"facediff.data.prepare.{corpus}")
    signature = inspect.signature(module.plan).parameters
    own = {name: option for name, option in options_of(module.plan).items() if name not in ("raw", "out", "work")}
    assert set(own) == set(signature) - {"raw", "quiet"}
    for name, option in own.items():
        assert isinstance(option, Parameter)
        assert len(option.help) > 10
        assert option.default == signature[name].default


def test_equal_templates_give_equal_bytes_wherever_their_arrays_come_from(tmp_path: Path) -> None:
    """NumPy may hand out several instances of one dtype, and a pickle tells them apart."""
    faces = {"A": np.ones((2, 3), np.float32), "B": np.zeros((2, 3), np.float32)}
    other = {**faces, "B": np.zeros((2, 3), np.dtype(np.float32).newbyteorder("<"))}
    assert other["B"].dtype is not faces["B"].dtype
    write_templates(tmp_path / "one.pkl", faces)
    write_templates(tmp_path / "two.pkl", other)
    assert (tmp_path / "one.pkl").read_bytes() == (tmp_path / "two.pkl").read_bytes()
