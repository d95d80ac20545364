"""The options of a study, for the command line and for Python."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from facediff.utils import ranges
from facediff.utils.option import Option
from facediff.utils.ranges import Range

Count = Annotated[int, Range(0, 50), Option(metavar="N")]


@dataclass(frozen=True)
class StudyOptions:
    """Study.

    Attributes:
        clips: clips to show (default: a seeded choice of those that all have, even among speakers)
        max_clips: clips that are chosen at most
        design: latin: every rater sees every clip once, with a pair that changes from rater to rater; all: every clip
            with every pair
        pairs: first: the first method with each other one and the truth; all: all with all
        still_controls: videos of the truth against a still face, for each rater; none without a truth
        same_controls: videos of one animation on both sides, for each rater
        repeats: videos that come again with their sides exchanged, for each rater
        questions: .yaml with questions, consent, title and the rule of exclusion (default: realism, lip_sync, style,
            comments)
        languages: of the page, en,de,es,fr,zh (default: all)
        seed: of the choice of clips, of sides, orders and references
        size: height and width of a face in pixels
        view: camera
        video: format; webm (VP9) for browsers without H.264
    """

    clips: Annotated[list[str] | None, Option(metavar="CLIP", many=True)] = None
    max_clips: Annotated[ranges.Samples, Option(metavar="N")] = 12
    design: Literal["latin", "all"] = "latin"
    pairs: Literal["first", "all"] = "first"
    still_controls: Count = 3
    same_controls: Count = 1
    repeats: Count = 1
    questions: Annotated[Path | None, Option(metavar="FILE", reads=True, exists="file")] = None
    languages: Annotated[Sequence[str] | None, Option(metavar="CODE,…")] = None
    seed: Annotated[ranges.Seed, Option(metavar="N")] = 0
    size: Annotated[ranges.Pixels, Option(metavar="PIXELS")] = 384
    view: Literal["front", "three_quarter", "side"] = "front"
    video: Literal["mp4", "webm"] = "mp4"

    def __post_init__(self) -> None:
        ranges.check_options(self)
