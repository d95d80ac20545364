"""3DMEAD: FLAME reconstructions of the emotional videos of MEAD (Wang et al. 2020, Daněček et al. 2023)."""

from __future__ import annotations

import re
from typing import Any, ClassVar, Literal

from facediff import registry
from facediff.data.corpus import FLAME_SOURCES, Clip
from facediff.data.datamodule import SpeechMotionDataModule
from facediff.utils.licences import Commercial

EMOTIONS = ("neutral", "happy", "sad", "surprised", "fear", "disgusted", "angry", "contempt")
TRAIN = (
    *(f"M{n:03d}" for n in (3, 5, 7, 9, 11, 12, 13, 19, *range(22, 32))),
    *(f"W{n:03d}" for n in (9, 11, 14, 15, 16, 18, 19, 21, 23, 24, 25, 26, 28, 29)),
)
VALIDATION = ("M032", "M033", "M034", "M035", "W033", "W035", "W036")
TEST = ("M037", "M039", "M040", "M041", "M042", "W037", "W038", "W040")
NEUTRAL_SENTENCES = {"train": range(1, 33), "val": range(33, 37), "test_a": range(37, 41)}
EMOTIONAL_SENTENCES = {"train": range(1, 25), "val": range(25, 28), "test_a": range(28, 31)}


@registry.corpus.register("Mead3D")
class Mead3D(SpeechMotionDataModule):
    """3DMEAD as vertices, from EMOTE's reconstructions or in ProbTalk3D's layout.

    25 frames per second, FLAME topology (5 023 vertices, metres), 47 speakers, eight emotions at three intensities; the
    clip attributes are ``emotion`` and ``intensity``, and style references share the emotion of their target.

    Args:
        split: ``sentence`` is ProbTalk3D's: the 32 training speakers, the last sentences of each emotion are for
            validation and test (test A). ``identity`` is EMOTE's: 32 speakers train, 7 validate, 8 test (test B).
            ``both`` trains and validates as ``sentence`` does and tests on both: test A, and EMOTE's 8 test speakers
            as test B. The dual path's paper names none.
        options: as for every data module.
    """

    corpus_name: ClassVar[str] = "mead3d"
    unit = "m"
    frame_rate: ClassVar[float] = 25.0
    n_vertices = 5023
    identities = list(TRAIN)
    mesh_files: ClassVar[tuple[str, ...]] = ("FLAME.ply", "FLAME_sample.ply", "flame_sample.ply")
    region_sources: ClassVar[dict[str, tuple[str, ...]]] = FLAME_SOURCES
    region_help: ClassVar[str] = (
        "lve.txt and fdd.txt are in datasets/regions of the ProbTalk3D repository "
        "(github.com/uuembodiedsocialai/ProbTalk3D); put them into regions/ of your corpus folder. Or take "
        "FLAME_masks.pkl from flame.is.tue.mpg.de."
    )
    reference_attributes: ClassVar[tuple[str, ...]] = ("emotion",)
    score_attributes: ClassVar[tuple[str, ...]] = ("emotion", "intensity")
    licence: ClassVar[str] = "MEAD and FLAME licences: non-commercial research"
    languages: ClassVar[tuple[str, ...]] = ("en",)
    commercial_use: ClassVar[Commercial] = "forbidden"
    licence_source: ClassVar[str] = "wywu.github.io/projects/MEAD/MEAD.html and flame.is.tue.mpg.de/modellicense.html"
    obtain: ClassVar[str] = (
        "3DMEAD is MEAD (wywu.github.io/projects/MEAD) with the reconstructions that EMOTE's authors distribute (see "
        "the inferno repository, github.com/radekd91/inferno); `facediff data prepare mead3d RAW OUT --flame MODEL` "
        "makes the corpus folder from them."
    )

    def __init__(self, *, split: Literal["sentence", "identity", "both"] = "sentence", **options: Any) -> None:  # noqa: ANN401
        super().__init__(**options)
        self.split = split

    @classmethod
    def parse_name(cls, name: str) -> Clip | None:
        """``M003_001_0_0``: identity, sequence, emotion, intensity.

        Sequences of one number have the same words within one emotion only.
        """
        match = re.fullmatch(r"([MW]\d{3})_(\d{3})_([0-7])_([0-2])", name)
        if match is None:
            return None
        emotion = EMOTIONS[int(match[3])]
        attributes = {"emotion": emotion, "intensity": str(int(match[4]) + 1)}
        return Clip(name, match[1], f"{emotion}_{match[2]}", attributes)

    def split_of(self, clip: Clip) -> str | None:
        """By speaker (``identity``), by sentence for the training speakers (``sentence``), or by both."""
        if self.split == "identity":
            groups = {"train": TRAIN, "val": VALIDATION, "test_b": TEST}
            return next((split for split, speakers in groups.items() if clip.identity in speakers), None)
        if clip.identity not in TRAIN:
            return "test_b" if self.split == "both" and clip.identity in TEST else None
        sentences = NEUTRAL_SENTENCES if clip.attributes["emotion"] == "neutral" else EMOTIONAL_SENTENCES
        return next((split for split, numbers in sentences.items() if clip.number in numbers), None)
