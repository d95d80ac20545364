"""Speaking styles of an exported model: what :mod:`facediff.animation.styles` asks of one without PyTorch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from facediff.animation.styles import Stillness, StyleFile, StyleReader
from facediff.errors import FaceDiffError, OptionError, choices
from facediff.runtime.graphs import ExportedGraphs

Array = npt.NDArray[np.float32]


@dataclass(frozen=True)
class RuntimeStyle:
    """A style vector.

    Attributes:
        name: of its source.
        vector: as the model's style encoder gives it, (S,).
    """

    name: str
    vector: Array


def style_from(style: object, model: ExportedGraphs, identity: str) -> RuntimeStyle:
    """The style that was given in Python or in words; the model must take styles from reference motion.

    Args:
        style: as :meth:`facediff.animation.styles.StyleReader.style` takes it, or what this function has returned.
        model: the model.
        identity: the speaker of an array, unless a file's name says it.
    """
    return style if isinstance(style, RuntimeStyle) else ExportedStyles(identity, model).style(style)


class ExportedStyles(StyleReader[RuntimeStyle]):
    """The styles of an exported model; see :func:`style_from`."""

    def __init__(self, identity: str, model: ExportedGraphs) -> None:
        about = model.description
        vertices = model.arrays["templates"].shape[1]
        super().__init__(identity, about.motion_space, vertices, about.frame_rate, about.unit)
        self.model, self.about = model, about

    @property
    def width(self) -> int:
        """S: how many numbers a style vector has."""
        return int(self.model.arrays["styles"].shape[1])

    def names(self) -> Sequence[str]:
        """Names of the folder's styles."""
        return self.about.styles

    def named(self, name: str) -> RuntimeStyle | None:
        """A style of the folder."""
        if name not in self.about.styles:
            return None
        return RuntimeStyle(name, self.model.arrays["styles"][self.about.styles.index(name)].astype(np.float32))

    def clip(self, name: str) -> StyleFile:
        """None: a folder has no clips."""
        raise OptionError("style", f'there is no "{name}", and it is no file: {choices(name, self.about.styles)}')

    def rest(self) -> Array:
        """The channels (C,) of the face at rest."""
        faces = self.about.faces
        resting: Array = self.model.arrays["resting"][faces.index(self.identity) if self.identity in faces else 0]
        return resting

    def face(self, opened: StyleFile) -> tuple[Array, str | None, float]:
        """The neutral face (V, 3) of the speaker in a file's name, else of the identity, else of the first face."""
        faces, candidates = self.about.faces, (opened.path.stem.rpartition("_")[0], self.identity)
        whose = next((name for name in candidates if name in faces), faces[0])
        return self.model.arrays["templates"][faces.index(whose)], whose, self.frame_rate

    def stillness(self) -> Stillness | None:
        """As the folder states it."""
        still = self.model.arrays.get("still")
        return None if still is None else Stillness(still, self.about.stillness)

    def still_vector(self) -> Array | None:
        """The style vector (S,) of a face that keeps still; None where the folder has no style encoder."""
        if "style" not in self.about.graphs:
            return None
        points = len(self.space.channels) or self.vertices
        return encode_style(self.model, np.zeros((1, points, self.space.dims), np.float32), "still").vector

    def encode(self, name: str, offsets: Array) -> RuntimeStyle:
        """The style of reference motion: offsets (T, points, dims) from rest."""
        return encode_style(self.model, offsets, name)

    def of_vector(self, name: str, vector: Array) -> RuntimeStyle:
        """A style vector (S,) as a style."""
        return RuntimeStyle(name, vector)

    def vector(self, style: RuntimeStyle) -> tuple[str, Array]:
        """The name of a style, and its style vector (S,)."""
        return style.name, style.vector


def encode_style(model: ExportedGraphs, motion: Array, name: str) -> RuntimeStyle:
    """The style of reference motion: offsets (T, points, dims) from rest, at the model's unit and frame rate."""
    if "style" not in model.description.graphs:
        raise FaceDiffError(
            f"style: the folder has no style encoder, so {model.description.model} takes styles by name alone; "
            f"choose one of {', '.join(model.description.styles[:5])}, or export the model again"
        )
    inputs = {"motion": np.ascontiguousarray(motion, np.float32)[None], "mask": np.ones((1, len(motion)), bool)}
    return RuntimeStyle(name, model.run("style", inputs)[0][0])
