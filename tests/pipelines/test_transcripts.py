"""Phonemes of a transcript are found where they are spoken, and the lips touch there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import facediff
from facediff.editing.controls.closures import close_lips
from facediff.errors import FaceDiffError
from facediff.speech.audio import read_speech
from facediff.speech.phonemes import closed_times, read_phonemes
from facediff.synthetic.sentences import TEST

SENTENCE = TEST[0]


def test_times_of_a_transcript_are_those_of_the_corpus(puppet_corpus: Path) -> None:
    pytest.importorskip("dtaidistance")
    from facediff.editing.transcripts import align_transcript

    said = read_speech(puppet_corpus / "wav" / "F1_t01.wav")
    speech = np.concatenate([np.zeros(9600, np.float32), said, np.zeros(16_000, np.float32)])
    found = closed_times(align_transcript(SENTENCE, speech))
    true = closed_times(read_phonemes(puppet_corpus / "phonemes" / "F1_t01.csv"))
    assert len(found) == len(true)
    away = [abs(0.6 + (a + b) / 2 - (c + d) / 2) for (a, b), (c, d) in zip(true, found, strict=True)]
    assert np.median(away) < 0.03
    with pytest.raises(FaceDiffError, match="transcript"):
        align_transcript(" ? ", speech)
    with pytest.raises(FaceDiffError, match="transcript"):
        align_transcript(SENTENCE, np.zeros(16_000, np.float32))
    for text in ("Bob", 4 * f"{SENTENCE} "):
        with pytest.raises(FaceDiffError, match="transcript.*speech"):
            align_transcript(text, said)


@pytest.mark.filterwarnings("ignore:.* labels close the lips:facediff.errors.Note")
def test_animation_closes_its_lips_by_alignment_and_by_transcript(
    model: facediff.Animator, puppet_corpus: Path
) -> None:
    pytest.importorskip("dtaidistance")
    from facediff.editing.transcripts import align_transcript

    speech, alignment = (puppet_corpus / folder for folder in ("wav/F1_t01.wav", "phonemes/F1_t01.csv"))
    free = model.animate(speech, identity="F1", voice_gate="off")
    heard = align_transcript(SENTENCE, read_speech(speech))
    for options, phonemes in (
        ({"alignment": alignment, "closure_budget": 2.0}, read_phonemes(alignment)),
        ({"transcript": SENTENCE, "closure_budget": 2.0}, heard),
    ):
        made = model.animate(speech, identity="F1", voice_gate="off", **options)  # type: ignore[arg-type]
        expected = close_lips(free, closed_times(phonemes), 2.0)
        assert not np.array_equal(expected.vertices, free.vertices)
        np.testing.assert_array_equal(made.vertices, expected.vertices)
        assert "lips closed" in made.metadata["edited"]
