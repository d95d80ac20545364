"""Speech in, animation out; bad input gets one sentence and leaves nothing behind."""

from __future__ import annotations

import os
import pickle
import re
import signal
import sys
from contextlib import suppress
from pathlib import Path

import av
import numpy as np
import pytest
import soundfile
import torch

from facediff.animation import read_archive
from facediff.cli.app import main
from facediff.mesh import read_mesh
from facediff.models import DualPathDiffusion, load_model
from facediff.speech.audio import read_speech
from tests.fakes.processes import Forked, program
from tests.fakes.waiting import wait_until, wait_until_read
from tests.fakes.words import last_of_each


@pytest.fixture
def speech(tmp_path: Path) -> Path:
    path = tmp_path / "speech.wav"
    time = np.arange(22050) / 22050
    soundfile.write(path, np.stack([0.3 * np.sin(2 * np.pi * 200 * time)] * 2, 1), 22050)
    return path


def animate(*words: object) -> int:
    return main(["animate", *last_of_each([*map(str, words), "--quiet"])])


def test_npy_holds_absolute_vertices_and_repeats_bit_for_bit(speech: Path, checkpoint: Path, tmp_path: Path) -> None:
    outputs = [tmp_path / "new" / f"{i}.npy" for i in range(3)]
    for path, seed in zip(outputs, (5, 5, 6), strict=True):
        assert animate(speech, "--checkpoint", checkpoint, "-o", path, "--seed", seed, "--identity", "B") == 0
    first, second, third = map(np.load, outputs)
    assert first.shape == (25, 24, 3)
    assert np.array_equal(first, second)
    assert not np.array_equal(first, third)
    template = load_model(checkpoint).assets.templates["B"].numpy()
    assert np.abs(first - template).max() < 0.2


def test_the_recording_in_the_package_needs_no_other_file(
    speech: Path, checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "out.npy"
    assert animate("--example", "--checkpoint", checkpoint, "-o", path) == 0
    assert len(np.load(path)) > 25
    assert animate(speech, "--example", "--checkpoint", checkpoint, "-o", path) == 2
    assert "has no effect" in capsys.readouterr().err


def write(path: Path, samples: np.ndarray, rate: int = 16000) -> Path:
    soundfile.write(path, samples, rate)
    return path


@pytest.mark.parametrize("seconds", [pytest.param(1.0, marks=pytest.mark.slow), 10.6])
def test_expressivity_goes_from_the_mean_to_the_sample(checkpoint: Path, tmp_path: Path, seconds: float) -> None:
    """In one pass and by windows."""
    speech = write(tmp_path / "speech.wav", 0.1 * np.random.default_rng(0).standard_normal(int(16_000 * seconds)))

    def made(speech: Path, checkpoint: Path, *words: object) -> np.ndarray:
        assert animate(speech, "--checkpoint", checkpoint, "-o", tmp_path / "x.npy", *words) == 0
        return np.asarray(np.load(tmp_path / "x.npy"), np.float64)

    sample, mean = (made(speech, checkpoint, "--seed", 3, "--expressivity", share) for share in (1, 0))
    assert np.array_equal(mean, made(speech, checkpoint, "--seed", 4, "--expressivity", "0.0"))
    assert np.array_equal(sample, made(speech, checkpoint, "--seed", 3))  # the bundled config's own is a sample
    found = made(speech, checkpoint, "--seed", 3, "--expressivity", 1.5)
    np.testing.assert_allclose(found, mean + 1.5 * (sample - mean), atol=1e-6)
    assert np.abs(sample - mean).max() > 1e-4


def test_bad_speech(checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "text.wav").write_text("hello " * 99)
    short = write(tmp_path / "short.wav", np.ones(1600) * 0.5)
    for speech, sentence in (
        (tmp_path / "missing.wav", "no such file or folder"),
        (tmp_path / "text.wav", "not a readable sound file"),
        (short, "lasts 0.10 s"),
    ):
        assert animate(speech, "--checkpoint", checkpoint, "-o", tmp_path / "out" / "x.npy") == 2
        assert sentence in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_seed_that_decides_nothing_is_refused(
    speech: Path,
    checkpoint: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(DualPathDiffusion, "samples", False)
    assert animate(speech, "--checkpoint", checkpoint, "-o", tmp_path / "x.npy", "--seed", 3) == 2
    assert "--seed" in capsys.readouterr().err
    assert not list(tmp_path.rglob("*.npy"))


def test_bad_options(
    speech: Path,
    checkpoint: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    np.save("other.npy", np.zeros((9, 31, 3), np.float32))
    np.save("far.npy", np.full((9, 24, 3), 0.5, np.float32))
    before = sorted(tmp_path.rglob("*"))
    for words, sentence in (
        ("--identity Zoe", '--identity: there is no identity "Zoe": known are A, B, C'),
        ("--style other.npy", "has shape (9, 31, 3); the model's faces have 24 vertices"),
        ("--style far.npy", "it is not A's"),
        ("--style A_e99", "no clip of that name"),
        ("--sampler dim", 'there is no sampler "dim": did you mean "ddim"?'),
        ("-o x.avi", 'there is no format ".avi"'),
        ("--window 0.1", "too few frames"),
        ("--expressiveness chin=2", "chin"),
        ("--blinks", "--blinks: lids and eyeballs of this face are not known"),
        ("--rate 8000", "--rate: has no effect without --stream"),
        ("--retry-failed", "--retry-failed: is for several recordings"),
    ):
        output = [] if "-o" in words else ["-o", "x.npy"]
        assert animate(speech, "--checkpoint", checkpoint, *output, *words.split()) == 2
        message = capsys.readouterr().err
        assert sentence in message
        assert len(message.splitlines()) == 1
    assert sorted(tmp_path.rglob("*")) == before


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


def test_several_samples_differ_and_stand_side_by_side_or_in_files_of_their_own(
    speech: Path, checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert animate(speech, "--checkpoint", checkpoint, "-o", tmp_path / "t.npy", "--samples", 2, "--seed", 5) == 0
    first, second = (np.load(tmp_path / f"t_sample{i}.npy") for i in (1, 2))
    assert not np.array_equal(first, second)
    assert animate(speech, "--checkpoint", checkpoint, "-o", tmp_path / "five.npy", "--seed", 5) == 0
    np.testing.assert_allclose(first, np.load(tmp_path / "five.npy"), rtol=0, atol=1e-5)
    assert animate(speech, "--checkpoint", checkpoint, "-o", tmp_path / "t.mp4", "--samples", 2, "--size", 64) == 0
    with av.open(str(tmp_path / "t.mp4")) as video:
        assert video.streams.video[0].width == 128
    assert "25 frames, identity A" in capsys.readouterr().out


def test_metadata_says_how_an_animation_was_made(speech: Path, checkpoint: Path, tmp_path: Path) -> None:
    path = tmp_path / "t.npz"
    words = ["--expressiveness", "1.5", "--sway", "3", "--style", "A_e02:1,B_e02:3"]
    assert animate(speech, "--checkpoint", checkpoint, "-o", path, *words) == 0
    animation = read_archive(path)
    assert animation.metadata["corpus"] == "tiny (synthetic)"
    assert animation.metadata["style"] == "0.25 A_e02 + 0.75 B_e02"
    assert "head sway" in animation.metadata["procedural"]
    assert "1.5" in animation.metadata["edited"]
    assert animation.frame_rate == 25
    assert animation.unit == "m"
    assert animation.inner_lip_pairs is not None
    assert animation.speech is not None
    assert (len(animation.speech), animation.sample_rate) == (22050, 22050)  # the recording's own


def test_long_speech_goes_to_disk_window_by_window(checkpoint: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    speech = write(tmp_path / "long.wav", 0.1 * rng.normal(size=16000 * 13))
    words = ["--seed", 2, "--voice-gate", "off"]  # to which noise is no speech
    assert animate(speech, "--checkpoint", checkpoint, "-o", tmp_path / "out" / "long.npy", *words) == 0
    made = np.load(tmp_path / "out" / "long.npy")
    model = load_model(checkpoint)
    expected = model.animate(torch.from_numpy(read_speech(speech)), identity="A", seed=2).vertices.numpy()
    assert made.shape == (325, 24, 3)
    np.testing.assert_array_equal(made, expected)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["long.npy"]


def test_speech_of_just_about_ten_seconds_is_made_as_the_model_makes_it(checkpoint: Path, tmp_path: Path) -> None:
    speech = write(tmp_path / "s.wav", 0.1 * np.random.default_rng(0).normal(size=160_100))  # 250 frames and a bit
    assert animate(speech, "--checkpoint", checkpoint, "-o", tmp_path / "s.npy", "--voice-gate", "off") == 0
    expected = load_model(checkpoint).animate(torch.from_numpy(read_speech(speech)), identity="A").vertices.numpy()
    np.testing.assert_array_equal(np.load(tmp_path / "s.npy"), expected)


def test_a_recording_is_not_replaced(
    checkpoint: Path, speech: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A video is a recording too, and has the suffix of an animation."""
    folder = tmp_path / "in"
    folder.mkdir()
    videos = [folder / "a.mp4", folder / "b.mp4"]
    assert animate(speech, "--checkpoint", checkpoint, "-o", videos[0], "--size", 32) == 0
    videos[1].write_bytes(videos[0].read_bytes())
    before = [path.read_bytes() for path in videos]
    capsys.readouterr()
    for words in ([videos[0], "-o", videos[0]], [*videos, "-o", folder]):
        assert animate(*words, "--checkpoint", checkpoint) == 2
        assert "a.mp4: would be overwritten, but this command reads" in capsys.readouterr().err
    assert [path.read_bytes() for path in videos] == before
    assert sorted(folder.iterdir()) == videos


def pcm(seconds: float) -> bytes:
    samples = 3000 * np.random.default_rng(0).normal(size=round(16000 * seconds))
    return samples.clip(-32767, 32767).astype("<i2").tobytes()


def stream_words(checkpoint: Path, output: object) -> list[str]:
    words = ["animate", "-", "--stream", "--checkpoint", str(checkpoint), "-o", str(output)]
    return [sys.executable, "-m", "facediff", *words]


def streamed(samples: bytes, checkpoint: Path, output: Path, *words: str) -> int:
    """The command in this process, with samples from a file as its standard input."""
    source = output.with_suffix(".pcm")
    source.write_bytes(samples)
    with source.open() as stdin, pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "stdin", stdin)
        status = main([*stream_words(checkpoint, output)[3:], *words])
    source.unlink()
    return status


def test_half_precision_is_the_same_for_a_stream(checkpoint: Path, tmp_path: Path) -> None:
    """The style is encoded in it as well."""
    speech = tmp_path / "s.wav"
    soundfile.write(speech, np.frombuffer(pcm(10.5), "<i2"), 16000)
    half = ["--precision", "bf16"]
    assert animate(speech, "--checkpoint", checkpoint, "-o", tmp_path / "file.npy", *half) == 0
    assert streamed(pcm(10.5), checkpoint, tmp_path / "stream.npy", *half) == 0
    np.testing.assert_array_equal(np.load(tmp_path / "stream.npy"), np.load(tmp_path / "file.npy"))


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_ctrl_c_ends_the_speech_and_what_was_said_is_kept(checkpoint: Path, tmp_path: Path) -> None:
    """A microphone has no other end."""
    process = Forked(program("facediff", *stream_words(checkpoint, tmp_path / "live.npy")[3:]))
    wait_until(lambda: "\n" in process.printed(1), lambda: process.poll() is None)
    # docs/streaming.md promises this line to programs that wait for it.
    told = r"look-ahead 4.50 s .* 75 frames at a time, 25 a second, 24 vertices; reading 16000 Hz, 16 bit"
    assert re.fullmatch(f"facediff animate: ready; {told}\n", process.printed(1))
    process.stdin.write(pcm(2))
    process.stdin.flush()
    wait_until_read(process.stdin, process.pid)
    os.kill(process.pid, signal.SIGINT)
    wait_until(lambda: process.poll() is not None)
    assert process.wait(1) == 0
    assert "2.00 s of speech" in process.printed(1)
    assert np.load(tmp_path / "live.npy").shape == (50, 24, 3)
    assert [path.name for path in tmp_path.iterdir()] == ["live.npy"]


def test_a_renderer_that_ends_ends_the_stream(checkpoint: Path) -> None:
    read, write = os.pipe()
    process = Forked(program("facediff", *stream_words(checkpoint, "-")[3:]), stdout=write)
    os.close(read)
    os.close(write)
    with suppress(BrokenPipeError):
        process.stdin.write(pcm(6))
    assert process.wait(60) == 141
    assert len(process.printed(1).splitlines()) == 1  # the look-ahead


@pytest.mark.parametrize("rate", ["16000", "44100"])
def test_a_stream_of_nothing(rate: str, checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert streamed(b"", checkpoint, tmp_path / "x.npy", "--rate", rate) == 2
    assert "ended before any sample came" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_stream_at_another_rate_and_a_file_sent_as_samples(
    checkpoint: Path, speech: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert streamed(pcm(1.5)[:-1], checkpoint, tmp_path / "s.npy", "--rate", "22050") == 0
    assert np.load(tmp_path / "s.npy").shape == (round(24_000 / 22_050 * 25), 24, 3)
    assert streamed(speech.read_bytes(), checkpoint, tmp_path / "x.npy") == 2
    assert "holds a sound file, not samples" in capsys.readouterr().err
    assert not (tmp_path / "x.npy").exists()


def test_samples_are_transferred_to_another_mesh_by_one_correspondence(
    speech: Path,
    checkpoint: Path,
    tiny_root: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    from facediff.editing import retargeting

    found = []
    correspond = retargeting.correspond
    monkeypatch.setattr(retargeting, "correspond", lambda *a, **k: found.append(1) or correspond(*a, **k))
    words = ["--samples", 2, "--target-mesh", tiny_root / "tiny.ply"]
    assert animate(speech, "--checkpoint", checkpoint, "-o", tmp_path / "t.npy", *words) == 0
    assert "motion is carried" in capsys.readouterr().out
    assert animate(speech, "--checkpoint", checkpoint, "-o", tmp_path / "own.npy", "--samples", 2) == 0
    assert len(found) == 1
    template = load_model(checkpoint).assets.templates["A"].numpy()
    rest = read_mesh(tiny_root / "tiny.ply").vertices
    for animation in (1, 2):
        carried, own = np.load(tmp_path / f"t_sample{animation}.npy"), np.load(tmp_path / f"own_sample{animation}.npy")
        moved, wanted = carried - rest, own - template
        # The same topology of nearly the same face: nearly the same motion, and another one for each take.
        assert np.abs(moved - wanted).max() < 0.25 * np.abs(wanted).max()
    assert not np.array_equal(np.load(tmp_path / "t_sample1.npy"), np.load(tmp_path / "t_sample2.npy"))
