"""People's recordings with their phones, to teach audio encoders.

A speaker is a folder of recordings, each with a TextGrid of the same name, as `facediff data align`, Praat, the
Montreal Forced Aligner and WebMAUS write it.
"""

from __future__ import annotations

import re
from functools import lru_cache
from pathlib import Path

from facediff.errors import FaceDiffError
from facediff.speech.audio import read_speech
from facediff.speech.espeak import SpokenPhoneme, Utterance
from facediff.speech.text_grids import REMEDY, SILENCES, phones_in
from facediff.synthetic.voices import CMU_PHONES
from facediff.utils import SAMPLE_RATE

SOUNDS = (".wav", ".flac")
LONGEST = 12.0  # Seconds of a recording that is used


def speakers_of(folder: Path) -> tuple[Path, ...]:
    """Folders of the speakers below a folder, each with at least one aligned recording; sorted."""
    speakers = tuple(path for path in sorted(folder.glob("*/")) if _stems(path))
    if not speakers:
        raise FaceDiffError(
            f"{folder}: holds no aligned recording; expected SPEAKER/NAME.wav or .flac, each with NAME.TextGrid"
        )
    return speakers


def recordings_of(speaker: Path, count: int) -> list[Path]:
    """The first recordings of a speaker's folder that last no longer than 12 s, without their suffixes."""
    short = [stem for stem in _stems(speaker) if phones_of(Path(f"{stem}.TextGrid"))[-1].end <= LONGEST]
    if not short:
        raise FaceDiffError(f"{speaker}: no recording of {LONGEST:g} s or less; cut them and align them again")
    return short[:count]


def read_aligned(stem: Path) -> Utterance:
    """A recording and its phones, by its path without a suffix."""
    suffixes = (*SOUNDS, *map(str.upper, SOUNDS))
    sound = next(path for suffix in suffixes if (path := Path(f"{stem}{suffix}")).is_file())
    grid = Path(f"{stem}.TextGrid")
    phonemes, samples = phones_of(grid), read_speech(sound)
    if phonemes[-1].end > len(samples) / SAMPLE_RATE + 0.1:
        raise FaceDiffError(
            f"{grid}: the tier of phones ends at {phonemes[-1].end:.2f} s and {sound.name} at "
            f"{len(samples) / SAMPLE_RATE:.2f} s; give the recording that was aligned"
        )
    return Utterance(samples, phonemes)


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
