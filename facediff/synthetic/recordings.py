"""Recordings of people with their phones as voices of the built-in corpus, so that it speaks as thousands of people do.

A speaker is a folder of recordings, each with a TextGrid of the same name: what Praat, the Montreal Forced Aligner and
WebMAUS write. The recordings are used as they are; the motion's truth is made from the phones, as always.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from facediff.errors import FaceDiffError
from facediff.registry import puppet_voice
from facediff.speech.audio import read_speech
from facediff.speech.espeak import SpokenPhoneme, Utterance
from facediff.synthetic.voices import CMU_PHONES, Delivery, Synthesiser
from facediff.utils import SAMPLE_RATE
from facediff.utils.limits import LIMITS

ALIGNED = "aligned"
SOUNDS = (".wav", ".flac")
PHONES, WORDS = ("phones", "phone", "phonemes", "mau", "segments"), ("words", "word", "ort", "ort-mau")
"""How tiers of phones and of words are called, alone or after the speaker's name (``84 - phones``)."""
SILENCES = {"", "sil", "sp", "spn", "pau", "<eps>", "<p>", "<p:>", "<p>:", "<sil>", "#"}
LONGEST = 12.0  # Seconds of a recording that a corpus takes
REMEDY = "align the recording again, with Praat or the Montreal Forced Aligner"
_TOKEN = re.compile(r'"((?:[^"]|"")*)"|(<exists>|<absent>)|(?<![^\s=])([-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?)(?!\S)')

Interval = tuple[float, float, str]


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
        """The recording, whatever the text and the delivery."""
        stem = Path(self.voice)
        stem = stem.with_suffix("") if stem.suffix.lower() in (*SOUNDS, ".textgrid") else stem
        sound = next((path for suffix in SOUNDS if (path := Path(f"{stem}{suffix}")).is_file()), None)
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
    if not folder.is_dir():
        raise FaceDiffError(f"{folder}: no such folder; expected SPEAKER/NAME.wav or .flac, each with NAME.TextGrid")
    speakers = tuple(str(path) for path in sorted(folder.iterdir()) if path.is_dir() and _stems(path))
    if not speakers:
        raise FaceDiffError(
            f"{folder}: holds no aligned recording; expected SPEAKER/NAME.wav or .flac, each with NAME.TextGrid"
        )
    return speakers


def recordings_of(speaker: str, most: int) -> list[Recording]:
    """The first recordings of a speaker's folder that last no longer than 12 s.

    Raises:
        FaceDiffError: if there is none.
    """
    taken = []
    for stem in _stems(Path(speaker)):
        grid = Path(f"{stem}.TextGrid")
        if phones_of(grid)[-1].end <= LONGEST:
            words = find_tier(read_text_grid(grid), WORDS)
            spoken = [text for _, _, text in (words or []) if text.lower() not in SILENCES]
            taken.append(Recording(f"{ALIGNED}:{stem}", " ".join(spoken) or stem.name))
        if len(taken) == most:
            break
    if not taken:
        raise FaceDiffError(f"{speaker}: no recording of {LONGEST:g} s or less; cut them and align them again")
    return taken


@lru_cache(maxsize=4096)
def _stems(speaker: Path) -> list[Path]:
    """Recordings of a speaker's folder, without their suffixes, that have a TextGrid."""
    sounds = sorted(path.with_suffix("") for path in speaker.rglob("*") if path.suffix.lower() in SOUNDS)
    return [stem for stem in sounds if Path(f"{stem}.TextGrid").is_file()]


def phones_of(path: Path) -> tuple[SpokenPhoneme, ...]:
    """The phones of a TextGrid in the International Phonetic Alphabet; pauses have an empty name.

    Phones of the ARPAbet are recognised by their names, with or without stress (``AA1``); all others are taken as IPA.
    """
    tiers = read_text_grid(path)
    intervals = find_tier(tiers, PHONES)
    if not intervals:
        names = ", ".join(tiers) or "none"
        raise FaceDiffError(f"{path}: has no tier of phones (its tiers: {names}); name it phones, or {REMEDY}")
    labels = [re.sub(r"[012]$", "", text) for _, _, text in intervals]
    sounding = {label for label in labels if label.lower() not in SILENCES}
    # Single letters are in both alphabets: a tier is in the ARPAbet if all its phones are, and one of two letters.
    arpabet = {label for label in sounding if label.lower() in CMU_PHONES}
    is_arpabet = any(len(label) == 2 and label.isascii() for label in arpabet)
    if is_arpabet and arpabet != sounding:
        strange = min(sounding - arpabet)
        raise FaceDiffError(f'{path}: its tier of phones has "{strange}", no phone of the ARPAbet; {REMEDY}')
    if not sounding:
        raise FaceDiffError(f"{path}: its tier of phones holds pauses only; {REMEDY}")
    phonemes = []
    for (start, end, _), label in zip(intervals, labels, strict=True):
        ipa = "" if label.lower() in SILENCES else CMU_PHONES[label.lower()] if is_arpabet else label
        phonemes.append(SpokenPhoneme(start, end, ipa))
    return tuple(phonemes)


def find_tier(tiers: Mapping[str, list[Interval]], kinds: tuple[str, ...]) -> list[Interval] | None:
    """The first tier that is called as one of these, alone or after a speaker's name."""
    return next((tier for name, tier in tiers.items() if name.rpartition(" - ")[2].strip().lower() in kinds), None)


def read_text_grid(path: Path) -> dict[str, list[Interval]]:
    """Interval tiers of a TextGrid by name, in Praat's long or short text format: start and end in seconds, and text.

    Tiers of points are left out. The format is that of Praat's manual, "TextGrid file formats".
    """
    try:
        LIMITS.check("bytes", path.stat().st_size, path)
        content = path.read_bytes()
        text = content.decode("utf-16" if content[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig")
    except OSError as error:
        raise FaceDiffError(f"{path}: cannot be read ({error.strerror}); {REMEDY}") from error
    except UnicodeDecodeError as error:
        raise FaceDiffError(f"{path}: is no text in UTF-8 or UTF-16; save it in Praat as a text file") from error
    # Both formats hold the same texts and numbers in the same order; the long one names each of them.
    tokens = iter(_TOKEN.finditer(text))
    tier = "its header"
    try:
        if (_text(tokens), _text(tokens)) != ("ooTextFile", "TextGrid"):
            raise FaceDiffError(f"{path}: is no TextGrid; expected a text file that Praat or an aligner has written")
        _number(tokens), _number(tokens), next(tokens)
        tiers: dict[str, list[Interval]] = {}
        for _ in range(int(_number(tokens))):
            kind, tier = _text(tokens), f"tier {_text(tokens)}"
            _number(tokens), _number(tokens)
            intervals = [_interval(tokens, kind) for _ in range(int(_number(tokens)))]
            if kind != "IntervalTier":
                continue
            edges = [edge for start, end, _ in intervals for edge in (start, end)]
            backwards = next((i for i in range(1, len(edges)) if edges[i] < edges[i - 1] - 1e-6), None)
            if backwards is not None or (edges and edges[0] < 0.0):
                where = edges[backwards or 0]
                raise FaceDiffError(f"{path}: {tier} goes back in time at {where:g} s; {REMEDY}")
            tiers.setdefault(tier.removeprefix("tier "), intervals)
    except (StopIteration, ValueError) as error:
        raise FaceDiffError(f"{path}: {tier} is cut short or damaged; {REMEDY}") from error
    return tiers


def _interval(tokens: Iterator[re.Match[str]], kind: str) -> Interval:
    start = _number(tokens)
    return start, _number(tokens) if kind == "IntervalTier" else start, _text(tokens).strip()


def _text(tokens: Iterator[re.Match[str]]) -> str:
    match = next(tokens)
    if match[1] is None:
        raise ValueError(match[0])
    return match[1].replace('""', '"')


def _number(tokens: Iterator[re.Match[str]]) -> float:
    match = next(tokens)
    if match[3] is None:
        raise ValueError(match[0])
    return float(match[3])
