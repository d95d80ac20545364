"""Sounds of people's recordings teach the audio encoder, and leave all else of a training as it was."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from facediff.callbacks import SpokenSoundsTerm
from facediff.data import Puppet
from facediff.data.spoken_sounds import IGNORED, SOUNDS, SpokenSounds, sounds_in_frames, visible_sound
from facediff.errors import FaceDiffError
from facediff.speech.phonemes import TimedPhoneme
from facediff.synthetic.corpus import generate
from tests.fakes.aligned import write_aligned
from tests.fakes.tiny import Tiny

Make = Callable[..., object]


@pytest.fixture
def recordings(tmp_path: Path) -> Path:
    for speaker in ("anna", "bert"):
        write_aligned(tmp_path / "recordings" / speaker / "a.wav", 4.0, [2.0])
    return tmp_path / "recordings"


@pytest.fixture(scope="module")
def two_clips(tmp_path_factory: pytest.TempPathFactory) -> str:
    root = tmp_path_factory.mktemp("two") / "corpus"
    generate(root, only=["F1_e01", "F1_e02"], progress=False)
    return str(root)


def test_sounds_that_look_alike_are_one_class() -> None:
    phonemes = ("p", "m", "v", "w", "uː", "ʃ", "θ", "s", "ɔ", "ɑ", "ə", "iː", "k")
    named = {ipa: SOUNDS[visible_sound(ipa)] for ipa in phonemes}
    assert named["p"] == named["m"] == "bilabial"
    assert named["w"] == named["uː"]
    assert len(set(named.values())) == len(SOUNDS) - 1
    assert visible_sound("") == SOUNDS.index("pause")


def test_each_frame_has_the_sound_of_its_middle_and_a_short_closure_one_frame() -> None:
    phonemes = [TimedPhoneme(0.0, 0.1, "ɑ"), TimedPhoneme(0.1, 0.105, "p"), TimedPhoneme(0.105, 0.2, "s")]
    found = [SOUNDS[sound] for sound in sounds_in_frames(phonemes, 6, 25.0)]
    assert found == ["open vowel", "open vowel", "bilabial", "sibilant", "sibilant", "pause"]


def test_pieces_are_peoples_and_the_corpuss_in_turn(recordings: Path, two_clips: str) -> None:
    """A piece's sounds are those of its own time: white noise has no other marks than its place."""
    data = Puppet(root=two_clips)
    batch = SpokenSounds(recordings, data).draw(4, 1.0, np.random.default_rng(0))
    assert batch.audio.shape == (4, 16_000)
    assert batch.sounds.shape == (4, 25)
    whole = SpokenSounds(recordings, data).people[0]
    piece = batch.audio[0].numpy()
    starts = range(0, len(whole[0]) - 16_000 + 1, 640)
    (place,) = [start for start in starts if np.array_equal(whole[0][start : start + 16_000], piece)]
    assert np.array_equal(whole[1][place // 640 : place // 640 + 25], batch.sounds[0].numpy())
    assert (batch.sounds != IGNORED).all()
    clips = [clip for clip in data.clips("train") if clip.identity == "F1"]
    whole = [data.corpus.read_audio(clip, 0, data.corpus.frames(clip)).numpy() for clip in clips]
    windows = [speech[start : start + 16_000] for speech in whole for start in range(0, len(speech) - 16_000 + 1, 640)]
    assert all(any(np.array_equal(window, batch.audio[k].numpy()) for window in windows) for k in (1, 3))


def test_people_are_changed_more_often_than_the_corpus(recordings: Path, two_clips: str) -> None:
    loud = SpokenSounds(recordings, Puppet(root=two_clips, augmentations=["loudness:share=1"], augmented_share=0.1))
    plain = SpokenSounds(recordings, Puppet(root=two_clips))
    pieces = [each.draw(200, 0.2, np.random.default_rng(0)).audio for each in (loud, plain)]
    changed = (pieces[0] != pieces[1]).any(1).float()
    assert 0.6 < changed[::2].mean() < 0.8
    assert 0.02 < changed[1::2].mean() < 0.2


def test_the_encoder_learns_the_sounds_and_nothing_else_changes(
    recordings: Path, make_model: Make, make_trainer: Make, tiny: Tiny
) -> None:
    def trained(*callbacks: SpokenSoundsTerm) -> dict[str, torch.Tensor]:
        torch.manual_seed(0)
        model = make_model()
        make_trainer(max_steps=3, callbacks=list(callbacks), limit_val_batches=0, num_sanity_val_steps=0).fit(  # type: ignore[attr-defined]
            model, datamodule=tiny
        )
        return {name: weight.clone() for name, weight in model.state_dict().items()}  # type: ignore[attr-defined]

    plain, without = trained(), trained(SpokenSoundsTerm(str(recordings), weight=0.0))
    assert all(torch.equal(plain[name], without[name]) for name in plain)
    term = SpokenSoundsTerm(str(recordings), weight=10.0)
    taught = trained(term)
    assert plain.keys() == taught.keys()
    changed = {name for name in plain if not torch.equal(plain[name], taught[name])}
    assert any("audio_encoder" in name for name in changed)
    resumed = SpokenSoundsTerm(str(recordings))
    resumed.load_state_dict(term.state_dict())
    assert torch.equal(resumed.state_dict()["head"]["weight"], term.state_dict()["head"]["weight"])


def test_faults_are_named(recordings: Path, make_model: Make, make_trainer: Make, tiny: Tiny) -> None:
    with pytest.raises(FaceDiffError, match="no aligned recording"):
        make_trainer(max_steps=1, callbacks=[SpokenSoundsTerm(str(recordings / "anna"))]).fit(  # type: ignore[attr-defined]
            make_model(), datamodule=tiny
        )
