"""Training, checkpoints and tests through Lightning's Trainer."""

from __future__ import annotations

import csv
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import numpy as np
import pytest
import torch
import yaml
from lightning.pytorch.callbacks import EMAWeightAveraging
from lightning.pytorch.cli import instantiate_module

from facediff import registry
from facediff.callbacks import PredictionWriter, SamplingPreview, ScoreTable
from facediff.cli.app import main
from facediff.data import collate
from facediff.data.batch import FORMAT_KEY
from facediff.errors import FaceDiffError
from facediff.models import DualPathDiffusion, load_model
from facediff.models.checkpoint import read_assets
from facediff.models.inference import noise_stream
from facediff.models.optimizers import Schedule, lr_factor
from tests.fakes.fixtures import quiet_trainer
from tests.fakes.tiny import Tiny

Make = Callable[..., DualPathDiffusion]
MakeTrainer = Callable[..., pl.Trainer]


@pytest.fixture(scope="module")
def trained(tiny_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint made from Python, with components as partials and EMA."""
    torch.manual_seed(0)
    model = DualPathDiffusion(
        n_vertices=24,
        identities=["A", "B"],
        frame_rate=25.0,
        dim=16,
        diffusion_steps=20,
        learning_rate=np.float64(1e-3),  # NumPy scalars must not reach the checkpoint
        decoder=partial(registry.decoder.get("gru"), num_layers=1),
        sampler=partial(registry.sampler.get("ddim"), steps=2),
    )
    folder = tmp_path_factory.mktemp("trained")
    averaging = EMAWeightAveraging(decay=0.5, use_buffers=False)
    trainer = quiet_trainer(folder, max_epochs=2, callbacks=[averaging])
    trainer.fit(model, datamodule=Tiny(root=str(tiny_root)))
    trainer.save_checkpoint(folder / "python.ckpt")
    return folder / "python.ckpt"


def test_a_checkpoint_is_plain_data_and_animates_without_the_corpus(trained: Path) -> None:
    checkpoint = torch.load(trained, weights_only=True)
    assert checkpoint["hyper_parameters"]["decoder"] == {
        "class_path": "facediff.registry.decoder.gru",
        "init_args": {"num_layers": 1, "bidirectional": True, "dropout": 0.1},
    }
    model = load_model(trained)
    assert isinstance(model, DualPathDiffusion)
    assert model.assets.motion_scale is not None
    assert model.animate(torch.randn(8000), identity="B").vertices.shape == (12, 24, 3)


def test_the_checkpoint_holds_the_averaged_weights(trained: Path) -> None:
    checkpoint = torch.load(trained, weights_only=True)
    averaged, raw = checkpoint["state_dict"], checkpoint["current_model_state"]
    assert averaged.keys() == raw.keys()
    loaded = load_model(trained).state_dict()
    assert all(torch.equal(loaded[name], averaged[name]) for name in averaged)


def test_test_scores_the_model_next_to_a_still_face_and_shuffled_speech(
    trained: Path, tiny: Tiny, make_trainer: MakeTrainer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trainer = make_trainer(callbacks=[ScoreTable()])
    (scores, *_) = trainer.test(load_model(trained), datamodule=tiny, verbose=False)
    printed = capsys.readouterr().out
    assert "SYNTHETIC corpus tiny, protocol paper" in printed
    assert "region tiny/lips: 12 vertices" in printed
    with (tmp_path / "test_scores.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [(row["split"], row["method"]) for row in rows] == [
        (split, method)
        for split in ("test_a", "test_b")
        for method in ("model", "usual_style", "still", "mean_face", "shuffled")
    ]
    still = next(row for row in rows if row["method"] == "still" and row["split"] == "test_a")
    assert float(still["lve"]) == pytest.approx(scores["test_a/still/lve"])
    # A still face's lip error is the truth's own largest lip offset, squared.
    largest = [s.motion[:, :12].double().square().sum(-1).amax(1) for s in tiny.dataset("test_a")]
    assert float(still["lve"]) == pytest.approx(float(torch.cat(largest).mean()), rel=1e-6)
    assert int(still["frames"]) == sum(len(values) for values in largest)


def test_test_scores_the_mean_face_of_the_training_clips(
    make_model: Make, tiny: Tiny, make_trainer: MakeTrainer
) -> None:
    scores = {}
    for part in make_trainer().test(make_model(motion_scale="none"), datamodule=tiny, verbose=False):
        scores |= part
    stored = {clip.name: tiny.corpus.read_motion(clip).double() for clip in tiny.corpus.clips.values()}
    faces = {
        person: torch.cat([stored[f"{person}_e{number:02d}"] for number in range(1, 5)]).mean(0) for person in "AB"
    }
    faces["C"] = (faces["A"] + faces["B"]) / 2  # nobody has trained on C
    for split, people in (("test_a", "AB"), ("test_b", "C")):
        clips = [(faces[person], stored[f"{person}_e{number:02d}"]) for person in people for number in (6, 7)]
        largest = torch.cat([(clip - face)[:, :12].square().sum(-1).amax(1) for face, clip in clips])
        assert scores[f"{split}/mean_face/lve"] == pytest.approx(largest.mean().item(), rel=1e-5)


def test_predictions_are_written_as_the_field_names_them(
    trained: Path, tiny: Tiny, make_trainer: MakeTrainer, tmp_path: Path
) -> None:
    model, writer = load_model(trained), PredictionWriter(str(tmp_path / "out"))
    make_trainer(callbacks=[writer], fast_dev_run=True).predict(model, datamodule=tiny)
    assert not (tmp_path / "out").exists()
    make_trainer(callbacks=[writer]).predict(model, datamodule=tiny)
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == [f"{c.name}_condition_{c.identity}.npy" for c in tiny.clips("test_a")]
    clip = tiny.clips("test_a")[0]
    written = np.load(tmp_path / "out" / names[0])
    assert written.shape == (tiny.corpus.frames(clip), 72)
    # Absolute vertices: near the template, not near zero.
    assert np.abs(written.reshape(-1, 24, 3) - tiny.corpus.templates[clip.identity].numpy()).max() < 0.2


def test_validation_is_the_same_twice(make_model: Make, tiny: Tiny, make_trainer: MakeTrainer) -> None:
    model = make_model()
    model.adopt(tiny.assets().with_motion_scale(2.0))
    scores = [make_trainer().validate(model, datamodule=tiny, verbose=False)[0] for _ in range(2)]
    assert scores[0] == scores[1]
    assert {"val/loss", "val/mve", "val/lve", "val/fdd", "val/reconstruction"} <= scores[0].keys()


def test_validation_draws_by_clips_not_by_the_number_of_a_batch(
    make_model: Make, tiny: Tiny, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = make_model(metrics=[]).eval()
    model.adopt(tiny.assets().with_motion_scale(2.0))
    monkeypatch.setattr(model.evaluation, "score", lambda *_: None)
    means = []
    for number in (0, 1):
        model._validation_sums = {}
        model.validation_step(next(iter(tiny.val_dataloader())), number)
        means.append({name: total.tolist() for name, total in model._validation_sums.items()})
    assert means[0] == means[1] != {}


def test_loss_terms_of_several_processes_are_means_over_all_clips(
    make_model: Make, tiny: Tiny, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three clips on two processes: sums and counts add up, and a repeated clip counts for nothing."""
    model, dataset = make_model(metrics=[]).eval(), tiny.dataset("train")
    model.adopt(tiny.assets().with_motion_scale(2.0))
    monkeypatch.setattr(model.evaluation, "score", lambda *_: None)
    samples = [dataset[0], dataset[3], dataset[5]]
    shares = [[collate(samples[:2])], [collate(samples[2:]), replace(collate(samples[:1]), repeated=True)]]
    sums = np.zeros(2)
    for share in shares:
        model._validation_sums = {}
        for batch in share:
            model.validation_step(batch, 0)
        sums += model._validation_sums["loss"].numpy()
    with torch.no_grad():
        losses = [
            float(model.losses(batch, noise_stream(" ".join(batch.names), 0, model.device))["loss"])
            for batch in (shares[0][0], shares[1][0])
        ]
    assert sums[0] / sums[1] == pytest.approx((2 * losses[0] + losses[1]) / 3, rel=1e-5)


@pytest.mark.parametrize(("factor", "energy"), [(1.0, 0.0), (0.0, 1.0), (0.5, 0.5)])
def test_the_best_checkpoint_is_chosen_by_energy_over_a_still_faces(
    make_model: Make, tiny: Tiny, make_trainer: MakeTrainer, factor: float, energy: float
) -> None:
    """Samples that are all one: the truth, a still face, and half of the movement."""
    model = make_model(validation_samples=2, motion_scale="none")
    model.generate = lambda batch, **_: factor * batch.motion
    (scores,) = make_trainer().validate(model, datamodule=tiny, verbose=False)
    assert scores["val/energy"] == pytest.approx(energy, abs=1e-6)


def test_mixed_precision_trains_with_clipped_gradients(make_model: Make, tiny: Tiny, make_trainer: MakeTrainer) -> None:
    model = make_model()
    before = model.network.unembed.weight.detach().clone()
    make_trainer(precision="bf16-mixed", gradient_clip_val=1.0).fit(model, datamodule=tiny)
    batch = collate([tiny.dataset("val")[0]])
    with torch.autocast("cpu", dtype=torch.bfloat16):
        noisy = torch.randn(batch.motion.flatten(2).shape)
        assert model.network(noisy, torch.tensor([3]), model.conditions(batch)).dtype == torch.float32
    after = model.network.unembed.weight
    assert after.dtype == torch.float32
    assert torch.isfinite(after).all()
    assert not torch.equal(before, after)


def test_double_precision_trains_previews_and_scores(make_model: Make, tiny: Tiny, make_trainer: MakeTrainer) -> None:
    model = make_model(style_from_speech=True)
    preview = SamplingPreview(clips=1, size=64, seconds=0.2)  # a preview that fails is a warning, which fails a test
    trainer = make_trainer(precision="64-true", callbacks=[preview])
    trainer.fit(model, datamodule=tiny)
    trainer.test(model, datamodule=tiny, verbose=False)
    assert model.network.unembed.weight.dtype == torch.float64
    assert np.isfinite(float(trainer.callback_metrics["test_b/usual_style/lve"]))


def test_a_training_without_an_end_warms_up_and_takes_no_cosine(
    make_model: Make, tiny: Tiny, make_trainer: MakeTrainer
) -> None:
    unlimited = {"max_epochs": -1, "max_time": {"seconds": 0}}
    make_trainer(**unlimited).fit(make_model(warmup_steps=10, lr_schedule="exponential"), datamodule=tiny)
    with pytest.raises(FaceDiffError, match=r"max_epochs.*max_steps"):
        make_trainer(**unlimited).fit(make_model(lr_schedule="cosine"), datamodule=tiny)


@pytest.mark.parametrize("schedule", ["constant", "cosine"])
def test_the_learning_rate_warms_up_and_ends_as_asked(schedule: Schedule) -> None:
    factors = [lr_factor(step, total=100, warmup_steps=10, schedule=schedule) for step in range(100)]
    assert factors[0] == pytest.approx(0.1)
    assert factors[4] < factors[8] <= 1.0
    assert factors[-1] == (1.0 if schedule == "constant" else pytest.approx(0.0, abs=1e-3))


def test_a_checkpoint_of_another_version_is_refused(tmp_path: Path, trained: Path) -> None:
    checkpoint = torch.load(trained, weights_only=True)
    del checkpoint[FORMAT_KEY]
    torch.save(checkpoint, tmp_path / "old.ckpt")
    with pytest.raises(FaceDiffError, match=r"old.ckpt: written by another version"):
        load_model(tmp_path / "old.ckpt")
    with pytest.raises(FaceDiffError, match=r"old.ckpt: written by another version"):
        read_assets(tmp_path / "old.ckpt")


class Further(DualPathDiffusion):
    """A model with an option of its own and another default of a common one."""

    def __init__(self, *, extra: int = 3, weight_decay: float = 0.25, **options: Any) -> None:  # noqa: ANN401
        super().__init__(weight_decay=weight_decay, **options)
        self.extra = extra


def test_hyper_parameters_are_kept_without_a_word_of_the_model() -> None:
    model = Further(n_vertices=24, identities=["A"], frame_rate=25.0, dim=16, decoder=registry.decoder.gru)
    kept = model.hparams
    assert (kept["extra"], kept["weight_decay"], kept["dim"], kept["warmup_steps"]) == (3, 0.25, 16, 0)
    assert kept["identities"] == ["A"]
    assert kept["decoder"]["init_args"] == {"num_layers": 2, "bidirectional": True, "dropout": 0.1}
    assert kept["fusion"]["init_args"]["num_heads"]
    options = {name: value for name, value in kept.items() if not name.startswith("_")}
    again = instantiate_module(Further, {**options, "extra": 4})
    assert again.hparams == {**kept, "extra": 4}
    assert model.weight_decay == again.weight_decay == 0.25


@pytest.mark.parametrize(
    "named",
    [
        "os.system",
        pytest.param("subprocess.Popen", marks=pytest.mark.slow),
        pytest.param("facediff.registry.decoder.nothing", marks=pytest.mark.slow),
        "facediff.registry.fusion.add",
        "this",
    ],
)
def test_a_checkpoint_that_names_a_program_does_not_run_it(tmp_path: Path, trained: Path, named: str) -> None:
    checkpoint = torch.load(trained, weights_only=True)
    harm = {
        "class_path": named,
        "init_args": {"command": f"touch {tmp_path}/harm", "args": ["touch", f"{tmp_path}/harm"]},
    }
    for place in ("decoder", "dim"):
        hostile = {**checkpoint, "hyper_parameters": {**checkpoint["hyper_parameters"], place: harm}}
        torch.save(hostile, tmp_path / "hostile.ckpt")
        with pytest.raises(FaceDiffError, match="it was not loaded"):
            load_model(tmp_path / "hostile.ckpt")
    nested = {"class_path": "facediff.registry.decoder.gru", "init_args": {"num_layers": harm}}
    checkpoint["hyper_parameters"]["decoder"] = nested
    torch.save(checkpoint, tmp_path / "hostile.ckpt")
    assert main(["test", "--ckpt_path", str(tmp_path / "hostile.ckpt")]) == 2
    assert not (tmp_path / "harm").exists()


def test_a_data_module_named_by_a_checkpoint_is_not_imported(tmp_path: Path, trained: Path) -> None:
    checkpoint = torch.load(trained, weights_only=True)
    checkpoint["facediff_data"] = {"class_path": "this.Zen", "root": "/"}
    torch.save(checkpoint, tmp_path / "hostile.ckpt")
    assert main(["test", "--ckpt_path", str(tmp_path / "hostile.ckpt")]) == 2
    assert "this" not in sys.modules


def test_an_interruption_leaves_the_best_checkpoint_alone(
    make_model: Make, tiny: Tiny, make_trainer: MakeTrainer, tmp_path: Path
) -> None:
    from lightning.pytorch.callbacks import ModelCheckpoint

    bundled = yaml.safe_load((Path(__file__).parents[2] / "configs/trainer/cpu.yaml").read_text())["callbacks"]
    keepers = [
        ModelCheckpoint(dirpath=tmp_path, **callback["init_args"])
        for callback in bundled
        if callback["class_path"].endswith("ModelCheckpoint")
    ]
    seen: list[bytes] = []

    class Interrupted(DualPathDiffusion):
        def training_step(self, batch: object, batch_idx: int) -> torch.Tensor:
            if self.current_epoch == 1 and batch_idx == 1:
                seen.append((tmp_path / "best.ckpt").read_bytes())
                raise RuntimeError("pulled the plug")
            return super().training_step(batch, batch_idx)  # type: ignore[arg-type]

    model = make_model()
    model.__class__ = Interrupted
    with pytest.raises(RuntimeError, match="pulled the plug"):
        make_trainer(max_epochs=3, callbacks=keepers, enable_checkpointing=True).fit(model, datamodule=tiny)
    assert seen == [(tmp_path / "best.ckpt").read_bytes()]


def test_a_corpus_that_does_not_fit_the_checkpoint_is_refused(
    trained: Path, tiny_root: Path, make_trainer: MakeTrainer
) -> None:
    class Other(Tiny):
        identities = ["A", "C"]

    with pytest.raises(FaceDiffError, match="identities are"):
        make_trainer().test(load_model(trained), datamodule=Other(root=str(tiny_root)), verbose=False)


def test_training_stops_when_the_loss_is_no_number(
    make_model: Callable[..., DualPathDiffusion], tiny: Tiny, make_trainer: Callable[..., pl.Trainer]
) -> None:
    with pytest.raises(FaceDiffError, match=r"model\.learning_rate"):
        make_trainer(max_epochs=50).fit(make_model(learning_rate=1e3, weight_decay=900.0), datamodule=tiny)


def test_sizes_follow_from_the_data_and_a_plain_trainer_trains(tiny_root: Path, make_trainer: MakeTrainer) -> None:
    """``for_data`` is what the command line links; one step of Lightning's own Trainer changes the weights."""
    data = Tiny(root=str(tiny_root), batch_size=4)
    model = DualPathDiffusion.for_data(data, dim=16, diffusion_steps=20)
    assert (model.n_vertices, model.identities, model.frame_rate) == (24, ["A", "B"], 25.0)
    assert model.hparams["dim"] == 16
    before = model.network.embed.weight.detach().clone()
    make_trainer(max_steps=1, limit_val_batches=0).fit(model, data)
    assert not torch.equal(model.network.embed.weight, before)
