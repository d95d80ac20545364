"""Published facts that a folder is held against."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class CheckFigure:
    """What everybody's copy of a split has.

    Attributes:
        split: the split.
        clips: its clips.
        frames: its frames.
    """

    split: str
    clips: int
    frames: int


CHECK_FIGURES = {"biwi": CheckFigure("test_a", 24, 3879)}
"""BIWI: what users of CodeTalker's scoring script report for its six people and sentences 37 to 40."""

INCOMPLETE = {"vocaset"}
"""Corpora of which some clips were never recorded."""

NEVER_RECORDED = 0.05
"""Share of a split that may be missing of these without a warning; the true number is not published."""

TEMPLATES = {
    "biwi": {"606284c0": "FaceFormer and TalkingStyle", "d436309f": "FaceDiffuser and DiffSpeaker"},
    "vocaset": {"2fc95570": "TalkingStyle and DiffSpeaker"},
}
"""``templates.pkl`` in the repositories of which projects, by the beginning of the file's git blob id."""

UNIT_AREA = {"biwi"}
"""Corpora whose circulating templates have a surface area of one."""

FLAME_REGIONS = {
    "regions/lve.txt": 428,
    "regions/fdd.txt": 1501,
    "FLAME_masks.pkl:lips": 250,
    "regions/FLAME_masks.pkl:lips": 250,
    "FLAME_masks.pkl:forehead+eye_region": 827,
    "regions/FLAME_masks.pkl:forehead+eye_region": 827,
    "regions/lip.txt": 648,
}
REGIONS = {
    "biwi": {"regions/lve.txt": 4996, "regions/lip.txt": 4996, "BIWI_lip.pkl": 4996, "regions/fdd.txt": 7784},
    "vocaset": FLAME_REGIONS,
    "mead3d": FLAME_REGIONS,
}
"""Distinct vertices of the lists that circulate."""
