"""The table of quality against steps: its scores against NumPy, and whom it names."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from facediff.data import collate
from facediff.errors import FaceDiffError
from facediff.models import DualPathDiffusion, load_model
from tests.fakes.tiny import Tiny
from tools import sampler_table
from tools.sampler_table import Scores, fastest

SEEDS = 3


@pytest.fixture
def checkpoint(
    make_model: Callable[..., DualPathDiffusion], make_trainer: Callable[..., pl.Trainer], tiny: Tiny, tmp_path: Path
) -> Path:
    trainer = make_trainer(limit_train_batches=1, limit_val_batches=0)
    trainer.fit(make_model(), datamodule=tiny)
    trainer.save_checkpoint(tmp_path / "tiny.ckpt")
    return tmp_path / "tiny.ckpt"


def motions(model: DualPathDiffusion, data: Tiny, split: str) -> list[tuple[NDArray[Any], NDArray[Any]]]:
    """Of each clip alone: what every seed makes, and the truth."""
    found = []
    for sample in map(data.dataset(split).__getitem__, range(len(data.clips(split)))):
        made = [model.generate(collate([sample]), seed=seed)[0].double().numpy() for seed in range(SEEDS)]
        found.append((np.stack(made), sample.motion.double().numpy()))
    return found


@pytest.mark.slow
def test_the_numbers_are_those_of_numpy(checkpoint: Path, tiny: Tiny, capsys: pytest.CaptureFixture[str]) -> None:
    numbers = checkpoint.with_suffix(".json")
    samplers = [("ddpm", 4), ("ddim", 2)]
    words = ["--checkpoint", str(checkpoint), "--seeds", str(SEEDS), "--batch-size", "3", "--json", str(numbers)]
    assert sampler_table.main([*words, "--sampler", *(f"{name}:{steps}" for name, steps in samplers)]) == 0
    printed = capsys.readouterr().out
    rows = json.loads(numbers.read_text())
    assert [(row["sampler"], row["steps"]) for row in rows] == samplers
    model, lips, upper = load_model(checkpoint), range(12), range(12, 24)
    for row in rows:
        model.choose_sampler(row["sampler"], row["steps"])
        assert row["real_time_factor"] > 0
        for split in ("test_a", "test_b"):
            clips = motions(model, tiny, split)
            for seed in range(SEEDS):
                errors = [np.square(made[seed] - truth)[:, lips].sum(-1).max(-1) for made, truth in clips]
                assert row["lve"][split][seed] == pytest.approx(np.concatenate(errors).mean(), rel=1e-4)
                spreads = [
                    [np.square(each)[:, upper].sum(-1).std(0).mean() for each in (truth, made[seed])]
                    for made, truth in clips
                ]
                fdd = np.mean([abs(one - other) for one, other in spreads])
                assert row["fdd"][split][seed] == pytest.approx(fdd, rel=1e-3)
                others = [other for other in range(SEEDS) if other != seed]
                apart = [
                    np.mean([np.linalg.norm(made[seed] - made[other], axis=-1).mean() for made, _ in clips])
                    for other in others
                ]
                assert row["diversity"][split][seed] == pytest.approx(np.mean(apart), rel=1e-4)
    assert printed.count("| `ddim` | 2 |") == 2
    assert "synthetic: says nothing about real people" in printed
    assert "command: `python tools/sampler_table.py --checkpoint" in printed
    assert "test_a 4 clips, test_b 2 clips; 3 seeds; protocol paper" in printed


def test_a_share_of_the_clips_and_one_split(checkpoint: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--checkpoint", str(checkpoint), "--seeds", "2", "--clips", "1", "--split", "test_b"]
    sampler_table.main([*words, "--sampler", "ddpm:3"])
    printed = capsys.readouterr().out
    assert "test_b 1 clips; 2 seeds" in printed
    assert "\ntest_b:\n" in printed
    assert "\ntest_a:\n" not in printed
    assert "**ddpm 3**" in printed


def test_a_corpus_that_is_not_there_is_named(checkpoint: Path) -> None:
    model = load_model(checkpoint)
    model.data_source = {"class_path": "their.corpora.Faces", "root": "/nowhere"}
    with pytest.raises(FaceDiffError, match=r"their\.corpora\.Faces"):
        sampler_table.corpus_of(model, None)


def scores(sampler: str, steps: int, lve: list[float], diversity: float, other: float | None = None) -> Scores:
    """Scores on two splits that differ in LVE only if told."""
    second = lve if other is None else [other] * len(lve)
    both = {"test_a": [diversity] * len(lve), "test_b": [diversity] * len(lve)}
    return Scores(sampler, steps, lve={"test_a": lve, "test_b": second}, diversity=both)


FULL = scores("ddpm", 1000, [1.0, 3.0], 10.0)


@pytest.mark.parametrize(
    ("others", "name"),
    [
        ([], "ddpm 1000"),
        ([scores("ddim", 25, [1.0, 3.01], 10.0), scores("ddim", 10, [1.05, 3.0], 10.0)], "ddim 25"),
        ([scores("ddim", 25, [1.0, 3.01], 10.0), scores("ddim", 10, [2.0, 2.05], 9.6)], "ddim 25"),
        ([scores("ddim", 25, [1.0, 3.01], 10.0), scores("ddim", 10, [2.0, 2.03], 9.6)], "ddim 10"),
        ([scores("ddim", 25, [1.0, 3.01], 10.0), scores("ddim", 10, [0.5, 2.0], 9.4)], "ddim 25"),
        ([scores("ddim", 10, [1.0, 3.0], 10.0, other=2.03)], "ddpm 1000"),
        ([scores("ddim", 10, [2.0, 2.01], 10.0), scores("dpm_solver", 10, [2.0, 2.0], 10.0)], "dpm_solver 10"),
    ],
    ids=["alone", "lve lost", "just lost", "just kept", "diversity lost", "lost on one split", "as many steps"],
)
def test_the_fastest_that_loses_nothing(others: list[Scores], name: str) -> None:
    assert fastest([FULL, *others], tolerance=0.01, kept=0.95).name == name


def test_lve_is_compared_seed_by_seed() -> None:
    """A difference that is the same for every seed is certain, however much the seeds differ."""
    generator = np.random.default_rng(0)
    reference = generator.uniform(1, 3, 8)
    mine = reference + 0.02 + generator.normal(0, 1e-3, 8)
    full, row = scores("ddpm", 1000, reference.tolist(), 1.0), scores("ddim", 10, mine.tolist(), 0.5)
    excess, error = row.excess("test_a", full)
    shares = (mine - reference) / reference.mean()
    assert excess == pytest.approx(shares.mean())
    assert error == pytest.approx(shares.std(ddof=1) / 8**0.5)
    assert error < 0.001
    assert row.kept("test_b", full) == pytest.approx(0.5)


def test_a_number_is_shown_with_its_spread_to_one_power_of_ten() -> None:
    assert sampler_table.shown([1.1e-5, 1.3e-5]) == "(1.200 ± 0.141)·10^-5"


def test_one_seed_shows_no_diversity(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        sampler_table.options(["--checkpoint", "x", "--seeds", "1"])
    assert "--seeds: 1 cannot show diversity" in capsys.readouterr().err


def test_ten_seconds_are_timed(tiny: Tiny) -> None:
    batch = sampler_table.ten_seconds(tiny.dataset("test_a")[0], 25.0)
    assert batch.audio.shape == (1, 160_000)
    assert batch.motion.shape[:2] == (1, 250)
    length = len(tiny.dataset("test_a")[0].audio)
    assert torch.equal(batch.audio[0, length : 2 * length], batch.audio[0, :length])
