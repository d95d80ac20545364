"""People's recordings with their words, for an audio encoder that knows one synthesiser's voices better than people's.

A model of the built-in corpus has heard few people, and its features of a stranger's speech are uncertain: of a woman's
m, it half expects an n. Where the words are known, what it should have heard is known too: the corpus's own speakers
say the same words, and both are aligned in time, by cepstra and by the features themselves. That is teacher-student
learning from parallel speech (Li, Seltzer, Wang, Zhao and Gong 2017) with parallels that are synthesised.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from facediff.errors import FaceDiffError, OptionError
from facediff.speech.audio import read_speech
from facediff.speech.cepstra import align_features, cepstra
from facediff.speech.phonemes import MOST_CHARACTERS, OTHER_PACE
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
"""A recording whose loudest sample is lower holds nothing but noise."""
MARGIN = STEP_RATE // 2
"""Steps of the corpus's speech that the teacher hears beyond both ends of a window."""
FEATURES = 1.4
"""Weight of the encoder's features beside cepstra in the alignment; of flite's p, b and m 94 % lie within 40 ms so, and
81 % by cepstra alone."""


class Said(NamedTuple):
    """A recording, and the same words by a speaker of the corpus.

    Attributes:
        recording: (S,) at 16 kHz; in half precision, since there are many.
        spoken: what the teacher hears, (R,) at 16 kHz; in half precision.
        places: the step of ``spoken`` that goes with each step of the recording.
    """

    recording: npt.NDArray[np.float16]
    spoken: npt.NDArray[np.float16]
    places: npt.NDArray[np.int64]

    def window(
        self, seconds: float, random: np.random.Generator
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32], npt.NDArray[np.int64]]:
        """What teacher and student hear of a random window of at most so many seconds, and the places in it."""
        size, most = SAMPLE_RATE // STEP_RATE, round(seconds * STEP_RATE)
        count = min(len(self.places), most)
        start = int(random.integers(len(self.places) - count + 1))
        places = self.places[start : start + count]
        first = max(0, int(places[0]) - MARGIN)
        spoken = self.spoken[first * size : (int(places[-1]) + 1 + MARGIN) * size]
        heard = self.recording[start * size : (start + count) * size]
        return spoken.astype(np.float32), heard.astype(np.float32), places - first


def read_said(folder: Path, data: SpeechMotionDataModule, teacher: AudioEncoder, *, most: int, seed: int) -> list[Said]:
    """People's recordings of a folder, aligned with the same words by speakers of the corpus.

    Args:
        folder: NAME.wav, .flac, .ogg or .mp3, each with its words in NAME.txt if they are English, and otherwise in
            NAME.LANGUAGE.txt, where LANGUAGE is espeak-ng's name of it, such as de or pt-br; in any folders below.
        data: the corpus, whose speakers say the words (:meth:`facediff.data.SpeechMotionDataModule.say`).
        teacher: the encoder whose features are to be reproduced.
        most: recordings; of more, so many are drawn.
        seed: of the draw.
    """
    expected = "expected NAME.wav or .flac, each with its words in NAME.txt, or NAME.de.txt if they are German"
    if not folder.is_dir():
        raise OptionError("transcribed", f"no such folder; {expected}", folder)
    named = {path.with_suffix(""): path for path in sorted(folder.rglob("*.txt"))}
    in_language = {name.with_suffix(""): (path, name.suffix[1:].lower()) for name, path in named.items()}
    transcripts = {}
    for path in folder.rglob("*"):
        name = path.with_suffix("")
        if path.suffix.lower() in SOUNDS and (name in named or name in in_language):
            transcripts[path] = (named[name], "") if name in named else in_language[name]
    if not transcripts:
        raise OptionError("transcribed", f"holds no recording with words; {expected}", folder)
    random = np.random.default_rng(seed)
    files = sorted(transcripts)
    chosen = [files[i] for i in random.permutation(len(files))[:most]]
    return [_read(path, *transcripts[path], data, teacher, number) for number, path in enumerate(chosen)]


def read_words(path: Path) -> str:
    """The words of a text file, in one line."""
    if path.stat().st_size > 4 * MOST_CHARACTERS:  # bytes of a character
        raise FaceDiffError(f"{path}: is longer than {MOST_CHARACTERS} characters; cut the recording and its text")
    try:
        text = " ".join(path.read_bytes().decode("utf-8-sig").split())
    except UnicodeDecodeError as error:
        raise FaceDiffError(f"{path}: is no text in UTF-8; save it as such") from error
    if not any(letter.isalpha() for letter in text):
        raise FaceDiffError(f"{path}: holds no words; expected what the recording of this name says")
    return text


def _read(
    path: Path, transcript: Path, language: str, data: SpeechMotionDataModule, teacher: AudioEncoder, number: int
) -> Said:
    recording, text = read_speech(path, max_seconds=LONGEST), read_words(transcript)
    try:
        spoken = data.say(text, number, language)
    except FaceDiffError as error:
        raise FaceDiffError(f"{transcript}: {error}") from error
    if spoken is None:
        raise OptionError.naming(
            f"{{transcribed}}: the speakers of {type(data).__name__} cannot say texts, as the built-in corpus's can; "
            f"omit it"
        )
    if not 1 / OTHER_PACE < len(recording) / len(spoken) < OTHER_PACE:
        raise FaceDiffError(
            f"{transcript}: takes {len(spoken) / SAMPLE_RATE:.1f} s to say, and {path.name} lasts "
            f"{len(recording) / SAMPLE_RATE:.1f} s; expected all words of this recording"
        )
    loudest = float(np.abs(recording).max())
    if loudest < SILENT:
        raise FaceDiffError(f"{path}: is silent; remove it, or record it again")
    recording *= np.abs(spoken).max() / loudest
    places = align_features(_features(recording, teacher), _features(spoken, teacher))
    return Said(recording.astype(np.float16), spoken.astype(np.float16), places)


def _features(speech: npt.NDArray[np.float32], encoder: AudioEncoder) -> npt.NDArray[np.float64]:
    """Standardised cepstra and the encoder's features (steps, channels), each as a whole by its weight."""
    length = torch.tensor([len(speech)])
    steps = (length * STEP_RATE // SAMPLE_RATE).clamp_min(2)
    device = next(encoder.parameters()).device
    with torch.no_grad():
        features = encoder(torch.from_numpy(speech)[None].to(device), length.to(device), steps.to(device))[0]
    heard = features.double().cpu().numpy()
    heard = (heard - heard.mean(0)) / np.maximum(heard.std(0), 1e-6)
    sound = cepstra(speech, int(steps), STEP_RATE)
    return np.concatenate([sound / np.sqrt(sound.shape[1]), FEATURES * heard / np.sqrt(heard.shape[1])], axis=1)
