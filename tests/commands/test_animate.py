"""Speech in, animation out; bad input gets one sentence and leaves nothing behind."""

from __future__ import annotations

import pickle
from pathlib import Path

import av
import numpy as np
import pytest
import soundfile
import torch

from facediff.cli import main
from facediff.systems import load_system


@pytest.fixture
def speech(tmp_path: Path) -> Path:
    path = tmp_path / "speech.wav"
    time = np.arange(22050) / 22050
    soundfile.write(path, np.stack([0.3 * np.sin(2 * np.pi * 200 * time)] * 2, 1), 22050)
    return path


def animate(*words: object) -> int:
    return main(["animate", *map(str, words), "--quiet"])


def test_npy_holds_absolute_vertices_and_repeats_bit_for_bit(speech: Path, checkpoint: Path, tmp_path: Path) -> None:
    outputs = [tmp_path / "new" / f"{i}.npy" for i in range(3)]
    for path, seed in zip(outputs, (5, 5, 6), strict=True):
        assert animate(speech, "--checkpoint", checkpoint, "-o", path, "--seed", seed, "--identity", "B") == 0
    first, second, third = map(np.load, outputs)
    assert first.shape == (25, 24, 3)
    assert np.array_equal(first, second)
    assert not np.array_equal(first, third)
    template = load_system(checkpoint).assets.templates["B"].numpy()
    assert np.abs(first - template).max() < 0.2


def test_mp4_has_every_frame_and_the_speech(speech: Path, checkpoint: Path, tmp_path: Path) -> None:
    path = tmp_path / "out.mp4"
    assert animate(speech, "--checkpoint", checkpoint, "-o", path, "--size", 64) == 0
    with av.open(str(path)) as video:
        assert sum(1 for _ in video.decode(video=0)) == 25
    with av.open(str(path)) as video:
        sound = np.concatenate([frame.to_ndarray().ravel() for frame in video.decode(audio=0)])
    assert np.abs(sound).max() > 0.1


def test_sampler_steps_and_style_are_chosen(speech: Path, checkpoint: Path, tiny_root: Path, tmp_path: Path) -> None:
    def made(*words: object) -> np.ndarray:
        assert animate(speech, "--checkpoint", checkpoint, "-o", tmp_path / "x.npy", *words) == 0
        return np.load(tmp_path / "x.npy")

    plain = made()
    assert not np.array_equal(plain, made("--sampler", "ddpm", "--steps", 4))
    assert not np.array_equal(plain, made("--steps", 5))
    by_name = made("--style", "B_e02")
    by_file = made("--style", tiny_root / "vertices_npy" / "B_e02.npy")
    assert not np.array_equal(plain, by_name)
    assert np.array_equal(by_name, by_file)


def write(path: Path, samples: np.ndarray, rate: int = 16000) -> Path:
    soundfile.write(path, samples, rate)
    return path


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda folder: folder / "missing.wav", "no such sound file"),
        (lambda folder: (folder / "empty.wav").touch() or folder / "empty.wav", "is empty"),
        (lambda folder: (folder / "t.wav").write_text("hello " * 99) and folder / "t.wav", "not a readable sound file"),
        (lambda folder: write(folder / "silent.wav", np.zeros(16000)), "only silence"),
        (lambda folder: write(folder / "short.wav", np.ones(1600) * 0.5), "lasts 0.10 s"),
        (lambda folder: write(folder / "long.wav", np.ones(600 * 8000, np.float32) * 0.1, 8000), "lasts 600 s"),
    ],
    ids=["missing", "empty", "text", "silence", "short", "ten_minutes"],
)
def test_bad_speech(
    make: object, sentence: str, checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    speech = make(tmp_path)  # type: ignore[operator]
    assert animate(speech, "--checkpoint", checkpoint, "-o", tmp_path / "out" / "x.npy") == 2
    message = capsys.readouterr().err
    assert sentence in message
    assert len(message.splitlines()) == 1
    assert not (tmp_path / "out").exists()


def bad_reference(folder: Path) -> Path:
    np.save(folder / "other.npy", np.zeros((9, 31, 3), np.float32))
    return folder / "other.npy"


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--identity", "Zoe"], 'there is no "Zoe"; the checkpoint knows A, B, C'),
        (["--style", "other.npy"], "has shape (9, 31, 3); the checkpoint's faces have 24 vertices"),
        (["--style", "A_e99"], "no clip of that name"),
        (["--style", "none.npy"], "no such file"),
        (["--style", "far.npy"], "so it must be another person's"),
        (["--sampler", "dim"], 'there is no sampler "dim": did you mean "ddim"?'),
        (["--steps", "0"], "sampler.steps: 0 is impossible"),
        (["--device", "cuda:7"], "not usable on this machine"),
        (["--checkpoint", "text.ckpt"], "not a checkpoint that can be loaded safely"),
        (["-o", "x.gif"], 'unknown suffix ".gif"'),
        (["-o", "text.ckpt/x.npy"], "cannot be written"),
    ],
)
def test_bad_options(
    words: list[str],
    sentence: str,
    speech: Path,
    checkpoint: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    bad_reference(tmp_path)
    np.save(tmp_path / "far.npy", np.full((9, 24, 3), 0.5, np.float32))
    (tmp_path / "text.ckpt").write_text("no checkpoint")
    before = sorted(tmp_path.rglob("*"))
    assert animate(speech, "--checkpoint", checkpoint, "-o", "x.npy", *words) == 2
    message = capsys.readouterr().err
    assert sentence in message
    assert len(message.splitlines()) == 1
    assert sorted(tmp_path.rglob("*")) == before


def test_a_checkpoint_of_another_topology_says_so(
    checkpoint: Path, tmp_path: Path, speech: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    loaded = torch.load(checkpoint, weights_only=True)
    assets = loaded["facediff_assets"]
    assets["templates"] = {name: value[:20] for name, value in assets["templates"].items()}
    torch.save(loaded, tmp_path / "other.ckpt")
    assert animate(speech, "--checkpoint", tmp_path / "other.ckpt", "-o", tmp_path / "x.npy") == 2
    assert "vertices are {24} in the model and {20} in the corpus" in capsys.readouterr().err


def test_a_style_from_another_folder_comes_with_its_template_and_frame_rate(
    speech: Path, checkpoint: Path, tiny_root: Path, tmp_path: Path
) -> None:
    """The same motion of the same face, moved away in space and stored at twice the frame rate, is the same style."""
    person = tmp_path / "ada"
    (person / "vertices_npy").mkdir(parents=True)
    templates = pickle.loads((tiny_root / "templates.pkl").read_bytes())  # noqa: S301 - written by the fake
    motion = np.load(tiny_root / "vertices_npy" / "A_e02.npy").reshape(-1, 24, 3)
    (person / "templates.pkl").write_bytes(pickle.dumps({"Ada": templates["A"] + 5.0}))
    np.save(person / "vertices_npy" / "Ada_s01.npy", np.repeat(motion + 5.0, 2, axis=0))
    (person / "manifest.json").write_text('{"person": "Ada", "frame_rate": 50}')

    def made(style: str) -> np.ndarray:
        assert animate(speech, "--checkpoint", checkpoint, "--style", style, "-o", tmp_path / "out.npy") == 0
        return np.load(tmp_path / "out.npy")

    # Coordinates around 5 hold a millionth part less than those around 0.
    np.testing.assert_allclose(made(str(person / "vertices_npy" / "Ada_s01.npy")), made("A_e02"), rtol=0, atol=1e-5)
    (person / "manifest.json").write_text('{"person": "Ada", "frame_rate": 30}')
    style = person / "vertices_npy" / "Ada_s01.npy"
    assert animate(speech, "--checkpoint", checkpoint, "--style", style, "-o", tmp_path / "out.npy") == 2
