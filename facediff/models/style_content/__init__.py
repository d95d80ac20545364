"""Style-content disentanglement."""

from facediff.models.style_content.model import StyleContentDisentanglement

__all__ = ["StyleContentDisentanglement"]
