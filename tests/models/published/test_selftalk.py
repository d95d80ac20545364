"""SelfTalk against its formulas: inference, the lip reader, the loss, and where the lip reader's vertices come from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning.pytorch import Trainer

from facediff.callbacks.averaging import EmaWithWarmup
from facediff.data import collate
from facediff.errors import FaceDiffError
from facediff.models import AnimationModel, SelfTalk, load_model
from facediff.models.published.import_options import ImportOptions
from facediff.models.published.importing import import_files, save_model
from facediff.models.published.selftalk import Transcription
from tests.fakes import published
from tests.fakes.published import COORDINATES, IDENTITIES, LIPS, VERTICES
from tests.fakes.tiny import Tiny
from tests.models.published.author import face, imported, sample_of, speech_of, templates

LIP_OPTIONS: dict[str, Any] = {"lip_reader": "text", "lip_vertices": LIPS}


@pytest.mark.parametrize(
    ("dataset", "steps", "frames"),
    [
        ("vocaset", 40, 24),
        ("vocaset", 41, 24),
        ("vocaset", 205, 122),
        ("biwi", 41, 20),
        ("biwi", 40, 20),
        ("biwi", 58, 29),
    ],
)
def test_it_gives_what_the_formulas_give(dataset: str, steps: int, frames: int, tmp_path: Path) -> None:
    state = published.selftalk_state(dataset)
    model = imported(state, tmp_path, dataset)
    assert isinstance(model, SelfTalk)
    offsets = published.selftalk_offsets(state, speech_of(steps), dataset)
    assert len(offsets) == frames
    for name in IDENTITIES:  # whoever it is conditioned on, since it knows no speakers
        made = model.animate(speech_of(steps), identity=name, condition="B").vertices.flatten(1)
        torch.testing.assert_close(made, offsets + face(name), rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("dataset", "frames", "steps"), [("vocaset", 24, 40), ("vocaset", 69, 114), ("biwi", 29, 57), ("biwi", 20, 40)]
)
def test_the_lip_reader_reads(dataset: str, frames: int, steps: int, tmp_path: Path) -> None:
    state = published.selftalk_state(dataset)
    model = imported(state, tmp_path, dataset, **LIP_OPTIONS)
    assert isinstance(model, SelfTalk)
    offsets = torch.randn(2, frames, COORDINATES, generator=torch.Generator().manual_seed(frames))
    lengths = torch.tensor([frames, frames - 9])
    made = model.read_lips(offsets.view(2, frames, VERTICES, 3), lengths)
    assert made.shape == (2, steps, published.LETTERS)
    for row, count in enumerate(lengths.tolist()):
        own = int(count / published.RATES[dataset] * 50)
        _, expected = published.selftalk_reading(state, offsets[row, :count], own)
        torch.testing.assert_close(made[row, :own], expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize(("dataset", "frames"), [("vocaset", 25), ("biwi", 18), ("biwi", 23)])
def test_the_loss(dataset: str, frames: int, tmp_path: Path) -> None:
    """1000 of positions, 1000 of velocities, 0.001 of the lip reader's features, 0.0001 of CTC."""
    state = published.selftalk_state(dataset)
    model = imported(state, tmp_path, dataset, **LIP_OPTIONS)
    speech = speech_of(40)
    truth = 0.1 * torch.randn(frames, VERTICES, 3, generator=torch.Generator().manual_seed(1))
    losses = model.losses(collate([sample_of(speech, truth, identity=1)]))
    count = min(frames, 20) if dataset == "biwi" else frames  # motion beyond the pairs of steps is cut
    made = published.selftalk_offsets(state, speech, dataset, count)
    error = made - truth.flatten(1)[:count]
    hidden, transcript = published.selftalk_text(state, speech)
    features, letters = published.selftalk_reading(state, made, len(hidden))
    assert len(transcript) > 2
    expected = {
        "reconstruction": error.square().mean().item(),
        "velocity": (error[1:] - error[:-1]).square().mean().item(),
        "consistency": (features - hidden).square().mean().item(),
        "ctc": published.ctc_of(letters.double().numpy(), transcript) / len(transcript),
    }
    found = {name: losses[name].item() for name in expected}
    assert found == pytest.approx(expected, rel=1e-4)
    weights = {"reconstruction": 1e3, "velocity": 1e3, "consistency": 1e-3, "ctc": 1e-4}
    total = sum(weights[name] * value for name, value in expected.items())
    assert losses["loss"].item() == pytest.approx(total, rel=1e-4)
    # Positions and velocities, a million times the lip reader's terms, would hide a weight at the wrong one.
    model.vertex_weight = model.velocity_weight = 0.0
    losses = model.losses(collate([sample_of(speech, truth, identity=1)]))
    total = 1e-3 * losses["consistency"].item() + 1e-4 * losses["ctc"].item()
    assert losses["loss"].item() == pytest.approx(total, rel=1e-5)


def test_a_transcript_has_no_blanks_and_keeps_letters_that_a_blank_divides() -> None:
    letters = torch.tensor([[0, 3, 3, 0, 3, 5, 5, 0, 7, 7], [0, 0, 4, 4, 0, 9, 9, 9, 9, 9]])
    said = Transcription(torch.zeros(2, 10, 1), letters, torch.tensor([9, 5]), 0).transcripts()
    assert [row.tolist() for row in said] == [[3, 3, 5, 7], [4]]


def test_the_recogniser_hears_each_clip_by_itself(tmp_path: Path) -> None:
    """And runs without dropout, also in training."""
    state = published.selftalk_state("vocaset")
    model = imported(state, tmp_path, "vocaset", **LIP_OPTIONS).train()
    assert isinstance(model, SelfTalk)
    assert model.text is not None
    samples = [sample_of(speech_of(steps), torch.zeros(24, VERTICES, 3), identity=0) for steps in (41, 58)]
    batch = collate(samples)
    heard = model.text(batch.audio, batch.audio_lengths)
    transcripts = heard.transcripts()
    for row, steps in enumerate((41, 58)):
        hidden, transcript = published.selftalk_text(state, speech_of(steps))
        torch.testing.assert_close(heard.features[row, :steps], hidden, rtol=0, atol=1e-5)
        assert transcripts[row].tolist() == transcript
    assert not any(p.requires_grad for p in model.text.parameters())


def test_speech_without_a_letter_has_a_loss(tmp_path: Path) -> None:
    state = published.selftalk_state("vocaset")
    state["text_encoder.lm_head.bias"][0] = 1e4  # blanks alone
    model = imported(state, tmp_path, "vocaset", **LIP_OPTIONS)
    loss = model.losses(collate([sample_of(speech_of(40), torch.zeros(24, VERTICES, 3), identity=0)]))
    assert loss["ctc"].isfinite()


def test_the_lip_reader_is_left_out_of_an_import_and_reported(tmp_path: Path) -> None:
    state = published.selftalk_state("vocaset")
    torch.save(state, tmp_path / "author.pth")
    made = import_files(
        tmp_path / "author.pth",
        ImportOptions(dataset="vocaset", templates=templates(), audio_config=published.AUDIO_CONFIG),
    )
    parts = ("text_encoder.", "lip_map.", "transformer.", "lm_head.")
    assert set(made.files.ignored) == {name for name in state if name.startswith(parts)}
    assert isinstance(made.model, SelfTalk)
    with pytest.raises(FaceDiffError, match="lip_vertices"):
        imported(state, tmp_path, "vocaset", lip_reader="text")
    with pytest.raises(FaceDiffError, match="lip_reader"):
        made.model.read_lips(torch.zeros(1, 5, VERTICES, 3))
    assert {label.commercial for label in made.model.licences} >= {"forbidden"}
    save_model(made.model, tmp_path / "model.ckpt")
    speech = speech_of(40)
    one, other = (
        each.animate(speech, identity="A").vertices for each in (made.model, load_model(tmp_path / "model.ckpt"))
    )
    assert torch.equal(one, other)


def test_the_lip_reader_is_of_the_corpus_and_is_kept_and_averaged(
    make_method: Callable[..., AnimationModel], tiny: Tiny, make_trainer: Callable[..., Trainer], tmp_path: Path
) -> None:
    model = make_method("SelfTalk")
    assert isinstance(model, SelfTalk)
    assert model.reader is None
    average = EmaWithWarmup()
    trainer = make_trainer(limit_train_batches=2, callbacks=[average])
    trainer.fit(model, datamodule=tiny)
    assert model.hparams["lip_vertices"] == list(range(12))
    trainer.save_checkpoint(tmp_path / "model.ckpt", weights_only=True)
    loaded = load_model(tmp_path / "model.ckpt")
    assert isinstance(loaded, SelfTalk)
    motion = torch.randn(1, 30, 24, 3, generator=torch.Generator().manual_seed(0))
    assert torch.equal(loaded.read_lips(motion), model.eval().read_lips(motion))
    batch = collate([tiny.dataset("train")[0]])
    assert torch.equal(loaded.losses(batch)["loss"], model.losses(batch)["loss"])


def test_without_a_lip_reader_its_terms_are_left_out(make_method: Callable[..., AnimationModel], tiny: Tiny) -> None:
    model = make_method("SelfTalk", lip_reader="none", text_config=None)
    model.adopt(tiny.assets().with_motion_scale(1.0))
    batch = collate([tiny.dataset("train")[0]])
    losses = model.losses(batch)
    assert losses.keys() == {"reconstruction", "velocity", "loss"}
    still = replace(batch, motion=batch.motion[:, :1], frame_lengths=batch.frame_lengths * 0 + 1)
    assert model.losses(still)["loss"].isfinite()  # a single frame has no velocity


def test_the_recogniser_is_read_from_a_folder_and_kept(
    make_method: Callable[..., AnimationModel], tiny: Tiny, ctc_source: Path, tmp_path: Path
) -> None:
    model = make_method("SelfTalk", text_config=None, text_source=str(ctc_source))
    model.adopt(tiny.assets().with_motion_scale(1.0))
    assert isinstance(model, SelfTalk)
    assert model.text is not None
    assert (model.text.width, model.text.letters) == (16, 29)
    save_model(model, tmp_path / "model.ckpt")
    content = torch.load(tmp_path / "model.ckpt", weights_only=True)
    content["hyper_parameters"]["text_source"] = "./nowhere"  # it is read from the checkpoint alone
    torch.save(content, tmp_path / "moved.ckpt")
    loaded = load_model(tmp_path / "moved.ckpt")
    batch = collate([tiny.dataset("train")[0]])
    assert torch.equal(loaded.losses(batch)["loss"], model.eval().losses(batch)["loss"])


def test_a_checkpoint_cannot_have_a_recogniser_fetched(
    make_method: Callable[..., AnimationModel], tiny: Tiny, tmp_path: Path
) -> None:
    model = make_method("SelfTalk")
    model.adopt(tiny.assets().with_motion_scale(1.0))
    save_model(model, tmp_path / "model.ckpt")
    content = torch.load(tmp_path / "model.ckpt", weights_only=True)
    content["hyper_parameters"].update(text_config=None, text_source="somebody/else")
    torch.save(content, tmp_path / "changed.ckpt")
    with pytest.raises(FaceDiffError, match="text_config"):
        load_model(tmp_path / "changed.ckpt")
