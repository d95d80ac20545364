"""Animations in Python: read, looked at, compared, changed and written as the commands do."""

from __future__ import annotations

import html
import re
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile
import trimesh

import facediff
from facediff.cli.app import main
from facediff.editing import retargeting
from facediff.editing.blendshapes import write_live_link
from facediff.errors import Note
from facediff.metrics import Region
from facediff.pipelines import motion
from tests.fakes.clicks import FRAMES, clicks


def command(*words: object) -> None:
    assert main([*map(str, words)]) == 0


@pytest.fixture
def anim() -> facediff.Animation:
    return replace(clicks(), frame_rate=25.0, regions={"lips": np.arange(4, 12)})


def test_animation_keeps_its_kind_and_its_numbers(anim: facediff.Animation) -> None:
    assert isinstance(replace(anim, name="x"), facediff.Animation)
    assert anim.vertices.dtype == np.float32
    said = repr(anim)
    for word in ("clicks", f"{FRAMES} frames", "3.00 s", "25 a second", "12 vertices in mm", "nobody", "speech"):
        assert word in said


def test_read_completes_an_array_by_another_animation(anim: facediff.Animation, tmp_path: Path) -> None:
    np.save(tmp_path / "truth.npy", (anim.vertices + 1).reshape(FRAMES, -1))
    truth = facediff.read(tmp_path / "truth.npy", like=anim)
    assert (truth.name, truth.frame_rate, truth.unit, truth.speech) == ("truth", 25, "mm", None)
    np.testing.assert_array_equal(truth.template, anim.template)
    np.testing.assert_array_equal(truth.triangles, anim.triangles)
    # Every vertex lies 1 mm away along each axis.
    error = facediff.metrics.lip_vertex_error(truth.vertices, anim.vertices, anim.regions["lips"])
    assert float(error) == pytest.approx(3.0, rel=1e-5)
    assert float(facediff.metrics.mean_vertex_error(truth.vertices, anim.vertices)) == pytest.approx(3**0.5, rel=1e-5)
    assert float(error) == float(
        facediff.metrics.lip_vertex_error(truth.vertices, anim.vertices, Region.from_indices("lips", range(4, 12)))
    )
    assert facediff.read(tmp_path / "truth.npy", like=anim, frame_rate=50, unit="cm").frame_rate == 50
    anim.save(tmp_path / "a.npz")
    again = facediff.read(str(tmp_path / "a.npz"))
    np.testing.assert_array_equal(again.vertices, anim.vertices)
    assert again.metadata == anim.metadata


@pytest.mark.parametrize(
    ("name", "options", "named"),
    [
        ("none.npy", {}, "none.npy"),
        ("bare.npy", {}, "frame_rate"),
        ("bare.npy", {"frame_rate": -1}, "frame_rate -1"),
        ("bare.npy", {"identity": "F1"}, "identity"),
        ("bare.npy", {"mesh": "none.ply", "frame_rate": 25}, "none.ply"),
        ("bare.npy", {"checkpoint": "none.ckpt"}, "none.ckpt"),
        ("bare.npy", {"speech": "none.wav", "frame_rate": 25}, "none.wav"),
        ("bare.npy", {"frame_rate": 25, "unit": "furlong"}, "furlong"),
        ("other.npy", {"like": True}, "other.npy"),
        ("face.txt", {"frame_rate": 25}, "face.txt"),
    ],
)
def test_read_names_what_is_wrong(
    name: str,
    options: dict[str, object],
    named: str,
    anim: facediff.Animation,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    np.save("bare.npy", anim.vertices)
    np.save("other.npy", anim.vertices[:, :9])
    Path("face.txt").touch()
    if "like" in options:
        options = {"like": anim}
    with pytest.raises(facediff.FaceDiffError, match=re.escape(named)) as raised:
        facediff.read(name, **options)  # type: ignore[arg-type]
    assert "--" not in str(raised.value).replace("facediff animate … -o", "")


def test_pages_are_those_of_the_command(anim: facediff.Animation, tmp_path: Path) -> None:
    other = replace(anim, vertices=anim.vertices[:50] + 2, name="other")
    anim.save(tmp_path / "truth.npz")
    other.save(tmp_path / "other.npz")
    words = ["--truth", tmp_path / "truth.npz", "--shortest", "-o", tmp_path / "command.html"]
    command("view", tmp_path / "other.npz", *words)
    page = other.compare(anim, tmp_path / "python.html")
    assert (tmp_path / "python.html").read_bytes() == (tmp_path / "command.html").read_bytes()
    assert page.save(tmp_path / "again.html").read_text() == page.html()
    assert len(page.animations[0].vertices) == 50
    with pytest.raises(facediff.FaceDiffError, match="same length"):
        facediff.view([other], truth=anim)
    with pytest.raises(facediff.FaceDiffError, match="labels"):
        facediff.view(anim, labels=["a", "b"])
    with pytest.raises(facediff.FaceDiffError, match=r"x\.htm2"):
        page.save(tmp_path / "x.htm2")
    twins = anim.compare(replace(anim, vertices=anim.vertices + 1))
    assert [each.name for each in twins.animations] == ["truth", "clicks"]


def test_options_of_a_file_are_those_of_the_command(anim: facediff.Animation, tmp_path: Path) -> None:
    anim.save(tmp_path / "a.npz")
    command("export", tmp_path / "a.npz", "-o", tmp_path / "command.pc2", "--output-unit", "cm", "--up", "z")
    assert anim.save(str(tmp_path / "python.pc2"), output_unit="cm", up="z")[0].name == "python.pc2"
    assert (tmp_path / "python.pc2").read_bytes() == (tmp_path / "command.pc2").read_bytes()
    for suffix, options, named in (
        (".glb", {"size": 64}, "size"),
        (".mp4", {"tolerance": 1}, "tolerance"),
        (".npy", {"shapes": "shapes"}, "shapes"),
        (".mp4", {"size": 3}, "size 3"),
        (".avi", {}, ".avi"),
        (".csv", {}, "shapes"),
        (".glb", {"output_unit": "cm"}, "unit"),
    ):
        with pytest.raises(facediff.FaceDiffError, match=named) as raised:
            anim.save(tmp_path / f"x{suffix}", **options)  # type: ignore[arg-type]
        assert "--" not in str(raised.value)
    assert not list(tmp_path.glob("x*"))
    anim.save(tmp_path / "quiet.html", no_speech=True)
    assert '"sound": null' in (tmp_path / "quiet.html").read_text()


def test_controls_are_those_of_the_command(anim: facediff.Animation, tmp_path: Path) -> None:
    anim.save(tmp_path / "a.npz")
    words = ["--expressiveness", "lips=0.5,all=2", "--sway", 5, "--controls-seed", 3]
    command("export", tmp_path / "a.npz", "-o", tmp_path / "command.npy", *words)
    made = anim.control(expressiveness={"lips": 0.5, "all": 2}, sway=5, controls_seed=3)
    assert isinstance(made, facediff.Animation)
    np.testing.assert_array_equal(made.vertices, np.load(tmp_path / "command.npy"))
    assert np.array_equal(anim.control(sway=False).vertices, anim.vertices)
    assert np.array_equal(anim.control(sway=True).vertices, anim.control(sway=2.0).vertices)
    assert not anim.control(expressiveness=0).vertices.std(0).any(), "0 is a number, and not nothing"
    with pytest.raises(facediff.FaceDiffError, match="^blinks: lids"):
        anim.control(blinks=True)


def test_other_meshes_and_weights_are_those_of_the_commands(model: facediff.Animator, workplace: Path) -> None:
    anim = model.animate("speech.wav", identity="F1")
    anim.save("a.npz")
    command("retarget", "a.npz", "--target-mesh", "face.ply", "-o", "command.npz")
    made = anim.retarget("face.ply", correspondence="map.npz")
    assert isinstance(made, facediff.Animation)
    assert Path("map.npz").is_file()
    np.testing.assert_array_equal(made.vertices, facediff.read("command.npz").vertices)
    carried = model.animate("speech.wav", identity="F1", target_mesh="face.ply", correspondence="map.npz")
    np.testing.assert_array_equal(made.vertices, carried.vertices)
    face = trimesh.load("face.ply", process=False)
    face.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0])).export("z_up.ply")
    upright = model.animate("speech.wav", identity="F1", target_mesh="z_up.ply", correspondence="z.npz")
    assert np.abs(upright.vertices - carried.vertices).max() < 1e-5
    words = ["animate", "speech.wav", "--checkpoint", "demo/puppet.ckpt", "--identity", "F1"]
    words += ["--target-mesh", "z_up.ply", "--correspondence", "z.npz"]
    command(*words, "-o", "own.pc2")
    assert " z up" in Path("own.obj").read_text().splitlines()[0], "a point cache fits its mesh"
    command(*words, "-o", "turned.pc2", "--up", "y")
    assert " y up" in Path("turned.obj").read_text().splitlines()[0]
    words = ["--shapes", "shapes", "--only-arkit", "--smoothness", 0.1, "--residual-limit", 1]
    command("blendshapes", "a.npz", "-o", "command.csv", *words)
    weights = anim.blendshapes("shapes", only_arkit=True, smoothness=0.1, residual_limit=1)
    assert weights.save("python.csv") == Path("python.csv")
    assert Path("python.csv").read_bytes() == Path("command.csv").read_bytes()
    write_live_link(Path("same.csv"), weights)
    assert Path("python.csv").read_bytes() == Path("same.csv").read_bytes()
    assert "residual" in repr(weights)
    with pytest.raises(facediff.FaceDiffError, match=r"x\.txt"):
        weights.save("x.txt")
    with pytest.raises(facediff.FaceDiffError, match="smoothness -1"):
        anim.blendshapes("shapes", smoothness=-1)
    for call, named in (
        (lambda: anim.blendshapes("none"), "shapes none"),
        (lambda: anim.retarget("none.obj"), "target_mesh none.obj"),
        (lambda: anim.retarget("face.ply", landmarks="none.csv"), "landmarks none.csv"),
    ):
        with pytest.raises(facediff.FaceDiffError, match=f"^{named}"):
            call()


def test_notebook_shows_one_frame_that_holds_the_page(anim: facediff.Animation) -> None:
    shown = anim._repr_html_()
    assert shown is not None
    assert shown.count("<iframe") == 1
    page = html.unescape(re.findall(r'srcdoc="([^"]*)"', shown)[0])
    assert page == facediff.view(anim).html()
    assert "default-src 'none'" in page, "it can load nothing"
    assert replace(anim, faces=None)._repr_html_() is None, "without triangles, the text is shown"


def test_notebook_shows_the_beginning_of_what_is_too_large(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(motion, "INLINE_MB", 0.5)
    rng, n = np.random.default_rng(0), 300
    face = rng.normal(0, 60, (n, 3)).astype(np.float32)
    moved = face + rng.normal(0, 5, (1000, n, 3)).astype(np.float32)
    large = facediff.Animation("large", moved, face, 25, np.arange(n, dtype=np.int32).reshape(-1, 3), unit="mm")
    shown = large._repr_html_()
    assert shown is not None
    assert 0.25 < len(shown) / 1e6 < 0.55
    assert "of 40.0 s" in shown


def test_a_poor_fit_is_refused_as_by_the_command(
    model: facediff.Animator, workplace: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    anim = model.animate("speech.wav", identity="F1")
    measure = retargeting.check_fit
    monkeypatch.setattr(retargeting, "check_fit", lambda *args: replace(measure(*args), faults=("the lips stick",)))
    with pytest.raises(facediff.FaceDiffError, match=r"face\.ply: the lips stick.*accept_poor"):
        anim.retarget("face.ply")
    anim.retarget("face.ply", correspondence="map.npz", accept_poor=True)
    assert len(anim.retarget("face.ply", correspondence="map.npz").vertices), "accepted when it was made"
    np.save("bare.npy", anim.vertices[:, ::-1])
    with pytest.raises(facediff.FaceDiffError, match=r"bare\.npy: its first frame does not lie on the neutral face"):
        facediff.read("bare.npy", mesh="face.ply", frame_rate=25)


@pytest.mark.parametrize("seconds", [0.5, 1.0, 3.0])
def test_speech_of_another_length_is_told(seconds: float, tmp_path: Path) -> None:
    rest, faces = np.eye(4, 3, dtype=np.float32), np.array([[0, 1, 2], [0, 2, 3]])
    np.save(tmp_path / "a.npy", np.stack([rest] * 25))
    soundfile.write(tmp_path / "a.wav", np.full(round(16_000 * seconds), 0.1), 16_000)
    like = facediff.Animation("like", rest[None], rest, 25.0, faces=faces)
    with pytest.warns(Note, match="lasts 1.00 s and") if seconds != 1 else nullcontext():
        facediff.read(tmp_path / "a.npy", like=like, speech=tmp_path / "a.wav")
