"""The numbers that several commands and functions take, by name.

Upper ends are far above useful values, and low enough that nothing overflows and no machine is filled by a
mistyped number.
"""

from __future__ import annotations

from typing import Annotated

from facediff.utils.hints import Range as Range
from facediff.utils.hints import check_options as check_options
from facediff.utils.hints import checked as checked
from facediff.utils.limits import FRAME_RATES

BlinkRate = Annotated[float, Range(1, 40)]
USUAL_BLINKS = 17.0
"""Blinks a minute of a person at rest, where no number is given."""
Bound = Annotated[float, Range(-1000, 1000)]
ClipLength = Annotated[float, Range(1, 600)]
Duration = Annotated[float, Range(0.001, 604_800)]
"""Seconds that something lasts; a week at most."""
Epochs = Annotated[int, Range(1, 100_000)]
EXPRESSIVITY = Range(0, 2)
Expressivity = Annotated[float, EXPRESSIVITY]
"""From the mean prediction (0) to a sample (1) and beyond."""
Factor = Annotated[float, Range(1e-9, 1e9)]
"""What lengths are multiplied by, or the end of a scale."""
FrameRate = Annotated[float, Range(*FRAME_RATES)]
GUIDANCE_SCALE = Range(0, 10)
GazeAngle = Annotated[float, Range(0, 20, above=True)]
USUAL_GAZE = 4.0
"""Degrees where no number is given."""
Interpolation = Annotated[float, Range(0, 1, above=True)]
KeyTolerance = Annotated[float, Range(0, 1)]
LearningRate = Annotated[float, Range(0, 1, above=True)]
Level = Annotated[float, Range(0.01, 0.9999)]
Millimetres = Annotated[float, Range(1e-6, 100)]
Semitones = Annotated[float, Range(-12, 12)]
TakeOffset = Annotated[float, Range(-3600, 3600)]
PageWidth = Annotated[float, Range(30, 1000)]
Pixels = Annotated[int, Range(16, 4096)]
"""Answers of one rater to one comparison of a user study, or comparisons in it."""
Port = Annotated[int, Range(0, 65_535)]
"""How far the share of answers that prefer something lies above one half."""
Raters = Annotated[int, Range(1, 1_000_000)]
Resamples = Annotated[int, Range(0, 1_000_000)]
Resolution = Annotated[int, Range(50, 1200)]
SampleRate = Annotated[int, Range(1000, 384_000)]
Samples = Annotated[int, Range(1, 1000)]
Seconds = Annotated[float, Range(0, 86_400)]
Seed = Annotated[int, Range(0, 2**62 - 1)]
"""The generators of random numbers take 64 bits, and the numbers of clips and samples are added to the seed."""
Steps = Annotated[int, Range(1, 10_000)]
Strength = Annotated[float, Range(0, 1e6)]
Stride = Annotated[int, Range(1, 1000)]
SwayAngle = Annotated[float, Range(0, 15, above=True)]
USUAL_SWAY = 2.0
"""Degrees where no number is given."""
Threads = Annotated[int, Range(0, 1024)]

USUAL_VOICE_STEPS = 600
"""Training steps in which an audio encoder learns other voices where no number is given."""
Vertices = Annotated[int, Range(1, 2_000_000)]
Dims = Annotated[int, Range(1, 3)]
Window = Annotated[float, Range(0.01, 600)]
Workers = Annotated[int, Range(1, 1024)]
