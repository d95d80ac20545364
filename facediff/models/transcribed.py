"""People's recordings with their words, for an audio encoder that knows one synthesiser's voices better than people's.

A model of the built-in corpus is trained on few voices and takes a woman's m for an n. Where the words of a recording
are known, the corpus's own speakers say them too, and both are aligned in time by cepstra and by the encoder's
features: teacher-student learning from parallel speech (Li, Seltzer, Wang, Zhao and Gong 2017) with synthesised
parallels.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from facediff.errors import FaceDiffError, OptionError, damaged
from facediff.speech.audio import read_speech
from facediff.speech.cepstra import align_features, cepstra
from facediff.speech.phonemes import OTHER_PACE
from facediff.utils import SAMPLE_RATE

if TYPE_CHECKING:
    from facediff.data import SpeechMotionDataModule
    from facediff.models.audio_encoders import AudioEncoder

STEP_RATE = 50
"""Features a second at which student and teacher are compared."""
SOUNDS = (".wav", ".flac", ".ogg", ".mp3")
LONGEST = 15.0
"""Seconds of a recording; longer ones are better cut at pauses."""
SILENT = 1e-4
"""A recording with a lower peak holds nothing but noise."""
MARGIN = STEP_RATE // 2
"""Steps of the corpus's speech that the teacher hears beyond both ends of a window."""
FEATURES = 1.4
"""Weight of the encoder's features beside cepstra in the alignment; of flite's p, b and m 94 % lie within 40 ms so, and
81 % by cepstra alone."""


class TranscribedRecording(NamedTuple):
    """A recording, and the same words by a speaker of the corpus.

    Attributes:
        recording: (S,) at 16 kHz; in half precision, since there are many.
        synthesised: the teacher's speech, (R,) at 16 kHz; in half precision.
        teacher_steps: the step of ``synthesised`` that goes with each step of the recording.
    """

    recording: npt.NDArray[np.float16]
    synthesised: npt.NDArray[np.float16]
    teacher_steps: npt.NDArray[np.int64]

    def window(
        self, seconds: float, random: np.random.Generator
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32], npt.NDArray[np.int64]]:
        """A random window of at most so many seconds: the teacher's speech, the student's, and the teacher's steps."""
        size = SAMPLE_RATE // STEP_RATE
        count = min(len(self.teacher_steps), round(seconds * STEP_RATE))
        start = int(random.integers(len(self.teacher_steps) - count + 1))
        steps = self.teacher_steps[start : start + count]
        first = max(0, int(steps[0]) - MARGIN)
        teacher = self.synthesised[first * size : (int(steps[-1]) + 1 + MARGIN) * size]
        student = self.recording[start * size : (start + count) * size]
        return teacher.astype(np.float32), student.astype(np.float32), steps - first


def read_transcribed(
    folder: Path, data: SpeechMotionDataModule, teacher: AudioEncoder, *, limit: int, seed: int
) -> list[TranscribedRecording]:
    """People's recordings of a folder, aligned with the same words by speakers of the corpus.

    Args:
        folder: NAME.wav, .flac, .ogg or .mp3, each with its words in NAME.txt if they are English, and otherwise in
            NAME.LANGUAGE.txt, where LANGUAGE is espeak-ng's name of it, such as de or pt-br; in any folders below.
        data: the corpus; its speakers say the words (:meth:`facediff.data.SpeechMotionDataModule.say`).
        teacher: the encoder with the features to be reproduced.
        limit: recordings; of more, so many are drawn.
        seed: of the draw.
    """
    texts = {path.with_suffix(""): path for path in sorted(folder.rglob("*.txt"))}
    in_language = {name.with_suffix(""): (path, name.suffix[1:].lower()) for name, path in texts.items()}
    transcripts = {}
    for path in folder.rglob("*"):
        name = path.with_suffix("")
        if path.suffix.lower() in SOUNDS and (name in texts or name in in_language):
            transcripts[path] = (texts[name], "") if name in texts else in_language[name]
    if not transcripts:
        raise OptionError(
            "transcribed",
            "no recording with words there; expected NAME.wav or .flac, each with its words in NAME.txt, or "
            "NAME.de.txt if they are German",
            folder,
        )
    random = np.random.default_rng(seed)
    files = sorted(transcripts)
    sample = [files[i] for i in random.permutation(len(files))[:limit]]
    return [_read(path, *transcripts[path], data, teacher, number) for number, path in enumerate(sample)]


def _read(
    path: Path, transcript: Path, language: str, data: SpeechMotionDataModule, teacher: AudioEncoder, number: int
) -> TranscribedRecording:
    recording = read_speech(path, max_seconds=LONGEST)
    with damaged(transcript, "expected the words of the recording of this name, in UTF-8"):
        text = " ".join(transcript.read_bytes().decode("utf-8-sig").split())
        if not any(letter.isalpha() for letter in text):
            raise ValueError("holds no words")
        speech = data.say(text, number, language)
    if speech is None:
        raise OptionError.naming(
            f"{{transcribed}}: the speakers of {type(data).__name__} cannot say texts, as the built-in corpus's can; "
            f"omit it"
        )
    if not 1 / OTHER_PACE < len(recording) / len(speech) < OTHER_PACE:
        raise FaceDiffError(
            f"{transcript}: takes {len(speech) / SAMPLE_RATE:.1f} s to say, and {path.name} lasts "
            f"{len(recording) / SAMPLE_RATE:.1f} s; expected all words of this recording"
        )
    loudest = float(np.abs(recording).max())
    if loudest < SILENT:
        raise FaceDiffError(f"{path}: is silent; remove it, or record it again")
    recording *= np.abs(speech).max() / loudest
    steps = align_features(_features(recording, teacher), _features(speech, teacher))
    return TranscribedRecording(recording.astype(np.float16), speech.astype(np.float16), steps)


def _features(speech: npt.NDArray[np.float32], encoder: AudioEncoder) -> npt.NDArray[np.float64]:
    """Standardised cepstra and the encoder's features (steps, channels), each as a whole by its weight."""
    length = torch.tensor([len(speech)])
    steps = (length * STEP_RATE // SAMPLE_RATE).clamp_min(2)
    device = next(encoder.parameters()).device
    with torch.no_grad():
        features = encoder(torch.from_numpy(speech)[None].to(device), length.to(device), steps.to(device))[0]
    array = features.double().cpu().numpy()
    array = (array - array.mean(0)) / np.maximum(array.std(0), 1e-6)
    sound = cepstra(speech, int(steps), STEP_RATE)
    return np.concatenate([sound / np.sqrt(sound.shape[1]), FEATURES * array / np.sqrt(array.shape[1])], axis=1)
