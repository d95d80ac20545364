"""``facediff export``."""
