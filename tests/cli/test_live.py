"""``facediff live`` with a trained model: its frames are those of a stream, and Ctrl-C ends it with its report."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch

import facediff
from facediff.animation.options import AnimationOptions
from facediff.cli.app import main
from facediff.cli.live import live_model
from facediff.models import import_checkpoint
from facediff.models.published.importing import save_model
from facediff.speech.audio import read_speech
from tests.fakes import published_parameters
from tests.fakes.published import AUDIO_CONFIG

WINDOWS = {"window": 0.6, "overlap": 0.2, "voice_gate": "off"}
WORDS = ["--window", "0.6", "--overlap", "0.2", "--voice-gate", "off"]


@pytest.fixture
def speech(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    soundfile.write(tmp_path / "speech.wav", 0.1 * rng.normal(size=22_400), 16_000)
    return tmp_path / "speech.wav"


def test_live_frames_are_those_of_a_stream(
    checkpoint: Path, speech: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out.jsonl"
    to = f"jsonl:{out}?weights=false&vertices=true"
    assert main(["live", str(checkpoint), str(speech), "--to", to, "--identity", "B", "--seed", "3", *WORDS]) == 0
    said = capsys.readouterr()
    assert said.out == ""  # a receiver may write there
    assert "lag" in said.err
    head, *frames, end = [json.loads(line) for line in out.read_text().splitlines()]
    assert end["type"] == "end"
    wanted = np.concatenate(
        list(facediff.load(checkpoint).stream([read_speech(speech)], identity="B", seed=3, **WINDOWS))  # type: ignore[arg-type]
    )
    assert len(wanted) == 35
    index = [frame["index"] for frame in frames]
    assert len(index) > 25  # a busy machine may drop some
    found = np.array([frame["vertices"] for frame in frames]) + np.array(head["neutral"])
    assert np.allclose(found, wanted[index], atol=3e-6)
    assert [frame["time"] for frame in frames] == pytest.approx([each / head["frame_rate"] for each in index])


@pytest.mark.parametrize("method", ["ARTalk", "facediff's windows"])
def test_live_knows_how_late_a_models_own_windows_are(method: str, tmp_path: Path) -> None:
    path, plan = tmp_path / "tiny.ckpt", {"window": 0.8} if method == "facediff's windows" else {}
    if method == "ARTalk":
        torch.save(published_parameters.artalk_state(), tmp_path / "artalk.pt")
        imported = import_checkpoint(tmp_path / "artalk.pt", audio_config=AUDIO_CONFIG, codec_heads=2)
    else:
        numbers, files = published_parameters.statistics(), published_parameters.write_diffposetalk(tmp_path, head=True)
        imported = import_checkpoint(files, audio_config=AUDIO_CONFIG, statistics=numbers)
    save_model(imported, path)
    model = live_model(AnimationOptions(checkpoint=path, **plan))
    stream, frame, waits, hops = model.start(), round(16_000 / model.frame_rate), [], []
    for heard in range(1, 70):
        if given := len(stream.feed(np.zeros(frame, np.float32))):
            waits.append((heard - sum(hops)) / model.frame_rate)  # of the first frame of those
            hops.append(given)
    assert max(waits) == pytest.approx(model.look_ahead, abs=0.6 / model.frame_rate)  # in whole frames
    assert hops[-1] / model.frame_rate == pytest.approx(model.hop)
