"""The lips touch where an alignment has them touch."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import facediff
from facediff.editing.controls.closures import close_lips
from facediff.errors import FaceDiffError
from facediff.speech.phonemes import closed_times, read_phonemes


@pytest.mark.filterwarnings("ignore:.* labels close the lips:facediff.errors.Note")
def test_animation_closes_its_lips_by_alignment(model: facediff.Animator, puppet_corpus: Path, tmp_path: Path) -> None:
    speech, alignment = (puppet_corpus / folder for folder in ("wav/F1_t01.wav", "phonemes/F1_t01.csv"))
    free = model.animate(speech, identity="F1", voice_gate="off")
    made = model.animate(speech, identity="F1", voice_gate="off", alignment=alignment, closure_budget=2.0)
    expected = close_lips(free, closed_times(read_phonemes(alignment)), 2.0)
    assert not np.array_equal(expected.vertices, free.vertices)
    np.testing.assert_array_equal(made.vertices, expected.vertices)
    assert "lips closed" in made.metadata["edited"]
    (late := tmp_path / "late.csv").write_text("start,end,ipa\n20,20.1,p\n20.2,20.3,b\n")
    with pytest.raises(FaceDiffError, match=r"late\.csv: its last phoneme ends at 20\.3 s"):
        model.animate(speech, identity="F1", alignment=late)
