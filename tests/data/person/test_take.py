"""A take of Live Link Face and its sound, out of step by a planted offset, as a corpus entry."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import soundfile

from facediff.cli.app import main
from facediff.data import LiveLink
from facediff.data.person import import_take
from facediff.spaces import Space
from facediff.spaces.files import ParameterClip, read_parameters, write_parameters
from facediff.synthetic.corpus import perform_clip, performed_clips, speak_clip
from facediff.synthetic.head.rig import SHAPES

RATE = 30.0


@pytest.fixture(scope="module")
def spoken() -> tuple[np.ndarray, np.ndarray]:
    """Speech and weights (T, 52) at 30 frames a second of six sentences of a speaker, in step."""
    speech, weights, times, seconds = [], [], [], 0.0
    for clip in [clip for clip in performed_clips() if clip.identity == "M1" and clip.split == "train"][:10]:
        said = speak_clip(clip)
        motion = perform_clip(clip, said, frame_rate=RATE)[0].weights
        speech.append(said.samples)
        weights.append(motion)
        times.append(seconds + np.arange(len(motion)) / RATE)
        seconds += len(said.samples) / 16_000
    # Sentences last a whole number of frames at 25 a second, and not at 30.
    frames = np.arange(int(seconds * RATE)) / RATE
    columns = np.concatenate(weights)[:, :52].T
    return np.concatenate(speech), np.stack([np.interp(frames, np.concatenate(times), one) for one in columns], axis=1)


def write_take(folder: Path, spoken: tuple[np.ndarray, np.ndarray], offset: float) -> tuple[Path, Path]:
    """The table, and a sound in which it begins ``offset`` seconds after the beginning."""
    speech, weights = spoken
    noise = np.random.default_rng(0).normal(0, 1e-3, round(abs(offset) * 16_000) + 8000).astype(np.float32)
    speech = np.concatenate([noise[: round(offset * 16_000)], speech]) if offset > 0 else speech
    first = round(-min(offset, 0.0) * 16_000)
    soundfile.write(folder / "take.wav", speech[first:], 16_000)
    space = Space("arkit", SHAPES[:52])
    clip = ParameterClip("take", weights.astype(np.float32), space, RATE, start=47_584.5)
    write_parameters(folder / "take.csv", clip)
    lines = (folder / "take.csv").read_text().splitlines(keepends=True)
    del lines[40:43]  # rows that the app dropped
    (folder / "take.csv").write_text("".join(lines))
    return folder / "take.csv", folder / "take.wav"


@pytest.mark.parametrize("offset", [0.2, -0.2, 1.37])
def test_a_planted_offset_is_found_to_20_ms(
    tmp_path: Path, spoken: tuple[np.ndarray, np.ndarray], offset: float
) -> None:
    take, sound = write_take(tmp_path, spoken, offset)
    report = import_take(take, sound, name="Ann", output=tmp_path / "ann")
    assert report.offset.found
    assert abs(report.offset.seconds - offset) <= 0.02
    assert report.offset.correlation > 0.5
    assert (report.dropped, report.frame_rate) == (3, RATE)


def test_the_entry_is_in_step_and_a_data_module_reads_it(
    tmp_path: Path, spoken: tuple[np.ndarray, np.ndarray], capsys: pytest.CaptureFixture[str]
) -> None:
    take, sound = write_take(tmp_path, spoken, 0.2)
    words = ["data", "import-take", str(take), str(sound), "--name", "Ann", "-o", str(tmp_path / "ann")]
    assert main([*words, "--clip-seconds", "3"]) == 0
    assert "offset +0." in capsys.readouterr().out
    manifest = json.loads((tmp_path / "ann" / "manifest.json").read_text())
    assert manifest["person"] == "Ann"
    data = LiveLink(root=str(tmp_path / "ann"), batch_size=2)
    assert data.identities == ["Ann"]
    names = [clip.name for split in ("train", "val", "test_a") for clip in data.clips(split)]
    assert sorted(names) == sorted(data.corpus.clips)
    original = read_parameters(take)
    whole = np.concatenate([data.corpus.read_motion(clip)[:, :, 0].numpy() for clip in data.corpus.clips.values()])
    jaw = data.space.index("jawOpen")
    # Joined again, the clips are the take; three rows are interpolated.
    assert np.abs(whole[50:, jaw] - original.values[47:, jaw][: len(whole) - 50]).max() < 1e-6
    batch = next(iter(data.train_dataloader()))
    assert batch.motion.shape[2:] == (61, 1)
    assert main(["data", "check", str(tmp_path / "ann"), "--corpus", "LiveLink"]) == 0
