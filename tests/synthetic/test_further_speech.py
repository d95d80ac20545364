"""Further speech: by the speakers asked for, the same by number, and no sentence of the corpus."""

from __future__ import annotations

import numpy as np

from facediff.data import Puppet
from facediff.synthetic.further_speech import WORDS, further_speech
from facediff.synthetic.sentences import SENTENCES


def test_a_number_is_a_piece_of_speech() -> None:
    one = further_speech(3, ("F1", "M1"))
    assert np.array_equal(one, further_speech(3, ("F1", "M1")))
    assert one.dtype == np.float32
    assert np.abs(one).max() == np.float32(0.6)
    assert not one[:1600].any()
    assert not one[-1280:].any()
    assert 1.5 < len(one) / 16_000 < 8
    assert not np.array_equal(one, further_speech(4, ("F1", "M1")))


def test_no_test_sentence_and_no_tested_speaker_is_heard() -> None:
    said = {word.strip(".,!?").lower() for sentence in SENTENCES[27:] for word in sentence.split()}
    assert not said & set(WORDS)
    assert len(set(WORDS)) == len(WORDS)
    speech = Puppet(drawn_speakers=2).further_speech()
    assert not {"F4", "M4"} & set(speech.keywords["identities"])
