"""The figures of a paper: faces, heat maps and curves of truth and methods, in the sizes and formats of journals.

What a figure shows is computed by functions of its own (`motion_maps`, `error_maps`, `opening_curves`, `read_curves`),
which need no matplotlib; drawing needs the extra ``figures``.
"""

from facediff.figures.curves import Sound, draw_lips, draw_training
from facediff.figures.frames import Moment, draw_frames, frame_at, pick_frames
from facediff.figures.heat import draw_error, draw_heatmap
from facediff.figures.lips import Curves, opening_curves, read_pairs
from facediff.figures.maps import VertexMap, error_maps, motion_maps
from facediff.figures.material import Material, find_clips
from facediff.figures.page import COLUMN, PAGE, Paper
from facediff.figures.phonemes import Phoneme, find_phoneme, read_phonemes
from facediff.figures.runs import Curve, choose_scalars, find_gaps, find_metrics, read_curves, smooth

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
