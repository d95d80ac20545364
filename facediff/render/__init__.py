"""Meshes to pictures and videos, without display, GPU or system packages.

Importing this costs NumPy only: OpenCV, PyAV and Pillow are loaded by the first call that needs them.

Example:
    >>> from facediff.render import Renderer, side_by_side, write_video  # doctest: +SKIP
    >>> renderer = Renderer(faces, template=template)  # doctest: +SKIP
    >>> frames = side_by_side(renderer, [truth, prediction], ["truth", "facediff"])  # doctest: +SKIP
    >>> write_video("out.mp4", frames, 25, audio, 16000)  # doctest: +SKIP
"""

from facediff.render.panels import comparison, contact_sheet, heat_colours, save_image, side_by_side
from facediff.render.rasteriser import EVEN, STUDIO, VIEWS, Camera, Light, Look, Renderer, portrait
from facediff.render.video import write_video

__all__ = [
    "EVEN",
    "STUDIO",
    "VIEWS",
    "Camera",
    "Light",
    "Look",
    "Renderer",
    "comparison",
    "contact_sheet",
    "heat_colours",
    "portrait",
    "save_image",
    "side_by_side",
    "write_video",
]
