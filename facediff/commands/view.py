"""``facediff view``."""
