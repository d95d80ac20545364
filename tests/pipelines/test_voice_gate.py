"""The mouth comes to rest in pauses, in files and streams alike, and nowhere else."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import facediff
from facediff.speech.audio import read_speech
from facediff.speech.pitch import shifted_by_pieces
from facediff.speech.voice_activity import openness, read_gate


@pytest.fixture
def speech(puppet_corpus: Path) -> np.ndarray:
    """A sentence between two seconds of faint noise each."""
    said = read_speech(puppet_corpus / "wav" / "F1_t01.wav")
    quiet = np.zeros(32_000, np.float32)
    made = np.concatenate([quiet, said, quiet])
    return made + (1e-3 * np.random.default_rng(0).standard_normal(len(made))).astype(np.float32)


def test_mouth_rests_in_pauses_and_speech_is_untouched(model: facediff.Animator, speech: np.ndarray) -> None:
    made = model.animate(speech, 16_000, identity="F1")
    free = model.animate(speech, 16_000, identity="F1", voice_gate="off").vertices
    gate = read_gate("energy")
    assert gate is not None
    opened = openness(speech, len(free), 25.0, gate)
    assert 0 in opened
    assert 1 in opened
    np.testing.assert_array_equal(made.vertices[opened == 1], free[opened == 1])
    lips, upper = made.regions["lips"], made.regions["upper_face"]
    resting = made.vertices[opened == 0]
    np.testing.assert_allclose(
        resting[:, lips], np.broadcast_to(made.template[lips], resting[:, lips].shape), atol=1e-7
    )
    np.testing.assert_array_equal(resting[:, upper], free[opened == 0][:, upper])
    assert not np.array_equal(resting, free[opened == 0])
    assert made.metadata["voice gate"] == "energy"


def test_stream_is_the_file(model: facediff.Animator, speech: np.ndarray) -> None:
    model.module.windows = facediff.models.inference.WindowPlan(seconds=2.0, overlap=0.04, above=0.0)
    options = {"identity": "F1", "voice_gate": "energy:release=0.3", "seed": 3}
    whole = model.animate(speech, 16_000, **options).vertices
    random, start, parts = np.random.default_rng(1), 0, []
    chunks = []
    while start < len(speech):
        length = int(random.integers(1, 20_000))
        chunks.append(speech[start : start + length])
        start += length
    parts = list(model.stream(chunks, **options))
    assert len(parts) > 1
    np.testing.assert_array_equal(np.concatenate(parts), whole)


def test_silence_is_a_face_at_rest(model: facediff.Animator) -> None:
    made = model.animate(np.zeros(32_000), 16_000, identity="F1")
    lips = made.regions["lips"]
    assert len(made.vertices) == 50
    assert np.abs(made.vertices[:, lips] - made.template[lips]).max() < 1e-7


def test_denoising_changes_what_is_heard_and_not_what_is_kept(model: facediff.Animator, speech: np.ndarray) -> None:
    pytest.importorskip("noisereduce")
    noisy = speech + (0.05 * np.random.default_rng(2).standard_normal(len(speech))).astype(np.float32)
    plain, clean = (model.animate(noisy, 16_000, voice_gate="off", denoise=each) for each in (False, True))
    assert not np.array_equal(plain.vertices, clean.vertices)
    np.testing.assert_array_equal(plain.speech, clean.speech)
    assert clean.metadata["denoised"] == "yes"
    from facediff.speech.audio import denoised

    quiet = slice(4000, 28_000)
    assert np.std(denoised(noisy)[quiet]) < 0.3 * np.std(noisy[quiet])
    assert not denoised(np.zeros(16_000, np.float32)).any()


def test_a_shifted_voice_is_heard_and_the_recording_kept(model: facediff.Animator, speech: np.ndarray) -> None:
    plain, lower = (model.animate(speech, 16_000, voice_shift=semitones) for semitones in (0, -4))
    heard = model.animate(shifted_by_pieces(speech.astype(np.float32), 2 ** (-4 / 12)), 16_000)
    assert not np.array_equal(plain.vertices, lower.vertices)
    np.testing.assert_array_equal(heard.vertices, lower.vertices)
    np.testing.assert_array_equal(plain.speech, lower.speech)
    assert lower.metadata["voice shift"] == "-4 semitones"
    assert "voice shift" not in plain.metadata
