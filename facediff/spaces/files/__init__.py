"""Files of motion in parameters: Live Link Face, BEAT, Audio2Face, and arrays in a declared layout."""

from facediff.spaces.files.clips import ParameterClip, even, from_start
from facediff.spaces.files.reading import read_parameters, write_parameters

__all__ = ["ParameterClip", "even", "from_start", "read_parameters", "write_parameters"]
