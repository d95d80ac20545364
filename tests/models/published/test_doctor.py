"""The importer's doctor names what differs, of files that can be imported and of those that cannot."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from facediff.cli.app import main
from facediff.models.published.doctor import examine
from facediff.models.published.import_options import ImportOptions
from tests.models.published.conftest import TEXT
from tests.models.published.test_lam import author

OPTIONS = ImportOptions(audio_config=TEXT)


def report(path: Path, options: ImportOptions = OPTIONS) -> str:
    return "\n".join(examine([path], options))


def test_a_file_that_fits(tmp_path: Path) -> None:
    _, path = author(tmp_path, 0)
    lines = report(path)
    assert hashlib.sha256(path.read_bytes()).hexdigest() in lines
    assert "method: LamAudio2Expression" in lines
    assert "all fit" in lines
    assert "not needed: backbone.identity_encoder.grus.weight_hh_l0" in lines


def test_what_the_import_leaves_out_is_left_out_here(tmp_path: Path) -> None:
    made, path = author(tmp_path, 0)
    torch.save({"state_dict": {**made.state_dict(), "extra.weight": torch.ones(2)}}, path)
    assert "of no use: extra.weight (2,)" in report(path)
    lines = report(path, replace(OPTIONS, option=["ignore=extra."]))
    assert "not needed: extra.weight left out as asked" in lines
    assert "all fit" in lines


def test_every_difference_is_named(tmp_path: Path) -> None:
    made, path = author(tmp_path, 0)
    state = {f"backbone.{name}": value for name, value in made.state_dict().items()}
    del state["backbone.decoder.0.1.norm.bias"]
    state["backbone.decoder.0.2.conv.weight"] = torch.ones(5, 16, 3)
    state["backbone.decoder.1.0.conv.weight"] = torch.ones(3)
    state["backbone.output_proj.bias"] = torch.full((52,), torch.nan)
    torch.save({"state_dict": state}, path)
    lines = report(path)
    for expected in (
        "missing: backbone.decoder.0.1.norm.bias (16,)",
        "other shape: backbone.decoder.0.2.conv.weight (5, 16, 3), expected (16, 16, 3)",
        "of no use: backbone.decoder.1.0.conv.weight (3,)",
        "not finite: backbone.output_proj.bias",
        "they do not fit",
    ):
        assert expected in lines


def test_of_an_unknown_file_the_nearest_methods_and_all_tensors_are_printed(tmp_path: Path) -> None:
    path = tmp_path / "other.pt"
    torch.save({"output_proj.weight": torch.ones(52, 4), **{f"w{i}": torch.ones(1) for i in range(60)}}, path)
    lines = report(path)
    assert "not LamAudio2Expression, since it lacks identity_encoder.id_mlp.weight" in lines
    assert "tensor: output_proj.weight (52, 4)" in lines
    assert "tensor: 21 more" in lines
    path.write_bytes(b"no file of torch")
    assert "cannot be read" in report(path)


def test_the_command_writes_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    _, path = author(tmp_path, 0)
    monkeypatch.chdir(tmp_path)
    assert main(["import-checkpoint", str(path), "--doctor"]) == 0
    printed = capsys.readouterr().out
    assert "stops at" in printed  # eight channels of speech do not say how many heads attend
    assert "audio_config" in printed
    assert list(tmp_path.iterdir()) == [path]
