"""BEAT, takes and FLAME clips in miniature, in the form in which they are distributed."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import lightning.pytorch as pl
import numpy as np
import pytest
import soundfile

from facediff.data import Beat, FlameClips, LiveLink, SpeechMotionDataModule
from facediff.data.check import check
from facediff.data.recordings import RecordingFolder
from facediff.errors import FaceDiffError
from facediff.models import DualPathDiffusion
from facediff.spaces import layout
from facediff.spaces.files import ParameterClip, write_parameters

RNG = np.random.default_rng(0)


def sound(path: Path, seconds: float) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    soundfile.write(path, RNG.normal(0, 0.1, round(seconds * 16_000)), 16_000)


def write_beat(root: Path, *, frames: int = 60) -> Path:
    """As distributed: a folder for each speaker, 60 frames a second, the first at 1/60."""
    for speaker, number in (
        ("1_wayne", 1),
        ("1_wayne", 2),
        ("1_wayne", 3),
        ("1_wayne", 66),
        ("2_scott", 1),
        ("2_scott", 2),
    ):
        name = f"{speaker}_0_{number}_{number}"
        weights = RNG.random((frames, 51)).astype(np.float32) * 0.9
        weights[:, 5] = 0
        clip = ParameterClip(name, weights, layout("arkit_51"), 60.0, start=1 / 60)
        (root / speaker.partition("_")[0]).mkdir(parents=True, exist_ok=True)
        write_parameters(root / speaker.partition("_")[0] / f"{name}.json", clip)
        sound(root / speaker.partition("_")[0] / f"{name}.wav", frames / 60)
    return root


def write_flame(root: Path, *, frames: int = 30) -> Path:
    for number in range(5):
        entry = layout("flame_diffposetalk")
        values = RNG.normal(0, 0.1, (frames, 56)).astype(np.float32)
        clip = ParameterClip("x", values, entry, 25.0, identity=np.zeros(100, np.float32), layout="flame_diffposetalk")
        root.mkdir(exist_ok=True)
        write_parameters(root / f"ann_s{number}.npz", clip)
        sound(root / f"ann_s{number}.wav", frames / 25)
    return root


def test_beat_is_read_in_its_own_names_rate_and_time(tmp_path: Path) -> None:
    data = Beat(root=str(write_beat(tmp_path / "beat")), batch_size=2)
    assert data.identities == ["1_wayne", "2_scott"]
    clip = data.corpus.clips["1_wayne_0_66_66"]
    assert (clip.attributes["emotion"], clip.attributes["form"]) == ("happiness", "speech")
    motion = data.corpus.read_motion(clip)[:, :, 0].numpy()
    stored = json.loads((tmp_path / "beat" / "1" / f"{clip.name}.json").read_text())
    weights = np.array([frame["weights"] for frame in stored["frames"]])
    # Frame k of the file lies at (k + 1) / 60 seconds of the sound, and frame j of the corpus at j / 30.
    assert np.abs(motion[1:30] - weights[1:58:2]).max() < 1e-5
    assert len(motion) == 31
    assert {split: len(data.clips(split)) for split in ("train", "val", "test_a")} == {
        "train": 4,
        "val": 1,
        "test_a": 1,
    }


def test_hidden_files_are_no_recordings(tmp_path: Path) -> None:
    write_beat(tmp_path)
    for suffix in ("json", "wav"):
        (tmp_path / "2" / f"._2_scott_0_1_1.{suffix}").write_bytes(b"\0\5\x16\7")
    names = RecordingFolder(tmp_path, layout("arkit_51"), 30.0).names()
    assert len(names) == 6
    assert names[-1] == "2_scott_0_2_2"


def test_sounds_may_have_a_suffix_in_capitals(tmp_path: Path) -> None:
    write_beat(tmp_path)
    (tmp_path / "2" / "2_scott_0_1_1.wav").rename(tmp_path / "2" / "2_scott_0_1_1.WAV")
    (tmp_path / "wav").mkdir()
    (tmp_path / "2" / "2_scott_0_2_2.wav").rename(tmp_path / "wav" / "2_scott_0_2_2.Wav")
    assert len(RecordingFolder(tmp_path, layout("arkit_51"), 30.0).names()) == 6


def test_flame_clips_need_a_layout_and_keep_the_version(tmp_path: Path) -> None:
    root = write_flame(tmp_path / "flame")
    data = FlameClips(root=str(root), layout="flame_diffposetalk", version="2020")
    assert data.space.version == "2020"
    assert data.corpus.read_motion(data.clips("train")[0]).shape == (30, 56, 1)
    with pytest.raises(FaceDiffError, match="flame_artalk"):
        FlameClips(root=str(root), layout="arkit")


def test_a_table_of_clips_decides_the_splits(tmp_path: Path) -> None:
    root = write_flame(tmp_path / "flame")
    (root / "clips.csv").write_text("clip,split\nann_s0,test_a\nann_s4,none\n")
    data = FlameClips(root=str(root), layout="flame_diffposetalk")
    assert [clip.name for clip in data.clips("test_a")] == ["ann_s0"]
    assert not any(data.find_split(clip) for clip in data.corpus.clips.values() if clip.name == "ann_s4")
    (root / "clips.csv").write_text("clip,split\nann_s0,tset\n")
    with pytest.raises(FaceDiffError, match="ann_s0"):
        FlameClips(root=str(root), layout="flame_diffposetalk").clips("train")


@pytest.mark.parametrize("corpus", ["beat", "flame"])
def test_a_model_trains_on_each(
    tmp_path: Path, corpus: str, make_model: Callable[..., DualPathDiffusion], make_trainer: Callable[..., pl.Trainer]
) -> None:
    data: SpeechMotionDataModule
    if corpus == "beat":
        data = Beat(root=str(write_beat(tmp_path / "beat")), batch_size=2)
    else:
        data = FlameClips(root=str(write_flame(tmp_path / "flame")), layout="flame_diffposetalk", batch_size=2)
    model = make_model(
        n_vertices=data.n_vertices, space=data.space, identities=data.identities, frame_rate=data.frame_rate
    )
    trainer = make_trainer(max_steps=1)
    trainer.fit(model, data)
    assert trainer.global_step == 1


def test_check_names_order_rate_and_dead_and_out_of_range_channels(tmp_path: Path) -> None:
    root = write_beat(tmp_path / "beat")
    report = check(root)
    kinds = {finding.kind: f"{finding.where} {finding.message}" for finding in report.findings}
    assert (report.corpus, report.n_vertices, report.stored_frame_rate, report.sound) == ("beat", 51, 60.0, True)
    assert "arkit_51" in kinds["order"]
    assert "tongueOut" in kinds["order"]
    assert layout("arkit_51").channels[5] in kinds["dead"]
    name = "1_wayne_0_1_1"
    weights = RNG.random((60, 51)).astype(np.float32) + 0.2
    write_parameters(root / "1" / f"{name}.json", ParameterClip(name, weights, layout("arkit_51"), 60.0))
    sound(root / "1" / f"{name}.wav", 3.0)
    kinds = {finding.kind: finding.where for finding in check(root).findings}
    assert "browDownLeft" in kinds["range"]
    assert name in kinds["length"]
    (root / "1" / f"{name}.json").write_text("{}")
    broken = check(root)
    assert not broken.sound
    assert any(finding.where.endswith(f"{name}.json") for finding in broken.findings)


def test_check_of_arrays_needs_the_layout_and_reports_mix_ups(tmp_path: Path) -> None:
    root = write_flame(tmp_path / "flame")
    bare = check(root, "flame_clips")
    assert not bare.sound
    assert any("flame_emoca" in finding.message for finding in bare.findings)
    assert check(root, "flame_clips:flame_diffposetalk").sound
    values = RNG.normal(0, 0.1, (60, 56)).astype(np.float32)
    values[:, 50:53] = np.abs(np.sin(np.arange(60)))[:, None] * [0.2, 0.001, 0.001]
    clip = ParameterClip("x", values, layout("flame_diffposetalk"), 25.0, layout="flame_diffposetalk")
    write_parameters(root / "ann_s1.npz", clip)
    remarks = [one.where for one in check(root, "flame_clips:flame_diffposetalk").findings if one.kind == "remark"]
    assert remarks == ["ann_s1.npz"]


def test_a_take_of_one_is_a_speaker_of_another_corpus(tmp_path: Path) -> None:
    beat = write_beat(tmp_path / "beat")
    person = tmp_path / "ann"
    person.mkdir()
    values = RNG.random((60, 61)).astype(np.float32)
    write_parameters(person / "Ann_s01.csv", ParameterClip("a", values, layout("live_link"), 30.0))
    sound(person / "Ann_s01.wav", 2.0)
    (person / "clips.csv").write_text("clip,split\nAnn_s01,train\n")
    (person / "manifest.json").write_text(json.dumps({"person": "Ann", "corpus": "person", "layout": "live_link"}))
    data = Beat(root=str(beat), people=[str(person)])
    assert data.identities == ["Ann", "1_wayne", "2_scott"]
    clip = data.corpus.clips["Ann_s01"]
    jaw = data.corpus.read_motion(clip)[:, data.space.index("jawOpen"), 0].numpy()
    assert np.abs(jaw - values[:, layout("live_link").index("jawOpen")]).max() < 1e-6
    assert LiveLink(root=str(person)).identities == ["Ann"]
    with pytest.raises(FaceDiffError, match=r"no clip of split val; .*limit_val_batches=0"):
        LiveLink(root=str(person)).val_dataloader()
    (person / "vertices_npy").mkdir()
    with pytest.raises(FaceDiffError, match=r"ann: expected a speaker.* in channels \(import-take\)"):
        _ = Beat(root=str(beat), people=[str(person)]).corpus


def test_conversations_and_speakers_who_are_not_asked_for_are_not_trained_on(tmp_path: Path) -> None:
    scott = [f"2_scott_0_{number}_{number}" for number in (1, 9, 10, 11)]
    for name in ("1_wayne_0_9_9", "1_wayne_1_1_1", *scott):
        for suffix in (".json", ".wav"):
            (tmp_path / name).with_suffix(suffix).write_bytes(b"")
    assert "1_wayne_1_1_1" not in [clip.name for clip in Beat(root=str(tmp_path)).clips("train")], "a conversation"
    one = Beat(root=str(tmp_path), extra_identities=["1_wayne"])
    clips = {split: [clip.name for clip in one.clips(split)] for split in ("train", "val", "test_a", "test_b")}
    assert clips == {"train": ["1_wayne_0_9_9"], "val": [], "test_a": [], "test_b": ["2_scott_0_9_9"]}
