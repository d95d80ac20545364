"""Raw distribution → prepare → check → fit → test, for each data set, through the command line."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from facediff.cli.app import main
from facediff.data import Biwi, Mead3D, Vocaset
from tests.fakes import biwi, flame, mead3d, vocaset


class MiniBiwi(Biwi):
    n_vertices = biwi.VERTICES


class MiniVocaset(Vocaset):
    n_vertices = vocaset.VERTICES


class MiniMead(Mead3D):
    n_vertices = flame.VERTICES


def raw_biwi(folder: Path) -> list[str]:
    biwi.write_raw_biwi(folder / "raw", audio="flv")
    return ["biwi", str(folder / "raw")]


def raw_vocaset(folder: Path) -> list[str]:
    vocaset.write_raw_vocaset(folder / "raw")
    return ["vocaset", str(folder / "raw")]


def raw_mead3d(folder: Path) -> list[str]:
    mead3d.write_raw_emote(folder / "raw")
    model = flame.write_flame(folder / "generic_model.pkl")
    masks = vocaset.python2_pickle(vocaset.flame_masks(flame.VERTICES))
    (folder / "FLAME_masks.pkl").write_bytes(masks)
    return ["mead3d", str(folder / "raw"), "--flame", str(model)]


FIT = ["--config", "configs/experiment/puppet.yaml", "--model.dim=16", "--model.sampler.steps=2", "--data.batch_size=4"]
FIT += ["--model.motion_space.prior_frames=5"]  # the clips are short
FIT += ["--trainer.max_epochs=1", "--trainer.check_val_every_n_epoch=1", "--trainer.enable_progress_bar=false"]
FIT += ["--trainer.enable_model_summary=false", "--trainer.log_every_n_steps=1"]


@pytest.mark.parametrize(
    ("raw", "module", "splits"),
    [
        (raw_biwi, "MiniBiwi", ["test_a", "test_b"]),
        pytest.param(raw_vocaset, "MiniVocaset", ["test_b"], marks=pytest.mark.slow),
        pytest.param(raw_mead3d, "MiniMead", ["test_a"], marks=pytest.mark.slow),
    ],
    ids=["biwi", "vocaset", "mead3d"],
)
@pytest.mark.slow
def test_from_the_raw_files_to_scores(
    raw: Callable[[Path], list[str]],
    module: str,
    splits: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    corpus, source, *options = raw(tmp_path)
    path = f"{MiniBiwi.__module__}.{module}"
    assert main(["data", "prepare", corpus, source, "out", *options, "--workers", "1", "--quiet"]) == 0
    capsys.readouterr()

    assert main(["data", "check", "out", "--corpus", path, "--json", "--workers", "1"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["sound"] is True
    assert report["corpus"] == corpus

    assert main(["fit", *FIT, f"--data={path}", "--data.root=out"]) == 0
    (checkpoint,) = Path("runs").rglob("best.ckpt")
    capsys.readouterr()
    assert main(["test", "--ckpt_path", str(checkpoint), "--trainer.enable_progress_bar=false"]) == 0
    table = capsys.readouterr().out
    assert f"corpus {corpus}" in table
    assert all(re.search(rf"{split}\W+model", table) for split in splits)


def test_an_unfinished_corpus_is_not_trained_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    vocaset.write_vocaset(tmp_path / "out")
    (tmp_path / "out" / "prepare.json").write_text("{}")
    assert main(["fit", *FIT, f"--data={MiniBiwi.__module__}.MiniVocaset", "--data.root=out"]) == 2
    message = capsys.readouterr().err
    assert "prepare.json" in message
    assert "facediff data prepare" in message
