"""What holds for every format: refusals before any work, all files or none, nothing of the user's overwritten."""

from __future__ import annotations

import subprocess
import sys
import textwrap
import wave
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from facediff.animation import Animation, write_archive
from facediff.errors import FaceDiffError
from facediff.export import FORMATS, ExportOptions, check_export, write_animations
from facediff.export.writing import check_free
from facediff.synthetic.known_faces import built_in_shapes

VIDEOS = (".mp4", ".webm", ".gif")
OWN = [".glb", ".usdc", ".usda", ".obj", ".ply", ".pc2", ".mdd", *VIDEOS, ".npz", ".npy"]
"""Formats that need no blendshapes and no browser page."""


def test_formats_are_as_promised() -> None:
    assert {*OWN, ".html", ".csv"} == set(FORMATS)
    assert {suffix for suffix, made in FORMATS.items() if made.holds_several} == {*VIDEOS, ".html"}
    assert {suffix for suffix, made in FORMATS.items() if made.speech == "in the file"} == {
        *VIDEOS[:2],
        ".html",
        ".npz",
    }
    assert {suffix for suffix, made in FORMATS.items() if not made.needs_mesh} == {
        ".pc2",
        ".mdd",
        ".csv",
        ".npz",
        ".npy",
    }
    assert all(made.help and made.next_step for made in FORMATS.values())


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("a.gltf", {}, ["a.gltf", 'no format ".gltf"', '".glb"?', ".usdc"]),
        ("a.GLB", {}, ['no format ".GLB"', ".glb"]),
        ("a", {}, ["no format", ".glb"]),
        ("a.glb", {"output_unit": "cm"}, [".glb", "metres"]),
        ("a.glb", {"up": "z"}, [".glb", "y up"]),
        ("a.npz", {"up": "z"}, [".npz", "y up"]),
        ("a.mp4", {"output_unit": "cm"}, [".mp4", "no lengths"]),
        ("a.mp4", {"up": "y"}, [".mp4", "no axes"]),
        ("a.obj", {"output_unit": "parsec"}, ['unit "parsec"']),
        ("a.csv", {}, ["a.csv", "shapes"]),
        ("a.csv", {"shapes": Path("nowhere")}, ["nowhere: no such folder or file"]),
        ("file/a.glb", {}, ["cannot be written"]),
        ("folder.glb", {}, ["is a folder"]),
        ("foreign.obj", {}, ["foreign_obj: is a folder with files"]),
    ],
)
def test_export_is_refused_before_any_work(
    tmp_path: Path, name: str, options: dict[str, object], words: list[str]
) -> None:
    (tmp_path / "file").write_text("in the way")
    (tmp_path / "folder.glb").mkdir()
    (tmp_path / "foreign_obj").mkdir()
    (tmp_path / "foreign_obj" / "own.txt").write_text("mine")
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(FaceDiffError) as caught:
        check_export(tmp_path / name, ExportOptions(**options))  # type: ignore[arg-type]
    assert all(word in str(caught.value) for word in words), caught.value
    assert sorted(tmp_path.rglob("*")) == before


def test_export_of_several_animations_writes_a_file_each(
    make_animation: Callable[..., Animation], tmp_path: Path
) -> None:
    first, second = make_animation(), make_animation(speech=None)
    second = replace(second, vertices=second.vertices[:7])
    written = write_animations(tmp_path / "a.npy", [first, second])
    assert written == [tmp_path / "a_sample1.npy", tmp_path / "a_sample2.npy"]
    assert [len(np.load(path)) for path in written] == [40, 7]
    written = write_animations(tmp_path / "a.glb", [first, second])
    assert [path.name for path in written] == ["a_sample1.glb", "a_sample2.glb", "a_sample1.wav"]
    written = write_animations(tmp_path / "a.ply", [first, second])
    assert [path.name for path in written] == ["a_sample1_ply", "a_sample2_ply"]
    assert (written[1] / "a_sample2_0006.ply").is_file()
    assert not (written[1] / "a_sample2_0007.ply").exists()


def test_export_to_a_full_disk_leaves_nothing(animation: Animation, tmp_path: Path) -> None:
    """A process that may not write files beyond a few kB, with the speech (which fails early) and without."""
    write_archive(tmp_path / "in.npz", animation)
    program = """
        import resource, sys
        from pathlib import Path
        from facediff.errors import FaceDiffError
        from facediff.export import ExportOptions, write_animations
        from facediff.animation import read_archive
        animation = read_archive(Path(sys.argv[1]))
        resource.setrlimit(resource.RLIMIT_FSIZE, (4000, 4000))
        for suffix in sys.argv[3:]:
            for speech in (True, False):
                try:
                    options = ExportOptions(no_speech=not speech, size=64)
                    write_animations(Path(sys.argv[2]) / f"a{suffix}", [animation], options)
                except FaceDiffError as error:
                    print(error)
    """
    place = tmp_path / "new"
    run = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(program), tmp_path / "in.npz", place, *OWN],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert (run.returncode, run.stderr) == (0, "")
    sentences = run.stdout.splitlines()
    assert len(sentences) == 2 * len(OWN), run.stdout
    assert all(str(place) in sentence and "partial" not in sentence for sentence in sentences), run.stdout
    assert sorted(file.name for file in tmp_path.rglob("*")) == ["in.npz"]


def test_export_whose_last_file_fails_writes_none(
    animation: Animation, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a_sample1.pc2").write_text("from before")
    write = Path.write_bytes

    def full(self: Path, data: bytes) -> int:
        if self.name == "a_sample2.obj":
            raise OSError(28, "No space left on device")
        return write(self, data)

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(FaceDiffError, match="No space left on device"):
        write_animations(tmp_path / "a.pc2", [animation, animation])
    assert [file.name for file in tmp_path.iterdir()] == ["a_sample1.pc2"]
    assert (tmp_path / "a_sample1.pc2").read_text() == "from before"


def test_files_next_to_an_export_never_replace_the_users_own(animation: Animation, tmp_path: Path) -> None:
    with wave.open(str(tmp_path / "hello.wav"), "wb") as own:
        own.setparams((2, 2, 48_000, 0, "NONE", ""))
        own.writeframes(bytes(4000))
    before = (tmp_path / "hello.wav").read_bytes()
    for _ in range(2):
        written = write_animations(tmp_path / "hello.usda", [animation])
        assert [path.name for path in written] == ["hello.usda", "hello_speech.wav"]
    assert "@./hello_speech.wav@" in (tmp_path / "hello.usda").read_text()
    (tmp_path / "hello_speech.wav").write_bytes(before)
    with pytest.raises(FaceDiffError, match=r"hello_speech\.wav: is a file that facediff did not write"):
        write_animations(tmp_path / "hello.glb", [animation])
    write_animations(tmp_path / "hello.glb", [animation], ExportOptions(no_speech=True))
    (tmp_path / "face.obj").write_text("v 0 0 0\n")
    with pytest.raises(FaceDiffError, match=r"face\.obj: is a file that facediff did not write"):
        write_animations(tmp_path / "face.mdd", [animation])
    assert (tmp_path / "face.obj").read_text() == "v 0 0 0\n"
    assert (tmp_path / "hello.wav").read_bytes() == (tmp_path / "hello_speech.wav").read_bytes() == before
    (tmp_path / "hello.json").write_text('{"format": "facediff direction 1"}')
    with pytest.raises(FaceDiffError, match=r"hello\.json: is a file that facediff did not write"):
        check_free(tmp_path / "hello.json")
    (tmp_path / "hello.json").unlink()
    (tmp_path / "hello.wav").write_bytes(b"")  # a run before was cut off here; nobody loses anything
    written = write_animations(tmp_path / "hello.usda", [animation])
    assert [path.name for path in written] == ["hello.usda", "hello.wav"]
    assert {file.name for file in tmp_path.iterdir()} == {
        "face.obj",
        "hello.glb",
        "hello.usda",
        "hello.wav",
        "hello_speech.wav",
    }


@pytest.mark.parametrize("name", ["notes.txt", "hello.wav", "hello_0003.ply"])
def test_sequence_never_replaces_a_folder_with_the_users_files(animation: Animation, tmp_path: Path, name: str) -> None:
    (folder,) = write_animations(tmp_path / "hello.ply", [animation])
    (folder / name).write_text("mine")
    with pytest.raises(FaceDiffError, match="hello_ply: is a folder with files that facediff did not write"):
        write_animations(tmp_path / "hello.ply", [animation])
    assert (folder / name).read_text() == "mine"


@pytest.mark.parametrize("suffix", OWN)
def test_export_may_be_repeated(make_animation: Callable[..., Animation], tmp_path: Path, suffix: str) -> None:
    options = ExportOptions(size=64)
    first = write_animations(tmp_path / f"a{suffix}", [make_animation()], options)
    shorter = make_animation(vertices=make_animation().vertices[:9])
    assert write_animations(tmp_path / f"a{suffix}", [shorter], options) == first
    assert sorted(tmp_path.iterdir()) == sorted(first)
    if first[0].is_dir():
        assert len(list(first[0].glob(f"*{suffix}"))) == 9


def test_speech_next_to_an_export_is_readable_everywhere(animation: Animation, tmp_path: Path) -> None:
    write_animations(tmp_path / "a.glb", [animation])
    with wave.open(str(tmp_path / "a.wav")) as sound:
        assert (sound.getnchannels(), sound.getsampwidth(), sound.getframerate()) == (1, 2, 16_000)
        assert sound.getnframes() == round(40 / 30 * 16_000)
        values = np.frombuffer(sound.readframes(20_000), "<i2")
    np.testing.assert_array_equal(values / np.float32(32768), animation.speech)


def test_speech_of_an_earlier_export_is_named(make_animation: Callable[..., Animation], tmp_path: Path) -> None:
    write_animations(tmp_path / "a.glb", [make_animation()])
    with pytest.warns(UserWarning, match=r"a\.wav: is of an earlier animation"):
        write_animations(tmp_path / "a.glb", [make_animation(speech=None)])


def test_csv_holds_weights_solved_for_the_shapes(make_animation: Callable[..., Animation], tmp_path: Path) -> None:
    rest = make_animation().template
    rng = np.random.default_rng(3)
    shapes = {name: rng.normal(0, 3e-3, rest.shape) for name in ("jawOpen", "mouthFunnel")}
    (tmp_path / "shapes").mkdir()
    faces = "".join(f"f {a} {b} {c}\n" for a, b, c in make_animation().triangles + 1)
    for name, offset in {"neutral": np.zeros_like(rest), **shapes}.items():
        rows = "".join(f"v {x:.9f} {y:.9f} {z:.9f}\n" for x, y, z in rest + offset)
        (tmp_path / "shapes" / f"{name}.obj").write_text(rows + faces)
    opened = np.linspace(0, 1, 40)
    animation = make_animation(vertices=(rest + opened[:, None, None] * shapes["jawOpen"]).astype(np.float32))
    written = write_animations(tmp_path / "a.csv", [animation], ExportOptions(shapes=tmp_path / "shapes"))
    assert [path.name for path in written] == ["a.csv", "a.json", "a.wav"]
    table = np.genfromtxt(tmp_path / "a.csv", delimiter=",", names=True, dtype=None, encoding="utf-8")
    np.testing.assert_allclose(table["JawOpen"], opened, atol=0.03)
    assert np.abs(table["MouthFunnel"]).max() < 0.03


def test_weights_of_the_built_in_face_need_no_shapes(tmp_path: Path) -> None:
    rest, faces, shapes = built_in_shapes("F1")
    opened = np.linspace(0, 0.5, 6, dtype=np.float32)
    motion = (rest + opened[:, None, None] * (shapes["jawOpen"] - rest)).astype(np.float32)
    animation = Animation(
        name="jaw", vertices=motion, template=rest.astype(np.float32), faces=faces, frame_rate=25.0, unit="m"
    )
    write_animations(tmp_path / "a.csv", [animation])
    table = np.genfromtxt(tmp_path / "a.csv", delimiter=",", names=True, dtype=None, encoding="utf-8")
    np.testing.assert_allclose(table["JawOpen"][:6], opened, atol=3e-3)
