"""facediff: personalised speech-driven 3D facial animation with PyTorch Lightning.

Importing the package costs nothing; import the room you need, e.g. ``facediff.metrics``.
"""

__version__ = "0.1.0"
