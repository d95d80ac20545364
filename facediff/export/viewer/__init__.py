"""One HTML file that plays animations in any browser: pictures in WebGL 2, the speech as their clock, no network.

Importing this costs NumPy only; the colours of the heat map come from :mod:`facediff.render`, which needs OpenCV.

Example:
    >>> from facediff.animation import read_animation
    >>> from facediff.export.viewer import write_page
    >>> write_page(path, [read_animation(true), read_animation(predicted)], truth=0)  # doctest: +SKIP
"""

from facediff.export.viewer.page import page_parts, write_page

__all__ = ["page_parts", "write_page"]
