"""Mean faces of speakers, and the gallery of their recordings."""

from __future__ import annotations

import pytest
import torch

from facediff.data.speakers import MOST, MeanFaces, speaker_gallery, spread
from facediff.errors import FaceDiffError
from tests.fakes.tiny import Tiny


def test_mean_face_is_that_of_all_training_frames(tiny: Tiny) -> None:
    faces = MeanFaces(tiny)
    speaker = tiny.clips("train")[0].identity
    motions = [tiny.corpus.read_motion(clip) for clip in tiny.clips("train") if clip.identity == speaker]
    expected = torch.cat(motions).mean(0)
    torch.testing.assert_close(faces.of([speaker])[0], expected)
    torch.testing.assert_close(faces.of(["nobody"])[0], torch.stack(list(faces.faces.values())).mean(0))


def test_gallery_holds_no_evaluated_recording(tiny: Tiny) -> None:
    speakers = sorted({clip.identity for clip in tiny.corpus.clips.values()})
    gallery = speaker_gallery(tiny, speakers, tiny.assets())
    known = tiny.known_clips()
    assert len(gallery.speakers) == sum(len(known.get(speaker, [])) for speaker in speakers)
    with pytest.raises(FaceDiffError, match="two"):
        speaker_gallery(tiny, speakers[:1], tiny.assets())


def test_spread_is_even(tiny: Tiny) -> None:
    clip = tiny.clips("train")[0]
    assert spread([clip] * MOST) == [clip] * MOST
    assert len(spread([clip] * (3 * MOST))) == MOST
