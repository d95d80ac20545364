"""The built-in corpus: synthetic speakers with faces made by code and speech from espeak-ng.

It is synthetic, needs no licence and no download, and has the layout of BIWI's circulating copies on disk. See
:func:`generate`.
"""

from facediff.synthetic.corpus import (
    GENERATOR,
    MOODS,
    REFERENCE_SENTENCES,
    SEEN_IDENTITIES,
    TEST_SENTENCES,
    TRAIN_SENTENCES,
    UNSEEN_IDENTITIES,
    VAL_SENTENCES,
    generate,
    is_complete,
)
from facediff.synthetic.face import N_VERTICES
from facediff.synthetic.motion import FRAME_RATE
from facediff.utils import SAMPLE_RATE

#: Unit of length of every position in the corpus.
UNIT = "m"

__all__ = [
    "FRAME_RATE",
    "GENERATOR",
    "MOODS",
    "N_VERTICES",
    "REFERENCE_SENTENCES",
    "SAMPLE_RATE",
    "SEEN_IDENTITIES",
    "TEST_SENTENCES",
    "TRAIN_SENTENCES",
    "UNIT",
    "UNSEEN_IDENTITIES",
    "VAL_SENTENCES",
    "generate",
    "is_complete",
]
