"""Writing files and folders whole or not at all; files of unknown origin: speech, pickles, meshes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from facediff.errors import FaceDiffError
from facediff.utils.checksums import describe_files, same_sizes, sha256
from facediff.utils.files import (
    atomic,
    atomic_folder,
    check_writable,
    locked,
    put_in_place,
    reserve_room,
    scratch_folder,
    sweep,
)
from facediff.utils.plain_files import read_json, write_json, write_rows

ROOT = Path(__file__).parents[2]


def test_an_atomic_file_is_whole_or_absent(tmp_path: Path) -> None:
    path = tmp_path / "new" / "out.txt"
    with pytest.raises(RuntimeError, match="halfway"), atomic(path) as temporary:  # noqa: PT012
        temporary.write_text("half")
        raise RuntimeError("halfway")
    assert list(tmp_path.rglob("*.txt")) == []
    with atomic(path) as temporary:
        temporary.write_text("whole")
    assert path.read_text() == "whole"
    assert [p.name for p in path.parent.iterdir()] == ["out.txt"]


def test_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(FaceDiffError, match="cannot be written"):
        check_writable(tmp_path / "file" / "out.npy")
    check_writable(tmp_path / "a" / "b" / "out.npy")
    assert not (tmp_path / "a").exists()


def test_an_atomic_folder_is_whole_or_absent(tmp_path: Path) -> None:
    path = tmp_path / "new" / "out"
    with pytest.raises(RuntimeError, match="halfway"), atomic_folder(path) as folder:  # noqa: PT012
        (folder / "a").touch()
        raise RuntimeError("halfway")
    assert list(tmp_path.iterdir()) == []
    with atomic_folder(path) as folder:
        (folder / "a").touch()
        assert not path.exists()
    assert [p.name for p in path.parent.rglob("*")] == ["out", "a"]


def test_an_atomic_folder_replaces_content_only_if_allowed(tmp_path: Path) -> None:
    path = tmp_path / "out"
    path.mkdir()
    for text in ("first", "second"):
        with atomic_folder(path, replace=text == "second") as folder:
            (folder / "a").write_text(text)
        assert (path / "a").read_text() == text
    with pytest.raises(FaceDiffError, match="not empty"), atomic_folder(path):
        pass
    with pytest.raises(FaceDiffError, match=r"a: is a file"), atomic_folder(path / "a", replace=True):
        pass
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_an_atomic_folder_handles_a_folder_that_appears_meanwhile(tmp_path: Path) -> None:
    path = tmp_path / "out"
    with pytest.raises(FaceDiffError, match="out: cannot be written"), atomic_folder(path) as folder:  # noqa: PT012
        (folder / "a").touch()
        path.mkdir()
        (path / "precious").touch()
    assert [p.name for p in tmp_path.rglob("*")] == ["out", "precious"]
    with atomic_folder(path, replace=True) as folder:
        (folder / "a").touch()
        (path / "other").touch()
    assert [p.name for p in tmp_path.rglob("*")] == ["out", "a"]


def test_the_scratch_folder_of_a_killed_process_is_removed_and_of_a_running_one_kept(tmp_path: Path) -> None:
    path = tmp_path / "out"
    program = (
        "import os, sys, pathlib; from facediff.utils.files import atomic_folder\n"
        "with atomic_folder(pathlib.Path(sys.argv[1])) as folder: (folder / 'half').touch(); os._exit(9)"
    )
    run = subprocess.run([sys.executable, "-c", program, str(path)], cwd=ROOT)
    assert run.returncode == 9
    (left,) = tmp_path.iterdir()
    assert left.name.startswith(".out.partial-")
    with scratch_folder(path) as living:
        with atomic_folder(path) as folder:
            (folder / "a").touch()
        assert {p.name for p in tmp_path.iterdir()} == {"out", living.name}
    assert {p.name for p in tmp_path.iterdir()} == {"out"}


def test_a_lock_keeps_others_out_and_leaves_nothing(tmp_path: Path) -> None:
    lock = tmp_path / "new" / ".lock"
    who = rf"new: another `facediff test` \(process {os.getpid()} on .*\) is at work here"
    with locked(lock, "facediff test"), pytest.raises(FaceDiffError, match=who):
        locked(lock, "facediff test").__enter__()
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").touch()
    with pytest.raises(FaceDiffError, match="cannot be written"):
        locked(tmp_path / "file" / ".lock", "facediff test").__enter__()


def test_described_files_are_compared_by_size(tmp_path: Path) -> None:
    write_json(tmp_path / "b" / "x.json", {"a": "ä"})
    write_rows(tmp_path / "a.csv", [{"clip": "A", "frames": 3}], line_end="\n")
    assert (tmp_path / "a.csv").read_bytes() == b"clip,frames\nA,3\n"
    assert read_json(tmp_path / "b" / "x.json") == {"a": "ä"}
    assert read_json(tmp_path / "a.csv") is None
    assert read_json(tmp_path / "none.json") is None
    files = describe_files(tmp_path, workers=2)
    assert list(files) == ["a.csv", "b/x.json"]
    assert files["a.csv"] == {"bytes": 16, "sha256": sha256(tmp_path / "a.csv")}
    assert same_sizes(tmp_path, files)
    (tmp_path / "a.csv").write_text("clip")
    assert not same_sizes(tmp_path, files)
    assert not same_sizes(tmp_path, {"none": {"bytes": 1}})


def write(path: Path, text: str = "new") -> None:
    with atomic(path) as temporary:
        temporary.write_text(text)


def test_an_atomic_file_goes_where_a_link_leads(tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    (tmp_path / "link.npy").symlink_to(tmp_path / "other" / "target.bin")  # nothing is there yet
    for text in ("first", "second"):
        with atomic(tmp_path / "link.npy") as temporary:
            assert temporary.suffix == ".npy"  # writers choose the format by it
            temporary.write_text(text)
        assert (tmp_path / "other" / "target.bin").read_text() == text
        assert (tmp_path / "link.npy").is_symlink()
    (tmp_path / "made").touch()
    put_in_place(tmp_path / "made", tmp_path / "link.npy")
    assert (tmp_path / "link.npy").is_symlink()
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    with pytest.raises(FaceDiffError, match="loop: cannot be written"):
        write(tmp_path / "loop")
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["link.npy", "loop", "other", "target.bin"]


def test_devices_and_pipes_are_refused_and_stay(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (Path("/dev/null"), tmp_path / "pipe"):
        for call in (write, check_writable):
            with pytest.raises(FaceDiffError, match=f"{path}: cannot be written"):
                call(path)
    assert Path("/dev/null").is_char_device()
    assert (tmp_path / "pipe").is_fifo()


def test_a_replaced_file_hands_its_permissions_on_and_a_protected_one_is_not_replaced(tmp_path: Path) -> None:
    path = tmp_path / "a.npy"
    write(path)
    path.chmod(0o640)
    write(path)
    assert path.stat().st_mode & 0o777 == 0o640
    path.chmod(0o444)
    for call in (write, check_writable):
        with pytest.raises(FaceDiffError, match=r"a\.npy: cannot be written"):
            call(path)
    assert path.stat().st_mode & 0o777 == 0o444


@pytest.mark.parametrize("name", ["x" * 251 + ".npy", "é" * 125 + ".npy", os.fsdecode(b"\xff\n.npy"), "-"])
def test_every_valid_name_can_be_written(tmp_path: Path, name: str) -> None:
    write(tmp_path / name)
    check_writable(tmp_path / name)
    with atomic_folder(tmp_path / "folder" / name) as folder:
        (folder / "a").touch()
    write_json(tmp_path / "a.json", {"name": name})
    assert read_json(tmp_path / "a.json") == {"name": name}
    assert {path.name for path in tmp_path.iterdir()} == {name, "folder", "a.json"}


def test_leftovers_of_a_killed_process_are_removed_and_others_stay(tmp_path: Path) -> None:
    program = (
        "import os, sys, pathlib; from facediff.utils.files import atomic\n"
        "with atomic(pathlib.Path(sys.argv[1])) as temporary: temporary.touch(); os._exit(9)"
    )
    subprocess.run([sys.executable, "-c", program, str(tmp_path / "a.npy")], cwd=ROOT, check=False)
    (left,) = tmp_path.iterdir()
    assert left.name.startswith(".a.partial-")
    with atomic(tmp_path / "b.npy") as temporary:
        temporary.touch()
        sweep.cache_clear()
        write(tmp_path / "c.npy")
    assert {path.name for path in tmp_path.iterdir()} == {"b.npy", "c.npy"}


@pytest.mark.parametrize("hard", [False, True])
def test_a_lock_that_is_a_link_destroys_nothing(hard: bool, tmp_path: Path) -> None:
    (tmp_path / "precious").write_text("precious")
    if hard:
        (tmp_path / ".lock").hardlink_to(tmp_path / "precious")
        with locked(tmp_path / ".lock", "facediff test"):
            pass
    else:
        (tmp_path / ".lock").symlink_to(tmp_path / "precious")
        with pytest.raises(FaceDiffError, match="cannot be written"):
            locked(tmp_path / ".lock", "facediff test").__enter__()
    assert (tmp_path / "precious").read_text() == "precious"


KILLED = """
import os, signal, sys, time
from pathlib import Path
from facediff.utils.files import locked

with locked(Path(sys.argv[1]), "facediff test"):
    reader, writer = os.pipe()
    worker = os.fork()
    if worker == 0:
        os.write(writer, b"runs")
        time.sleep(60)
    os.read(reader, 4)
    print(worker, flush=True)
    os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no processes can be forked here")
def test_the_lock_of_a_killed_process_is_free_although_its_workers_live(tmp_path: Path) -> None:
    words = [sys.executable, "-c", KILLED, str(tmp_path / ".lock")]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as killed:
        assert killed.stdout is not None
        worker = int(killed.stdout.readline())
        try:
            assert killed.wait(60) == -signal.SIGKILL
            os.kill(worker, 0)  # lives
            with locked(tmp_path / ".lock", "facediff test"):
                pass
        finally:
            os.kill(worker, signal.SIGKILL)


def test_room_is_taken_before_a_map_is_written(tmp_path: Path) -> None:
    with (tmp_path / "hole").open("wb") as stream:
        stream.truncate(1 << 20)
    reserve_room(tmp_path / "hole")
    assert (tmp_path / "hole").stat().st_blocks * 512 >= 1 << 20
