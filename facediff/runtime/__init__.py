"""Trained models without PyTorch: NumPy, ONNX Runtime, and nothing else that is heavy.

``facediff export-model`` writes a folder with a model's graphs; this package animates with it.

Example:
    >>> from facediff.runtime import RuntimeModel
    >>> model = RuntimeModel.open("puppet-onnx")  # doctest: +SKIP
    >>> model.animate(samples, identity="F1", seed=3).vertices.shape  # doctest: +SKIP
    (150, 1008, 3)
"""

from typing import TYPE_CHECKING

from facediff.utils.lazy import lazy_names

if TYPE_CHECKING:
    from facediff.runtime.model import RuntimeModel as RuntimeModel
    from facediff.runtime.model import RuntimeStream as RuntimeStream

__getattr__, __dir__, __all__ = lazy_names(__name__, {"model": "RuntimeModel RuntimeStream"})
