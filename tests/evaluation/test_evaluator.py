"""Metrics chosen by name for files: every registered one is computed, or refused with the reason."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile
import torch
from torchmetrics import Metric

import facediff.metrics as fm
from facediff import registry
from facediff.errors import FaceDiffError
from facediff.evaluation import EvaluationReport, text
from facediff.metrics import LipPairs, parse
from facediff.speech.phonemes import closures, read_phonemes
from tests.evaluation.conftest import LENGTHS, LIPS, Files, write_corpus

PAIRS = [(1, 2), (7, 11)]
OF_A_MODEL = {
    "sample_diversity",
    "mean_estimate_error",
    "coverage_error",
    "spread_error_ratio",
    "energy_score",
    "real_time_factor",
    "nearest_speaker_accuracy",
}
NO_CLIP_VALUES = {
    "clip_speech_lip_correlation",
    "motion_liveliness",
    "difference_ratio",
    "frame_step",
    "spectrum_distance",
    "blink_rate",
    "blink_rate_ratio",
    "eyelid_drift",
}
PHONEMES = "start,end,ipa,viseme\n0.00,0.08,m,PP\n0.08,0.2,a,aa\n0.2,0.28,ˈb,PP\n"


OF_CHANNELS = {name for name in registry.metric.names() if parse(name).of_channels}


@pytest.fixture
def corpus(tmp_path: Path) -> Files:
    """A corpus with speech, phonemes, pairs of lip vertices and a frame rate; each clip predicted in two styles."""
    files = write_corpus(tmp_path / "corpus")
    rng = np.random.default_rng(3)
    for folder in ("wav", "phonemes"):
        (files.root / folder).mkdir()
    for clip, frames in LENGTHS.items():
        soundfile.write(files.root / "wav" / f"{clip}.wav", rng.uniform(-0.5, 0.5, 640 * frames), 16_000)
        (files.root / "phonemes" / f"{clip}.csv").write_text(PHONEMES, encoding="utf-8")
        other = "B_C" if clip.startswith("A") else "A"
        motion = files.read(files.truth / f"{clip}.npy")
        files.write(files.method() / f"{clip}_condition_{other}.npy", motion + 0.03 * rng.standard_normal(motion.shape))
    (files.root / "regions" / "inner_lip_pairs.txt").write_text("1, 2\n7, 11\n")
    (files.root / "regions" / "eyelid_pairs.txt").write_text("0, 5\n13, 18\n")
    (files.root / "manifest.json").write_text(json.dumps({"frame_rate": 25}))
    return files


def scored(files: Files, *metrics: str, **options: object) -> EvaluationReport:
    return files.evaluate(metrics=metrics, corpus=files.root, protocols=["meshtalk"], **options)


def values(report: EvaluationReport) -> dict[str, float]:
    return {score.metric: score.value for score in report.methods[0].scores if score.protocol == "metrics"}


def batches(files: Files) -> list[dict[str, Any]]:
    """Prediction under the own identity, truth and template of each clip."""
    found = []
    for clip in sorted(LENGTHS):
        identity = clip.rpartition("_")[0]
        paths = files.method() / f"{clip}_condition_{identity}.npy", files.truth / f"{clip}.npy"
        prediction, truth = (torch.from_numpy(files.read(path)) for path in paths)
        found.append({"prediction": prediction, "truth": truth, "clip": clip, "identity": identity})
    return found


@pytest.mark.parametrize("name", registry.metric.names())
def test_every_registered_metric_is_computed_or_refused_with_the_reason(corpus: Files, name: str) -> None:
    if name in OF_A_MODEL:
        with pytest.raises(FaceDiffError, match=rf"metric {name}: needs .*facediff test --model.metrics"):
            scored(corpus, name)
        return
    if name in OF_CHANNELS:
        with pytest.raises(FaceDiffError, match=rf"metric {name}: needs motion in parameters"):
            scored(corpus, name)
        return
    identity = "all" if name == "identity_diversity" else "own"
    if name.startswith("blink"):
        name = f"{name}:closed=0.02,reopened=0.01"  # random faces do not shut their eyes
    report = scored(corpus, name, identity=identity, bootstrap=20)
    (score,) = [score for score in report.methods[0].scores if score.protocol == "metrics"]
    assert score.metric == name
    assert np.isfinite(score.value)
    assert 0 < score.sequences <= len(LENGTHS)
    assert f"  {name}: " in report.protocols["metrics"]
    printed = text(report)
    assert "further metrics" in printed
    assert f"\n{name} " in printed
    data = json.loads(json.dumps(report.as_dict(), allow_nan=False))
    assert data["methods"][0]["scores"][-1]["metric"] == name
    if name.partition(":")[0] not in NO_CLIP_VALUES:
        assert score.interval is None or score.interval.low <= score.value <= score.interval.high
        assert f"metrics/{name}" in report.rows()[0]


def test_scores_are_those_of_the_classes(corpus: Files) -> None:
    pairs = LipPairs.from_pairs("inner_lip_pairs", PAIRS)
    texts = ["lip_warping_distance", "mouth_opening_difference:pooling=sequences", "clip_speech_lip_correlation:of=gap"]
    texts += ["bilabial_closure_rate:count=closures,of=truth", "lip_vertex_error:squared=false"]
    found = values(scored(corpus, *texts))
    rates = {"sample_rate": 16_000, "frames_per_second": 25.0}
    expected: list[Any] = [
        fm.LipWarpingDistance(LIPS),
        fm.MouthOpeningDifference(pairs, pooling="sequences"),
        fm.ClipSpeechLipCorrelation(LIPS, n_identities=2, of="gap", **rates),  # type: ignore[arg-type]
        fm.BilabialClosureRate(pairs, count="closures", of="truth"),
        fm.LipVertexError(LIPS, squared=False),
    ]
    for batch in batches(corpus):
        clip, identity = batch.pop("clip"), batch.pop("identity")
        waveform = torch.from_numpy(soundfile.read(corpus.root / "wav" / f"{clip}.wav", dtype="float32")[0])
        spoken = closures(read_phonemes(corpus.root / "phonemes" / f"{clip}.csv"), 25)
        batch |= {"waveform": waveform, "closures": spoken, "identities": ["A", "B_C"].index(identity)}
        for metric in expected:
            fm.feed(metric, batch)
    for name, metric in zip(texts, expected, strict=True):
        assert found[name] == pytest.approx(metric.compute().item(), rel=1e-12), name


def test_clips_without_a_value_are_left_out(corpus: Files) -> None:
    (corpus.root / "phonemes" / "A_e01.csv").unlink()
    report = scored(corpus, "bilabial_closure_rate", bootstrap=30)
    (score,) = [score for score in report.methods[0].scores if score.protocol == "metrics"]
    assert score.sequences == len(LENGTHS) - 1
    rows = {row["clip"]: row["metrics/bilabial_closure_rate"] for row in report.rows()}
    assert rows["A_e01"] is None
    assert all(value is not None for clip, value in rows.items() if clip != "A_e01")


def test_a_clip_of_which_one_method_has_no_value_is_not_compared(corpus: Files) -> None:
    path = next(corpus.method("theirs").glob("A_e03*"))
    motion = np.load(path)
    np.save(path, np.broadcast_to(motion[:1], motion.shape))  # a mouth that does not move is neither early nor late
    metric = "temporal_misalignment:smoothing=0"
    report = corpus.evaluate("ours", "theirs", metrics=[metric], corpus=corpus.root, protocols=["meshtalk"])
    rows = {(row["method"], row["clip"]): row[f"metrics/{metric}"] for row in report.rows()}
    assert rows["theirs", "A_e03"] is None
    assert rows["ours", "A_e03"] is not None
    clips = [clip for clip in LENGTHS if rows["theirs", clip] is not None and rows["ours", clip] is not None]
    gaps = [rows["theirs", clip] - rows["ours", clip] for clip in clips]
    (found,) = [each for each in report.comparisons if each.metric == metric]
    assert (found.difference, found.sequences) == (pytest.approx(np.mean(gaps)), len(clips))
    (line,) = [line for line in text(report).splitlines() if f"theirs − ours: {metric}" in line]
    assert line.split()[-1] == str(len(clips))


@pytest.mark.parametrize("change", [lambda motion: 1000 * motion, lambda motion: 0.01 * motion], ids=["mm", "offsets"])
def test_predictions_in_another_unit_are_not_scored(corpus: Files, change: Callable[[np.ndarray], np.ndarray]) -> None:
    path = next(corpus.method("theirs").glob("A_e03*"))
    np.save(path, change(np.load(path)))
    report = corpus.evaluate("theirs")
    assert f"{path}: its face is" in text(report)
    assert "A_e03" not in {row["clip"] for row in report.rows() if row["paper/lve"] is not None}


class PlainError(Metric):
    """A metric of another package that knows nothing of facediff's base classes."""

    full_state_update = False
    total: torch.Tensor
    count: torch.Tensor

    def __init__(self, scale: float = 1.0) -> None:
        super().__init__()
        self.scale = scale
        self.add_state("total", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("count", torch.zeros(()), dist_reduce_fx="sum")

    def update(self, prediction: torch.Tensor, truth: torch.Tensor) -> None:
        self.total = self.total + self.scale * (prediction.double() - truth.double()).abs().sum()
        self.count = self.count + truth.numel()

    def compute(self) -> torch.Tensor:
        return self.total / self.count


def test_any_torchmetrics_class_can_be_registered(corpus: Files, monkeypatch: pytest.MonkeyPatch) -> None:
    registry.metric.load()
    entry = registry.Entry("plain_error", PlainError)
    monkeypatch.setitem(registry.metric._entries, "plain_error", entry)
    report = scored(corpus, "plain_error:scale=2", bootstrap=20)
    pairs = [(batch["prediction"], batch["truth"]) for batch in batches(corpus)]
    expected = 2 * sum((p - t).abs().sum().item() for p, t in pairs) / sum(t.numel() for _, t in pairs)
    (score,) = [score for score in report.methods[0].scores if score.protocol == "metrics"]
    assert score.value == pytest.approx(expected, rel=1e-9)
    assert (score.interval, score.sequences) == (None, len(LENGTHS))
    assert "metrics/plain_error:scale=2" not in report.rows()[0]
