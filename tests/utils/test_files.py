"""Writing files and folders whole or not at all; files of unknown origin: speech, pickles, meshes."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import soundfile
import trimesh

from facediff.errors import FaceDiffError
from facediff.mesh import read_mesh
from facediff.speech.audio import read_speech
from facediff.utils.checksums import describe_files, same_sizes, sha256
from facediff.utils.files import (
    atomic,
    atomic_folder,
    check_writable,
    discard,
    locked,
    put_in_place,
    reserve_room,
    scratch_folder,
)
from facediff.utils.plain_files import read_json, write_json, write_rows
from facediff.utils.tables import format_table

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize(
    ("rate", "channels", "suffix"),
    [(16000, 1, "wav"), (44100, 2, "wav"), (22050, 1, "flac"), (48000, 2, "ogg"), (24000, 1, "mp3")],
)
def test_any_sound_file_becomes_16_khz_mono(tmp_path: Path, rate: int, channels: int, suffix: str) -> None:
    time = np.arange(rate) / rate
    tone = 0.5 * np.sin(2 * np.pi * 440 * time)
    path = tmp_path / f"tone.{suffix}"
    soundfile.write(path, np.stack([tone] * channels, 1), rate)
    speech = read_speech(path)
    assert speech.dtype == np.float32
    assert len(speech) == pytest.approx(16000, abs=1200 if suffix == "mp3" else 2)
    spectrum = np.abs(np.fft.rfft(speech[2000:14000]))
    assert np.argmax(spectrum) * 16000 / 12000 == pytest.approx(440, abs=2)
    assert np.abs(speech[4000:12000]).max() == pytest.approx(0.5, abs=0.03)


def test_stereo_is_averaged(tmp_path: Path) -> None:
    left = np.linspace(-0.5, 0.5, 1600)
    soundfile.write(tmp_path / "a.wav", np.stack([left, -left / 2], 1), 16000, subtype="FLOAT")
    np.testing.assert_allclose(read_speech(tmp_path / "a.wav"), left / 4, atol=1e-7)


@pytest.mark.parametrize("suffix", ["ply", "obj"])
def test_a_mesh_keeps_its_vertex_order_and_duplicates(tmp_path: Path, suffix: str) -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 0], [1, 1, 0]], float)
    faces = np.array([[0, 1, 2], [3, 1, 4]])
    trimesh.Trimesh(vertices, faces, process=False).export(tmp_path / f"m.{suffix}")
    mesh = read_mesh(tmp_path / f"m.{suffix}")
    np.testing.assert_allclose(mesh.vertices, vertices)
    assert np.array_equal(mesh.faces, faces)


def test_a_mesh_without_faces(tmp_path: Path) -> None:
    (tmp_path / "points.obj").write_text("v 0 0 0\nv 1 0 0\n")
    with pytest.raises(FaceDiffError, match=r"points\.obj"):
        read_mesh(tmp_path / "points.obj")


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


def test_an_obj_keeps_vertices_that_no_face_uses_and_its_colours(tmp_path: Path) -> None:
    """As textured scans have them; a mesh library that drops them would shift all that follow."""
    (tmp_path / "m.obj").write_text(
        "vt 0 0\nv 0 0 0 1 0 0\nv 9 9 9 0 1 0\nv 1 0 0 0 0 1\nv 0 1 0 0.5 0.5 0.5\nf 1/1 3/1 4/1\nf -4//1 -2//1 -1//1\n"
    )
    mesh = read_mesh(tmp_path / "m.obj")
    assert mesh.vertices.tolist() == [[0, 0, 0], [9, 9, 9], [1, 0, 0], [0, 1, 0]]
    assert mesh.faces.tolist() == [[0, 2, 3], [0, 2, 3]]
    assert mesh.colours is not None
    assert mesh.colours.tolist() == [[255, 0, 0], [0, 255, 0], [0, 0, 255], [128, 128, 128]]
    (tmp_path / "m.obj").write_text("v 0 0 0 255 51 0\nv 1 0 0 0 0 1\nv 0 1 0 0 0 0\nf 1 2 3\n")  # in bytes
    colours = read_mesh(tmp_path / "m.obj").colours
    assert colours is not None
    assert colours.tolist() == [[255, 51, 0], [0, 0, 1], [0, 0, 0]]


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


def test_errors_in_an_atomic_folder_name_the_final_path(tmp_path: Path) -> None:
    with pytest.raises(FaceDiffError) as caught, atomic_folder(tmp_path / "out") as folder:  # noqa: PT012
        (folder / "file").touch()
        check_writable(folder / "file" / "below")
    assert str(tmp_path / "out" / "file" / "below") in str(caught.value)
    assert "partial" not in str(caught.value)


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


def test_names_do_nothing_to_a_terminal() -> None:
    name = "clip\x1b]0;x\x07\x1b[2J\r\n\u202egpj\udcff\x9b"
    shown = "\n".join([str(FaceDiffError(f"{name}: no such file")), format_table([name], [[name], [name]])])
    assert len(shown.splitlines()) == 4
    assert all(letter.isprintable() for line in shown.splitlines() for letter in line)


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


def test_what_a_killed_process_left_is_removed_and_what_a_living_one_writes_stays(tmp_path: Path) -> None:
    program = (
        "import os, sys, pathlib; from facediff.utils.files import atomic\n"
        "with atomic(pathlib.Path(sys.argv[1])) as temporary: temporary.touch(); os._exit(9)"
    )
    subprocess.run([sys.executable, "-c", program, str(tmp_path / "a.npy")], cwd=ROOT, check=False)
    (left,) = tmp_path.iterdir()
    assert left.name.startswith(".a.partial-")
    again = left.with_name(re.sub(r"-\d+-\d+-", f"-{os.getpid()}-1-", left.name))
    again.touch()  # of another process that had the number of this one
    with atomic(tmp_path / "b.npy") as living:
        living.touch()
        write(tmp_path / "c.npy")
        assert {path.name for path in tmp_path.iterdir()} == {"c.npy", living.name}
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


def test_a_folder_that_may_not_be_written_is_refused_before_a_writer_has_its_own_words(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "access", lambda path, mode: not (Path(path) == tmp_path and mode == os.W_OK))
    with pytest.raises(FaceDiffError, match=r"a\.yaml"), atomic(tmp_path / "a.yaml"):
        raise TypeError("path is not creatable")


@pytest.mark.parametrize("number", [float("nan"), float("inf"), -float("inf")])
def test_no_json_holds_numbers_that_json_does_not_know(number: float, tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    write_json(path, {"rate": 1.0})
    with pytest.raises(FaceDiffError, match="report.json"):
        write_json(path, {"rates": [{"rate": number}]})
    assert path.read_text() == '{\n "rate": 1.0\n}\n'
    assert list(tmp_path.iterdir()) == [path]


def test_a_checksum_of_what_cannot_be_read_names_it(tmp_path: Path) -> None:
    with pytest.raises(FaceDiffError, match="gone"):
        sha256(tmp_path / "gone")
    with pytest.raises(FaceDiffError, match=tmp_path.name):
        sha256(tmp_path)


@pytest.mark.parametrize("folder", [False, True])
def test_what_is_given_up_is_removed_though_a_signal_comes_meanwhile(
    folder: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A signal raises wherever the command is, also at the first step of removing."""
    path = tmp_path / "partial"
    if folder:
        path.mkdir()
        (path / "part").touch()
    else:
        path.touch()
    came: list[int] = []
    whole = Path.is_dir

    def is_dir(self: Path, **options: bool) -> bool:
        if not came:
            came.append(1)
            raise KeyboardInterrupt
        return whole(self, **options)

    monkeypatch.setattr(Path, "is_dir", is_dir)
    with pytest.raises(KeyboardInterrupt):
        discard(path)
    assert list(tmp_path.iterdir()) == []


def test_room_is_taken_before_a_map_is_written(tmp_path: Path) -> None:
    with (tmp_path / "hole").open("wb") as stream:
        stream.truncate(1 << 20)
    reserve_room(tmp_path / "hole")
    assert (tmp_path / "hole").stat().st_blocks * 512 >= 1 << 20


@pytest.mark.slow
def test_a_file_a_thousand_folders_deep_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with atomic(Path("a/" * 1200) / "x.txt") as temporary:
        temporary.write_text("x")
    assert (Path("a/" * 1200) / "x.txt").read_text() == "x"
    (Path("a/" * 1200) / "x.txt").unlink()
    os.removedirs("a/" * 1200)  # pytest's tidying up would call itself for each
