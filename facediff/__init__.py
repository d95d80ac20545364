"""facediff: personalised speech-driven 3D facial animation with PyTorch Lightning.

Example:
    >>> import facediff
    >>> model = facediff.load("demo/puppet.ckpt")  # doctest: +SKIP
    >>> animation = model.animate("speech.wav", identity="F1")  # doctest: +SKIP
    >>> animation.save("speech.mp4")  # doctest: +SKIP
    [PosixPath('speech.mp4')]

Importing this package loads nothing else: every name is imported when it is first used. docs/python.md shows them all.
"""

from typing import TYPE_CHECKING

from facediff.utils.lazy import lazy_names
from facediff.version import __version__ as __version__

if TYPE_CHECKING:
    from facediff import metrics as metrics
    from facediff.animation.animation import Animation as Animation
    from facediff.editing.controls.direction import Direction as Direction
    from facediff.editing.controls.direction import Key as Key
    from facediff.editing.controls.direction import read_direction as read_direction
    from facediff.errors import FaceDiffError as FaceDiffError
    from facediff.pipelines.animator import Animator as Animator
    from facediff.pipelines.animator import import_checkpoint as import_checkpoint
    from facediff.pipelines.animator import load as load
    from facediff.pipelines.motion import read as read
    from facediff.pipelines.motion import view as view

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "animation.animation": "Animation",
        "editing.controls.direction": "Direction Key read_direction",
        "errors": "FaceDiffError",
        "pipelines.animator": "Animator import_checkpoint load",
        "pipelines.motion": "read view",
    },
    packages="metrics",
)
