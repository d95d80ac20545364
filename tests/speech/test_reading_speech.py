"""Speech in the forms that Python gives it in; arrays and tensors are tried in tests/pipelines/test_animator.py."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile

from facediff.errors import FaceDiffError
from facediff.speech.audio import speech_of

TONE = (0.3 * np.sin(np.arange(16000) / 7)).astype(np.float32)


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """A second in stereo at 22 050 Hz, 16 bits."""
    path = tmp_path / "tone.wav"
    soundfile.write(path, np.stack([TONE, 0.5 * TONE], 1), 22050, subtype="PCM_16")
    return path


def test_open_files_and_audio_of_data_sets_are_the_recording(recording: Path) -> None:
    expected = speech_of(recording)
    content = recording.read_bytes()
    samples, rate = soundfile.read(recording)
    with recording.open("rb") as file:
        forms = {
            "open file": (file, "tone"),
            "content": (io.BytesIO(content), "speech"),
            "bytes of a data set": ({"bytes": content, "path": "clips/a.wav"}, "a"),
            "path of a data set": ({"bytes": None, "path": str(recording)}, "tone"),
            "decoded audio of a data set": ({"array": samples.T, "sampling_rate": rate, "path": None}, "speech"),
        }
        for form, (speech, name) in forms.items():
            found = speech_of(speech)  # type: ignore[arg-type]
            assert (found.name, found.rate) == (name, 22050), form
            np.testing.assert_allclose(found.speech, expected.speech, rtol=0, atol=2e-7, err_msg=form)
            np.testing.assert_allclose(found.sound, 0.75 * TONE, rtol=0, atol=1 / 32768, err_msg=form)


class Pipe(io.RawIOBase):
    """A file that is read once from the beginning to the end, such as an answer of a server."""

    def __init__(self, content: bytes) -> None:
        self.content = io.BytesIO(content)

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:  # noqa: ANN401
        return self.content.readinto(buffer)


def test_a_file_that_is_read_once_is_the_recording(recording: Path) -> None:
    expected = speech_of(recording).speech
    np.testing.assert_array_equal(speech_of(Pipe(recording.read_bytes())).speech, expected)  # type: ignore[arg-type]
    at_its_end = io.BytesIO()
    at_its_end.write(recording.read_bytes())
    np.testing.assert_array_equal(speech_of(at_its_end).speech, expected)


@pytest.mark.parametrize(
    ("speech", "rate", "problem"),
    [
        (io.BytesIO(b"no sound"), None, "speech"),
        (TONE, None, "rate: is missing"),
        (np.zeros(0, np.float32), 16000, "speech"),
        (TONE * np.nan, 16000, "speech"),
        ({"array": TONE[:100], "sampling_rate": 16000}, None, "lasts"),
    ],
)
def test_what_is_no_speech_is_refused(speech: object, rate: float | None, problem: str) -> None:
    with pytest.raises(FaceDiffError, match=problem):
        speech_of(speech, rate)  # type: ignore[arg-type]
