"""Recognising a folder, comparing it with its manifest, and the report as text."""

from __future__ import annotations

import hashlib
import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from facediff.cli.app import run
from facediff.data.check import check
from facediff.errors import FaceDiffError
from tests.data.check.small import kinds, message, rows
from tests.fakes import biwi


@pytest.mark.parametrize(("folder", "corpus"), [("biwi", "biwi"), ("vocaset", "vocaset"), ("mead", "mead3d")])
def test_a_corpus_is_recognised(copies: Path, folder: str, corpus: str) -> None:
    root = copies / folder
    assert check(root, quick=True).corpus == corpus  # by its names and vertices
    (root / "manifest.json").write_text('{"corpus": "vocaset"}')
    assert check(root, quick=True).corpus == "vocaset"  # by what the manifest says


def test_a_corpus_named_by_its_short_name(fakes: Path) -> None:
    report = check(fakes / "biwi", "biwi", quick=True)
    assert report.corpus == "biwi"
    assert report.n_vertices == biwi.VERTICES  # of two data modules for BIWI, the one that fits
    with pytest.raises(FaceDiffError, match='there is no "vocasett": did you mean "vocaset"'):
        check(fakes / "biwi", "vocasett")
    for wrong in (
        "facediff.data.biwi.Nothing",
        "nowhere.Biwi",
        "pathlib.Path",
        "..",
        "facediff.data.SpeechMotionDataModule",
    ):
        with pytest.raises(FaceDiffError, match="--corpus"):
            check(fakes / "biwi", wrong)


def test_a_data_module_in_the_working_folder(
    fakes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [place for place in sys.path if place not in ("", str(tmp_path))])
    lines = ["from facediff.data import Biwi", "class Mine(Biwi):", "    n_vertices = 64", "    corpus_name = 'mine'"]
    Path("corpus_in_working_folder.py").write_text("\n".join(lines))
    arguments = [str(fakes / "biwi"), "--corpus", "corpus_in_working_folder.Mine", "--quick", "--json"]
    assert run("data check", arguments) == 0
    assert json.loads(capsys.readouterr().out)["corpus"] == "mine"


def test_a_manifest_cannot_have_code_imported(copies: Path) -> None:
    (copies / "probe.py").write_text("raise SystemExit('imported')")
    (copies / "tiny" / "manifest.json").write_text('{"corpus": "probe.Biwi"}')
    assert check(copies / "tiny", quick=True).corpus in ("tiny", None)


def write_raw(folder: Path, files: list[str]) -> Path:
    for file in files:
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).write_bytes(b"\0" * 64)
    return folder


def test_a_preparation_that_has_not_ended(copies: Path) -> None:
    root = copies / "biwi"
    (root / "prepare.json").write_text(json.dumps({"corpus": "biwi", "options": {}}))
    report = check(root, quick=True)
    assert kinds(report) == ["unfinished"]
    assert "run the same `facediff data prepare` again" in message(report, "unfinished")
    assert report.manifest["ended"] is False


@pytest.mark.parametrize("files", [[], ["wav/hello.wav", "vertices_npy/hello.npy"], ["a/b.txt"]])
def test_a_folder_that_is_not_recognised(tmp_path: Path, capsys: pytest.CaptureFixture[str], files: list[str]) -> None:
    root = write_raw(tmp_path / "x", files)
    root.mkdir(exist_ok=True)
    assert run("data check", [str(root), "--quiet"]) == 1
    out = capsys.readouterr().out
    assert "not recognised" in out
    assert "--corpus" in out


def test_a_persons_folder(copies: Path) -> None:
    """As ``facediff data import-person`` writes it: the vertices and splits are in its own files."""
    root = copies / "tiny"
    for path in [*root.glob("wav/[BC]*"), *root.glob("vertices_npy/[BC]*")]:
        path.unlink()
    shutil.rmtree(root / "regions")
    (root / "tiny.ply").unlink()
    splits = ["train", "train", "train", "train", "val", "test", "test"]
    lines = [f"A_e{i:02d},A,e{i:02d},{split}" for i, split in enumerate(splits, 1)]
    (root / "clips.csv").write_text("\n".join(["clip,subject,sentence,split", *lines]))
    manifest = {"corpus": "person", "person": "A", "frame_rate": 25.0, "n_vertices": 24}
    (root / "manifest.json").write_text(json.dumps(manifest))
    report = check(root)
    assert (report.corpus, report.data_module, report.findings) == ("person", None, [])
    assert {split: row[3] for (_, split), row in rows(report).items()} == {
        "train": 14 + 16 + 18 + 20,
        "val": 22,
        "test_a": 24 + 26,
    }
    (root / "manifest.json").write_text(json.dumps({**manifest, "frame_rate": None}))
    assert kinds(check(root)) == ["unrecognised"]


def test_files_are_compared_with_the_manifest(copies: Path) -> None:
    root = copies / "tiny"
    files = sorted(path for path in root.rglob("*") if path.is_file())
    described = {
        path.relative_to(root).as_posix(): {
            "bytes": path.stat().st_size,
            "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
        }
        for path in files
    }
    (root / "manifest.json").write_text(json.dumps({"facediff": "1.2", "corpus": "tiny", "files": described}))
    report = check(root, "tests.fakes.tiny.Tiny")
    assert (report.findings, report.manifest["facediff"]) == ([], "1.2")
    path = root / "vertices_npy" / "A_e01.npy"
    array = np.load(path)
    array[3, 3] += 1e-4
    np.save(path, array)
    assert check(root, "tests.fakes.tiny.Tiny", quick=True).findings == []  # of equal size
    assert check(root, "tests.fakes.tiny.Tiny").manifest["changed"] == ["vertices_npy/A_e01.npy"]
    path.write_bytes(path.read_bytes() + b"\0")
    assert check(root, "tests.fakes.tiny.Tiny", quick=True).manifest["changed"] == ["vertices_npy/A_e01.npy"]
