"""VOCASET, the corpus of VOCA (Cudeiro et al. 2019)."""

from __future__ import annotations

import re
from typing import ClassVar

from facediff import registry
from facediff.data.corpus import FLAME_SOURCES, Circulating, Clip
from facediff.data.datamodule import SpeechMotionDataModule
from facediff.utils.licences import Commercial

TRAIN = (
    "FaceTalk_170728_03272_TA",
    "FaceTalk_170904_00128_TA",
    "FaceTalk_170725_00137_TA",
    "FaceTalk_170915_00223_TA",
    "FaceTalk_170811_03274_TA",
    "FaceTalk_170913_03279_TA",
    "FaceTalk_170904_03276_TA",
    "FaceTalk_170912_03278_TA",
)
VALIDATION = ("FaceTalk_170811_03275_TA", "FaceTalk_170908_03277_TA")
TEST = ("FaceTalk_170809_00138_TA", "FaceTalk_170731_00024_TA")
EVALUATED = range(21, 41)


@registry.corpus.register("Vocaset")
class Vocaset(SpeechMotionDataModule):
    """VOCASET in the layout of FaceFormer, CodeTalker, SelfTalk and TalkingStyle.

    12 speakers, 40 sentences, FLAME topology (5 023 vertices, metres). Circulating copies hold 60 frames per second, of
    which every second one is read, as in all projects; a folder made by ``facediff data prepare vocaset`` records its
    own frame rate. Eight speakers train (all sentences), two validate and two test (sentences 21–40 of each). The last
    four are unseen speakers, so the test is test B. Some clips were never recorded and are left out.
    """

    corpus_name: ClassVar[str] = "vocaset"
    unit = "m"
    frame_rate: ClassVar[float] = 30.0
    stored_frame_rate: ClassVar[float | None] = 60.0
    n_vertices = 5023
    identities = list(TRAIN)
    mesh_files: ClassVar[tuple[str, ...]] = ("FLAME_sample.ply",)
    region_sources: ClassVar[dict[str, tuple[str, ...]]] = FLAME_SOURCES
    region_help: ClassVar[str] = (
        "Get FLAME_masks.pkl from flame.is.tue.mpg.de (FLAME vertex masks); put it into your corpus folder. Or take "
        "lve.txt and fdd.txt from data/vocaset/regions of the FaceDiffuser repository "
        "(github.com/uuembodiedsocialai/FaceDiffuser) into regions/."
    )
    licence: ClassVar[str] = "VOCASET licence of the Max Planck Society: non-commercial research"
    languages: ClassVar[tuple[str, ...]] = ("en",)
    commercial_use: ClassVar[Commercial] = "forbidden"
    licence_source: ClassVar[str] = "voca.is.tue.mpg.de/license.html"
    obtain: ClassVar[str] = (
        "VOCASET is distributed after registration at voca.is.tue.mpg.de; `facediff data prepare vocaset RAW OUT` "
        "makes the corpus folder from its files."
    )
    circulating: ClassVar[Circulating] = Circulating(
        templates={"2fc95570": "TalkingStyle and DiffSpeaker"}, incomplete=True
    )

    @classmethod
    def parse_name(cls, name: str) -> Clip | None:
        """``FaceTalk_170728_03272_TA_sentence01``."""
        match = re.fullmatch(r"(FaceTalk_\d+_\d+_TA)_(sentence\d\d)", name)
        return Clip(name, match[1], match[2]) if match else None

    @classmethod
    def expected_clips(cls) -> dict[str, list[str]]:
        """320 training, 40 validation and 40 test clips; a few of them were never recorded."""
        speakers = {"train": (TRAIN, range(1, 41)), "val": (VALIDATION, EVALUATED), "test_b": (TEST, EVALUATED)}
        return {
            split: [f"{name}_sentence{number:02d}" for name in names for number in numbers]
            for split, (names, numbers) in speakers.items()
        }

    def split_of(self, clip: Clip) -> str | None:
        """By speaker, and for validation and test by sentence number."""
        if clip.identity in TRAIN:
            return "train"
        if clip.number not in EVALUATED:
            return None
        return "val" if clip.identity in VALIDATION else "test_b" if clip.identity in TEST else None

    def only_numbers(self, clip: Clip) -> bool:
        """Sentences 21 to 40 are each speaker's own, so equal numbers are not equal words.

        The published split evaluates "the 20 unique sentences that are not shared with any other subject" (Cudeiro et
        al. 2019, section 5). A column ``text`` in ``clips.csv`` decides for all sentences.
        """
        return clip.number in EVALUATED or super().only_numbers(clip)
