"""Style-content disentanglement."""

from facediff.systems.style_content.system import StyleContentDisentanglement

__all__ = ["StyleContentDisentanglement"]
