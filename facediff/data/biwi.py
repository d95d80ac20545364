"""BIWI, the B3D(AC)^2 corpus of emotional speech (Fanelli et al. 2010)."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import ClassVar

from facediff import registry
from facediff.data.corpus import Circulating, Clip
from facediff.data.datamodule import SpeechMotionDataModule
from facediff.utils.licences import Commercial

SEEN = ("F2", "F3", "F4", "M3", "M4", "M5")
UNSEEN = ("F1", "F5", "F6", "F7", "F8", "M1", "M2", "M6")
SENTENCES = {"train": range(1, 33), "val": range(33, 37), "test": range(37, 41)}


@registry.corpus.register("Biwi")
class Biwi(SpeechMotionDataModule):
    """BIWI (B3D(AC)^2) in the layout of FaceFormer, CodeTalker, SelfTalk and FaceDiffuser.

    25 frames per second, 23 370 vertices, emotional sentences e01 to e40. F2 F3 F4 M3 M4 M5 are trained on: sentences
    1–32 train, 33–36 validate, 37–40 test (test A: 24 sequences); the other eight speakers' 37–40 are test B (32). The
    other sentences of these eight serve as style references only.
    """

    corpus_name: ClassVar[str] = "biwi"
    unit = "normalised (the square root of a face's surface area is 1, about 185 mm)"
    frame_rate: ClassVar[float] = 25.0
    n_vertices = 23370
    identities = list(SEEN)
    mesh_files: ClassVar[tuple[str, ...]] = ("BIWI.ply",)
    region_sources: ClassVar[dict[str, tuple[str, ...]]] = {
        "lips": ("regions/lve.txt", "regions/lip.txt", "BIWI_lip.pkl"),
        "upper_face": ("regions/fdd.txt",),
    }
    region_help: ClassVar[str] = (
        "The files lve.txt and fdd.txt are in the CodeTalker repository (github.com/Doubiiu/CodeTalker), in "
        "BIWI/regions; put them into regions/ of your corpus folder."
    )
    licence: ClassVar[str] = "B3D(AC)^2 end-user licence of ETH Zurich: non-commercial research"
    languages: ClassVar[tuple[str, ...]] = ("en",)
    commercial_use: ClassVar[Commercial] = "forbidden"
    licence_source: ClassVar[str] = "licence agreement of data.vision.ee.ethz.ch/cvl/datasets/b3dac2.en.html"
    obtain: ClassVar[str] = (
        "ETH Zurich distributed BIWI (B3D(AC)^2) on request; since 2024 its page is reported gone and no request is "
        "known to have succeeded, so only those who have a copy can use it. `facediff data prepare biwi RAW OUT` makes "
        "the corpus folder from the raw files."
    )
    circulating: ClassVar[Circulating] = Circulating(
        counts=("test_a", 24, 3879),
        templates={"606284c0": "FaceFormer and TalkingStyle", "d436309f": "FaceDiffuser and DiffSpeaker"},
        unit_area=True,
    )

    @classmethod
    def parse_name(cls, name: str) -> Clip | None:
        """``F2_e01``; the neutral sequences (``F2_01``) are not used by the field."""
        match = re.fullmatch(r"([FM]\d)_(e\d\d)", name)
        return Clip(name, match[1], match[2]) if match else None

    @classmethod
    def name_attributes(cls, name: str) -> Mapping[str, str]:
        """Of 80 sequences of a speaker, 40 are emotional (``F2_e01`` to ``F2_e40``) and 40 neutral (``F2_01`` …)."""
        match = re.fullmatch(r"[FM]\d_(e?)\d\d", name)
        return {} if match is None else {"emotion": "emotional" if match[1] else "neutral"}

    @classmethod
    def expected_clips(cls) -> dict[str, list[str]]:
        """192 training, 24 validation, 24 test A and 32 test B sequences."""

        def names(speakers: tuple[str, ...], part: str) -> list[str]:
            return [f"{speaker}_e{number:02d}" for speaker in speakers for number in SENTENCES[part]]

        return {
            "train": names(SEEN, "train"),
            "val": names(SEEN, "val"),
            "test_a": names(SEEN, "test"),
            "test_b": names(UNSEEN, "test"),
        }

    def split_of(self, clip: Clip) -> str | None:
        """By speaker and sentence number."""
        part = next((part for part, numbers in SENTENCES.items() if clip.number in numbers), None)
        if clip.identity in UNSEEN:
            return "test_b" if part == "test" else None
        return "test_a" if part == "test" else part
