"""``facediff export`` from words to files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile
import trimesh

from facediff.animation import Animation, write_archive
from facediff.cli.app import main


def test_bare_array_is_completed_by_options(
    animation: Animation, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    np.save(tmp_path / "x.npy", animation.vertices.reshape(40, -1))
    trimesh.Trimesh(animation.template, animation.triangles, process=False).export(tmp_path / "face.ply")
    soundfile.write(tmp_path / "x.wav", np.zeros(44_100), 44_100)
    words = ["export", str(tmp_path / "x.npy"), "-o", str(tmp_path / "out.obj"), "--frame-rate", "30", "--unit", "m"]
    words += ["--mesh", str(tmp_path / "face.ply"), "--speech", str(tmp_path / "x.wav")]
    assert main([*words, "--output-unit", "cm", "--up", "z"]) == 0
    assert "42 files" in capsys.readouterr().out
    mesh = trimesh.load(tmp_path / "out_obj" / "out_0005.obj", process=False, maintain_order=True)
    x, y, z = animation.vertices[5].T
    np.testing.assert_allclose(mesh.vertices, np.stack([x, -z, y], 1) * 100, atol=1e-5)
    sound = soundfile.info(tmp_path / "out_obj" / "out.wav")
    assert (sound.samplerate, sound.frames) == (44_100, 44_100 * 40 // 30)
    assert main([*words, "--no-speech"]) == 0
    assert not (tmp_path / "out_obj" / "out.wav").exists()


@pytest.mark.parametrize(("option", "wrong", "own"), [("--frame-rate", "31", "30"), ("--unit", "mm", "m")])
def test_what_a_file_says_of_its_own_rate_and_unit_stands(
    option: str, wrong: str, own: str, animation: Animation, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source, out = tmp_path / "in.npz", tmp_path / "out.npz"
    write_archive(source, replace(animation, frame_rate=30.0))
    assert main(["export", str(source), "-o", str(out), option, own]) == 0
    out.unlink()
    assert main(["export", str(source), "-o", str(out), option, wrong]) == 2
    assert f"in.npz has {own}" in capsys.readouterr().err
    assert not out.exists()
