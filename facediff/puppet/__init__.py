"""The built-in corpus: synthetic speakers with faces made by code and speech from espeak-ng.

It is synthetic, needs no licence and no download, and lies on disk in the layout of BIWI's circulating
copies. See `generate`.
"""

from facediff.puppet.corpus import GENERATOR, generate, is_complete
from facediff.puppet.face import N_VERTICES
from facediff.puppet.manner import FRAME_RATE
from facediff.puppet.plan import (
    MOODS,
    REFERENCE_SENTENCES,
    SEEN_SUBJECTS,
    TEST_SENTENCES,
    TRAIN_SENTENCES,
    UNSEEN_SUBJECTS,
    VAL_SENTENCES,
)
from facediff.puppet.speech import SAMPLE_RATE

#: Unit of length of every position in the corpus.
UNIT = "m"

__all__ = [
    "FRAME_RATE",
    "GENERATOR",
    "MOODS",
    "N_VERTICES",
    "REFERENCE_SENTENCES",
    "SAMPLE_RATE",
    "SEEN_SUBJECTS",
    "TEST_SENTENCES",
    "TRAIN_SENTENCES",
    "UNIT",
    "UNSEEN_SUBJECTS",
    "VAL_SENTENCES",
    "generate",
    "is_complete",
]
