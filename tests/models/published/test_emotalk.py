"""EmoTalk's checkpoint gives what the published inference gives, by a reference that shares no code with the model."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path
from typing import Any

import pytest
import soundfile
import torch
from torch import Tensor

from facediff.animation.archives import read_animation
from facediff.cli.app import main
from facediff.errors import FaceDiffError
from facediff.models import EmoTalk, import_checkpoint
from facediff.spaces.layouts import layout
from facediff.utils.licences import commercial_use
from tests.fakes import published
from tests.fakes.published import HIDDEN, State, features_of, hidden_of, interpolated, linear
from tests.models.published.author import speech_of

CONTENT, EMOTION, LEVEL, PERSON = 8, 8, 4, 4
DIM = CONTENT + EMOTION + LEVEL + PERSON
PERSONS = 5


def emotalk_state(seed: int = 0) -> State:
    """A tiny EmoTalk.pth, with all that the authors' file holds and inference does not need."""
    draw = published.Drawn(seed)
    state = published.backbone_state("audio_encoder_cont.", draw, large=True)
    state |= published.backbone_state("audio_encoder_emo.wav2vec2.", draw, large=True)
    for name in ("audio_encoder_cont.lm_head", "audio_encoder_emo.wav2vec2.lm_head"):
        state |= published.linear_state(name, 32, 1024, draw)
    state |= published.linear_state("audio_encoder_emo.classifier.dense", HIDDEN, HIDDEN, draw)
    state |= published.linear_state("audio_encoder_emo.classifier.out_proj", 7, HIDDEN, draw)
    state |= published.linear_state("audio_feature_map_cont", CONTENT, HIDDEN, draw)
    state |= published.linear_state("audio_feature_map_emo", DIM, HIDDEN, draw)
    state |= published.linear_state("audio_feature_map_emo2", EMOTION, DIM, draw)
    state |= published.linear_state("obj_vector_level", LEVEL, 2, draw)
    state |= published.linear_state("obj_vector_person", PERSON, PERSONS, draw)
    state |= published.decoder_state("transformer_decoder.", DIM, 1, draw, hidden=DIM)
    return state | published.linear_state("bs_map_r", 52, DIM, draw)


def reference(s: State, speech: Tensor, level: int, person: int) -> Tensor:
    """All 52 weights of every frame."""
    frames = math.ceil(len(speech) / 16000 * 30)
    wave = published.standardised(speech, 1e-7)
    content = features_of(wave, s, "audio_encoder_cont.")
    content = linear(hidden_of(interpolated(content, frames), s, "audio_encoder_cont."), s, "audio_feature_map_cont")
    emotion = features_of(wave, s, "audio_encoder_emo.wav2vec2.")
    emotion = hidden_of(interpolated(emotion, int(len(emotion) / 50.0 * 30)), s, "audio_encoder_emo.wav2vec2.")
    memory = linear(interpolated(emotion, frames), s, "audio_feature_map_emo")
    mood = torch.relu(linear(memory, s, "audio_feature_map_emo2"))
    rows = [
        linear(torch.eye(count)[chosen], s, name).expand(frames, -1)
        for name, count, chosen in (("obj_vector_level", 2, level), ("obj_vector_person", PERSONS, person))
    ]
    tokens = torch.cat([content, mood, *rows], 1)
    return linear(published.decoded(tokens, memory, s, "transformer_decoder.", "vocaset"), s, "bs_map_r")


def imported(state: State, folder: Path, **options: Any) -> EmoTalk:  # noqa: ANN401
    torch.save(state, folder / "EmoTalk.pth")
    model = import_checkpoint(folder / "EmoTalk.pth", audio_config=published.AUDIO_CONFIG, **options)
    assert isinstance(model, EmoTalk)
    return model


def predict(model: EmoTalk, speech: Tensor, person: str) -> Tensor:
    clip = model.clip_of(speech, person, None)
    frames = torch.tensor([model.frames_of(len(speech))])
    with torch.no_grad():
        return model.generate_frames(clip, frames, seeds=[0])[0, ..., 0]


@pytest.mark.parametrize(("steps", "level", "person"), [(40, 1, 0), (41, 0, 3), (205, 1, 4)])
def test_it_animates_as_published(steps: int, level: int, person: int, tmp_path: Path) -> None:
    state, speech = emotalk_state(), speech_of(steps)
    model = imported(state, tmp_path, level=level)
    expected = reference(state, speech, level, person)
    torch.testing.assert_close(predict(model, speech, str(person)), expected, rtol=0, atol=1e-5)


def test_rows_that_do_not_fit_are_named(tmp_path: Path) -> None:
    state = emotalk_state()
    state["obj_vector_level.weight"] = torch.cat([state["obj_vector_level.weight"]] * 2)
    with pytest.raises(FaceDiffError, match=r"EmoTalk\.pth"):
        imported(state, tmp_path)


def test_each_speech_network_may_have_its_own_configuration(tmp_path: Path) -> None:
    state, speech = emotalk_state(), speech_of(40)
    torch.save(state, tmp_path / "EmoTalk.pth")
    both = {"audio_encoder": published.AUDIO_CONFIG, "emotion_encoder": published.AUDIO_CONFIG}
    model = import_checkpoint(tmp_path / "EmoTalk.pth", audio_config=both)
    assert isinstance(model, EmoTalk)
    torch.testing.assert_close(predict(model, speech, "1"), reference(state, speech, 1, 1), rtol=0, atol=1e-5)


def test_an_imported_model_is_of_arkits_channels_and_not_for_commerce(tmp_path: Path) -> None:
    model = imported(emotalk_state(), tmp_path)
    assert (model.space, model.frame_rate) == (layout("arkit"), 30.0)
    assert model.identities == [str(number) for number in range(PERSONS)]
    assert commercial_use(model.licences) == "forbidden"
    with pytest.raises(FaceDiffError, match="templates"):
        import_checkpoint(tmp_path / "EmoTalk.pth", templates={})
    with pytest.raises(FaceDiffError, match="identities"):
        import_checkpoint(tmp_path / "EmoTalk.pth", identities=["one"])


def test_an_imported_checkpoint_animates_to_weights_and_to_the_built_in_face(tmp_path: Path) -> None:
    torch.save(emotalk_state(), tmp_path / "EmoTalk.pth")
    (tmp_path / "config.json").write_text(json.dumps(published.AUDIO_CONFIG))
    words = [str(tmp_path / "EmoTalk.pth"), "--audio-config", str(tmp_path / "config.json")]
    assert main(["import-checkpoint", *words, "-o", str(tmp_path / "emotalk.ckpt")]) == 0
    speech = speech_of(205)
    soundfile.write(tmp_path / "speech.wav", speech.numpy(), 16_000, subtype="FLOAT")
    words = ["animate", str(tmp_path / "speech.wav"), "--checkpoint", str(tmp_path / "emotalk.ckpt")]
    assert main([*words, "--condition", "3", "-o", str(tmp_path / "face.csv")]) == 0
    with (tmp_path / "face.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    expected = reference(emotalk_state(), speech, 1, 3)
    for name in ("jawOpen", "browDownLeft", "tongueOut"):
        column = expected[:, layout("arkit").index(name)]
        written = torch.tensor([float(row[name[0].upper() + name[1:]]) for row in rows[: len(expected)]])
        torch.testing.assert_close(written, column, rtol=0, atol=1e-5)
    assert main([*words, "-o", str(tmp_path / "face.npz")]) == 0
    animation = read_animation(tmp_path / "face.npz")
    assert animation.triangles.max() < len(animation.template)
    assert main([*words, "--commercial-only", "-o", str(tmp_path / "face.npy")]) != 0
