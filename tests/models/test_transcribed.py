"""People's recordings with their words are aligned with the same words by the corpus, and teach an audio encoder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch

from facediff.data import Puppet
from facediff.errors import FaceDiffError
from facediff.models.audio_distillation import DistillationOptions, distil_audio_encoder, with_pause_in_both
from facediff.models.base import AnimationModel
from facediff.models.transcribed import STEP_RATE, TranscribedRecording, read_transcribed
from tests.fakes.tiny import Tiny

TEXT = "mabopimeba"
OPTIONS = DistillationOptions(steps=40, batch_size=4, workers=0, interpolation=1.0, learning_rate=3e-3, share=0.0)


def sung(text: str, seconds: float, brightness: float = 1.0) -> np.ndarray:
    """Each letter is a chord of its own, of so many seconds."""
    time = np.arange(round(seconds * 16_000)) / 16_000
    tones = [200 + 61 * (ord(letter) * 7 % 23) for letter in text]
    chords = [np.sin(2 * np.pi * tone * time) + brightness * np.sin(2 * np.pi * 2.7 * tone * time) for tone in tones]
    return (0.2 * np.concatenate(chords)).astype(np.float32)


class Singers(Tiny):
    """A corpus whose speakers sing what they are told, ten letters a second, and backwards in Hebrew."""

    def say(self, text: str, number: int, language: str = "") -> np.ndarray:
        assert number >= 0
        if language not in {"", "he"}:
            raise FaceDiffError(f'language "{language}": nobody sings in it')
        return sung(text[::-1] if language else text, 0.1)


@pytest.fixture
def data(tiny_root: Path) -> Singers:
    made = Singers(root=str(tiny_root))
    made.prepare_data()
    made.setup("fit")
    return made


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A slower and duller singer, below a folder of its own."""
    (tmp_path / "people" / "one").mkdir(parents=True)
    soundfile.write(tmp_path / "people" / "one" / "a.wav", sung(TEXT, 0.14, 0.4), 16_000)
    (tmp_path / "people" / "one" / "a.txt").write_text(f"{TEXT}\n", encoding="utf-8")
    return tmp_path / "people"


def test_steps_go_with_the_same_letters(folder: Path, data: Singers, make_model: Callable[..., AnimationModel]) -> None:
    (recording,) = read_transcribed(folder, data, make_model().speech_encoder.eval(), limit=9, seed=0)
    letters = np.arange(len(recording.teacher_steps)) / STEP_RATE / 0.14
    assert len(letters) == round(0.14 * len(TEXT) * STEP_RATE)
    assert np.abs(recording.teacher_steps / STEP_RATE / 0.1 - letters).max() < 0.5
    assert abs(float(np.abs(recording.recording).max()) - float(np.abs(recording.synthesised).max())) < 1e-3


def test_the_name_of_a_text_says_its_language(
    folder: Path, data: Singers, make_model: Callable[..., AnimationModel]
) -> None:
    words = folder / "one" / "a.txt"
    words.rename(words.with_name("a.he.txt"))
    words.with_name("b.txt").write_text("of no recording", encoding="utf-8")
    encoder = make_model().speech_encoder.eval()
    (backwards,) = read_transcribed(folder, data, encoder, limit=9, seed=0)
    assert np.array_equal(backwards.synthesised, sung(TEXT[::-1], 0.1).astype(np.float16))
    words.write_text(TEXT, encoding="utf-8")
    (forwards,) = read_transcribed(folder, data, encoder, limit=9, seed=0)
    assert np.array_equal(forwards.synthesised, sung(TEXT, 0.1).astype(np.float16))


def test_two_recordings_share_a_text(folder: Path, data: Singers, make_model: Callable[..., AnimationModel]) -> None:
    soundfile.write(folder / "one" / "a.flac", sung(TEXT, 0.12), 16_000)
    both = read_transcribed(folder, data, make_model().speech_encoder.eval(), limit=9, seed=0)
    assert sorted(len(recording.recording) for recording in both) == [
        round(16_000 * each * len(TEXT)) for each in (0.12, 0.14)
    ]


def test_a_window_is_of_both(folder: Path, data: Singers, make_model: Callable[..., AnimationModel]) -> None:
    """Samples that carry their own number say where a window was cut."""
    places = np.arange(200) * 2 // 3
    counted = (np.arange(200 * 320) // 320).astype(np.float16)
    recording = TranscribedRecording(counted, counted[: 150 * 320], places)
    for seed in range(5):
        spoken, heard, within = recording.window(1.0, np.random.default_rng(seed))
        assert len(heard) == 50 * 320
        steps = heard[::320].astype(int)
        assert np.array_equal(spoken[within * 320].astype(int), places[steps])
        assert len(spoken) <= (within.max() - within.min() + 1 + 50) * 320


def test_a_pause_lies_between_the_same_sounds_of_both() -> None:
    """Samples that carry their own number, and a pause in which both are faint."""
    places = np.arange(100) * 3 // 2
    heard = np.repeat(1 + np.arange(100), 320).astype(np.float32)
    spoken = np.repeat(1 + np.arange(150), 320).astype(np.float32)
    positions = set()
    for seed in range(30):
        quiet, still, within = with_pause_in_both(spoken, heard, places, np.random.default_rng(seed))
        assert len(still) == len(heard)
        steps, taught = still[::320], quiet[within * 320]
        paused = np.abs(steps) < 0.5
        assert 14 <= paused.sum() <= 50
        assert np.array_equal(np.abs(taught) < 0.5, paused)
        assert np.array_equal(taught[~paused], spoken[places[steps[~paused].astype(int) - 1] * 320])
        positions.add(int(np.argmax(paused)))
    assert len(positions) > 10


def test_the_student_hears_the_singer_as_the_teacher_hears_the_corpus(
    folder: Path, data: Singers, make_model: Callable[..., AnimationModel]
) -> None:
    teacher = make_model().speech_encoder.eval()
    (recording,) = read_transcribed(folder, data, teacher, limit=9, seed=0)
    speech, synthesised = (torch.from_numpy(wave.astype(np.float32))[None] for wave in recording[:2])

    def features(encoder: torch.nn.Module, speech: torch.Tensor) -> torch.Tensor:
        count = torch.tensor([speech.shape[1]])
        with torch.inference_mode():
            return encoder(speech, count, count * STEP_RATE // 16_000)[0]

    target = features(teacher, synthesised)[torch.from_numpy(recording.teacher_steps)]

    def error(**options: object) -> float:
        model = make_model()
        distil_audio_encoder(model, data, replace(OPTIONS, **options))  # type: ignore[arg-type]
        return float((features(model.speech_encoder, speech) - target).square().mean())

    assert error(transcribed=folder, transcribed_share=0.8) < 0.3 * error()


def test_speakers_of_the_built_in_corpus_take_turns(tmp_path: Path) -> None:
    data = Puppet(root=str(tmp_path / "none"))
    first, second, again = (data.say("My map", number) for number in (0, 1, 6))
    assert not np.array_equal(data.say("My map", 0, "de"), first)
    with pytest.raises(FaceDiffError, match='language "dee": .*did you mean "de"'):
        data.say("My map", 0, "dee")
    assert first.dtype == np.float32
    assert 0.4 < len(first) / 16_000 < 2.0
    assert not np.array_equal(first, second)
    assert np.array_equal(first, again)
