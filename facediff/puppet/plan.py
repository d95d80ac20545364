"""Who says what in which mood: the clips of the built-in corpus and its splits."""

from __future__ import annotations

from dataclasses import dataclass

SEEN_SUBJECTS = ("F1", "F2", "F3", "M1", "M2", "M3")
UNSEEN_SUBJECTS = ("F4", "M4")
MOODS = ("flat", "neutral", "lively")
TRAIN_SENTENCES = tuple(range(1, 25))
VAL_SENTENCES = tuple(range(25, 28))
TEST_SENTENCES = tuple(range(28, 33))
#: Sentences of the unseen speakers that belong to no split, about a minute each: style references, and what a trained
#: model is adapted with.
REFERENCE_SENTENCES = tuple(range(1, 25))


@dataclass(frozen=True)
class Clip:
    """One clip of the corpus.

    Attributes:
        subject: Who speaks.
        number: Which sentence, from 1.
        mood: One of `MOODS`.
    """

    subject: str
    number: int
    mood: str

    @property
    def sentence(self) -> str:
        """Name of the sentence, such as ``"e01"``."""
        return f"e{self.number:02d}"

    @property
    def name(self) -> str:
        """Name of the clip and stem of its files, such as ``"F1_e01"``."""
        return f"{self.subject}_{self.sentence}"


def clips() -> tuple[Clip, ...]:
    """All clips, speaker by speaker.

    Moods take turns, shifted by one from speaker to speaker, so that every speaker has every mood equally
    often in training and every sentence is heard in every mood.
    """
    everything = (*TRAIN_SENTENCES, *VAL_SENTENCES, *TEST_SENTENCES)
    plan = [(subject, everything) for subject in SEEN_SUBJECTS]
    plan += [(subject, (*REFERENCE_SENTENCES, *TEST_SENTENCES)) for subject in UNSEEN_SUBJECTS]
    return tuple(
        Clip(subject, number, MOODS[(number + turn) % len(MOODS)])
        for turn, (subject, numbers) in enumerate(plan)
        for number in numbers
    )
