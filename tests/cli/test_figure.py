"""``facediff figure`` from words to files, and what it says where something does not fit."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from facediff.cli.app import load, main
from facediff.cli.options import named_folders
from facediff.cli.parsing import arguments_of
from facediff.errors import FaceDiffError
from facediff.evaluation.figures import FigureData
from tests.fakes.tiny import VERTICES
from tests.fakes.words import last_of_each

TINY = ["--topology", "tests.fakes.tiny.Tiny"]
SMALL = ["--width", "85", "--dpi", "80"]
FIGURES = ("frames", "heatmap", "lips")
PHONEMES = "start,end,ipa,viseme\n0,0.10,,SIL\n0.10,0.20,m,PP\n0.20,0.30,ˈɑː,AA\n0.30,0.9,f,FF\n"


@pytest.fixture
def corpus(tiny_root: Path, tmp_path: Path) -> Path:
    root = shutil.copytree(tiny_root, tmp_path / "corpus")
    (root / "phonemes").mkdir()
    for clip in ("A_e06", "A_e07"):
        (root / "phonemes" / f"{clip}.csv").write_text(PHONEMES, encoding="utf-8")
    for name, moved in (("ours", 0.001), ("theirs", 0.004)):
        (tmp_path / name).mkdir()
        for clip in ("A_e06", "A_e07"):
            truth = np.load(root / "vertices_npy" / f"{clip}.npy")
            np.save(tmp_path / name / f"{clip}_condition_A.npy", truth + np.float32(moved))
    return root


def words(figure: str, corpus: Path, *more: str) -> list[str]:
    folder = corpus.parent
    files = [str(folder / "ours"), str(corpus), "--method", f"other={folder / 'theirs'}", *TINY]
    files += ["--phonemes", "m", "ɑː"] if figure == "frames" else []
    return last_of_each(["figure", figure, *files, *SMALL, "-o", str(folder / "figure.png"), *more])


@pytest.mark.parametrize("figure", FIGURES)
def test_every_figure(figure: str, corpus: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words(figure, corpus)) == 0
    printed = capsys.readouterr()
    assert printed.err == ""
    assert printed.out == f"written: {corpus.parent / 'figure.png'}\n"
    with Image.open(corpus.parent / "figure.png") as picture:
        assert picture.size[0] == round(85 / 25.4 * 80)


def test_a_close_up_below_the_working_folder(
    corpus: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(words("frames", corpus, "--close-up", "-o", "out/figure.pdf")) == 0
    assert capsys.readouterr().out == "written: out/figure.pdf\n"
    assert (tmp_path / "out" / "figure.pdf").read_bytes().startswith(b"%PDF")


def gather(corpus: Path, *more: str) -> FigureData:
    """What the command finds by its options."""
    words = [str(corpus.parent / "ours"), str(corpus), "-o", "a.png", *more]
    given = arguments_of(load("figure heatmap"), "facediff figure heatmap", words)
    material: FigureData = given["files"].gather(given["predictions"], given["truth"], given["page"])[1]
    return material


def test_material_next_to_the_files_is_found(corpus: Path) -> None:
    material = gather(corpus, *TINY)
    assert (material.n_vertices, material.rate, material.truth_stride) == (VERTICES, 25.0, 1)
    assert (material.unit, material.remark, material.corpus) == ("m", "tiny: synthetic corpus", corpus)
    assert material.names == ["truth", "ours"]
    assert material.choose() == ["A_e06", "A_e07"]
    assert material.faces is not None
    assert set(material.templates) == {"A", "B", "C"}


def test_a_truth_of_twice_the_frame_rate(corpus: Path) -> None:
    (corpus / "manifest.json").write_text('{"frame_rate": 50, "unit": "cm"}')
    material = gather(corpus, *TINY)
    assert (material.rate, material.truth_stride, material.unit) == (25.0, 2, "cm")
    assert gather(corpus, *TINY, "--frame-rate", "50").truth_stride == 1
    assert gather(corpus, *TINY, "--truth-stride", "3").truth_stride == 3
    with pytest.raises(FaceDiffError, match="no whole multiple"):
        gather(corpus, *TINY, "--frame-rate", "30")


def test_folders_that_are_no_corpus(corpus: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Plain folders and files given by hand do as well as a corpus."""
    truth, mesh = tmp_path / "plain", tmp_path / "face.obj"
    shutil.copytree(corpus / "vertices_npy", truth)
    trimesh.load(corpus / "tiny.ply", process=False).export(mesh)
    base = ["figure", "frames", str(tmp_path / "ours"), str(truth), "--clip", "A_e06", *SMALL]
    base += ["-o", str(tmp_path / "a.png"), "--times", "0.1"]
    assert main(base) == 2
    assert "give --mesh" in capsys.readouterr().err
    assert main([*base, "--mesh", str(mesh)]) == 2
    assert "give --frame-rate" in capsys.readouterr().err
    assert main([*base, "--mesh", str(mesh), "--frame-rate", "25"]) == 0
    given = ["--templates", str(corpus / "templates.pkl"), "--mesh", str(mesh)]
    assert main(["figure", "heatmap", str(tmp_path / "ours"), str(truth), "-o", str(tmp_path / "b.png"), *given]) == 0
    lips = ["figure", "lips", str(tmp_path / "ours"), str(truth), "-o", str(tmp_path / "c.svg"), "--frame-rate", "25"]
    assert main([*lips, "--lip-pairs", "0-6,1-7"]) == 0
    assert "note: there is no sound of A_e06; give --audio" in capsys.readouterr().out
    table, sound = corpus / "phonemes" / "A_e06.csv", corpus / "wav" / "A_e06.wav"
    assert main([*lips, "--lip-pairs", "0-6", "--phoneme-file", str(table), "--audio", str(sound)]) == 0
    text = (tmp_path / "c.svg").read_text(encoding="utf-8")
    assert "ɑː" in text
    assert "sound" in text


def test_lengths_that_differ_are_noted(corpus: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = corpus.parent / "ours" / "A_e06_condition_A.npy"
    np.save(path, np.load(path)[:9])
    assert main(words("lips", corpus)) == 0
    printed = capsys.readouterr().out
    assert "note: A_e06: lengths differ (truth 24, ours 9, other 24 frames): cut to the first 9" in printed
    assert main(words("frames", corpus, "--clip", "A_e06", "--phonemes", "f")) == 2
    assert "has no frame at 0.6 s; ours has 9 frames" in capsys.readouterr().err


def test_what_does_not_fit_is_one_sentence(
    corpus: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(corpus.parent)
    trimesh.Trimesh(np.eye(4)[:, :3], [[0, 1, 2], [1, 2, 3]], process=False).export("other.ply")
    before = sorted(corpus.parent.rglob("*"))
    for wrong, message in (
        ("frames --clip A_e66", 'did you mean "A_e06"'),
        ("lips --clip B_e01", 'ours: there is no clip "B_e01"'),
        ("frames --phonemes z", "in clip A_e06: known are m, ɑː, f"),
        ("frames --times 0.1", "either --times or --phonemes"),
        ("heatmap --mesh other.ply", "has 4 vertices, the motion 24"),
        ("heatmap --topology biwy", 'did you mean "biwi"'),
        ("heatmap --method ours=ours", 'already one called "ours"'),
        ("heatmap --method truth=ours", 'a method cannot be called "truth"'),
        ("heatmap --identity B", "under the condition B"),
        ("lips --lip-pairs 3-900", "--lip-pairs 3-900"),
        ("lips --span 0.03 0.05", "holds no frame"),
        ("frames --lips all", "--lips: has no effect without --close-up"),
    ):
        figure, *more = wrong.split()
        assert main(words(figure, corpus, *more)) == 2
        printed = capsys.readouterr()
        assert printed.out == ""
        assert message in printed.err
        assert printed.err.count("\n") == 1
    assert sorted(corpus.parent.rglob("*")) == before


@pytest.mark.parametrize("drawn", [0, 42])
def test_the_built_in_corpus_by_name(
    drawn: int, corpus: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from facediff.data.puppet import cache_root

    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("FACEDIFF_CACHE", str(tmp_path / "cache"))
    given = ["figure", "heatmap", "ours", "puppet", *TINY, *SMALL, "-o", "a.png"]
    assert main(given) == 2
    assert "`facediff demo` makes it" in capsys.readouterr().err
    shutil.copytree(corpus, cache_root(0, drawn))
    assert main(given) == 0


def test_folders_by_name(tmp_path: Path) -> None:
    for name in ("a=b", "y=z"):
        (tmp_path / name).mkdir()
    found = named_folders([f"{tmp_path}/a=b", f"x={tmp_path}/y=z"], lambda path: path.name)
    assert found == {"a=b": tmp_path / "a=b", "x": tmp_path / "y=z"}
    for word in ("=y", "x="):
        with pytest.raises(FaceDiffError, match="NAME=FOLDER"):
            named_folders([word], lambda path: path.name)
