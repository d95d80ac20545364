"""The benchmarks at toy size: every way is measured, and the ratios that they print follow from their seconds."""

from __future__ import annotations

import importlib
import json
import re
import runpy
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from facediff.models import DualPathDiffusion
from facediff.speech.windows import WindowPlan
from tests.fakes.processes import run
from tests.fakes.tiny import Tiny

FOLDER = Path(__file__).parents[2] / "tools" / "benchmarks"
TOY = "--vertices 30 --dim 32 --layers 2 --heads 4 --threads 1 --tiny-encoder"


def toy(name: str, words: str) -> str:
    done = run(FOLDER / f"{name}.py", *words.split(), timeout=250)
    assert done.returncode == 0, done.stderr
    assert "machine: " in done.stdout
    return str(done.stdout)


@pytest.mark.slow
def test_sampling(tmp_path: Path) -> None:
    text = toy("sampling", f"{TOY} --seconds 1 --repeats 2 --steps 3 --json {tmp_path}/seconds.json")
    seconds = json.loads((tmp_path / "seconds.json").read_text())
    peer = seconds["conditions"] + 500 * (seconds["audio encoder"] + seconds["ddpm vertices"])
    assert seconds["peer"] == pytest.approx(peer)
    assert f"{peer / seconds['student']:.0f} times as long" in text
    assert len(re.findall(r"^  (ddpm|ddim|dpm_solver) ", text, re.MULTILINE)) == 9


@pytest.mark.slow
def test_training(tmp_path: Path) -> None:
    words = "--clips 4 --frames 12 --max-frames 60 --frozen 2 --rounds 1 --single 1"
    text = toy("training", f"{TOY} {words} --json {tmp_path}/rows.json")
    rows = json.loads((tmp_path / "rows.json").read_text())["2"]
    printed = [line for line in text.splitlines() if re.match(r"(peers|\+ [a-z0-9 -]+?)  +\d", line)]
    assert len(printed) == len(rows) == 6
    for line, (name, row) in zip(printed, rows.items(), strict=True):
        clips_per_second, *_, ratio, _, _ = (float(word) for word in line[len(name) :].split())
        assert clips_per_second == pytest.approx(row["clips"] / row["seconds"], rel=1e-3, abs=1e-3)
        peers = rows["peers"]["clips"] / rows["peers"]["seconds"]
        assert ratio == pytest.approx(clips_per_second / peers, abs=0.01)


@pytest.mark.slow
def test_rendering() -> None:
    text = toy("rendering", "video --seconds=0.2 --size=48 --rounds=1")
    assert [line.split()[-1] for line in text.splitlines() if "this version" in line] == ["1.00", "1.00"]


@pytest.mark.slow
def test_loading() -> None:
    text = toy("loading", "--clips=3 --frames=30 --vertices=200 --window=10 --epochs=2 --only=windows")
    rows = [line for line in text.splitlines() if "x memory" in line]
    assert re.search(r"file by file .* 1\.00 x clips/s, [01]\.000 x memory", rows[0])
    # A window is a third of a clip, so a row's frames and clips a second stand in that proportion.
    clips, frames = map(float, re.split(r"\s{2,}", rows[1])[1:3])
    assert frames / clips == pytest.approx(10, abs=0.5)


def test_every_way_of_loading_reads_all_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(FOLDER))
    tool = runpy.run_path(str(FOLDER / "loading.py"))
    tool["write_corpus"](tmp_path, 3, 30, 20)
    args = tool["parser"]().parse_args(["--root", str(tmp_path), "--epochs=2", "--window=10", "--vertices=20"])
    ways = {name: list(read()) for name, read in tool["ways"](args).items() if "workers" not in name}
    assert len(ways) == 4
    for name, frames in ways.items():
        assert frames == [10 if "windows" in name else 30] * 6, name


@pytest.mark.slow
def test_long_speech(
    monkeypatch: pytest.MonkeyPatch,
    make_model: Callable[..., DualPathDiffusion],
    tiny: Tiny,
    tiny_root: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.syspath_prepend(str(FOLDER))
    model = make_model()
    model.adopt(tiny.assets().with_motion_scale(tiny.motion_scale()))
    model.data_source = {"class_path": "tests.fakes.tiny.Tiny", "root": str(tiny_root)}
    model.windows = WindowPlan(1.2, 0.4, 0.5, 0.2, 2.0)
    with torch.inference_mode():
        importlib.import_module("long_speech").score(model.eval(), "A", 65.0)
    printed = capsys.readouterr().out
    assert "test sentences of A" in printed
    assert len(re.findall(r"^ +1  \d\.\d{4}$", printed, re.MULTILINE)) == 1
