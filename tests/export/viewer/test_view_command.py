"""`facediff view`: files and options to a page, or one sentence and nothing."""

from __future__ import annotations

import json
import re
import webbrowser
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from facediff.animation import write_archive
from facediff.cli.app import main
from tests.fakes.clicks import FRAMES, clicks


def facts(page: Path) -> dict[str, Any]:
    found = re.search(r'id="facts">(.*?)</script>', page.read_text())
    assert found
    read: dict[str, Any] = json.loads(found[1])
    return read


@pytest.fixture
def files(tmp_path: Path) -> Path:
    write_archive(tmp_path / "guess.npz", clicks(name="guess", lower=3))
    np.save(tmp_path / "true.npy", clicks().vertices.reshape(FRAMES, -1))
    return tmp_path


def test_bare_truth_gets_the_mesh_of_an_archive_and_comes_first(
    files: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = files / "page.html"
    assert main(["view", str(files / "guess.npz"), "--truth", str(files / "true.npy"), "-o", str(page)]) == 0
    read = facts(page)
    assert [animation["name"] for animation in read["animations"]] == ["true", "guess"]
    assert read["truth"] == 0
    assert read["heat"]["highest"] in (3, 4)
    assert read["frameRate"] == 25
    assert read["animations"][0]["opening"] is not None
    assert read["sound"] is not None
    assert re.search(r"page.html: 75 frames of 2 animations, 0\.\d MB", capsys.readouterr().out)


def test_checkpoint_completes_a_bare_array_and_leaves_an_archive_as_it_is(
    files: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The checkpoint's first face is not the archive's; whoever names an identity wants that one's."""
    own = clicks()
    faces = {"first": own.template + 50, "second": own.template + 100}
    assets = SimpleNamespace(
        template=lambda name: torch.from_numpy(faces[name]),
        identities=("first", "second"),
        faces=own.triangles,
        frame_rate=50.0,
        unit="cm",
        colours_of=lambda name: None,
        regions={},
        inner_lip_pairs=None,
    )
    monkeypatch.setattr("facediff.models.checkpoint.read_assets", lambda path: assets)
    (files / "c.ckpt").touch()
    page, words = files / "page.html", ["--checkpoint", str(files / "c.ckpt"), "-o", str(files / "page.html")]
    assert main(["view", str(files / "guess.npz"), *words]) == 0
    assert facts(page)["frameRate"] == 25
    assert facts(page)["animations"][0]["centre"] == [0, 0, -2.5]
    assert main(["view", str(files / "true.npy"), *words]) == 0
    assert facts(page)["frameRate"] == 50
    assert facts(page)["animations"][0]["centre"] == [500, 500, 475]
    assert main(["view", str(files / "guess.npz"), "--identity", "second", *words]) == 0
    assert facts(page)["animations"][0]["centre"] == [100, 100, 97.5]


def test_labels_the_shortest_and_the_browser(files: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    short = replace(clicks(), vertices=clicks().vertices[:40])
    write_archive(files / "short.npz", short)
    page = files / "page.html"
    words = ["view", str(files / "guess.npz"), str(files / "short.npz"), "-o", str(page), "--open", "--shortest"]
    assert main([*words, "--labels", "Ä <b>", "two"]) == 0
    assert [animation["name"] for animation in facts(page)["animations"]] == ["Ä <b>", "two"]
    assert facts(page)["frames"] == 40
    assert opened == [page.resolve().as_uri()]
