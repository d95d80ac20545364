"""Augmentations keep time, level and truth; each does what its name says."""

from __future__ import annotations

import numpy as np
import pytest
import soundfile

from facediff.data import Puppet
from facediff.data.augmentation import Augmentation, Augmenter, read_augmentations, vorbis, warped
from facediff.errors import FaceDiffError
from facediff.registry import augmentation

RATE = 16_000
NAMES = augmentation.names()


def example(seconds: float = 2.0) -> np.ndarray:
    time = np.arange(round(seconds * RATE)) / RATE
    speech = sum(np.sin(2 * np.pi * 140 * order * time) / order for order in range(1, 30))
    return (0.1 * speech * (1.2 + np.sin(2 * np.pi * 3 * time))).astype(np.float32)


def only(words: str) -> Augmentation:
    return read_augmentations([words])[0]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("seed", range(4))
def test_law_of_all_augmentations(name: str, seed: int) -> None:
    given = example()
    augment = Augmenter([only(f"{name}:share=1")])
    made = augment(given, seed)
    assert made.dtype == np.float32
    assert len(made) == len(given)
    assert np.isfinite(made).all()
    assert np.abs(made).max() <= 1
    np.testing.assert_array_equal(made, augment(given, seed))
    assert any(not np.array_equal(augment(given, other), made) for other in range(10, 14))
    # Words stay where they are: the envelope follows that of the recording.
    if name not in ("noise", "hum", "room", "loudness", "babble", "music"):
        envelopes = [np.abs(speech).reshape(-1, 800).mean(1) for speech in (given, made)]
        assert np.corrcoef(*envelopes)[0, 1] > 0.8
    assert not augment(np.zeros_like(given), seed).any()


def test_share_is_that_of_clips_and_the_others_stay_as_they_are() -> None:
    given = example(0.4)
    made = [Augmenter([only("tilt:share=0.5")], 0.6)(given, seed) for seed in range(300)]
    changed = np.mean([not np.array_equal(speech, given) for speech in made])
    assert 0.2 < changed < 0.4


@pytest.mark.parametrize("ratio", [0.85, 1.2])
def test_warping_moves_a_formant_and_not_the_pitch(ratio: float) -> None:
    time = np.arange(2 * RATE) / RATE
    harmonics = 100.0 * np.arange(1, 70)
    sizes = np.exp(-(((harmonics - 1500) / 300) ** 2)) + 1e-3
    voice = (sizes[:, None] * np.sin(2 * np.pi * harmonics[:, None] * time)).sum(0).astype(np.float32)
    spectrum = np.abs(np.fft.rfft(warped(voice, ratio)[4000:20_000] * np.hanning(16_000)))
    of_harmonics = spectrum[100:7000:100]
    assert spectrum[150:7000:100].max() < 0.02 * of_harmonics.max()  # nothing between the harmonics
    centre = (of_harmonics**2 * harmonics[: len(of_harmonics)]).sum() / (of_harmonics**2).sum()
    assert centre == pytest.approx(1500 * ratio, rel=0.05)


def test_formants_move_with_the_pitch_where_both_are_changed_together() -> None:
    time = np.arange(2 * RATE) / RATE
    tones = {300: 1.0, 2000: 0.5}
    speech = sum(size * np.sin(2 * np.pi * hertz * time) for hertz, size in tones.items()).astype(np.float32)
    together = only("voice:share=1,semitones=5,formants=0,together=1")
    ratios = []
    for seed in range(8):
        made = together.change(speech, np.random.default_rng(seed))
        spectrum = np.abs(np.fft.rfft(made[4000:20_000] * np.hanning(16_000)))  # a hertz a bin
        low, high = np.argmax(spectrum[:1000]), 1000 + np.argmax(spectrum[1000:])
        assert high / low == pytest.approx(2000 / 300, rel=0.01)
        assert spectrum[high] / spectrum[low] == pytest.approx(0.5, rel=0.15)
        ratios.append(low / 300)
    assert 2 ** (-5 / 12) < min(ratios) < 0.9
    assert 1.1 < max(ratios) < 2 ** (5 / 12)


@pytest.mark.parametrize("name", ["noise", "hum", "babble", "music"])
def test_noise_has_the_ratio_that_was_asked_for(name: str) -> None:
    given = example()
    made = only(f"{name}:share=1,least=12,most=12").change(given, np.random.default_rng(1))
    added = np.mean((made - given) ** 2)
    assert 10 * np.log10(np.mean(given**2) / added) == pytest.approx(12, abs=0.01)


def test_training_hears_changed_speech_and_tests_do_not(puppet_of_two: str) -> None:
    plain, data = (Puppet(root=puppet_of_two, augmentations=each) for each in (None, ["tilt:share=1", "noise:share=1"]))
    ours, theirs = (each.dataset("train", training=True)[0] for each in (data, plain))
    assert ours.audio.shape == theirs.audio.shape
    assert not np.array_equal(ours.audio, theirs.audio)
    np.testing.assert_array_equal(ours.motion, theirs.motion)
    data.projection.choose(lambda motion: motion[:, :3, 0])  # reading vertices takes most of a small model's step
    assert data.dataset("train", training=True)[0].motion.shape[1:] == (3,)
    data.projection.choose(None)
    for split in ("train", "test_a"):
        ours, theirs = (each.dataset(split)[0] for each in (data, plain))
        np.testing.assert_array_equal(ours.audio, theirs.audio)
    assert data.hparams["augmentations"] == ["tilt:share=1", "noise:share=1"]
    data.features.reader = lambda clip: None
    with pytest.raises(FaceDiffError, match=r"data\.augmentations"):
        data.dataset("train", training=True)


def test_only_clips_that_fit_are_changed(puppet_of_two: str) -> None:
    def heard(**options: object) -> list[np.ndarray]:
        dataset = Puppet(root=puppet_of_two, **options).dataset("train", training=True)
        return [dataset[index].audio.numpy() for index in range(2)]

    plain = heard()
    changes = {"augmentations": ["tilt:share=1"]}
    for patterns, changed in (({"mood": "live*"}, [1]), ({"mood": "neutral", "subject": "F1"}, [0]), ({}, [0, 1])):
        now = heard(**changes, augmented_clips=patterns)
        assert [index for index in range(2) if not np.array_equal(now[index], plain[index])] == changed
    with pytest.raises(FaceDiffError, match=r"augmented_clips: {'mood': 'sad'} fits none .* 'mood': 'neutral'"):
        heard(**changes, augmented_clips={"mood": "sad"})


@pytest.fixture(scope="module")
def puppet_of_two(tmp_path_factory: pytest.TempPathFactory) -> str:
    pytest.importorskip("espeakng_loader")
    from facediff.synthetic.corpus import generate

    root = tmp_path_factory.mktemp("two") / "corpus"
    generate(root, only=["F1_e01", "F1_e02", "F1_t01"], progress=False)
    return str(root)


def test_long_speech_is_encoded_piece_by_piece(monkeypatch: pytest.MonkeyPatch) -> None:
    lengths, write = [], soundfile.SoundFile.write

    def noting(file: soundfile.SoundFile, samples: np.ndarray) -> None:
        lengths.append(len(samples))
        write(file, samples)

    monkeypatch.setattr(soundfile.SoundFile, "write", noting)
    assert len(vorbis(np.zeros(25 * RATE, np.float32), 1.0)) == 25 * RATE
    assert max(lengths) <= 10 * RATE  # two minutes at once overflow the stack and end the process
