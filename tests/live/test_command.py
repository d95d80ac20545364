"""The command ``facediff live``: options, checks before anything is opened, the whole path."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile

from facediff.cli.app import main as facediff
from facediff.errors import FaceDiffError
from facediff.live.command import perform
from facediff.live.model import LiveModel, usual_gate
from facediff.live.options import LiveOptions
from facediff.registry import Kind
from facediff.spaces import Rotation, Space
from facediff.spaces.arkit import ARKIT
from facediff.spaces.decoding import ChannelDecoder
from facediff.speech.voice_activity import EnergyGate, Openness, read_gate
from tests.fakes.live import Kept, fake_model

MADE: list[Kept] = []


class Keeping(Kept):
    """A receiver that tests find again."""

    def __init__(self, address: object, *, weights: bool = False, refuse: bool = False) -> None:
        super().__init__(weights=weights)
        self.name, self.refuse = str(getattr(address, "text", address)), refuse
        MADE.append(self)

    def open(self, performance: Any) -> None:  # noqa: ANN401
        super().open(performance)
        if self.refuse:
            raise FaceDiffError(f"{self.name}: port taken")


@pytest.fixture(autouse=True)
def receivers(monkeypatch: pytest.MonkeyPatch) -> None:
    """No receivers but the one of this file."""
    kind = Kind("receiver", "", "tests")
    kind.register("keep")(Keeping)
    for place in ("facediff.registry", "facediff.live.frames", "facediff.live.options"):
        monkeypatch.setattr(f"{place}.receiver", kind)
    MADE.clear()


@pytest.fixture
def speech(tmp_path: Path) -> Path:
    soundfile.write(tmp_path / "speech.wav", 0.1 * np.sin(np.arange(4800) / 9), 16_000)
    return tmp_path / "speech.wav"


def test_performance_from_a_recording_to_receivers(speech: Path) -> None:
    said: list[str] = []
    options = LiveOptions(speech=str(speech), to=["keep:1", "keep:2"])
    summary = perform(options, fake_model, said.append)
    assert summary.frames == 15
    assert [len(made.frames) for made in MADE] == [15, 15]
    assert [made.closed for made in MADE] == [1, 1]
    performance = MADE[0].performance
    assert performance is not None
    assert (performance.frame_rate, performance.speech, performance.metadata["licence"]) == (50.0, True, "none")
    assert sum(len(samples) for samples, _ in MADE[0].speech) == 4800  # a recording is heard, too
    assert any("lag" in sentence for sentence in said)


def test_receiver_that_cannot_open_closes_those_before_it(speech: Path) -> None:
    options = LiveOptions(speech=str(speech), to=["keep:1", "keep:2?refuse=true"])
    with pytest.raises(FaceDiffError, match="keep:2"):
        perform(options, fake_model, str)
    assert [made.closed for made in MADE] == [1, 1]
    assert not MADE[0].frames


def test_weights_of_a_model_of_channels_are_sent_as_they_are(speech: Path) -> None:
    """Without shapes; receivers of vertices get what the rig makes of them."""
    space = Space("arkit", ("jawOpen", "HeadYaw", "HeadPitch", "HeadRoll"), rotations=(Rotation("head", 1, "euler"),))
    neutral = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)
    deltas = np.random.default_rng(1).normal(size=(1, 5, 3))

    class Channels(Moved):
        def feed(self, samples: np.ndarray) -> np.ndarray:
            return super().feed(samples)[:, :, :1] / 100  # of four vertices that count frames, the first coordinates

        def finish(self) -> np.ndarray:
            return super().finish()[:, :, :1] / 100

    fake = fake_model()
    facts = {"neutral": neutral, "start": lambda: Channels(fake.start(), np.zeros((4, 3), np.float32))}
    model = LiveModel(**{**vars(fake), **facts, "decoder": ChannelDecoder(space, np.zeros(4), neutral, deltas)})
    options = LiveOptions(speech=str(speech), to=["keep:1?weights=true", "keep:2"])
    perform(options, lambda: model, str)
    assert MADE[0].performance is not None
    assert MADE[0].performance.shapes == space.channels
    for frame in (frame for made in MADE for frame in made.frames):
        assert frame.weights is not None
        np.testing.assert_allclose(frame.weights, [frame.index / 100, 0, 0, 0], atol=1e-6)
        np.testing.assert_allclose(frame.vertices, frame.index / 100 * deltas[0], atol=1e-5)
    with pytest.raises(FaceDiffError, match="shapes"):
        perform(options, fake_model, str)


def test_the_model_that_comes_with_facediff_has_its_own_shapes(speech: Path) -> None:
    """Weights without an option: that model's face is the built-in one."""
    assert facediff(["live", str(speech), "--to", "keep:1?weights=true", "--quiet"]) == 0
    performance = MADE[0].performance
    assert performance is not None
    assert set(ARKIT) <= set(performance.shapes)
    assert all(frame.weights is not None and len(frame.weights) == len(performance.shapes) for frame in MADE[0].frames)


def test_weights_of_blendshapes_are_solved_for(speech: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Of a set whose one shape moves the first vertex as the made-up stream does."""
    neutral = np.random.default_rng(0).normal(size=(4, 3)).astype(np.float32)
    monkeypatch.setattr("tests.fakes.live.fake_model", None)
    for name, moved in (("neutral", 0.0), ("jawOpen", 20.0)):
        vertices = neutral.copy()
        vertices[0, 0] += moved
        lines = [*(f"v {x} {y} {z}" for x, y, z in vertices), "f 1 2 3", "f 2 4 3"]
        (tmp_path / f"{name}.obj").write_text("\n".join(lines))
    model = fake_model()
    still = LiveModel(**{**vars(model), "neutral": neutral, "start": lambda: Moved(model.start(), neutral)})
    options = LiveOptions(speech=str(speech), to=["keep:1?weights=true"], shapes=tmp_path)
    perform(options, lambda: still, str)
    performance = MADE[0].performance
    assert performance is not None
    assert performance.shapes == ("jawOpen",)
    weights = [float(frame.weights[0]) for frame in MADE[0].frames if frame.weights is not None]
    assert len(weights) == 15
    # Smoothness makes the weight lag behind a ramp by a little.
    assert np.allclose(weights[5:], np.arange(5, 15) / 20, atol=0.03)


class Moved:
    """A stream whose frames begin at a neutral face."""

    heads = None

    def __init__(self, stream: Any, neutral: np.ndarray) -> None:  # noqa: ANN401
        self.stream, self.neutral = stream, neutral

    @property
    def made(self) -> int:
        return int(self.stream.made)

    def feed(self, samples: np.ndarray) -> np.ndarray:
        return np.asarray(self.stream.feed(samples) + self.neutral, np.float32)

    def finish(self) -> np.ndarray:
        return np.asarray(self.stream.finish() + self.neutral, np.float32)


def test_usual_gate_waits_no_longer_than_the_windows() -> None:
    for look_ahead in (0.05, 0.1, 0.2, 0.3, 0.5, 0.9, 1.5, 4.5):
        gate = read_gate(usual_gate(look_ahead))
        assert gate is not None
        assert Openness(gate, 25.0).look_ahead <= max(look_ahead, 0.03) + 1e-9
    whole = read_gate(usual_gate(1.5))
    assert whole is not None
    assert vars(whole) == vars(EnergyGate())


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["nowhere", "-", "--to", "keep:1"], "nowhere"),
        (["FOLDER", "nowhere.wav", "--to", "keep:1"], "nowhere.wav"),
        (["FOLDER", "-", "--to", "keep:1", "--voice-gate", "energetic"], "--voice-gate"),
        (["FOLDER", "-", "--to", "keep:1", "--window", "nan"], "--window"),
        (["FOLDER", "-", "--to", "keep:1", "--checkpoint", "FOLDER"], "--checkpoint"),
        (["-", "--to", "keep:1", "--checkpoint", "nowhere"], "nowhere"),
        (["FOLDER", "-", "--to", "keep:1", "--seconds", "0"], "--seconds"),
        (["FOLDER", "-", "--to", "keep:1", "--threads", "-1"], "--threads"),
    ],
)
def test_wrong_words_end_with_one_sentence(
    words: list[str], named: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "model.json").touch()
    assert facediff(["live", *(str(tmp_path) if word == "FOLDER" else word for word in words)]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert named in line
