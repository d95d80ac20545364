"""Augmentations keep time, level and truth; each does what its name says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import soundfile

from facediff.data import Puppet
from facediff.data.augmentation import (
    Augmentation,
    Augmenter,
    Example,
    read_augmentations,
    vorbis,
    warped,
)
from facediff.errors import FaceDiffError
from facediff.registry import augmentation

RATE = 16_000
NAMES = augmentation.names()


def example(seconds: float = 2.0) -> Example:
    frames = round(25 * seconds)
    random = np.random.default_rng(0)
    time = np.arange(frames * 640) / RATE
    speech = sum(np.sin(2 * np.pi * 140 * order * time) / order for order in range(1, 30))
    speech = 0.1 * speech * (1.2 + np.sin(2 * np.pi * 3 * time))
    return Example(
        speech=speech.astype(np.float32),
        motion=random.standard_normal((frames, 6, 3)).astype(np.float32).cumsum(0),
        frame_rate=25.0,
        rest=np.full((6, 3), 9, np.float32),
        mouth=np.array([1, 1, 1, 1, 0, 0], np.float32),
    )


def only(words: str) -> Augmentation:
    return read_augmentations([words])[0]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("seed", range(4))
def test_law_of_all_augmentations(name: str, seed: int) -> None:
    given = example()
    augment = Augmenter([only(f"{name}:share=1")])
    made, again = augment(given, seed), augment(given, seed)
    assert made.speech.dtype == made.motion.dtype == np.float32
    assert len(made.speech) == round(len(made.motion) / 25 * RATE)
    assert np.isfinite(made.speech).all()
    assert np.abs(made.speech).max() <= 1
    np.testing.assert_array_equal(made.speech, again.speech)
    np.testing.assert_array_equal(made.motion, again.motion)
    assert any(not np.array_equal(augment(given, other).speech, made.speech) for other in range(10, 14))
    if name not in ("speed", "pauses"):
        np.testing.assert_array_equal(made.motion, given.motion)
        assert len(made.speech) == len(given.speech)
        # What is said stays where it is: the envelope follows the given one.
        if name not in ("noise", "hum", "room", "loudness", "babble", "music"):
            envelopes = [np.abs(each.speech).reshape(-1, 800).mean(1) for each in (given, made)]
            assert np.corrcoef(*envelopes)[0, 1] > 0.8
    silent = Example(np.zeros_like(given.speech), given.motion, 25.0, given.rest, given.mouth)
    assert np.isfinite(augment(silent, seed).speech).all()


def test_share_is_that_of_clips_and_the_others_stay_as_they_are() -> None:
    given = example(0.4)
    made = [Augmenter([only("tilt:share=0.5")], 0.6)(given, seed).speech for seed in range(300)]
    changed = np.mean([speech is not given.speech and not np.array_equal(speech, given.speech) for speech in made])
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
    given, together = replace(example(), speech=speech), only("voice:share=1,semitones=5,formants=0,together=1")
    ratios = []
    for seed in range(8):
        made = together(given, np.random.default_rng(seed)).speech
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
    made = only(f"{name}:share=1,least=12,most=12")(given, np.random.default_rng(1))
    added = np.mean((made.speech - given.speech) ** 2)
    assert 10 * np.log10(np.mean(given.speech**2) / added) == pytest.approx(12, abs=0.01)


def test_pause_is_silent_and_brings_the_mouth_to_rest_but_not_the_brow() -> None:
    given = example()
    for seed in range(20):
        made = only("pauses:share=1")(given, np.random.default_rng(seed))
        np.testing.assert_array_equal(made.motion[:, 4:], given.motion[:, 4:])
        loud = np.abs(made.speech).reshape(-1, 640).max(1) > 0.02
        resting = np.isclose(made.motion[:, :4], 9, atol=1e-4).all((1, 2))
        assert (~loud).sum() >= 5
        assert not (resting & loud).any()
    whole = only("pauses:share=1,silent=1")(given, np.random.default_rng(0))
    np.testing.assert_allclose(whole.motion[:, :4], 9, atol=1e-4)


def test_speed_changes_speech_and_motion_together() -> None:
    given = example()
    lengths = {len(only("speed:share=1,ratio=0.2")(given, np.random.default_rng(seed)).motion) for seed in range(20)}
    assert min(lengths) >= 41
    assert max(lengths) <= 60
    assert len(lengths) > 5


def test_training_hears_changed_speech_and_tests_do_not(puppet_of_two: str) -> None:
    plain, data = (Puppet(root=puppet_of_two, augmentations=each) for each in (None, ["tilt:share=1", "noise:share=1"]))
    ours, theirs = (each.dataset("train", training=True)[0] for each in (data, plain))
    assert ours.audio.shape == theirs.audio.shape
    assert not np.array_equal(ours.audio, theirs.audio)
    np.testing.assert_array_equal(ours.motion, theirs.motion)
    for split in ("train", "test_a"):
        ours, theirs = (each.dataset(split)[0] for each in (data, plain))
        np.testing.assert_array_equal(ours.audio, theirs.audio)
    assert data.hparams["augmentations"] == ["tilt:share=1", "noise:share=1"]
    with pytest.raises(FaceDiffError, match="speed"):
        Puppet(root=puppet_of_two, augmentations=["speed"], window=20).dataset("train", training=True)
    data.features.reader = lambda clip: None
    with pytest.raises(FaceDiffError, match=r"data\.augmentations"):
        data.dataset("train", training=True)


@pytest.mark.parametrize(("augmentation", "components"), [("tilt", True), ("pauses", False)])
def test_changes_of_speech_alone_leave_training_on_components(
    puppet_of_two: str, augmentation: str, components: bool
) -> None:
    """Reading vertices instead takes most of a small model's step."""
    data = Puppet(root=puppet_of_two, augmentations=[f"{augmentation}:share=1"])
    data.projection.choose(lambda motion: motion[:, :3, 0])
    motion = data.dataset("train", training=True)[0].motion
    assert motion.shape[1:] == ((3,) if components else (data.n_vertices, 3))


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
    with pytest.raises(FaceDiffError, match=r"augmented_clips .*: changes nothing without augmentations"):
        heard(augmented_clips={"mood": "neutral"})


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
