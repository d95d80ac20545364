"""An animation: finished motion of a face with its mesh, speech and metadata, as all other packages exchange it.

Example:
    >>> from facediff.animation import read_animation
    >>> animation = read_animation(Path("hello.npz"))  # doctest: +SKIP
    >>> animation.vertices.shape, animation.frame_rate  # doctest: +SKIP
    ((250, 1008, 3), 25.0)
"""

from facediff.animation.animation import Animation, metres_per_unit
from facediff.animation.files import read_animation, read_archive, write_archive

__all__ = ["Animation", "metres_per_unit", "read_archive", "read_animation", "write_archive"]
