"""Changes to a finished take: expressiveness by region, and procedural blinks, gaze and head sway."""

from facediff.directing.blinks import add_blinks, blink_curve
from facediff.directing.expressiveness import read_factors, region_factors, scale_regions
from facediff.directing.eyes import Eyes, closing_of_lids
from facediff.directing.gaze import add_gaze, gaze_curve
from facediff.directing.sway import add_sway, sway_curve

__all__ = [
    "Eyes",
    "add_blinks",
    "add_gaze",
    "add_sway",
    "blink_curve",
    "closing_of_lids",
    "gaze_curve",
    "read_factors",
    "region_factors",
    "scale_regions",
    "sway_curve",
]
