"""Recordings of people with their phones as voices of the built-in corpus, so that it speaks as thousands of people do.

A speaker is a folder of recordings, each with a TextGrid of the same name: what Praat, the Montreal Forced Aligner and
WebMAUS write. The recordings are used as they are; the motion's truth is made from the phones, as always.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from facediff.errors import FaceDiffError
from facediff.registry import puppet_voice
from facediff.speech.audio import read_speech
from facediff.speech.espeak import SpokenPhoneme, Utterance
from facediff.speech.text_grids import REMEDY, SILENCES, WORDS, find_tier, phones_in, read_text_grid
from facediff.synthetic.cast import ALIGNED
from facediff.synthetic.voices import CMU_PHONES, Delivery, Synthesiser
from facediff.utils import SAMPLE_RATE
from facediff.utils.checksums import file_stamps

SOUNDS = (".wav", ".flac")
LONGEST = 12.0  # Seconds of a recording that a corpus takes


@puppet_voice.register(ALIGNED)
class Aligned(Synthesiser):
    """A recording of a person with a TextGrid next to it; the voice is its path, with or without a suffix."""

    install = "give a recording with a TextGrid of the same name, aligned:FOLDER/NAME"

    @classmethod
    def voices(cls) -> list[str]:
        """None: recordings are the user's."""
        return []

    @classmethod
    def open(cls, voice: str, name: str) -> Aligned:  # noqa: ARG003
        """The recording of a path."""
        return cls(voice)

    def speak(self, text: str = "", delivery: Delivery = Delivery()) -> Utterance:  # noqa: ARG002, B008 - frozen
        """The recording, for any text and delivery."""
        stem = Path(self.voice)
        stem = stem.with_suffix("") if stem.suffix.lower() in (*SOUNDS, ".textgrid") else stem
        suffixes = (*SOUNDS, *map(str.upper, SOUNDS))
        sound = next((path for suffix in suffixes if (path := Path(f"{stem}{suffix}")).is_file()), None)
        if sound is None:
            raise FaceDiffError(f"{stem}: no such recording; expected a .wav or .flac file with a .TextGrid")
        grid = Path(f"{stem}.TextGrid")
        phonemes, samples = phones_of(grid), read_speech(sound)
        if phonemes[-1].end > len(samples) / SAMPLE_RATE + 0.1:
            raise FaceDiffError(
                f"{grid}: the tier of phones ends at {phonemes[-1].end:.2f} s and {sound.name} at "
                f"{len(samples) / SAMPLE_RATE:.2f} s; give the recording that was aligned"
            )
        return Utterance(samples, phonemes)


@dataclass(frozen=True)
class Recording:
    """A recording that can be spoken with: the name of its voice, and its words as far as the TextGrid has them."""

    voice: str
    text: str


def speakers_of(folder: Path) -> tuple[str, ...]:
    """Folders of the speakers below a folder, each with at least one aligned recording; sorted."""
    speakers = tuple(str(path) for path in sorted(folder.glob("*/")) if _stems(path))
    if not speakers:
        raise FaceDiffError(
            f"{folder}: holds no aligned recording; expected SPEAKER/NAME.wav or .flac, each with NAME.TextGrid"
        )
    return speakers


def state_of(people: Sequence[str]) -> str:
    """A hash of the paths, sizes and times of all recordings and TextGrids of people's voices; empty without any."""
    folders = [Path(voice.removeprefix(f"{ALIGNED}:")) for voice in people if voice.startswith(f"{ALIGNED}:")]
    stamps = [file_stamps(folder) for folder in folders]
    return hashlib.sha256(repr(stamps).encode()).hexdigest()[:16] if stamps else ""


def recordings_of(speaker: str, count: int) -> list[Recording]:
    """The first recordings of a speaker's folder that last no longer than 12 s."""
    recordings = []
    for stem in _stems(Path(speaker)):
        grid = Path(f"{stem}.TextGrid")
        if phones_of(grid)[-1].end <= LONGEST:
            tier = find_tier(read_text_grid(grid), WORDS) or []
            text = " ".join(text for _, _, text in tier if text.lower() not in SILENCES)
            recordings.append(Recording(f"{ALIGNED}:{stem}", text or stem.name))
        if len(recordings) == count:
            break
    if not recordings:
        raise FaceDiffError(f"{speaker}: no recording of {LONGEST:g} s or less; cut them and align them again")
    return recordings


@lru_cache(maxsize=4096)
def _stems(speaker: Path) -> list[Path]:
    """Recordings of a speaker's folder, without their suffixes, that have a TextGrid."""
    # A recording that is there as .wav and as .flac is one.
    sounds = sorted({path.with_suffix("") for path in speaker.rglob("*") if path.suffix.lower() in SOUNDS})
    return [stem for stem in sounds if Path(f"{stem}.TextGrid").is_file()]


def phones_of(path: Path) -> tuple[SpokenPhoneme, ...]:
    """The phones of a TextGrid in the International Phonetic Alphabet; pauses have an empty name.

    Phones of the ARPAbet are recognised by their names, with or without stress (``AA1``); all others are taken as IPA.
    """
    intervals = phones_in(path)
    labels = [re.sub(r"[012]$", "", text) for _, _, text in intervals]
    sounding = {label for label in labels if label.lower() not in SILENCES}
    # Single letters are in both alphabets: a tier is in the ARPAbet if all its phones are, and one of two letters.
    arpabet = {label for label in sounding if label.lower() in CMU_PHONES}
    is_arpabet = any(len(label) == 2 and label.isascii() for label in arpabet)
    if not sounding or (is_arpabet and arpabet != sounding):
        fault = f'has "{min(sounding - arpabet)}", no phone of the ARPAbet' if sounding else "holds pauses only"
        raise FaceDiffError(f"{path}: its tier of phones {fault}; {REMEDY}")
    phonemes = []
    for (start, end, _), label in zip(intervals, labels, strict=True):
        ipa = "" if label.lower() in SILENCES else CMU_PHONES[label.lower()] if is_arpabet else label
        phonemes.append(SpokenPhoneme(start, end, ipa))
    return tuple(phonemes)
