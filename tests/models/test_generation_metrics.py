"""The generation metrics against the metrics taken by hand, for a model with noise and for one without."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import facediff.metrics as fm
from facediff.cli.generation_metrics import text
from facediff.data import Batch, collate
from facediff.data.articulation import MouthMotion, articulation, mouth_motion
from facediff.errors import FaceDiffError
from facediff.models.base import AnimationModel
from facediff.models.generation_metrics import GENERATION_METRICS, GenerationScores, SamplingOptions, measure
from facediff.speech.phonemes import TimedPhoneme
from facediff.utils.plain_files import write_table
from tests.fakes.channels import CHANNELS, TinyChannels, write_channels
from tests.fakes.tiny import RATE, SEEN, VERTICES, Tiny, write_tiny

LIPS, UPPER = range(12), range(12, 24)
Make = Callable[..., Any]


class Scripted(AnimationModel):
    """Says what a script makes of a clip's true motion, its reference and a seed."""

    samples = True
    script: Callable[[Batch, int], Tensor]

    def losses(self, batch: Batch, generator: torch.Generator | None = None) -> dict[str, Tensor]:
        raise NotImplementedError

    def generate_clips(self, batch: Batch, *, seed: int = 0, progress: Any = None) -> Tensor:  # noqa: ANN401
        return type(self).script(batch, seed)

    def generate_samples(self, clip: Batch, seeds: Sequence[int], *, progress: Any = None) -> Tensor:  # noqa: ANN401
        return torch.cat([self.generate_clips(clip, seed=seed) for seed in seeds])


def scripted(data: Tiny, script: Callable[[Batch, int], Tensor], *, noise: bool = True) -> Scripted:
    made = type("Made", (Scripted,), {"script": staticmethod(script), "samples": noise})
    model = made(n_vertices=VERTICES, identities=SEEN, frame_rate=float(RATE), motion_scale="none")
    model.adopt(data.assets())
    return model.eval()


def noisy(batch: Batch, seed: int) -> Tensor:
    """The truth with noise of the seed and the clip, three times as much on the upper face."""
    random = torch.Generator().manual_seed(1000 * seed + sum(map(ord, batch.names[0])))
    noise = torch.randn(batch.motion.shape[1:], generator=random) * 0.001
    noise[:, 12:] *= 3
    return batch.motion + noise


def run(data: Tiny, *models: AnimationModel, **options: Any) -> GenerationScores:  # noqa: ANN401
    return measure({f"{place}.ckpt": lambda model=model: model for place, model in enumerate(models)}, data, **options)


def test_every_generation_metric_is_the_metric_that_it_names(tiny: Tiny) -> None:
    model = scripted(tiny, noisy)
    scores = run(tiny, model, splits=["test_a"], sampling=SamplingOptions(samples=4, references=1))
    drawn, truths, still, faces = [], [], [], []
    clips = tiny.dataset("test_a")
    people = {
        person: torch.cat([tiny.corpus.read_motion(clip) for clip in tiny.clips("train") if clip.identity == person])
        for person in SEEN
    }
    for sample in clips:
        batch = collate([sample])
        drawn.append(torch.cat([noisy(batch, seed) for seed in range(4)]))
        truths.append(sample.motion)
        still.append(torch.zeros_like(sample.motion))
        faces.append(people[sample.identity_name].mean(0).expand_as(sample.motion))

    def taken(metric: Any, of: list[Tensor], **more: Any) -> float:  # noqa: ANN401
        for motion, truth in zip(of, truths, strict=True):
            for each in motion if motion.ndim == 4 and not isinstance(metric, fm.metric_of_samples) else [motion]:
                metric.update(each, truth, **more)
        return float(metric.compute())

    fm.metric_of_samples = (fm.SpreadErrorRatio, fm.EnergyScore, fm.SamplesMetric)  # type: ignore[attr-defined]
    lve = taken(fm.LipVertexError(LIPS), drawn)
    of_still, of_faces = (taken(fm.LipVertexError(LIPS), of) for of in (still, faces))
    mean, best = (taken(each(LIPS, n_samples=4), drawn) for each in (fm.MeanEstimateError, fm.CoverageError))
    expected = {
        "liveliness_upper_face": taken(fm.MotionLiveliness(UPPER), drawn),
        "liveliness_lips": taken(fm.MotionLiveliness(LIPS), drawn),
        "spectrum_upper_face": taken(fm.SpectrumDistance(UPPER), drawn),
        "difference_ratio_upper_face": taken(fm.DifferenceRatio(UPPER), drawn),
        "difference_ratio_lips": taken(fm.DifferenceRatio(LIPS), drawn),
        "frame_step_upper_face": taken(fm.FrameStep(UPPER), drawn),
        "frame_step_lips": taken(fm.FrameStep(LIPS), drawn),
        "variance_upper_face": taken(fm.SpreadErrorRatio(UPPER, n_samples=4, squared=True), drawn),
        "variance_lips": taken(fm.SpreadErrorRatio(LIPS, n_samples=4, squared=True), drawn),
        "spread_face": taken(fm.SpreadErrorRatio(n_samples=4), drawn),
        "spread_upper_face": taken(fm.SpreadErrorRatio(UPPER, n_samples=4), drawn),
        "spread_lips": taken(fm.SpreadErrorRatio(LIPS, n_samples=4), drawn),
        "energy_lips": taken(fm.EnergyScore(LIPS, n_samples=4), drawn),
        "energy_upper_face": taken(fm.EnergyScore(UPPER, n_samples=4), drawn),
        "fdd_still": taken(fm.FaceDynamicsDeviation(UPPER), drawn) / taken(fm.FaceDynamicsDeviation(UPPER), still),
        "mve": taken(fm.MeanVertexError(), drawn),
        "lve": lve,
        "lve_still": lve / of_still,
        "lve_mean_still": mean / of_still,
        "lve_best_still": best / of_still,
        "lve_mean_face": lve / of_faces,
        "lve_mean_mean_face": mean / of_faces,
        "lve_best_mean_face": best / of_faces,
    }
    del fm.metric_of_samples  # type: ignore[attr-defined]
    for name, value in expected.items():
        assert scores.mean("test_a", name) == pytest.approx(value, rel=1e-5), name
    assert scores.mean("test_a", "real_time_factor") > 0  # type: ignore[operator]
    assert scores.clips == {"test_a": 4}
    assert {"blink_ratio", "closed"} <= scores.missing.keys()
    assert scores.mean("test_a", "blink_ratio") is None


def test_a_mumbling_mouth_has_its_share_of_the_truths_articulation(tmp_path: Path) -> None:
    data = Tiny(root=str(write_tiny(tmp_path / "tiny")))
    for file, pairs in (("inner_lip_pairs", "0, 12\n1, 13\n"), ("lip_teeth_pairs", "2, 14\n")):
        (data.root / "regions" / f"{file}.txt").write_text(pairs)
    (data.root / "phonemes").mkdir()
    said = [("0", "0.12", "p"), ("0.12", "0.24", "a"), ("0.24", "0.36", "f"), ("0.36", "0.48", "u")]
    for clip in data.clips("test_a"):
        write_table(data.root / "phonemes" / f"{clip.name}.csv", [("start", "end", "ipa"), *said])
    scores = run(data, scripted(data, lambda batch, _: batch.motion / 2), splits=["test_a"])
    faces: dict[float, list[MouthMotion]] = {1.0: [], 0.5: []}
    for sample in data.dataset("test_a"):
        rest, spoken = sample.template.numpy(), [TimedPhoneme(float(a), float(b), ipa) for a, b, ipa in said]
        for share, mouths in faces.items():
            vertices = rest + share * sample.motion.numpy()
            facts = {"millimetres": 1000, "frame_rate": RATE, "phonemes": spoken}
            pairs = np.array([[0, 12], [1, 13]]), np.array([[2, 14]])
            mouths.append(mouth_motion(vertices, rest, pairs[0], lip_teeth_pairs=pairs[1], **facts))
    shares = articulation(faces[0.5]).shares_of(articulation(faces[1.0]))
    for name in ("closure_auc", "closed", "chance", "open_vowels", "rounding", "contact"):
        expected = None if np.isnan(shares[name]) else pytest.approx(shares[name], rel=1e-5)
        assert scores.mean("test_a", name) == expected, name
    assert scores.mean("test_a", "open_vowels") is not None


def test_a_reference_is_followed_with_the_label_and_without(tiny: Tiny) -> None:
    """The script moves as its reference does, if it is not told who speaks; the truth plus a little if it is."""

    def script(batch: Batch, seed: int) -> Tensor:
        styled = batch.reference.mean(1, keepdim=True).expand_as(batch.motion)
        return torch.where(batch.identity[:, None, None, None] >= 0, batch.motion + 0.001, styled)

    scores = run(tiny, scripted(tiny, script), sampling=SamplingOptions(samples=2, references=1))
    assert scores.mean("test_a", "nearest_speaker") == 1.0
    assert scores.mean("test_a", "true_nearest_speaker") == 1.0
    assert "chance 1/3" in scores.title("nearest_speaker")
    assert scores.mean("test_a", "mve_hidden_another") > 1.2  # type: ignore[operator]
    assert scores.mean("test_a", "mve_known_another") == pytest.approx(1.0)
    assert scores.mean("test_b", "mve_known_another") is None  # nobody has trained on C, whose label says nothing
    assert scores.mean("test_b", "nearest_speaker") is not None


def test_what_animate_gives_is_scored_with_the_style_that_it_takes(tiny: Tiny) -> None:
    def script(batch: Batch, seed: int) -> Tensor:
        return batch.reference.mean(1, keepdim=True).expand_as(batch.motion)

    model = scripted(tiny, script)
    scores = run(tiny, model, splits=["test_a"], sampling=SamplingOptions(samples=2, references=1))
    found, still = fm.LipVertexError(LIPS), fm.LipVertexError(LIPS)
    for sample in tiny.dataset("test_a"):
        stored = model.assets.references[sample.identity_name].motion.float()
        found.update(stored.mean(0).expand_as(sample.motion), sample.motion)
        still.update(torch.zeros_like(sample.motion), sample.motion)
    expected = float(found.compute()) / float(still.compute())
    assert scores.mean("test_a", "lve_default_still") == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("rigged", [True, False])
def test_channels_are_scored_as_decoded_vertices_and_as_channels(tmp_path: Path, rigged: bool) -> None:  # noqa: FBT001
    root = write_channels(tmp_path / "channels")
    data: Tiny = (
        TinyChannels(root=str(root))
        if rigged
        else type("Bare", (TinyChannels,), {"rig": lambda *_: None})(root=str(root))
    )
    assets = data.assets()
    assert (assets.rig is None) != rigged

    def shaken(batch: Batch, seed: int) -> Tensor:
        random = torch.Generator().manual_seed(seed)
        return batch.motion * 0.5 + 0.05 * torch.randn(batch.motion.shape[1:], generator=random)

    made = type("Made", (Scripted,), {"script": staticmethod(shaken), "samples": True})
    model = made(n_vertices=6, space=CHANNELS, identities=SEEN, frame_rate=float(RATE), motion_scale="none").eval()
    model.adopt(assets)
    scores = run(data, model, splits=["test_a"], sampling=SamplingOptions(samples=2, references=1))
    lve = fm.LipVertexError(assets.scored.regions["lips"])
    for sample in data.dataset("test_a"):
        for seed in (0, 1):
            drawn = shaken(collate([sample]), seed)[0]
            lve.update(*(assets.to_scored(side, sample.identity_name) for side in (drawn, sample.motion)))
    assert scores.mean("test_a", "lve") == pytest.approx(lve.compute().item(), rel=1e-5)
    assert ("nearest_speaker" in scores.missing) != rigged


def test_a_model_without_noise_has_no_spread_and_is_scored_by_its_distance(tiny: Tiny) -> None:
    model = scripted(tiny, lambda batch, seed: torch.zeros_like(batch.motion), noise=False)
    scores = run(tiny, model, sampling=SamplingOptions(samples=5))
    assert scores.samples == 1
    assert "spread 0" in text(scores)
    for split in ("test_a", "test_b"):
        assert scores.mean(split, "spread_face") == 0.0
        for name in ("lve_still", "lve_mean_still", "lve_best_still", "fdd_still"):
            assert scores.mean(split, name) == pytest.approx(1.0)
        distances = [sample.motion[:, :12].square().sum((1, 2)).div(12).sqrt() for sample in tiny.dataset(split)]
        assert scores.mean(split, "energy_lips") == pytest.approx(torch.cat(distances).mean().item(), rel=1e-5)


def test_several_checkpoints_have_means_and_deviations(tiny: Tiny) -> None:
    models = [
        scripted(tiny, lambda batch, seed, share=share: share * batch.motion, noise=False) for share in (0.5, 0.8)
    ]
    scores = run(tiny, *models, splits=["test_b"])
    assert scores.values["test_b"]["liveliness_lips"] == [pytest.approx(0.5), pytest.approx(0.8)]
    assert scores.mean("test_b", "liveliness_lips") == pytest.approx(0.65)
    assert scores.deviation("test_b", "liveliness_lips") == pytest.approx(0.3 / 2**0.5)
    rows = {row["metric"]: row for row in scores.rows()}
    assert rows.keys() == GENERATION_METRICS.keys()
    assert rows["liveliness_lips"]["value_2"] == pytest.approx(0.8)
    assert "0.650 ± 0.212" in text(scores)
    with pytest.raises(FaceDiffError, match="samples"):
        SamplingOptions(samples=1)
    other = scripted(tiny, noisy)
    other._assets = replace(other.assets, unit="mm")
    with pytest.raises(FaceDiffError, match="frame rate or unit"):
        run(tiny, models[0], other, splits=["test_b"])


def test_the_command_writes_what_it_prints(
    make_model: Make, tiny: Tiny, make_trainer: Make, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from facediff.cli.app import main

    trainer = make_trainer(limit_train_batches=1, limit_val_batches=0)
    trainer.fit(make_model(), datamodule=tiny)
    trainer.save_checkpoint(tmp_path / "a.ckpt")
    words = [
        "generation-metrics",
        str(tmp_path / "a.ckpt"),
        "--corpus",
        "tests.fakes.tiny.Tiny",
        "--quiet",
        "--samples",
        "2",
    ]
    words += ["--references", "1", "--max-clips", "1"]
    assert main([*words, "--json", str(tmp_path / "a.json"), "--csv", str(tmp_path / "a.csv")]) == 0
    printed = capsys.readouterr().out
    assert "SYNTHETIC corpus tiny" in printed
    assert "ddim with 3 steps" in printed
    content = json.loads((tmp_path / "a.json").read_text())
    assert content["clips"] == {"test_a": 1, "test_b": 1}
    assert main([*words, "--sampler", "ddpm", "--steps", "2"]) == 0
    printed = capsys.readouterr().out
    assert "ddpm with 2 steps" in printed
    assert main([*words, "--expressivity", "0", "--splits", "test_b"]) == 0
    printed = capsys.readouterr().out
    assert "expressivity 0" in printed
    assert next(line for line in printed.splitlines() if "spread / error, whole face" in line).split()[-1] == "0.000"
    assert main([*words, "--splits", "tests"]) == 2
