"""Speech with the sounds that can be seen on a mouth, to teach an audio encoder by people without a face.

Sounds that look alike are one class, by their targets in :mod:`facediff.synthetic.articulation`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from facediff.data.augmentation import Augmenter
from facediff.data.datamodule import SpeechMotionDataModule
from facediff.errors import FaceDiffError
from facediff.speech.audio import samples_for
from facediff.speech.phonemes import TimedPhoneme, phonemes_file, read_phonemes
from facediff.synthetic.articulation import PAUSE, articulations
from facediff.synthetic.recordings import recordings_of, speakers_of
from facediff.synthetic.voices import open_voice

SOUNDS = (
    *("pause", "bilabial", "labiodental", "rounded glide or close vowel", "postalveolar", "dental", "sibilant"),
    *("rounded vowel", "open vowel", "mid vowel", "close vowel", "other consonant"),
)
IGNORED = -1  # frames of padding
BRIEF = (1, 2)
"""Sounds that mark the frame of their middle, however short they are."""
MOST = 100
"""Recordings of a speaker that are used."""
CHANGED = 0.7
"""Share of people's pieces that the corpus's augmentations change, at least.

Other rooms, microphones and voices cost nothing here, since no motion has to fit them.
"""


def visible_sound(ipa: str) -> int:
    """The place in :data:`SOUNDS` of a phoneme; a pause for one that is not known."""
    sound = articulations(ipa)[0] if ipa else PAUSE
    targets = sound.targets
    jaw, pucker = targets.get("jawOpen", 0.0), targets.get("mouthPucker", 0.0)
    if not targets:
        return 0
    if sound.contact:
        return 1 if sound.contact == "lip" else 2
    if pucker > 0.6:
        return 3
    if targets.get("mouthFunnel", 0.0) > 0.4 and jaw < 0.12:
        return 4
    if targets.get("tongueForward", 0.0) > 0.5:
        return 5
    if "mouthSmile" in targets:  # vowels alone
        return 7 if pucker > 0.15 else 8 if jaw > 0.3 else 9 if jaw > 0.16 else 10
    return 6 if targets.get("mouthLowerDown", 0.0) >= 0.4 and jaw < 0.1 else 11


def sounds_in_frames(phonemes: Sequence[TimedPhoneme], frames: int, frame_rate: float) -> npt.NDArray[np.int64]:
    """The sound at the middle of each frame (frames,), as its place in :data:`SOUNDS`."""
    sounds = np.zeros(frames, np.int64)
    for phoneme in phonemes:
        sound = visible_sound(phoneme.ipa)
        first, last = (math.ceil(time * frame_rate - 0.5) for time in (phoneme.start, phoneme.end))
        sounds[max(first, 0) : max(last, 0)] = sound
        middle = math.floor(phoneme.middle * frame_rate)
        if sound in BRIEF and 0 <= middle < frames:
            sounds[middle] = sound
    return sounds


@dataclass(frozen=True, eq=False)
class SoundBatch:
    """Pieces of speech with their sounds."""

    audio: Tensor  # (batch, samples) at 16 kHz, padded with zeros
    audio_lengths: Tensor  # (batch,) valid samples
    frame_lengths: Tensor  # (batch,) valid frames
    sounds: Tensor  # (batch, frames), places in SOUNDS, IGNORED on padding


class SpokenSounds:
    """People's recordings and a corpus's training clips, from which pieces are drawn, half of each.

    Args:
        recordings: folder of `facediff data align`.
        data: the corpus; without phoneme tables, people's recordings are used alone.
    """

    def __init__(self, recordings: Path, data: SpeechMotionDataModule) -> None:
        self.frame_rate = data.frame_rate
        self.augmenter = given = data.augmenter
        self.of_people = given and Augmenter(given.augmentations, max(CHANGED, given.share))
        self.people: list[tuple[npt.NDArray[np.float32], npt.NDArray[np.int64]]] = []
        for speaker in speakers_of(recordings):
            for recording in recordings_of(speaker, MOST):
                said = open_voice(recording.voice).speak("")
                phonemes = [TimedPhoneme(*astuple(phoneme)) for phoneme in said.phonemes]
                frames = int(len(said.samples) / samples_for(1, self.frame_rate))
                if frames:
                    self.people.append((said.samples, sounds_in_frames(phonemes, frames, self.frame_rate)))
        if not self.people:
            raise FaceDiffError(f"{recordings}: holds no recording of a frame or more; align longer ones")
        self.corpus = data.corpus
        self.clips = [(clip, path) for clip in data.clips("train") if (path := phonemes_file(data.root, clip.name))]
        self._sounds: dict[int, npt.NDArray[np.int64]] = {}

    def draw(self, count: int, seconds: float, random: np.random.Generator) -> SoundBatch:
        """So many pieces of up to so many seconds."""
        pieces, sounds = [], []
        for number in range(count):
            if self.clips and number % 2:
                index = int(random.integers(len(self.clips)))
                read, known = partial(self.corpus.read_audio, self.clips[index][0]), self._sounds_of(index)
                augmenter = self.augmenter
            else:
                speech, known = self.people[int(random.integers(len(self.people)))]
                read, augmenter = partial(self._stretch, speech), self.of_people
            length = min(len(known), max(1, round(seconds * self.frame_rate)))
            start = int(random.integers(len(known) - length + 1))
            piece, seed = read(start, start + length), int(random.integers(2**31))
            pieces.append(piece if augmenter is None else torch.from_numpy(augmenter(piece.numpy(), seed)))
            sounds.append(torch.from_numpy(known[start : start + length]))
        pad = torch.nn.utils.rnn.pad_sequence
        return SoundBatch(
            pad(pieces, batch_first=True),
            torch.tensor([len(piece) for piece in pieces]),
            torch.tensor([len(known) for known in sounds]),
            pad(sounds, batch_first=True, padding_value=IGNORED),
        )

    def _sounds_of(self, index: int) -> npt.NDArray[np.int64]:
        """The sounds of a clip of the corpus; its table is read once."""
        if index not in self._sounds:
            clip, path = self.clips[index]
            self._sounds[index] = sounds_in_frames(read_phonemes(path), self.corpus.frames(clip), self.frame_rate)
        return self._sounds[index]

    def _stretch(self, speech: npt.NDArray[np.float32], start: int, stop: int) -> Tensor:
        """Samples of a recording from one frame to another."""
        first, last = (samples_for(frame, self.frame_rate) for frame in (start, stop))
        return torch.from_numpy(speech[first:last])
