"""An animation: finished motion of a face with its mesh, speech and metadata, as all other packages exchange it.

Example:
    >>> from facediff.animation import read_animation
    >>> animation = read_animation(Path("hello.npz"))  # doctest: +SKIP
    >>> animation.vertices.shape, animation.frame_rate  # doctest: +SKIP
    ((250, 1008, 3), 25.0)
"""

from typing import TYPE_CHECKING

from facediff.utils.lazy import lazy_names

if TYPE_CHECKING:
    from facediff.animation.animation import Animation as Animation
    from facediff.animation.animation import metres_per_unit as metres_per_unit
    from facediff.animation.archives import read_animation as read_animation
    from facediff.animation.archives import read_archive as read_archive
    from facediff.animation.archives import write_archive as write_archive

# Imported late: the command line reads the options of this package without NumPy.
__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {"animation": "Animation metres_per_unit", "archives": "read_animation read_archive write_archive"},
)
