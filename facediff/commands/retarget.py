"""``facediff retarget``."""
