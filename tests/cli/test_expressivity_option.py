"""``--expressivity`` and ``--guidance`` as typed: for files, samples, long speech, streams and tests."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import soundfile

from facediff.animation import read_archive
from facediff.cli.app import main
from facediff.models import load_model
from tests.fakes.words import last_of_each


def say(path: Path, seconds: float) -> Path:
    random = np.random.default_rng(0)
    soundfile.write(path, 0.1 * random.standard_normal(int(16000 * seconds)), 16000, subtype="PCM_16")
    return path


@pytest.fixture
def speech(tmp_path: Path) -> Path:
    return say(tmp_path / "speech.wav", 1.0)


def animate(*words: object) -> int:
    return main(["animate", *last_of_each([*map(str, words), "--quiet"])])


def made(speech: Path, checkpoint: Path, *words: object) -> np.ndarray:
    path = speech.with_name("x.npy")
    assert animate(speech, "--checkpoint", checkpoint, "-o", path, *words) == 0
    return np.asarray(np.load(path), np.float64)


@pytest.mark.parametrize("seconds", [pytest.param(1.0, marks=pytest.mark.slow), 10.6])
def test_expressivity_goes_from_the_mean_to_the_sample(checkpoint: Path, tmp_path: Path, seconds: float) -> None:
    """In one pass and by windows."""
    speech = say(tmp_path / "speech.wav", seconds)
    sample, mean = (made(speech, checkpoint, "--seed", 3, "--expressivity", share) for share in (1, 0))
    assert np.array_equal(mean, made(speech, checkpoint, "--seed", 4, "--expressivity", "0.0"))
    assert np.array_equal(sample, made(speech, checkpoint, "--seed", 3))  # the bundled config's own is a sample
    found = made(speech, checkpoint, "--seed", 3, "--expressivity", 1.5)
    np.testing.assert_allclose(found, mean + 1.5 * (sample - mean), atol=1e-6)
    assert np.abs(sample - mean).max() > 1e-4


def test_samples_are_near_their_mean_and_files_say_it(speech: Path, checkpoint: Path, tmp_path: Path) -> None:
    path = tmp_path / "two.npz"
    words = ["--samples", 2, "--expressivity", "0.5", "--guidance", "identity=1.5", "--identity", "A"]
    assert animate(speech, "--checkpoint", checkpoint, "-o", path, *words) == 0
    files = sorted(tmp_path.glob("two_sample*.npz"))
    first, second = (read_archive(each) for each in files)
    assert first.metadata["expressivity"] == "0.5"
    assert first.metadata["guidance"] == "identity=1.5"
    assert not np.array_equal(first.vertices, second.vertices)
    plain = tmp_path / "plain.npz"
    assert animate(speech, "--checkpoint", checkpoint, "-o", plain) == 0
    assert not {"expressivity", "guidance"} & {*read_archive(plain).metadata}


def test_a_stream_has_the_expressivity_of_the_file(
    speech: Path, checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = ["--expressivity", "lips=0.5", "--guidance", "identity=1.2", "--window", 0.5, "--overlap", 0.2]
    samples = (soundfile.read(speech)[0] * 32768).astype("<i2").tobytes()
    raw = tmp_path / "raw"
    raw.write_bytes(samples)
    with raw.open("rb") as source:
        monkeypatch.setattr(sys, "stdin", SimpleNamespace(buffer=source))
        assert animate("-", "--stream", "--checkpoint", checkpoint, "-o", tmp_path / "s.npy", *options) == 0
    streamed = np.load(tmp_path / "s.npy")
    model = load_model(checkpoint)
    assert streamed.shape == (25, model.n_vertices, 3)
    with raw.open("rb") as source:
        monkeypatch.setattr(sys, "stdin", SimpleNamespace(buffer=source))
        assert animate("-", "--stream", "--checkpoint", checkpoint, "-o", tmp_path / "s.npy", *options[4:]) == 0
    assert not np.array_equal(streamed, np.load(tmp_path / "s.npy"))
