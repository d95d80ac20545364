"""A distilled audio encoder gives the teacher's features of augmented speech; the rest stays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
import torch

from facediff.data.augmentation import Augmenter, filtered, read_augmentations
from facediff.errors import FaceDiffError
from facediff.models.audio_distillation import (
    DistillationOptions,
    SpeechPairs,
    distil_audio_encoder,
    encoder_weights,
    read_recordings,
)
from facediff.models.base import AnimationModel
from facediff.speech.audio import write_wav
from tests.fakes.tiny import Tiny

FEW = DistillationOptions(steps=3, batch_size=2, workers=0)


@pytest.fixture
def model(make_model: Callable[..., AnimationModel]) -> AnimationModel:
    return make_model()


def muffled(speech: np.ndarray) -> np.ndarray:
    """Speech through a door, which no augmentation is."""
    quieter = filtered(speech, lambda hertz: 1 / (1 + (hertz / 250) ** 2))
    return (quieter + 0.02 * np.random.default_rng(1).standard_normal(len(speech))).astype(np.float32)


def features(model: AnimationModel, speech: np.ndarray) -> torch.Tensor:
    count = torch.tensor([len(speech)])
    with torch.inference_mode():
        return model.speech_encoder(torch.from_numpy(speech)[None], count, count // 640)[0]


def test_speech_that_was_never_trained_on_is_heard_better(model: AnimationModel, tiny: Tiny) -> None:
    """On test clips, by a change that training does not use, and clean speech stays."""
    speech = [tiny.dataset("test_a")[index].audio.numpy() for index in range(4)]
    wanted = [features(model, each) for each in speech]

    def error(change: bool) -> float:
        made = [features(model, muffled(each) if change else each) for each in speech]
        return float(torch.cat([(one - two).square() for one, two in zip(made, wanted, strict=True)]).mean())

    before = error(change=True)
    distil_audio_encoder(
        model, tiny, DistillationOptions(steps=60, batch_size=6, workers=0, interpolation=1.0, learning_rate=3e-3)
    )
    assert error(change=True) < 0.5 * before
    assert error(change=False) < 0.2 * before


def test_only_the_audio_encoder_changes(model: AnimationModel, tiny: Tiny) -> None:
    before = {name: value.clone() for name, value in model.state_dict().items()}
    distil_audio_encoder(model, tiny, FEW)
    changed = {name for name, value in model.state_dict().items() if not torch.equal(value, before[name])}
    assert changed
    assert changed <= set(encoder_weights(model))
    assert not model.speech_encoder.training
    assert all(weight.requires_grad for weight in model.parameters())


def test_weights_go_a_share_of_the_way(make_model: Callable[..., AnimationModel], tiny: Tiny) -> None:
    """0 is the model as it was, and a half lies in the middle between that and all of the way."""
    ends = {}
    for interpolation in (0.0, 0.5, 1.0):
        model = make_model()
        distil_audio_encoder(model, tiny, replace(FEW, interpolation=interpolation))
        ends[interpolation] = encoder_weights(model)
    for name, before in encoder_weights(make_model()).items():
        assert torch.equal(ends[0.0][name], before)
        torch.testing.assert_close(ends[0.5][name], (before + ends[1.0][name]) / 2)


def test_the_seed_decides_whatever_process_changes_speech(
    make_model: Callable[..., AnimationModel], tiny: Tiny
) -> None:
    """And nothing else does, nor are other random numbers moved on."""
    made = []
    for seed, workers in ((0, 0), (0, 1), (1, 0)):
        model = make_model()
        torch.manual_seed(len(made))
        distil_audio_encoder(model, tiny, replace(FEW, seed=seed, workers=workers))
        after = torch.rand(1)
        torch.manual_seed(len(made))
        assert torch.equal(after, torch.rand(1))
        made.append(encoder_weights(model))
    assert all(torch.equal(made[0][name], made[1][name]) for name in made[0])
    assert not all(torch.equal(made[0][name], made[2][name]) for name in made[0])


def test_what_cannot_be_learnt_is_refused(model: AnimationModel, tiny: Tiny) -> None:
    with pytest.raises(FaceDiffError, match='no augmentation "voices"'):
        distil_audio_encoder(model, tiny, replace(FEW, augmentations=["voices"]))
    model.speech_encoder.requires_grad_(False)
    with pytest.raises(FaceDiffError, match="audio_encoder"):
        distil_audio_encoder(model, tiny, FEW)


class Talks(Tiny):
    """A corpus with further speech, and a note of what was asked of it."""

    asked: ClassVar[list[int]] = []

    def further_speech(self) -> Callable[[int], np.ndarray]:
        def tone(number: int) -> np.ndarray:
            self.asked.append(number)
            return np.sin(np.arange(8000 + number) / 9).astype(np.float32)

        return tone


def test_further_speech_is_heard_as_often_as_clips(make_model: Callable[..., AnimationModel], tiny_root: Path) -> None:
    data = Talks(root=str(tiny_root))
    distil_audio_encoder(make_model(), data, replace(FEW, steps=12, extra_speech=500))
    assert 0 <= min(data.asked) < max(data.asked) < 500
    assert 6 <= len(data.asked) <= 18  # of 24, without what is asked for a second time
    data.asked.clear()
    distil_audio_encoder(make_model(), data, replace(FEW, extra_speech=0))
    assert not data.asked


def test_people_are_heard_in_their_share_of_the_pieces(tiny: Tiny, tmp_path: Path) -> None:
    loud = np.random.default_rng(0).uniform(-0.5, 0.5, 80_000).astype(np.float32)
    (tmp_path / "reader").mkdir()
    write_wav(tmp_path / "reader" / "a.wav", loud, 16_000)
    options = replace(FEW, steps=20, batch_size=8, pauses=0, share=0, people=tmp_path, recorded_share=0.25)
    (speech,) = recordings = read_recordings(tmp_path, seed=0)
    np.testing.assert_allclose(speech, loud, atol=1e-4)
    pairs = SpeechPairs(tiny, Augmenter([]), options, recordings)
    lengths = torch.cat([pairs[index].lengths for index in range(len(pairs))])
    heard = (lengths == 4 * 16_000).float().mean()  # clips of the corpus are shorter
    assert heard == pytest.approx(0.25, abs=0.1)
    with pytest.raises(FaceDiffError, match="no recording there"):
        read_recordings(tmp_path / "nowhere", seed=0)


def test_the_background_goes_on_where_the_teacher_hears_a_pause(tiny: Tiny) -> None:
    options = replace(FEW, extra_speech=0, pauses=1.0, share=1.0, steps=20)
    augmenter = Augmenter(read_augmentations(["music:share=1,least=6,most=6"]))
    pairs = SpeechPairs(tiny, augmenter, options)
    pauses = 0
    for number in range(len(pairs)):
        batch = pairs[number]
        for clean, student, length in zip(batch.clean, batch.augmented, batch.lengths.tolist(), strict=True):
            steps = length // 160
            quiet, heard = (each[: steps * 160].reshape(steps, 160).abs().amax(1) for each in (clean, student))
            paused = (quiet < 1e-3 * clean.abs().max()).numpy()
            pauses += paused.sum() >= 25  # steps of 10 ms
            assert float(heard[torch.from_numpy(paused)].mean()) > 0.01 * float(student.abs().max())
    assert pauses > 20
