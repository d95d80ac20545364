"""Phonemes of any language to the mouth."""

from __future__ import annotations

import numpy as np
import pytest

from facediff.speech.espeak import SpokenPhoneme
from facediff.synthetic.articulation import (
    PAUSE,
    SPEECH_SHAPES,
    articulations,
    blend,
    lip_contact,
    speech_sounds,
)
from facediff.synthetic.voices import open_voice

SENTENCES = {
    "en-us": "Mama bought a map of Bombay for papa.",
    "de": "Meine Mutter macht am Abend einen Pudding.",
    "fr": "Ma mère prépare une bonne soupe pour papa.",
    "es": "Mi mamá compra mucho pan por la mañana.",
    "it": "La bambina mangia una buona minestra.",
    "pt": "A minha mãe bebe muito bom vinho.",
    "ru": "Моя мама любит большой белый пароход.",
    "pl": "Moja babcia piecze dobre białe bułki.",
    "cmn": "妈妈买了一把白色的椅子",
    "hi": "मेरी माँ बाज़ार में फल बेचती है।",
}


def test_features_make_the_shapes() -> None:
    (open_vowel,), (close_vowel,), (rounded,) = articulations("ɑ"), articulations("i"), articulations("u")
    assert open_vowel.targets["jawOpen"] > 3 * close_vowel.targets["jawOpen"]
    assert close_vowel.targets["mouthStretch"] > 0.3
    assert rounded.targets["mouthPucker"] > 0.8
    assert rounded.targets["mouthStretch"] == 0.0
    for sound in "pbm":
        assert articulations(sound)[0].contact == "lip", sound
    for sound in "fvɱ":
        assert articulations(sound)[0].contact == "teeth", sound
    for sound in "ɸβwnt":
        assert not articulations(sound)[0].contact, sound
    assert articulations("") == (PAUSE,)
    assert len(articulations("aɪ")) == 2
    assert len(articulations("tʃ")) == 1
    assert articulations("tʃ")[0].targets["mouthFunnel"] > 0.4
    assert articulations("kʷ")[0].targets["mouthPucker"] > 0.5
    assert articulations("ˈpʰ")[0].contact == "lip"


@pytest.mark.parametrize("language", SENTENCES)
def test_every_sound_of_ten_languages_is_known(language: str) -> None:
    utterance = open_voice(f"espeak:{language}").speak(SENTENCES[language])
    unseen = [p.ipa for p in utterance.phonemes if any(part.strength == 0.3 for part in articulations(p.ipa))]
    assert unseen == []
    sounds = speech_sounds(utterance.phonemes)
    times = np.arange(0.0, utterance.phonemes[-1].end, 0.005)
    for contact, least in (("lip", 2), ("teeth", 0)):
        touching = [p for p in utterance.phonemes if any(part.contact == contact for part in articulations(p.ipa))]
        assert len(touching) >= least
        track = lip_contact(sounds, times, contact)
        for phoneme in touching:
            assert np.interp(0.5 * (phoneme.start + phoneme.end), times, track) > 0.95, phoneme
    assert blend(sounds, times)[:, SPEECH_SHAPES.index("jawOpen")].max() > 0.2


def test_blending_stays_between_the_targets() -> None:
    phonemes = [SpokenPhoneme(0.2 * k, 0.2 * (k + 1), ipa) for k, ipa in enumerate(["ɑ", "i", "u", "s", "ɑ"])]
    sounds = speech_sounds(phonemes)
    times = np.linspace(0.0, 1.0, 201)
    weights = blend(sounds, times)
    for column, shape in enumerate(SPEECH_SHAPES):
        targets = [sound.stress * sound.articulation.targets.get(shape, 0.0) for sound in sounds]
        assert weights[:, column].max() <= max(targets) + 1e-9, shape
        assert weights[:, column].min() >= min(targets) - 1e-9, shape
    jaw = weights[:, SPEECH_SHAPES.index("jawOpen")]
    assert jaw[20] > 2 * jaw[60]
    assert np.abs(np.diff(weights, axis=0)).max() < 0.08  # no jumps within 5 ms
