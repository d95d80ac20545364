"""The version of the package, in a file of its own so that every package may read it."""

__version__ = "2.0.0"
