"""The figures of a paper: faces, heat maps and curves of truth and methods, in the sizes and formats of journals.

What a figure shows is computed by functions of its own (`motion_maps`, `error_maps`, `opening_curves`, `read_curves`),
which need no matplotlib; drawing needs the extra ``figures``.
"""

from facediff.data.phonemes import Phoneme, read_phonemes
from facediff.evaluation.figures.curves import (
    Curve,
    Curves,
    Sound,
    choose_scalars,
    draw_lips,
    draw_training,
    find_gaps,
    find_metrics,
    opening_curves,
    read_curves,
    read_pairs,
    smooth,
)
from facediff.evaluation.figures.frames import (
    Moment,
    draw_frames,
    find_phoneme,
    frame_at,
    pick_frames,
)
from facediff.evaluation.figures.heatmaps import VertexMap, draw_error, draw_heatmap, error_maps, motion_maps
from facediff.evaluation.figures.material import Material, find_clips
from facediff.evaluation.figures.page import COLUMN, PAGE, Paper

__all__ = [
    "COLUMN",
    "PAGE",
    "Curve",
    "Curves",
    "Material",
    "Moment",
    "Paper",
    "Phoneme",
    "Sound",
    "VertexMap",
    "choose_scalars",
    "draw_error",
    "draw_frames",
    "draw_heatmap",
    "draw_lips",
    "draw_training",
    "error_maps",
    "find_clips",
    "find_gaps",
    "find_metrics",
    "find_phoneme",
    "frame_at",
    "motion_maps",
    "opening_curves",
    "pick_frames",
    "read_curves",
    "read_pairs",
    "read_phonemes",
    "smooth",
]
