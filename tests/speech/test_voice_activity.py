"""Gates find pauses at every level of noise, keep onsets, and depend on nothing but the speech."""

from __future__ import annotations

import functools
import tempfile
from pathlib import Path

import numpy as np
import onnx
import pytest
import soundfile
from hypothesis import given, settings
from hypothesis import strategies as st

from facediff.errors import FaceDiffError
from facediff.registry import voice_gate
from facediff.speech.voice_activity import EnergyGate, Openness, VoiceGate, openness, read_gate, speech_problems

RATE = 16_000
FRAMES = 25.0


def talk(seconds: float, seed: int = 0) -> np.ndarray:
    """A buzz whose level goes up and down four times a second, by 20 dB, as that of syllables; its mean power is 1."""
    count = round(seconds * RATE)
    time = np.arange(count) / RATE
    pitch = 140 + 20 * np.sin(2 * np.pi * 0.7 * time + seed)
    phase = 2 * np.pi * np.cumsum(pitch) / RATE
    buzz = sum(np.sin(order * phase) / order for order in range(1, 20))
    made = buzz * 10 ** (-0.5 - 0.5 * np.cos(2 * np.pi * 4 * time))
    return made / np.sqrt((made**2).mean())


def sentence_with_pauses(decibels: float, seed: int = 0) -> np.ndarray:
    """1 s of noise, 2 s of speech with it, 1 s of noise, 2 s of speech, 1 s of noise; the ratio is in decibels."""
    quiet = np.zeros(RATE)
    speech = np.concatenate([quiet, talk(2, 1), quiet, talk(2, 2), quiet])
    noise = np.random.default_rng(seed).standard_normal(len(speech))
    return 0.1 * (speech + noise * 10 ** (-decibels / 20))


@pytest.mark.parametrize("decibels", [12, 20, 30, 50, 200])
def test_mouth_rests_in_pauses_and_no_onset_is_cut(decibels: float) -> None:
    found = openness(sentence_with_pauses(decibels), 175, FRAMES, EnergyGate())
    # A frame and a half on either side: what is said begins and ends softly here.
    assert found[[*range(27, 73), *range(102, 148)]].min() > 0.99
    assert found[[*range(18), *range(84, 94), *range(159, 175)]].max() < 0.01


def with_plucked_notes(speech: np.ndarray, decibels: float) -> np.ndarray:
    """Speech with three notes a second that decay, every other one louder by 9 dB."""
    time = np.arange(len(speech)) / RATE
    notes = sum(np.sin(2 * np.pi * (330 + 55 * order) * time) for order in range(4)) * np.exp(-3 * (time % 0.35))
    notes *= np.where(time // 0.35 % 2, 2.8, 1.0)
    return speech + notes / np.sqrt((notes**2).mean()) * 10 ** (-decibels / 20) * 0.1


def test_music_far_behind_the_speech_is_a_pause() -> None:
    found = openness(with_plucked_notes(sentence_with_pauses(200), 18), 175, FRAMES, EnergyGate())
    assert found[[*range(27, 73), *range(102, 148)]].min() > 0.99
    assert found[86:93].max() < 0.01


def test_soft_words_in_quiet_are_speech() -> None:
    """Without anything behind the speech, it may be as soft as it likes."""
    speech = np.concatenate([np.zeros(RATE), 0.1 * talk(2, 1), np.zeros(RATE), 0.02 * talk(2, 2), np.zeros(RATE)])
    assert openness(speech, 175, FRAMES, EnergyGate())[102:148].min() > 0.99


def test_gate_opens_before_speech_by_lead_and_closes_after_hold_within_release() -> None:
    speech = np.concatenate([np.zeros(RATE), talk(1), np.zeros(RATE)])
    times = (np.arange(300) + 0.5) / 100
    found = openness(speech, 300, 100.0, EnergyGate(attack=0.1, lead=0.2, hold=0.3, release=0.2))
    assert found[(times > 0.82) & (times < 2.28)].min() > 0.99
    assert found[(times < 0.68) | (times > 2.54)].max() == 0
    assert np.diff(found).max() < 0.2  # in no hurry
    assert (np.diff(found[times < 1.5]) >= 0).all()


def test_louder_recording_is_gated_alike() -> None:
    soft, loud = (openness(level * sentence_with_pauses(30), 175, FRAMES, EnergyGate()) for level in (0.1, 2))
    np.testing.assert_array_equal(soft, loud)


@pytest.mark.parametrize("seed", [0, 1])
def test_noise_silence_and_hum_alone_are_no_speech(seed: int) -> None:
    noise = np.random.default_rng(seed).standard_normal(4 * RATE)
    hum = np.sin(2 * np.pi * 50 * np.arange(4 * RATE) / RATE) + 0.5 * np.sin(
        2 * np.pi * 150 * np.arange(4 * RATE) / RATE
    )
    for level in (0, 1e-3, 0.3):
        for sound in (noise, hum):
            assert openness(level * sound, 100, FRAMES, EnergyGate()).max() == 0


def test_drawn_out_vowel_after_a_pause_is_speech() -> None:
    time = np.arange(2 * RATE) / RATE
    vowel = sum(np.sin(2 * np.pi * 150 * order * time) / order for order in range(1, 15))
    noise = 1e-3 * np.random.default_rng(0).standard_normal(3 * RATE)
    found = openness(0.1 * np.concatenate([np.zeros(RATE), vowel]) + noise, 75, FRAMES, EnergyGate())
    assert found[26:].min() == 1
    assert found[:18].max() == 0


def test_words_in_one_breath_are_no_noise() -> None:
    """The recording of the manual stays within 5 dB for 0.6 s in its middle."""
    speech, rate = soundfile.read(Path(__file__).parents[2] / "docs/examples/speech.wav")
    assert rate == RATE
    frames = round(len(speech) / rate * FRAMES)
    found = openness(speech, frames, FRAMES, EnergyGate())
    assert found[8:-8].min() > 0.9


def silero_like(path: Path) -> Path:
    """A graph with the inputs and outputs of Silero's: a voice is heard where samples are positive on average."""
    make, kind = onnx.helper.make_tensor_value_info, onnx.TensorProto
    nodes = [
        onnx.helper.make_node("ReduceMean", ["input"], ["mean"], keepdims=1),
        onnx.helper.make_node("Greater", ["mean", "zero"], ["above"]),
        onnx.helper.make_node("Cast", ["above"], ["output"], to=kind.FLOAT),
        onnx.helper.make_node("Identity", ["state"], ["stateN"]),
    ]
    graph = onnx.helper.make_graph(
        nodes,
        "vad",
        [make("input", kind.FLOAT, [1, 576]), make("state", kind.FLOAT, [2, 1, 128]), make("sr", kind.INT64, [])],
        [make("output", kind.FLOAT, None), make("stateN", kind.FLOAT, [2, 1, 128])],
        [onnx.helper.make_tensor("zero", kind.FLOAT, [], [0.0])],
    )
    onnx.save(onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=9), path)
    return path


@functools.cache
def gates() -> list[VoiceGate]:
    """All gates; Silero's with a network that takes every other sample for a voice."""
    model = silero_like(Path(tempfile.mkdtemp()) / "vad.onnx")
    names = [name if name != "silero" else f"silero:model={model}" for name in voice_gate.names()]
    return [read_gate(name) for name in sorted(names, key=lambda name: "silero" in name)]  # type: ignore[misc]


@given(cuts=st.lists(st.integers(1, 30_000), max_size=8), which=st.integers(0, 1))
@settings(max_examples=15, deadline=None)
def test_openness_does_not_depend_on_how_speech_is_cut(cuts: list[int], which: int) -> None:
    gate = gates()[which]
    speech = with_plucked_notes(sentence_with_pauses(25), 15)[: 5 * RATE]
    whole = openness(speech, 125, FRAMES, gate)
    stream, parts, start = Openness(gate, FRAMES), [], 0
    for cut in [*cuts, len(speech)]:
        piece = speech[start : start + cut]
        parts.append(stream.feed(piece))
        start += len(piece)
        # What is certain is given, and not held back until the end.
        assert sum(map(len, parts)) >= int((start / RATE - stream.look_ahead) * FRAMES) - 1
    parts.append(stream.finish(125))
    np.testing.assert_array_equal(np.concatenate(parts), whole)


def test_what_comes_after_the_look_ahead_does_not_matter() -> None:
    first, second = sentence_with_pauses(25), sentence_with_pauses(25)
    second[4 * RATE :] = 0.9
    known = int((4 - Openness(EnergyGate(), FRAMES).look_ahead) * FRAMES)
    made = [openness(speech, 175, FRAMES, EnergyGate())[:known] for speech in (first, second)]
    np.testing.assert_array_equal(*made)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("energie", "energie"),
        ("energy:margins=3", "margins"),
        ("energy:margin=x", "margin"),
        ("energy:margin=90", "margin"),
        ("energy:attack=0.4,lead=0.4", "lead"),
    ],
)
def test_impossible_gate_is_named(text: str, named: str) -> None:
    with pytest.raises(FaceDiffError, match=named):
        read_gate(text)


def test_recordings_are_told_what_is_wrong_with_them() -> None:
    clean, random = sentence_with_pauses(60), np.random.default_rng(0)
    assert speech_problems(clean) == []
    assert "clipped" in " ".join(speech_problems(np.clip(6 * clean, -1, 1)))
    assert "dB below the speech" in " ".join(speech_problems(sentence_with_pauses(15)))
    assert "no speech" in " ".join(speech_problems(0.1 * random.standard_normal(RATE)))


def test_silero_is_the_lower_of_level_and_network(tmp_path: Path) -> None:
    """Loud sound of which the network hears no voice is a pause, and so is a voice below the noise; in any pieces."""
    model = silero_like(tmp_path / "vad.onnx")
    random = np.random.default_rng(0)
    speech = 1e-4 * random.standard_normal(8 * 16_000)
    speech[2 * 16_000 : 4 * 16_000] += 0.3 * (1 + np.sin(np.arange(2 * 16_000)))
    speech[5 * 16_000 : 7 * 16_000] -= 0.3 * (1 + np.sin(np.arange(2 * 16_000)))
    gate = read_gate(f"silero:model={model}")
    opened = openness(speech, 200, 25.0, gate)
    assert opened[55:95].min() == 1
    assert opened[:44].max() == opened[108:].max() == 0
    tracker = Openness(gate, 25.0)
    places = [0, *np.sort(random.integers(len(speech), size=60)).tolist(), len(speech)]
    parts = [tracker.feed(speech[a:b]) for a, b in zip(places, places[1:], strict=False)]
    np.testing.assert_array_equal(np.concatenate([*parts, tracker.finish(200)]), opened)
    with pytest.raises(FaceDiffError, match="pip install --no-deps silero-vad"):
        read_gate(f"silero:model={tmp_path / 'missing.onnx'}")
