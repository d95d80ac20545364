"""The figures of a paper: faces, heat maps and curves of truth and methods, in the sizes and formats of journals.

The numbers in a figure are computed by functions of their own (`motion_maps`, `opening_curves`), which need no
matplotlib; drawing needs the extra ``figures``.
"""

from facediff.evaluation.figures.frames import (
    Moment,
    draw_frames,
    find_phoneme,
    frame_at,
    pick_frames,
)
from facediff.evaluation.figures.heatmaps import VertexMap, draw_heatmap, motion_maps
from facediff.evaluation.figures.lips import Curves, SpeechTrack, draw_lips, opening_curves
from facediff.evaluation.figures.material import FigureData, find_clips
from facediff.evaluation.figures.page import COLUMN, PAGE, Paper
from facediff.evaluation.file_pairs import read_pairs
from facediff.speech.phonemes import TimedPhoneme, read_phonemes

__all__ = [
    "COLUMN",
    "PAGE",
    "Curves",
    "FigureData",
    "Moment",
    "Paper",
    "TimedPhoneme",
    "SpeechTrack",
    "VertexMap",
    "draw_frames",
    "draw_heatmap",
    "draw_lips",
    "find_clips",
    "find_phoneme",
    "frame_at",
    "motion_maps",
    "opening_curves",
    "pick_frames",
    "read_pairs",
    "read_phonemes",
]
