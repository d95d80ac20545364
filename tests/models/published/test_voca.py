"""VOCA from its authors' files gives what the published code gives, by a reference in NumPy of its own."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lightning.pytorch import Trainer

from facediff.cli.app import main
from facediff.data import collate
from facediff.errors import FaceDiffError
from facediff.models import Voca, import_checkpoint, load_model
from facediff.models.deepspeech import DeepSpeechEncoder, cepstra
from facediff.models.published.import_options import ImportOptions
from facediff.models.published.importing import import_files, save_model
from facediff.models.styles import style_from
from tests.fakes import voca
from tests.fakes.tiny import Tiny
from tests.fakes.voca import IDENTITIES, VERTICES, write_arrays, write_voca
from tests.models.published.test_lam import speech_of
from tests.models.published.test_laws import clips, with_assets

Make = Callable[..., Any]


def templates() -> dict[str, np.ndarray]:
    return {name: np.random.default_rng(i).normal(size=(VERTICES, 3)) for i, name in enumerate(IDENTITIES)}


def imported(files: object, **options: Any) -> Voca:  # noqa: ANN401
    given: dict[str, Any] = {"dataset": "vocaset", "identities": IDENTITIES, "templates": templates(), **options}
    model = import_checkpoint(files, **given)  # type: ignore[arg-type]
    assert isinstance(model, Voca)
    return model


# 48 frames; 50 of 49.76; one of less speech than a frame of cepstra takes.
@pytest.mark.parametrize("samples", [12_800, 13_270, 300])
def test_parity(samples: int, tmp_path: Path) -> None:
    model, speech = imported(write_voca(tmp_path)), speech_of(samples)
    assert model.frame_rate == 60.0
    for number, name in enumerate(IDENTITIES):
        made = model.animate(speech, identity="A", condition=name).vertices.flatten(1)
        expected = voca.voca_reference(speech.numpy(), number, templates()["A"])
        torch.testing.assert_close(made, torch.from_numpy(expected).float(), rtol=0, atol=1e-5)


def test_cepstra() -> None:
    """Silence too, where the logarithm needs help."""
    samples = np.trunc(speech_of(5000).numpy().astype(np.float64) * 32768)
    for each in (samples, samples[:399], samples[:561], np.zeros(900)):
        made = cepstra(torch.from_numpy(each)[None])[0]
        torch.testing.assert_close(made, torch.from_numpy(voca.cepstra(each)), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("rate", "step"), [(30, 2), (20, 3)])
def test_other_frame_rates_take_every_so_many_frames(rate: int, step: int, tmp_path: Path) -> None:
    files, speech = write_voca(tmp_path), speech_of(13_270)
    whole = imported(files).animate(speech, identity="B").vertices
    model = imported(files, frame_rate=rate)
    assert model.frame_rate == rate
    torch.testing.assert_close(model.animate(speech, identity="B").vertices, whole[::step], rtol=0, atol=1e-6)
    with pytest.raises(FaceDiffError, match="frame_rate=25"):
        imported(files, frame_rate="25")
    with pytest.raises(FaceDiffError, match="frame_rate"):
        imported(files, frame_rate="fast")


def test_without_a_speaker_vertices_are_mixed(tmp_path: Path) -> None:
    model, speech = imported(write_voca(tmp_path)), speech_of(4000)
    clip = model.clip_of(speech, "A", None)
    clip.identity.fill_(-1)
    made = model.generate_frames(clip, torch.tensor([15]), seeds=[0]) + clip.template
    parts = [voca.voca_reference(speech.numpy(), k, templates()["A"]) for k in range(3)]
    expected = torch.from_numpy(sum(parts) / 3).float()
    torch.testing.assert_close(made[0].flatten(1).detach(), expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("shares", [(0.2, 0.3, 0.5), (1.0, -0.5, 0.5)])
def test_a_style_mixes_vertices(shares: tuple[float, ...], tmp_path: Path) -> None:
    """Also where one weight alone is 1, and others lead away from a style."""
    model, speech = imported(write_voca(tmp_path)), speech_of(3000)
    words = ",".join(f"{name}:{share}" for name, share in zip(IDENTITIES, shares, strict=True))
    made = model.animate(speech, identity="A", style=style_from(words, "A", model)).vertices
    parts = [share * voca.voca_reference(speech.numpy(), k, templates()["A"]) for k, share in enumerate(shares)]
    torch.testing.assert_close(made.flatten(1), torch.from_numpy(sum(parts)).float(), rtol=0, atol=1e-5)


def test_variables_may_have_no_scope(tmp_path: Path) -> None:
    state = {name.removeprefix("VOCA/"): value for name, value in voca.voca_state().items()}
    index = write_arrays(tmp_path / "bare.npz", state)
    made = imported([index, write_arrays(tmp_path / "g.npz", voca.deepspeech_state())])
    assert torch.equal(
        made.network.expression.bias.detach(), torch.from_numpy(state["ExpressionLayer/expression_offset/biases"])
    )


def test_the_command_and_its_checkpoint(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    write_voca(tmp_path)
    (tmp_path / "faces.pkl").write_bytes(pickle.dumps(templates()))
    monkeypatch.chdir(tmp_path)
    words = [
        "import-checkpoint",
        "voca.npz",
        "deepspeech.npz",
        "--dataset",
        "vocaset",
        "--identities",
        "A,B,C",
    ]
    assert main([*words, "--templates", "faces.pkl", "-o", "voca.ckpt"]) == 0
    printed = "".join(capsys.readouterr())
    for expected in ("60 frames", "of the optimiser", "MPL-2.0", "forbidden"):
        assert expected in printed
    for name in ("deepspeech.npz", "voca.npz"):
        (tmp_path / name).unlink()
    made = load_model(tmp_path / "voca.ckpt").animate(speech_of(3000), identity="A").vertices
    expected = voca.voca_reference(speech_of(3000).numpy(), 0, templates()["A"])
    torch.testing.assert_close(made.flatten(1), torch.from_numpy(expected).float(), rtol=0, atol=1e-5)


# Training.


def test_the_loss_is_the_published_one(make_method: Make) -> None:
    model = with_assets(make_method("Voca", velocity_weight=10.0))
    batch = collate(clips(9, 14))
    frames = model.trained_frames(batch)
    with torch.no_grad():
        losses = model.losses(batch)
        made = model.generate_frames(batch, frames, seeds=[0, 0])
    errors = [(made - batch.motion)[row, :count] for row, count in enumerate(frames.tolist())]
    squared = [error.square().sum(-1) for error in errors]
    changes = [torch.cat([error[:1] * 0, error.diff(dim=0)]).square().sum(-1) for error in errors]
    reconstruction, velocity = torch.cat(squared).mean(), torch.cat(changes).mean()
    torch.testing.assert_close(losses["reconstruction"], reconstruction)
    torch.testing.assert_close(losses["loss"], reconstruction + 10.0 * velocity)


def test_the_batch_norm_does_not_see_padding(make_method: Make) -> None:
    """In training, where it takes the batch's own mean: a clip far shorter than the other changes nothing."""
    results = []
    for extra in (0, 40):
        model = with_assets(make_method("Voca")).train()
        batch = collate(clips(9, 9 + extra)[:1] + clips(9, 9))
        padded = torch.nn.functional.pad
        audio = padded(batch.audio, (0, 640 * extra))
        motion = padded(batch.motion, (0, 0, 0, 0, 0, extra))
        model.losses(replace(batch, audio=audio, motion=motion))
        results.append(model.network.norm.running_mean.clone())
    torch.testing.assert_close(results[0], results[1], rtol=0, atol=1e-6)


def test_shapes_start_as_principal_components(
    make_method: Make, tiny: Tiny, make_trainer: Callable[..., Trainer]
) -> None:
    model = make_method("Voca", learning_rate=0.0, motion_scale="none", components=2)
    make_trainer(limit_train_batches=1, limit_val_batches=0).fit(model, datamodule=tiny)
    _, shapes = tiny.principal_motion(2, torch.ones(3 * model.n_vertices))
    torch.testing.assert_close(model.network.expression.weight.detach(), shapes.T)
    assert not model.network.expression.bias.any()


# The audio encoder by itself.


def test_deepspeech_is_an_encoder_of_any_model(tmp_path: Path, make_method: Make) -> None:
    _, graph = write_voca(tmp_path)
    encoder = DeepSpeechEncoder(dim=None, source=str(graph))
    assert encoder.width == 29
    assert not any(parameter.requires_grad for parameter in encoder.parameters())
    speech = speech_of(8000)
    features, lengths = encoder.frozen_features(speech[None], torch.tensor([8000]))
    torch.testing.assert_close(
        features[0], torch.from_numpy(voca.logits(speech.numpy(), voca.deepspeech_state())).float(), rtol=0, atol=1e-5
    )
    assert lengths.tolist() == [len(features[0])]
    model = with_assets(make_method("FaceFormer", audio_encoder=partial(DeepSpeechEncoder, source=str(graph))))
    made = model.animate(speech, identity="A")
    save_model(model, tmp_path / "model.ckpt")
    graph.unlink()
    assert torch.equal(load_model(tmp_path / "model.ckpt").animate(speech, identity="A").vertices, made.vertices)
    with pytest.raises(FaceDiffError, match=r"audio_encoder\.source"):
        DeepSpeechEncoder(dim=None, source=str(graph))
    with pytest.raises(FaceDiffError, match="config"):
        DeepSpeechEncoder(dim=None, config={**encoder.sizes, "cell": -1})


def test_what_is_not_needed_is_reported(tmp_path: Path) -> None:
    files = write_voca(tmp_path)
    state = voca.deepspeech_state() | {"other/table": np.ones(3, np.float32)}
    write_arrays(files[1], state)
    made = import_files(files, ImportOptions(dataset="vocaset", identities=IDENTITIES, templates=templates()))
    assert "other/table" in made.files.ignored
    assert "SpeechEncoder/conv1/weights/Adam_1" in made.files.ignored
