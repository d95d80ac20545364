"""``facediff blendshapes``."""
