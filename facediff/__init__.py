"""facediff: personalised speech-driven 3D facial animation with PyTorch Lightning.

Importing this package loads nothing else; import the package that you need, such as ``facediff.metrics``.
"""

__version__ = "0.1.0"
