"""Where the viewer stands: a long lens whose distance is chosen so that the template fills the picture."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError
from facediff.render.geometry import check_vertices

# Degrees by which the head turns about the vertical axis: negative turns the face to the viewer's left,
# towards the key light.
VIEWS: dict[str, float] = {"front": 0.0, "three_quarter": -35.0, "side": -90.0}

# A portrait lens: the nose does not swell as it does with a wide angle.
FIELD_OF_VIEW = math.radians(18.0)


@dataclass(frozen=True)
class Camera:
    """A perspective camera that looks at `centre`; make one with `Camera.framing`.

    Attributes:
        centre: the point (x, y, z) that comes to the middle of the picture, in the mesh's unit.
        rotation: rows of the 3 x 3 rotation from the mesh's axes to the camera's (x right, y up, z to viewer)
        distance: from the camera to the centre, in the mesh's unit.
        radius: how far vertices may lie from the centre and still be drawn, in the mesh's unit.
    """

    centre: tuple[float, ...]
    rotation: tuple[tuple[float, ...], ...]
    distance: float
    radius: float

    @classmethod
    def framing(
        cls,
        templates: npt.ArrayLike | Sequence[npt.ArrayLike],
        *,
        view: str = "front",
        aspect: float = 1.0,
        margin: float = 0.1,
    ) -> "Camera":
        """The camera that shows all of one template, or of several in one unit at equal scale.

        Args:
            templates: (V, 3), or a list of such arrays of any topologies.
            view: a name in `VIEWS`.
            aspect: width / height of the picture.
            margin: share of the picture's half size that stays free on every side.
        """
        if view not in VIEWS:
            raise FaceDiffError(f'view "{view}" is not known: choose one of {", ".join(VIEWS)}.')
        if isinstance(templates, np.ndarray) and templates.ndim == 2:
            templates = [templates]
        points = np.concatenate([check_vertices(template, "template") for template in templates])  # type: ignore[union-attr]
        size = float(np.ptp(points, axis=0).max())
        if size <= 0:
            raise FaceDiffError("template has no extent (all vertices coincide): pass the rest positions.")
        rotation = _turn(math.radians(VIEWS[view]))
        turned = points @ rotation.T
        middle = (turned.min(axis=0) + turned.max(axis=0)) / 2
        x, y, z = (turned - middle).T
        half = math.tan(FIELD_OF_VIEW / 2) * (1 - margin)
        distance = float(max(np.max(np.abs(x) / (half * aspect) + z), np.max(np.abs(y) / half + z)))
        return cls(
            centre=tuple((middle @ rotation).tolist()),
            rotation=tuple(tuple(row) for row in rotation.tolist()),
            distance=distance,
            radius=2 * size,
        )

    @property
    def near(self) -> float:
        """Depth before which nothing is drawn."""
        return max(self.distance - self.radius, self.distance * 0.02)

    @property
    def far(self) -> float:
        """Depth behind which nothing is drawn."""
        return self.distance + self.radius

    def to_camera(self, vertices: npt.NDArray[np.floating[Any]]) -> npt.NDArray[np.float64]:
        """Positions (V, 3) in the camera's axes, origin at the camera: visible points have negative z."""
        turned = (vertices - np.asarray(self.centre)) @ np.asarray(self.rotation).T
        turned[:, 2] -= self.distance
        return np.asarray(turned, dtype=np.float64)


def _turn(angle: float) -> npt.NDArray[np.float64]:
    """Rotation about the vertical axis by `angle` radians."""
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])
