"""FBX through a program called blender, which here is a script that writes down how it was called."""

from __future__ import annotations

import ast
import json
import runpy
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from facediff.animation import Animation, write_archive
from facediff.cli.app import main
from facediff.cli.retarget import surface_notes
from facediff.errors import FaceDiffError
from facediff.export import fbx, write_animations
from facediff.spaces import layout
from tests.fakes.avatar import avatar_parts, write_avatar
from tests.fakes.clicks import clicks
from tests.fakes.glb_reader import Reader


@pytest.fixture
def blender(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A program on PATH, which keeps its words and the .glb, and writes the .fbx, but no fails and second_sample2."""
    folder = tmp_path / "bin"
    folder.mkdir()
    program = folder / "blender"
    program.write_text(
        f"#!{sys.executable}\n"
        "import json, pathlib, shutil, sys\n"
        f"kept = pathlib.Path({str(folder)!r})\n"
        "(kept / 'words.json').write_text(json.dumps(sys.argv[1:]))\n"
        "glb, made = sys.argv[sys.argv.index('--') + 1:][:2]\n"
        "shutil.copy(glb, kept / 'seen.glb')\n"
        "if made.endswith(('fails.fbx', 'second_sample2.fbx')):\n    sys.exit('cannot import')\n"
        "pathlib.Path(made).write_bytes(b'Kaydara FBX Binary')\n"
    )
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(folder))
    return folder


def test_blender_is_called_with_the_script_and_the_animations_rate(tmp_path: Path, blender: Path) -> None:
    own = tmp_path / "hello.wav"
    own.write_bytes(b"a recording of the user's")
    animation = clicks()
    written = write_animations(tmp_path / "hello.fbx", [animation])
    assert [path.name for path in written] == ["hello.fbx", "hello_speech.wav"]
    assert own.read_bytes() == b"a recording of the user's"
    assert written[0].read_bytes().startswith(b"Kaydara")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bin", "hello.fbx", "hello.wav", "hello_speech.wav"]
    words = json.loads((blender / "words.json").read_text())
    script = Path(words[words.index("--python") + 1])
    assert script == fbx.SCRIPT
    assert script.is_file()
    assert "--background" in words
    assert words[-4:] == ["--frame-rate", "25", "--frames", str(len(animation.vertices))]
    assert words[words.index("--") + 1].endswith("hello.glb")
    assert len(Reader(blender / "seen.glb").times) == len(animation.vertices)
    # The script takes what it is called with.
    options = {
        node.args[0].value
        for node in ast.walk(ast.parse(script.read_text()))
        if isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "add_argument"
        if isinstance(node.args[0], ast.Constant)
    }
    assert {"glb", "fbx", "--frame-rate", "--frames"} <= options


@pytest.mark.usefixtures("blender")
def test_several_samples_and_a_failure(tmp_path: Path) -> None:
    written = write_animations(tmp_path / "x.fbx", [clicks(), clicks()])
    assert [path.name for path in written if path.suffix == ".fbx"] == ["x_sample1.fbx", "x_sample2.fbx"]
    with pytest.raises(FaceDiffError, match="cannot import"):
        write_animations(tmp_path / "fails.fbx", [clicks()])
    assert not (tmp_path / "fails.fbx").exists()
    # All or none: the first of two is not left behind where the second fails.
    before = sorted(tmp_path.iterdir())
    with pytest.raises(FaceDiffError, match="cannot import"):
        write_animations(tmp_path / "second.fbx", [clicks(), clicks()])
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.usefixtures("blender")
@pytest.mark.parametrize("name", ["a.fbx", "a.FBX"])
def test_the_command_ends_and_refuses_what_has_no_effect(
    tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    write_archive(tmp_path / "a.npz", clicks())
    words = ["export", str(tmp_path / "a.npz"), "-o", str(tmp_path / name)]
    assert main([*words, "--size", "100"]) == 2
    assert "--size" in capsys.readouterr().err
    assert main(words) == 0
    assert f"{tmp_path / name}: " in capsys.readouterr().out
    (tmp_path / "target.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\n" + "f 1/1 2/1 3/1\n" * 6)
    assert surface_notes(tmp_path / "target.obj", tmp_path / name, clicks()) == []


def test_frame_rate_and_length_are_read_from_a_face_and_from_an_avatar(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "bpy", ModuleType("bpy"))
    facts_of = runpy.run_path(str(fbx.SCRIPT))["facts_of"]
    animation = clicks()
    frames = len(animation.vertices)
    write_animations(tmp_path / "face.glb", [animation])
    assert facts_of(str(tmp_path / "face.glb")) == (25.0, frames)
    write_avatar(tmp_path / "avatar.glb", avatar_parts(rounds=0))  # with an animation of its own, of one second
    spoken = Animation("x", animation.vertices, animation.template, 30.0, faces=animation.faces)
    spoken = spoken.made_of(layout("arkit"), np.zeros((frames, 52), np.float32))
    write_animations(tmp_path / "out.glb", [spoken], into=tmp_path / "avatar.glb", own_shapes=True)
    assert facts_of(str(tmp_path / "out.glb")) == (30.0, frames)


@pytest.mark.slow
@pytest.mark.skipif(fbx.command() is None, reason="needs Blender")
def test_blender_embeds_an_avatars_pictures_and_leaves_out_its_helpers(tmp_path: Path) -> None:
    write_avatar(tmp_path / "avatar.glb", avatar_parts(rounds=0))
    animation = clicks()
    animation = animation.made_of(layout("arkit"), np.zeros((len(animation.vertices), 52), np.float32))
    (written, *_) = write_animations(tmp_path / "x.fbx", [animation], into=tmp_path / "avatar.glb", own_shapes=True)
    assert b"\x89PNG" in written.read_bytes()
    assert b"Icosphere" not in written.read_bytes()
