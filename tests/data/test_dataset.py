"""Reading a corpus: offsets, alignment of speech and motion, references, windows, batches."""

from __future__ import annotations

import math
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch

from facediff.data.dataset import MotionDataset, Pick
from facediff.errors import FaceDiffError
from tests.fakes.tiny import Tiny


def test_motion_is_offsets_from_the_identitys_template(tiny: Tiny) -> None:
    sample = tiny.dataset("val")[0]
    stored = np.load(tiny.root / "vertices_npy" / f"{sample.name}.npy").reshape(-1, 24, 3)
    torch.testing.assert_close(sample.motion + sample.template, torch.from_numpy(stored))
    assert sample.identity == ["A", "B"].index(sample.identity_name)


def test_audio_spans_exactly_the_motion(tiny: Tiny) -> None:
    for split in ("train", "val", "test_a", "test_b"):
        for sample in tiny.dataset(split):
            assert len(sample.audio) == len(sample.motion) * 640


def test_a_window_cuts_speech_and_motion_together(tiny_root: Path) -> None:
    data = Tiny(root=str(tiny_root), window=5)
    dataset = data.dataset("train", training=True)
    starts = set()
    for _ in range(20):
        sample = dataset[0]
        whole = data.corpus.read_motion(dataset.clips[0])
        matches = [i for i in range(len(whole) - 4) if torch.equal(whole[i : i + 5], sample.motion)]
        assert len(matches) == 1
        audio, _ = soundfile.read(tiny_root / "wav" / f"{sample.name}.wav", dtype="float32")
        assert np.array_equal(sample.audio.numpy(), audio[matches[0] * 640 : (matches[0] + 5) * 640])
        starts.add(matches[0])
    assert len(starts) > 1


@pytest.mark.parametrize("split", ["train", "val", "test_a", "test_b"])
def test_the_reference_is_never_the_clip_it_predicts_nor_an_evaluated_one(tiny: Tiny, split: str) -> None:
    dataset = tiny.dataset(split, training=split == "train")
    evaluated = {clip.name for s in ("val", "test_a", "test_b") for clip in tiny.clips(s)}
    for _ in range(5):
        for sample in dataset:
            assert sample.reference_name != sample.name
            assert sample.reference_name not in evaluated
            assert sample.reference_name.startswith(f"{sample.identity_name}_")


def test_the_reference_shares_the_targets_mood(tiny: Tiny) -> None:
    clips = tiny.corpus.clips
    for split in ("train", "test_a", "test_b"):
        for sample in tiny.dataset(split):
            assert clips[sample.reference_name].attributes["mood"] == clips[sample.name].attributes["mood"]


def test_references_of_any_mood_are_for_training_only(tiny_root: Path) -> None:
    data = Tiny(root=str(tiny_root), reference="any_mood")
    clips = data.corpus.clips

    def same_mood(training: bool) -> set[bool]:
        samples = [data.dataset("train", training=training).sample(Pick(0, seed)) for seed in range(20)]
        assert all(sample.reference_name.startswith("A_") for sample in samples)
        assert all(sample.reference_name != sample.name for sample in samples)
        mood = clips[samples[0].name].attributes["mood"]
        return {clips[sample.reference_name].attributes["mood"] == mood for sample in samples}

    assert same_mood(training=True) == {True, False}
    assert same_mood(training=False) == {True}


def test_self_reference_is_for_training_only(tiny_root: Path) -> None:
    data = Tiny(root=str(tiny_root), reference="self")
    assert all(sample.reference_name == sample.name for sample in data.dataset("train", training=True))
    assert all(sample.reference_name != sample.name for sample in data.dataset("train"))


def test_evaluation_samples_do_not_change(tiny: Tiny) -> None:
    for first, second in zip(tiny.dataset("test_a"), tiny.dataset("test_a"), strict=True):
        assert first.reference_name == second.reference_name
        assert torch.equal(first.motion, second.motion)


def test_decoys_say_something_else_and_are_as_long(tiny: Tiny) -> None:
    dataset = tiny.dataset("test_a")
    for sample in dataset:
        assert sample.decoy_audio is not None
        assert len(sample.decoy_audio) == len(sample.audio)
        assert not torch.equal(sample.decoy_audio, sample.audio)


@pytest.mark.parametrize("texts", [None, ["one", "two", "three"], ["one", "one", "three"]])
@pytest.mark.parametrize("second", ["B_e01", "B_e03"])
def test_a_decoy_is_the_next_clip_with_other_words(second: str, texts: list[str] | None, tiny: Tiny) -> None:
    clips = [tiny.corpus.clips[name] for name in ("A_e01", second, "A_e02")]
    if second == "B_e03" and (texts is None or texts[0] != texts[1]):
        clips[1] = clips[0]
    dataset = MotionDataset(
        tiny.corpus, clips, tiny.identities, tiny.reference_policy(), training=False, decoys=True, texts=texts
    )
    other = tiny.corpus.read_audio(clips[2], 0, tiny.corpus.frames(clips[2]))
    for index in (0, 1):
        decoy = dataset[index].decoy_audio
        assert decoy is not None
        assert torch.equal(decoy, other.repeat(2)[: len(decoy)])


def test_cached_features_of_a_window_cover_its_partial_steps(tiny: Tiny) -> None:
    """As HuBERT has it: a step less than two a frame, so that windows begin and end within steps."""
    clips = tiny.clips("train")
    steps = {clip.name: torch.arange(2.0 * tiny.corpus.frames(clip) - 1)[:, None] for clip in clips}
    dataset = MotionDataset(
        tiny.corpus,
        clips,
        tiny.identities,
        tiny.reference_policy(),
        training=True,
        window=5,
        features=lambda clip: steps[clip.name],
    )
    for seed in range(20):
        index = seed % len(clips)
        sample, frames = dataset.sample(Pick(index, seed), begin=seed % 7), tiny.corpus.frames(clips[index])
        ratio = Fraction(2 * frames - 1, frames)
        first, last = round(ratio * (seed % 7)), math.ceil(ratio * (seed % 7 + 5))
        assert sample.features is not None
        assert sample.features[:, 0].tolist() == list(range(first, last))


def test_only_the_epoch_that_was_stopped_is_continued_within(tiny_root: Path) -> None:
    loader = Tiny(root=str(tiny_root), batch_size=2).train_dataloader()
    whole = {}
    for epoch in range(3):
        loader.sampler.set_epoch(epoch)
        whole[epoch] = [batch.names for batch in loader]
    loader.load_state_dict({"epoch": 1, "batches": 2, "seed": 0})
    assert [batch.names for batch in loader] == whole[1][2:]
    loader.sampler.set_epoch(2)
    assert [batch.names for batch in loader] == whole[2]
    with pytest.warns(UserWarning, match=r"epoch of 9 batches, now of .: clips are repeated"):
        loader.load_state_dict({"epoch": 1, "batches": 2, "of": 9, "seed": 0})


def test_unknown_people_have_identity_minus_one(tiny: Tiny) -> None:
    assert {sample.identity for sample in tiny.dataset("test_b")} == {-1}


def test_newcomers_train_on_their_clips_of_no_split(tiny_root: Path) -> None:
    data = Tiny(root=str(tiny_root), extra_identities=["C"])
    assert data.identities == ["C", "A", "B"]
    assert {clip.name for clip in data.clips("train") if clip.identity == "C"} == {f"C_e0{n}" for n in range(1, 6)}
    assert {clip.identity for clip in data.clips("test_b")} == {"C"}, "test clips stay test clips"
    only = Tiny(root=str(tiny_root), extra_identities=["C"], train_identities=["C"])
    assert {clip.identity for clip in only.clips("train")} == {"C"}
    assert only.identities == data.identities
    assert [clip.name for clip in only.clips("val")] == [clip.name for clip in data.clips("val")]
    with pytest.raises(FaceDiffError, match="A occurs more than once"):
        Tiny(root=str(tiny_root), extra_identities=["A"])
