"""As whom strangers are tested: by name, stated with the result, and scored as a mean by hand."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from lightning.pytorch import Trainer

from facediff.data import Sample, collate
from facediff.models import DualPathDiffusion
from facediff.models.evaluation import conditioned, to_shuffle
from tests.fakes.tiny import Tiny

Make = Callable[..., DualPathDiffusion]


def test_a_part_of_a_batch_is_the_batch_of_a_part(tiny: Tiny) -> None:
    samples = [tiny.dataset("test_a")[i] for i in range(3)]
    samples.append(tiny.dataset("test_b")[0])
    chosen = collate(samples).select([2, 0])
    want = collate([samples[2], samples[0]])
    for name, value in vars(want).items():
        if isinstance(value, torch.Tensor):
            torch.testing.assert_close(getattr(chosen, name), value, msg=name)
        else:
            assert getattr(chosen, name) == value, name


def test_each_seen_identity_lends_itself_and_its_style(tiny: Tiny) -> None:
    assets = tiny.assets()
    batch = collate([tiny.dataset("test_a")[0], tiny.dataset("test_b")[0]])
    views = conditioned(batch, "each_seen", assets.identities, assets.references)
    assert [name for name, _ in views] == ["", "A", "B"]
    assert views[0][1].names == batch.names[:1]
    for index, (name, view) in enumerate(views[1:]):
        assert view.names == batch.names[1:]
        assert view.identity.tolist() == [index]
        assert view.reference_names == [assets.references[name].clip]
        torch.testing.assert_close(view.reference[0], assets.references[name].motion.float())
    assert conditioned(batch, "style_only", assets.identities, assets.references)[0][1] is batch


@pytest.mark.parametrize(("policy", "people"), [("style_only", ["A", "unknown"]), ("each_seen", ["A", "A", "B"])])
def test_strangers_are_predicted_as_they_are_tested(
    policy: str, people: list[str], make_model: Make, tiny: Tiny
) -> None:
    model = make_model(unseen_identity=policy).eval()
    model.adopt(tiny.assets().with_motion_scale(1.0))
    batch = collate([tiny.dataset("test_a")[0], tiny.dataset("test_b")[0]])
    with torch.inference_mode():
        predictions = model.predict_step(batch, 0)
        assert [clip.identity for clip in predictions] == people
        assert [clip.name for clip in predictions] == [batch.names[0], *batch.names[1:] * (len(people) - 1)]
        views = conditioned(batch, model.unseen_identity, model.identities, tiny.assets().references)
        expected = [
            motion + face for _, view in views for motion, face in zip(model.generate(view), view.template, strict=True)
        ]
    for clip, motion in zip(predictions, expected, strict=True):
        torch.testing.assert_close(clip.vertices, motion[: len(clip.vertices)])


@pytest.mark.parametrize(("method", "logged"), [("model", "test_b/lve"), ("shuffled", "test_b/shuffled/lve")])
@pytest.mark.slow
def test_the_mean_over_identities_is_reported(
    method: str, logged: str, make_model: Make, tiny: Tiny, make_trainer: Callable[..., Trainer]
) -> None:
    """Scores of test B are the mean over clips and identities of those computed by hand.

    Another sentence's speech is tried once for each clip, under the identity that its name decides.
    """
    model = make_model(unseen_identity="each_seen", motion_scale="none")
    trainer = make_trainer()
    metrics = trainer.test(model, datamodule=tiny, verbose=False)
    reported = {name: value for part in metrics for name, value in part.items()}
    total, frames = 0.0, 0
    dataset, assets = tiny.dataset("test_b"), tiny.assets()
    for i in range(len(dataset)):
        batch = collate([dataset[i]])
        for name, view in conditioned(batch, "each_seen", assets.identities, assets.references):
            if method == "shuffled" and name != "AB"[zlib.crc32(batch.names[0].encode()) % 2]:
                continue
            heard = view if method == "model" else replace(view, audio=view.decoy_audio, features=None)
            with torch.inference_mode():
                motion = model.eval().generate(heard, seed=0)
            error = (motion - batch.motion)[0][:, assets.regions["lips"]].double().square().sum(-1).amax(-1)
            total, frames = total + float(error.sum()), frames + len(error)
    assert reported[logged] == pytest.approx(total / frames, rel=1e-4)
    rows = [row for row in model.evaluation.sequences() if row["split"] == "test_b" and row["method"] == method]
    assert len(rows) == len(dataset) * (2 if method == "model" else 1)
    assert {row["identity"] for row in rows} <= {"A", "B"}


def test_every_clip_is_shuffled_once_whatever_the_batches(tiny: Tiny) -> None:
    assets, clips = tiny.assets(), [tiny.dataset("test_a")[0], *map(tiny.dataset("test_b").__getitem__, range(2))]

    def tried(batches: list[list[Sample]]) -> list[tuple[str, str]]:
        views = [
            view for batch in batches for view in conditioned(collate(batch), "each_seen", "AB", assets.references)
        ]
        parts = [(name, to_shuffle(name, view, "AB")) for name, view in views]
        return sorted((clip, name) for name, part in parts if part is not None for clip in part.names)

    assert tried([clips]) == tried([[clip] for clip in clips]) == tried([clips[::-1]])
    assert [clip for clip, _ in tried([clips])] == sorted(clip.name for clip in clips)
    assert to_shuffle("", collate([replace(clips[0], decoy_audio=None)]), "AB") is None


def test_the_mean_of_samples_is_a_row_where_it_is_asked_for(
    make_model: Make, tiny: Tiny, make_trainer: Callable[..., Trainer]
) -> None:
    model = make_model(motion_scale="none", test_samples=3)
    model.adopt(tiny.assets().with_motion_scale(1.0))
    scores: dict[str, float] = {}
    for part in make_trainer().test(model, datamodule=tiny, verbose=False):
        scores |= part
    assets, errors = tiny.assets(), []
    for i in range(len(tiny.dataset("test_a"))):
        batch = collate([tiny.dataset("test_a")[i]])
        with torch.inference_mode():
            made = torch.stack([model.eval().generate(batch, seed=seed) for seed in range(3)]).mean(0)
        errors.append((made - batch.motion)[0][:, assets.regions["lips"]].double().square().sum(-1).amax(-1))
    assert scores["test_a/sample_mean/lve"] == pytest.approx(float(torch.cat(errors).mean()), rel=1e-4)
    assert scores["test_a/sample_mean/lve"] < scores["test_a/lve"]


def test_what_animate_gives_is_a_row_of_its_own(
    make_model: Make, tiny: Tiny, make_trainer: Callable[..., Trainer]
) -> None:
    """Without a style, ``animate`` takes the speaker's stored reference, whatever the clip's own is."""
    model = make_model(motion_scale="none")
    model.adopt(tiny.assets().with_motion_scale(1.0))
    scores: dict[str, float] = {}
    for part in make_trainer().test(model, datamodule=tiny, verbose=False):
        scores |= part
    assert scores["test_a/usual_style/lve"] != scores["test_a/lve"]
    assets, errors = tiny.assets(), []
    for i in range(len(tiny.dataset("test_a"))):
        sample = tiny.dataset("test_a")[i]
        stored = replace(sample, reference=assets.references[sample.identity_name].motion.float())
        with torch.inference_mode():
            made = model.eval().generate(collate([stored]), seed=0)[0]
        error = (made - sample.motion)[:, assets.regions["lips"]]
        errors.append(error.double().square().sum(-1).amax(-1))
    assert scores["test_a/usual_style/lve"] == pytest.approx(float(torch.cat(errors).mean()), rel=1e-4)
