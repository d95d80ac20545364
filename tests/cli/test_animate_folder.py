"""Batch mode: every recording gets its output or an error; finished outputs are kept, and none is half-written."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from facediff.animation import read_archive
from facediff.cli.app import main
from facediff.errors import FaceDiffError
from facediff.models import load_model
from facediff.pipelines.folder import LOCK, output_names, recordings, seed_of_recording
from facediff.utils.files import locked
from tests.fakes.batches import run
from tests.fakes.waiting import PATIENCE, wait_until, wait_until_signalled

ROOT = Path(__file__).parents[2]
FACES = "".join(f"f {r * 6 + c + 1} {r * 6 + c + 2} {r * 6 + c + 7}\n" for r in range(3) for c in range(5))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "in"
    made.mkdir()
    for name in "abcd":
        (made / f"{name}.wav").write_text(f"hello {name}")
    (tmp_path / "C.ckpt").write_text("weights")
    return made


def outputs(folder: Path) -> dict[str, dict[str, object]]:
    out = folder.parent / "out"
    assert not [path for path in out.rglob("*") if "partial" in path.name]
    return {path.name: json.loads(path.read_text()) for path in out.glob("*.npy")}


def times(folder: Path) -> dict[str, int]:
    return {path.name: path.stat().st_mtime_ns for path in (folder.parent / "out").glob("*.npy")}


def test_a_damaged_file_next_to_an_output_makes_it_again(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "a.wav").write_text("with sound")
    assert run(folder) == 0
    sound, before = folder.parent / "out" / "a.sound", times(folder)
    assert run(folder) == 0
    assert times(folder) == before
    for damage in (lambda: sound.write_bytes(b""), sound.unlink):
        damage()
        assert run(folder) == 0
        assert sound.read_text() == "sound"
        assert times(folder).pop("a.npy") != before.pop("a.npy")
        before = times(folder)
        assert "a.sound is missing or damaged" in capsys.readouterr().out


def test_failures_of_all_kinds_stop_nothing_else(folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for name, words in (("b", "bad"), ("c", "deadly"), ("d", "bug")):
        (folder / f"{name}.wav").write_text(words)
    for name in "efgh":
        (folder / f"{name}.wav").write_text(name)
    assert run(folder, workers=2) == 1
    made = outputs(folder)
    assert set(made) == {f"{name}.npy" for name in "aefgh"}
    assert os.getpid() not in {facts["pid"] for facts in made.values()}
    lines = capfd.readouterr().out.splitlines()
    assert lines[-1] == "8 recordings: 5 made, 3 failed"
    table = {line.split()[0]: line for line in lines[-9:-1]}
    assert "holds only silence" in table["b.wav"]
    assert "killed its process" in table["c.wav"]
    assert "ValueError: no such thing" in table["d.wav"]

    before = times(folder)
    (folder / "d.wav").write_text("mended")
    assert run(folder) == 1
    out = capfd.readouterr().out
    assert "8 recordings: 5 up to date, 2 failed, 1 made" in out
    assert "killed its process" in out
    assert "--retry-failed tries again" in out
    after = times(folder)
    assert {name: after[name] for name in before} == before
    (folder / "c.wav").write_text("mended")
    (folder / "b.wav").write_text("fine")
    assert run(folder, retry_failed=True) == 0


def test_each_process_loads_the_model_once_and_seeds_do_not_depend_on_it(folder: Path) -> None:
    assert run(folder, "--pause", "0.2", workers=2) == 0
    made = outputs(folder)
    for pid in {facts["pid"] for facts in made.values()}:
        counts = sorted(int(str(facts["nth"])) for facts in made.values() if facts["pid"] == pid)
        assert counts == list(range(1, len(counts) + 1))
    assert len({facts["pid"] for facts in made.values()}) == 2
    seeds = {name: facts["seed"] for name, facts in made.items()}
    assert len(set(seeds.values())) == 4
    assert run(folder, "--other") == 0
    assert {name: facts["seed"] for name, facts in outputs(folder).items()} == seeds
    assert seed_of_recording(Path("x/a.wav"), 3) == seeds["a.npy"] != seed_of_recording(Path("a.wav"), 4)


def test_only_outputs_of_changed_inputs_are_made_again(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(folder, "--seed", "1") == 0
    first = times(folder)

    def again(*command: str) -> tuple[set[str], str]:
        capsys.readouterr()
        before = times(folder)
        assert run(folder, *command) == 0
        after = times(folder)
        return {name for name in after if after[name] != before.get(name)}, capsys.readouterr().out

    assert again("--seed", "1")[0] == set()
    os.utime(folder / "a.wav")  # touched, not changed
    assert again("--seed", "1")[0] == set()
    folder.rename(folder.parent / "elsewhere")
    shutil.copytree(folder.parent / "elsewhere", folder)  # other times, the same bytes
    assert again("--seed", "1")[0] == set()
    (folder / "a.wav").write_text("hallo a")  # as long as before
    assert again("--seed", "1")[0] == {"a.npy"}
    out = folder.parent / "out"
    (out / "b.npy").write_text("cut")
    (out / ".b.partial-12-ab.npy").write_text("left by a killed run")
    (out / ".b.partial-folder").mkdir()
    changed, told = again("--seed", "1")
    assert changed == {"b.npy"}
    assert "b.npy" in told
    assert "damaged" in told
    assert not list(out.glob(".b.*"))
    (folder.parent / "C.ckpt").write_text("other weights")
    changed, told = again("--seed", "1")
    assert changed == set(first)
    assert "C.ckpt has changed" in told
    changed, told = again("--seed", "2")
    assert changed == set(first)
    assert "the options have changed" in told


def test_an_unusable_checkpoint_stops_the_batch(folder: Path) -> None:
    for workers in (1, 2):
        with pytest.raises(FaceDiffError, match="no such checkpoint"):
            run(folder, "no-model", workers=workers)
    assert outputs(folder) == {}


def test_two_batches_do_not_share_a_folder(folder: Path) -> None:
    with (
        locked(folder.parent / "out" / LOCK, "facediff animate"),
        pytest.raises(FaceDiffError, match="facediff animate"),
    ):
        run(folder)
    assert run(folder) == 0


def test_a_file_that_no_batch_wrote_stays(folder: Path) -> None:
    (folder.parent / "out").mkdir()
    (folder.parent / "out" / "b.npy").touch()
    with pytest.raises(FaceDiffError, match=r"b\.npy: would be replaced"):
        run(folder)


def test_names_that_collide_keep_their_suffix(folder: Path, tmp_path: Path) -> None:
    (folder / "A.FLAC").write_text("x")
    (folder / "notes.txt").write_text("x")
    (folder / ".hidden.wav").write_text("x")
    found = recordings([folder, folder / "a.wav"])
    assert [path.name for path in found] == ["A.FLAC", "a.wav", "b.wav", "c.wav", "d.wav"]
    assert output_names(found, ".mp4") == ["A.FLAC.mp4", "a.wav.mp4", "b.mp4", "c.mp4", "d.mp4"]
    with pytest.raises(FaceDiffError, match="would both give a.wav.mp4"):
        output_names([Path("x/a.wav"), Path("y/a.wav")], ".mp4")
    with pytest.raises(FaceDiffError, match="holds no recording"):
        recordings([tmp_path])


PROGRAM = """
from pathlib import Path
from tests.fakes.batches import run
from tests.fakes.waiting import PATIENCE, wait_until, wait_until_signalled
if __name__ == "__main__":
    run(Path({folder!r}), "--hold", {hold!r}, workers=2)
"""


def started(folder: Path, tmp_path: Path) -> subprocess.Popen[str]:
    """A batch in a process group of its own, at work on its second pair of recordings until the file ``hold`` comes."""
    script = tmp_path / "batch.py"
    script.write_text(PROGRAM.format(folder=str(folder), hold=str(tmp_path / "hold")))
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(
        [sys.executable, str(script)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
        start_new_session=True,
    )
    out = folder.parent / "out"
    wait_until(
        lambda: len(list(out.glob("[!.]*.npy"))) == len(list(out.glob(".*.partial-*"))) == 2,
        lambda: process.poll() is None,
    )
    return process


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_ctrl_c_finishes_running_recordings_and_a_second_run_the_rest(folder: Path, tmp_path: Path) -> None:
    for name in "ef":
        (folder / f"{name}.wav").write_text(name)
    process = started(folder, tmp_path)
    os.killpg(process.pid, signal.SIGINT)
    wait_until_signalled(process.pid)
    (tmp_path / "hold").touch()
    out, error = process.communicate(timeout=PATIENCE)
    assert "KeyboardInterrupt" in error
    assert "the same command" in out
    done = outputs(folder)  # no partial files
    assert 2 <= len(done) < 6
    assert f"6 recordings: {len(done)} made, {6 - len(done)} left" in out  # also what was finished after the signal
    before = times(folder)
    assert run(folder, "--hold", str(tmp_path / "hold"), workers=1) == 0
    after = times(folder)
    assert len(after) == 6
    assert {name: after[name] for name in before} == before


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="looks for processes in /proc")
def test_workers_end_when_their_parent_is_killed(folder: Path, tmp_path: Path) -> None:
    process = started(folder, tmp_path)
    process.kill()
    process.communicate(timeout=PATIENCE)

    def of_the_group() -> list[str]:
        found = []
        for stat in Path("/proc").glob("[0-9]*/stat"):
            try:
                fields = stat.read_text().rpartition(")")[2].split()
            except OSError:
                continue
            if int(fields[2]) == process.pid and fields[0] != "Z":
                found.append(stat.parent.name)
        return found

    wait_until(lambda: not of_the_group())
    assert run(folder) == 0
    assert len(outputs(folder)) == 4


@pytest.mark.slow
def test_a_second_batch_keeps_outputs_made_with_the_same_correspondence_and_shapes(
    checkpoint: Path, tiny_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The map to a mesh is written on the way; blendshapes decide a table as a checkpoint does."""
    for name in ("A_e01", "B_e02"):
        (tmp_path / "in").mkdir(exist_ok=True)
        shutil.copy(tiny_root / "wav" / f"{name}.wav", tmp_path / "in")
    common = ["animate", str(tmp_path / "in"), "--checkpoint", str(checkpoint), "--workers", "1", "--quiet"]
    mesh = ["--target-mesh", str(tiny_root / "tiny.ply"), "--correspondence", str(tmp_path / "map.npz")]
    for state in ("made", "up to date"):
        assert main([*common, *mesh, "--suffix", ".npz", "-o", str(tmp_path / "meshes")]) == 0
        assert f"2 recordings: 2 {state}" in capsys.readouterr().out
    shapes = tmp_path / "shapes"
    shapes.mkdir()
    neutral = load_model(checkpoint).assets.templates["A"].numpy()
    for name, way in (("neutral", 0.0), ("jawOpen", 0.01)):
        moved = neutral + np.array([0, -way, 0]) * (np.arange(24) < 12)[:, None]
        (shapes / f"{name}.obj").write_text("".join(f"v {x:.8f} {y:.8f} {z:.8f}\n" for x, y, z in moved) + FACES)
    tables = [*common, "--shapes", str(shapes), "--suffix", ".csv", "-o", str(tmp_path / "tables")]
    for state in ("made", "up to date"):
        assert main(tables) == 0
        assert f"2 recordings: 2 {state}" in capsys.readouterr().out
    (shapes / "jawOpen.obj").write_text((shapes / "jawOpen.obj").read_text().replace("v 0.0", "v 0.00", 1))
    assert main(tables) == 0
    assert "jawOpen.obj has changed" in capsys.readouterr().out


def test_animate_takes_a_folder(
    checkpoint: Path, tmp_path: Path, tiny_root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The command itself, with a trained model: a recording in a batch is what it is alone with the batch's seed."""
    folder, out = tmp_path / "in", tmp_path / "out"
    folder.mkdir()
    for name in ("A_e01", "B_e02"):
        shutil.copy(tiny_root / "wav" / f"{name}.wav", folder)
    (folder / "broken.wav").write_text("no sound")
    words = ["--checkpoint", str(checkpoint), "--sway", "3", "--style", "A_e02:1,B_e02:1", "--quiet"]
    command = ["animate", str(folder), *words, "--seed", "3", "--suffix", ".npz", "--workers", "1", "-o", str(out)]
    assert main(command) == 1
    assert "3 recordings: 2 made, 1 failed" in capsys.readouterr().out
    seed = seed_of_recording(folder / "A_e01.wav", 3)
    alone = ["animate", str(folder / "A_e01.wav"), *words, "--seed", str(seed), "-o", str(tmp_path / "alone.npz")]
    assert main(alone) == 0
    one, other = read_archive(out / "A_e01.npz"), read_archive(tmp_path / "alone.npz")
    assert np.array_equal(one.vertices, other.vertices)
    assert one.metadata == other.metadata
    assert one.metadata["procedural"] == f"head sway (3 degrees, seed {seed})"
    assert one.metadata["style"] == "0.5 A_e02 + 0.5 B_e02"
    capsys.readouterr()
    assert main(command) == 1
    assert "3 recordings: 2 up to date, 1 failed" in capsys.readouterr().out
    assert main([*command[:2], "--suffix", ".obj", "-o", str(out)]) == 2
    assert "a batch writes one file for each recording" in capsys.readouterr().err


def test_a_mesh_without_a_mouth_is_refused_before_a_recording_is_animated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A new map is judged by a recording's motion, as for one recording; a neutral face opens no mouth."""
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "a_broken.wav").write_text("no sound")
    shutil.copy(ROOT / "docs" / "examples" / "speech.wav", tmp_path / "in")
    trimesh.creation.icosphere(2, 0.1).export(tmp_path / "ball.obj")
    before = sorted(tmp_path.rglob("*"))
    mesh = ["--target-mesh", str(tmp_path / "ball.obj"), "--correspondence", str(tmp_path / "map.npz")]
    assert main(["animate", str(tmp_path / "in"), *mesh, "-o", str(tmp_path / "out")]) == 2
    assert "ball.obj: no line between its lips" in capsys.readouterr().err
    assert sorted(tmp_path.rglob("*")) == before
