"""The figure of chosen moments: a row for the truth and each method, a column for each time or phoneme."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from facediff.errors import FaceDiffError, choices
from facediff.evaluation.figures.material import Array, FigureData, Painter
from facediff.evaluation.figures.page import Grid, Heading, Paper, check_output, save, style
from facediff.speech.phonemes import STRESS, TimedPhoneme

HIGHEST = 50.0  # Largest height of a picture in mm


def find_phoneme(selector: str, phonemes: Sequence[TimedPhoneme], clip: str) -> TimedPhoneme:
    """A phoneme by name: ``m`` is the first of the clip, ``m:2`` the second.

    An exact match takes precedence; else stress marks are ignored, then length marks and diacritics; else the name is
    that of a viseme, ``PP``.
    """
    name, _, number = selector.rpartition(":") if re.search(r".:\d+$", selector) else (selector, "", "1")
    rank, spoken_phonemes = int(number), [phoneme for phoneme in phonemes if phoneme.ipa]
    for same in (
        lambda p: p.ipa == name,
        lambda p: p.plain == name.strip(STRESS),
        lambda p: _without_marks(p.ipa) == _without_marks(name),
        lambda p: name in p.viseme.split("+"),
    ):
        matches = [phoneme for phoneme in spoken_phonemes if same(phoneme)]
        if 1 <= rank <= len(matches):
            return matches[rank - 1]
    symbols = dict.fromkeys(phoneme.plain for phoneme in spoken_phonemes)
    reason = choices(name, symbols) if symbols else "its phonemes are not known; give --phoneme-file"
    raise FaceDiffError(f'phoneme "{selector}": not spoken, or not so often, in clip {clip}: {reason}')


def _without_marks(ipa: str) -> str:
    """Without stress, length and diacritics."""
    letters = unicodedata.normalize("NFD", ipa)
    return "".join(letter for letter in letters if letter not in STRESS + "ː" and not unicodedata.combining(letter))


@dataclass(frozen=True)
class Moment:
    """A moment of a clip."""

    time: float  # in seconds
    phoneme: TimedPhoneme | None = None  # None if it was chosen by its time alone

    @property
    def heading(self) -> Heading:
        """The text above its column."""
        if self.phoneme is None or not self.phoneme.ipa:
            return Heading(small=f"{self.time:.2f} s")
        word = f" {self.phoneme.word}" if self.phoneme.word else ""
        return Heading(f"/{self.phoneme.plain}/{word}", f"{self.time:.2f} s")


def frame_at(time: float, frame_rate: float) -> int:
    """Number of the frame that is shown at a time: frame k lasts from k / frame_rate to (k + 1) / frame_rate.

    -1 for a time that is no number.
    """
    return int(np.floor(time * frame_rate + 1e-6)) if np.isfinite(time) else -1


def pick_frames(material: FigureData, clip: str, moments: Sequence[Moment]) -> dict[str, list[Array]]:
    """Faces (V, 3) of the truth and each method at every moment."""
    picked: dict[str, list[Array]] = {}
    for name, motion in material.open(clip).items():
        picked[name] = []
        for moment in moments:
            frame, path = frame_at(moment.time, material.rate), material.path(clip, name)
            if not 0 <= frame < len(motion):
                raise FaceDiffError(
                    f"{path}: has no frame at {moment.time:g} s; {name} has {len(motion)} frames at "
                    f"{material.rate:g} a second; give --frame-rate if it is another"
                )
            picked[name].append(np.asarray(motion[frame], np.float64))
    return picked


def draw_frames(
    material: FigureData,
    clip: str,
    moments: Sequence[Moment],
    output: Path,
    *,
    paper: Paper | None = None,
    view: str = "front",
    region: Sequence[int] | None = None,
) -> None:
    """Draw truth and methods, a row each, at chosen moments, a column each.

    ``view`` is a name in :data:`facediff.render.VIEWS`; ``region`` has the vertices of a close-up, such as the lips.
    """
    check_output(output)
    paper = paper or Paper()
    faces, shape = material.mesh([clip])
    painter = Painter(faces, shape, view=view, colours=material.colours, region=region)
    picked = pick_frames(material, clip, moments)
    with style(paper):
        headings = [moment.heading for moment in moments]
        grid = Grid(paper, material.names, headings, aspect=painter.aspect, highest=HIGHEST, remark=material.remark)
        painter.set_size(*grid.pixels)
        figure = grid.draw_labels()
        for row, motion in enumerate(picked.values()):
            for column, face in enumerate(motion):
                grid.picture(painter.paint(face), row, column)
        save(figure, output)
