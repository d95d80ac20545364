"""DiffSpeaker gives what its published inference gives, by a reference that shares no code with it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from facediff.data import Batch, collate
from facediff.errors import FaceDiffError
from facediff.models import AnimationModel, DiffSpeaker, Style, import_checkpoint
from facediff.models.published.import_options import ImportOptions
from facediff.models.published.importing import import_files
from tests.fakes import diffspeaker, published
from tests.fakes.published import COORDINATES, IDENTITIES
from tests.models.published.author import face, imported, speech_of, templates
from tests.models.published.test_laws import clips, with_assets

MakeMethod = Callable[..., AnimationModel]


def model_of(state: published.State, folder: Path, dataset: str, **options: Any) -> DiffSpeaker:  # noqa: ANN401
    model = imported(state, folder, dataset, **options)
    assert isinstance(model, DiffSpeaker)
    return model


def noise_of(frames: int, seed: int) -> Tensor:
    return torch.randn(1, frames, COORDINATES, generator=torch.Generator().manual_seed(seed))[0]


# 58 and 205 steps of speech are where floating point gives a frame less at 25 and at 30 frames a second.
@pytest.mark.parametrize(
    ("dataset", "steps", "frames"),
    [
        pytest.param("vocaset", 40, 24, marks=pytest.mark.slow),
        ("vocaset", 41, 24),
        ("vocaset", 205, 122),
        pytest.param("biwi", 40, 20, marks=pytest.mark.slow),
        ("biwi", 41, 20),
        pytest.param("biwi", 58, 28, marks=pytest.mark.slow),
    ],
)
def test_parity(dataset: str, steps: int, frames: int, tmp_path: Path) -> None:
    state = diffspeaker.state(dataset)
    model = model_of(state, tmp_path, dataset)
    speech = speech_of(steps)
    assert model.frames_of(len(speech)) == diffspeaker.frames_of(steps, dataset) == frames
    for number, name in enumerate(IDENTITIES[: 1 if steps > 100 else 3]):
        made = model.animate(speech, identity="A", condition=name, seed=number).vertices.flatten(1)
        expected = diffspeaker.reference(state, speech, dataset, number, face("A"), noise_of(frames, number))
        torch.testing.assert_close(made, expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("corrected", [False, True], ids=["published", "ddim"])
def test_both_schedulers(corrected: bool, tmp_path: Path) -> None:
    state = diffspeaker.state("biwi", layers=2, hidden=24)  # each layer has tokens of its own
    scheduler = "ddim" if corrected else "published"
    model = model_of(state, tmp_path, "biwi", scheduler=scheduler, sampling_steps=20)
    made = model.animate(speech_of(41), identity="B", seed=4).vertices.flatten(1)
    expected = diffspeaker.reference(
        state, speech_of(41), "biwi", 1, face("B"), noise_of(20, 4), steps=20, corrected=corrected
    )
    torch.testing.assert_close(made, expected, rtol=0, atol=1e-5)


def test_the_sampler_can_be_chosen(tmp_path: Path) -> None:
    state = diffspeaker.state("vocaset")
    model = model_of(state, tmp_path, "vocaset")
    speech, noise = speech_of(40), noise_of(24, 0)
    before = model.animate(speech, identity="A").vertices.flatten(1)
    with model.choosing():
        model.choose_sampler("ddim", 10)
        made = model.animate(speech, identity="A").vertices.flatten(1)
    expected = diffspeaker.reference(state, speech, "vocaset", 0, face("A"), noise, steps=10, corrected=True)
    torch.testing.assert_close(made, expected, rtol=0, atol=1e-5)
    assert torch.equal(model.animate(speech, identity="A").vertices.flatten(1), before)
    for words in ({"name": "ddpm"}, {"steps": 0}, {"steps": 1001}):
        with pytest.raises(FaceDiffError, match=r"sampler|steps"):
            model.choose_sampler(**words)  # type: ignore[arg-type]


def test_an_unknown_speaker_gets_the_first_row(tmp_path: Path) -> None:
    state = diffspeaker.state("biwi")
    model = model_of(state, tmp_path, "biwi")
    model.assets.templates["Z"] = torch.zeros(published.VERTICES, 3)
    made = model.animate(speech_of(40), identity="Z").vertices.flatten(1)
    expected = diffspeaker.reference(state, speech_of(40), "biwi", 0, torch.zeros(()), noise_of(20, 0))
    torch.testing.assert_close(made, expected, rtol=0, atol=1e-5)


def test_rows_of_speakers_are_mixed(tmp_path: Path) -> None:
    state = diffspeaker.state("biwi")
    model = model_of(state, tmp_path, "biwi")
    model.assets.templates["Z"] = torch.zeros(published.VERTICES, 3)  # whose row would be the first one
    shares = torch.tensor([0.0, 0.25, 0.75])
    made = model.animate(speech_of(40), identity="Z", style=Style("B and C", shares)).vertices.flatten(1)
    row = shares @ state["denoiser.obj_vector.weight"]
    expected = diffspeaker.reference(state, speech_of(40), "biwi", 0, torch.zeros(()), noise_of(20, 0), row=row)
    torch.testing.assert_close(made, expected, rtol=0, atol=1e-5)


# Training.


def test_the_loss_is_that_of_the_formula(make_method: MakeMethod) -> None:
    """A mean over all numbers of a padded batch, as published."""
    model = with_assets(make_method("DiffSpeaker", motion_scale="none"))
    assert isinstance(model, DiffSpeaker)
    batch = collate(clips(9, 14))
    step, noise = torch.tensor([3, 700]), torch.randn(2, 14, 3 * model.n_vertices)
    found = model.losses_at(batch, step, noise)
    signal, position, velocity = diffspeaker.signal_of(), [], []
    for row, frames in enumerate((9, 14)):
        alone: Batch = batch.select([row])
        one = replace(alone, motion=alone.motion[:, :frames])
        clean = one.motion.flatten(2)
        noisy = signal[step[row]].sqrt() * clean + (1 - signal[step[row]]).sqrt() * noise[row : row + 1, :frames]
        given = model.conditions(one, torch.tensor([frames]))
        made = model.network.motion_out(model.network(model.network.motion_in(noisy), step[row : row + 1], given))
        error = torch.nn.functional.pad(made - clean, (0, 0, 0, 14 - frames))[0]  # as the mask leaves it
        position.append(error.square())
        velocity.append(error.diff(dim=0).square())
    expected = torch.cat(position).mean() + torch.cat(velocity).mean()
    torch.testing.assert_close(found["loss"], expected, rtol=1e-5, atol=1e-7)


def test_more_frames_than_the_tables_have(make_method: MakeMethod, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(DiffSpeaker, "table_frames", 20)
    speech = 0.1 * torch.randn(21 * 640 + 400, generator=torch.Generator().manual_seed(2))
    sizes = {}
    for way in ("refuse", "windows", "extend"):
        model = with_assets(make_method("DiffSpeaker", long_speech=way))
        if way == "refuse":
            with pytest.raises(FaceDiffError, match="long_speech"):
                model.animate(speech, identity="A")
            short = model.animate(speech[: 20 * 640 + 80], identity="A").vertices
            assert len(short) == 20
            with pytest.raises(FaceDiffError, match="clip1: 1.0 s"):
                model.losses(collate(clips(9, 24)))
        else:
            sizes[way] = len(model.animate(speech, identity="A").vertices)
    assert sizes == {"windows": 21, "extend": 21}


# The authors' checkpoints.


def test_a_container_of_lightning_with_all_that_it_keeps(tmp_path: Path) -> None:
    """Optimiser, loops and callbacks of a training, whose tensors are not those of the model."""
    state = diffspeaker.state("vocaset")
    moments = {number: {"step": 3, "exp_avg": value.clone()} for number, value in enumerate(state.values())}
    content = {
        "epoch": 8999,
        "global_step": 90_000,
        "pytorch-lightning_version": "1.9.0",
        "state_dict": state,
        "loops": {"fit_loop": {"state_dict": {}, "epoch_progress": {"total": {"ready": 9000}}}},
        "callbacks": {"ModelCheckpoint{'monitor': None}": {"best_model_score": torch.tensor(1.0)}},
        "optimizer_states": [{"state": moments, "param_groups": [{"lr": 1e-4, "params": [*moments]}]}],
        "lr_schedulers": [],
        "MixedPrecisionPlugin": {"scale": 65536.0},
    }
    model = model_of(content, tmp_path, "vocaset")  # type: ignore[arg-type]
    assert torch.equal(model.network.motion_out.weight, state["denoiser.motion_decoder.weight"])


def test_the_table_of_positions_may_be_missing_but_not_another(tmp_path: Path) -> None:
    state = diffspeaker.state("vocaset")
    speech = speech_of(40)
    whole = model_of(state, tmp_path, "vocaset").animate(speech, identity="A").vertices
    table = state.pop("denoiser.PPE.pe")
    assert torch.equal(model_of(state, tmp_path, "vocaset").animate(speech, identity="A").vertices, whole)
    for wrong, named in ((table + 0.1, "PPE.pe"), (published.positions(5025, 16, 25)[None], "dataset vocaset")):
        torch.save(state | {"denoiser.PPE.pe": wrong}, tmp_path / "author.pth")
        with pytest.raises(FaceDiffError, match=named):
            import_checkpoint(
                tmp_path / "author.pth",
                dataset="vocaset",
                identities=IDENTITIES,
                templates=templates(),
                audio_config=published.AUDIO_CONFIG,
            )


def test_what_is_not_needed_is_reported(tmp_path: Path) -> None:
    state = diffspeaker.state("biwi") | {"_losses.total": torch.zeros(1)}
    torch.save(state, tmp_path / "author.ckpt")
    made = import_files(
        tmp_path / "author.ckpt",
        ImportOptions(
            dataset="biwi", identities=IDENTITIES, templates=templates(), audio_config=published.AUDIO_CONFIG
        ),
    )
    assert set(made.files.ignored) == {"denoiser.PPE.pe", "_losses.total"}
    assert any(licence.commercial == "unknown" for licence in made.model.licences)
