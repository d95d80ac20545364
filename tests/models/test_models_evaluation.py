"""Metrics chosen by name in a test: every registered one is computed, next to the protocol."""

from __future__ import annotations

import csv
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning.pytorch import Trainer

from facediff import registry
from facediff.callbacks.outputs import ScoreTable
from facediff.data import Reference, collate
from facediff.errors import FaceDiffError
from facediff.metrics import BilabialClosureRate, LipPairs, SampleDiversity, parse
from facediff.models import Style
from facediff.models.evaluation import with_identity, with_usual_styles
from tests.fakes.tiny import Tiny

Make = Callable[..., Any]
SEVERAL = {"sample_diversity", "mean_estimate_error", "coverage_error", "spread_error_ratio", "energy_score"}


@pytest.fixture
def rich(tiny_root: Path, tmp_path: Path) -> Tiny:
    """The tiny corpus with pairs of lip vertices and the phonemes of each clip."""
    root = tmp_path / "rich"
    shutil.copytree(tiny_root, root)
    (root / "regions" / "inner_lip_pairs.txt").write_text("0, 1\n2, 3\n")
    (root / "regions" / "eyelid_pairs.txt").write_text("6, 12\n7, 13\n")
    (root / "phonemes").mkdir()
    for wav in (root / "wav").glob("*.wav"):
        (root / "phonemes" / f"{wav.stem}.csv").write_text("start,end,ipa\n0.0,0.1,m\n0.1,0.2,a\n0.2,0.3,b\n")
    return Tiny(root=str(root))


def chosen(name: str) -> str:
    if name.startswith("blink"):
        return f"{name}:closed=0.1,reopened=0.05"  # the corner of the tiny face that counts as its eyes opens wide
    return f"{name}:n_samples=2" if name in SEVERAL else name


def test_every_registered_metric_is_in_the_table_and_the_files(
    make_model: Make, rich: Tiny, make_trainer: Callable[..., Trainer], capsys: pytest.CaptureFixture[str]
) -> None:
    metrics = [chosen(name) for name in registry.metric.names() if not parse(name).of_channels]
    model = make_model(metrics=metrics, motion_scale="none")
    trainer = make_trainer(callbacks=[ScoreTable()], logger=False)
    reported = {
        name: value for part in trainer.test(model, datamodule=rich, verbose=False) for name, value in part.items()
    }
    printed = capsys.readouterr().out
    for metric in metrics:
        assert f"\n{metric} " in printed
        assert f"metric {metric}: " in printed
        values = [value for name, value in reported.items() if name.endswith(f"/{metric}")]
        assert values, metric
        assert all(torch.tensor(value).isfinite() for value in values)
    assert reported["test_a/shuffled/lip_vertex_error"] != reported["test_a/lip_vertex_error"]
    assert reported["test_a/lip_vertex_error"] == pytest.approx(reported["test_a/lve"], rel=1e-12)
    assert "test_a/still/sample_diversity:n_samples=2" not in reported
    with (Path(trainer.default_root_dir) / "test_sequences.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert {"lip_warping_distance", "sample_diversity:n_samples=2", "identity_diversity"} <= rows[0].keys()
    assert [row["sample_diversity:n_samples=2"] == "" for row in rows] == [row["method"] != "model" for row in rows]


@pytest.mark.slow
def test_samples_and_conditions_are_generated_as_documented(
    make_model: Make, rich: Tiny, make_trainer: Callable[..., Trainer]
) -> None:
    model = make_model(metrics=["sample_diversity:n_samples=2,pairing=all", "identity_diversity"], motion_scale="none")
    (reported, *_) = make_trainer().test(model, datamodule=rich, verbose=False)
    batches = list(rich.test_dataloader()[0])
    samples, styles = SampleDiversity(n_samples=2, pairing="all"), registry.metric.identity_diversity()
    for batch in batches:
        with torch.inference_mode():
            drawn = [model.eval().generate(batch, seed=seed) for seed in (0, 1)]
            references = [model.assets.references[name] for name in model.identities]
            views = [with_identity(batch, place, reference) for place, reference in enumerate(references)]
            styled = [model.generate(view, seed=0) for view in views]
        samples.update(torch.stack(drawn, 1), lengths=batch.frame_lengths)
        styles.update(torch.stack(styled, 1), lengths=batch.frame_lengths)
    assert reported["test_a/sample_diversity:n_samples=2,pairing=all"] == pytest.approx(
        samples.compute().item(), rel=1e-5
    )
    assert reported["test_a/identity_diversity"] == pytest.approx(styles.compute().item(), rel=1e-5)


def test_closures_are_those_of_the_phonemes(make_model: Make, rich: Tiny, make_trainer: Callable[..., Trainer]) -> None:
    model = make_model(metrics=["bilabial_closure_rate:of=truth"], motion_scale="none")
    (reported, *_) = make_trainer().test(model, datamodule=rich, verbose=False)
    rate = BilabialClosureRate(LipPairs.from_pairs("lips", [(0, 1), (2, 3)]), of="truth")
    for batch in rich.test_dataloader()[0]:
        frames = [[(start, end) for start, end in [(0, 2), (5, 8)] if start < n] for n in batch.frame_lengths.tolist()]
        rate.update(
            batch.motion, batch.motion, closures=frames, offsets_from=batch.template, lengths=batch.frame_lengths
        )
    assert reported["test_a/bilabial_closure_rate:of=truth"] == pytest.approx(rate.compute().item(), rel=1e-6)


def test_validation_has_them_too(make_model: Make, tiny: Tiny, make_trainer: Callable[..., Trainer]) -> None:
    of_one_sample = "mean_estimate_error:n_samples=1"
    model = make_model(metrics=["lip_speed_correlation", of_one_sample, "lip_vertex_error"], motion_scale="none")
    (reported,) = make_trainer().validate(model, datamodule=tiny, verbose=False)
    assert -1 <= reported["val/lip_speed_correlation"] <= 1
    assert reported[f"val/{of_one_sample}"] == pytest.approx(reported["val/lip_vertex_error"], rel=1e-6)


def test_what_the_corpus_lacks_is_named(make_model: Make, rich: Tiny, make_trainer: Callable[..., Trainer]) -> None:
    (rich.root / "regions" / "inner_lip_pairs.txt").unlink()
    shutil.rmtree(rich.root / "phonemes")
    with pytest.raises(FaceDiffError) as error:
        make_trainer().test(make_model(metrics=["bilabial_closure_rate"]), datamodule=rich, verbose=False)
    message = str(error.value)
    assert all(
        name in message for name in ("bilabial_closure_rate", "inner_lip_pairs.txt", str(rich.root / "phonemes"))
    )


def test_no_clip_is_scored_in_the_style_of_its_own_motion(tiny: Tiny) -> None:
    dataset = tiny.dataset("train")
    batch = collate([dataset[place] for place, clip in enumerate(dataset.clips) if clip.identity == "A"])
    assert len(batch) > 1
    reference = Reference(batch.names[0], batch.motion[0])
    for style in (reference, Style(batch.names[0], torch.ones(4))):
        (view,) = with_usual_styles(batch, lambda name, style=style: style)
        assert view.names == batch.names[1:]
    assert with_usual_styles(batch.select([0]), lambda name: reference) == []


@pytest.mark.parametrize("name", ["frame_step", "step_distance:region=jaw", "blink_rate", "blink_rate_ratio"])
def test_metrics_of_frames_in_order_take_whole_clips(name: str) -> None:
    """A step across frames that are left out is no step of the motion."""
    assert parse(name).moment == "all"
    with pytest.raises(FaceDiffError, match="omit the prefix"):
        parse(f"l_{name}")
