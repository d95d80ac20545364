"""The look: material, lights and background, and the colour of every direction that a surface can face.

All lights are far away and fixed to the camera, so the colour of a point depends on its normal only. It is
computed once for the half sphere of normals that face the viewer and then looked up per pixel, which makes
shading per pixel (not per vertex) affordable without a GPU. Light is added up in linear units.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Colour = tuple[float, float, float]

TABLE_SIZE = 256


@dataclass(frozen=True)
class Light:
    """A far light.

    Attributes:
        direction: where it stands seen from the face: x right, y up, z to the viewer; any length.
        colour: linear red, green, blue; 1 lights a white surface fully.
        wrap: 0 for a small lamp, up to 1 for a large soft one that reaches round the edge.
        gloss: strength of its highlight.
    """

    direction: Colour
    colour: Colour
    wrap: float = 0.3
    gloss: float = 0.0


# Key from the upper left, cool fill from the right, rim from behind at the right.
STUDIO = (
    Light((-0.55, 0.60, 0.80), (0.80, 0.76, 0.70), wrap=0.25, gloss=0.16),
    Light((0.85, 0.05, 0.60), (0.14, 0.17, 0.22), wrap=0.5),
    Light((0.75, 0.45, -0.55), (0.50, 0.52, 0.58), wrap=0.0),
)

# The same strength from straight ahead: a symmetric face gives a symmetric picture.
EVEN = (Light((0.0, 0.45, 0.9), (0.85, 0.83, 0.80), wrap=0.3, gloss=0.1),)


@dataclass(frozen=True)
class Look:
    """Material, lights and background of a picture; colours are sRGB in [0, 1] unless a light's.

    Attributes:
        albedo: the surface's own colour where no per-vertex colours are given.
        lights: the lamps beside the ambient light.
        sky: linear ambient light on what faces up.
        ground: linear ambient light on what faces down.
        background_top: background at the upper edge.
        background_bottom: background at the lower edge.
        hollow: tint (linear) that hollows fade to, so that a mouth is dark and warm inside.
    """

    albedo: Colour = (0.90, 0.745, 0.66)
    lights: tuple[Light, ...] = STUDIO
    sky: Colour = (0.24, 0.26, 0.30)
    ground: Colour = (0.12, 0.09, 0.08)
    background_top: Colour = (0.93, 0.94, 0.955)
    background_bottom: Colour = (0.76, 0.78, 0.815)
    hollow: Colour = (0.10, 0.02, 0.015)


def to_linear(srgb: npt.ArrayLike) -> npt.NDArray[np.float32]:
    """SRGB values in [0, 1] to linear light."""
    values = np.asarray(srgb, dtype=np.float64)
    linear = np.where(values <= 0.04045, values / 12.92, ((np.maximum(values, 0) + 0.055) / 1.055) ** 2.4)
    return linear.astype(np.float32)


def to_srgb(linear: npt.ArrayLike) -> npt.NDArray[np.float32]:
    """Linear light in [0, 1] to sRGB."""
    values = np.clip(np.asarray(linear, dtype=np.float64), 0, 1)
    srgb = np.where(values <= 0.0031308, values * 12.92, 1.055 * values ** (1 / 2.4) - 0.055)
    return srgb.astype(np.float32)


def light_table(look: Look) -> npt.NDArray[np.float32]:
    """Light that leaves a surface, by the normal it has: (TABLE_SIZE, TABLE_SIZE, 4).

    Row and column are the normal's y and x from -1 to 1 (row 0 is y = -1). Channels 0 to 2 hold what a
    white matt surface sends back, channel 3 the highlight, which does not take the surface's colour.
    """
    axis = np.linspace(-1, 1, TABLE_SIZE)
    x, y = np.meshgrid(axis, axis)
    # Outside the unit disc lie interpolation errors at the outline only: treat them as the outline itself.
    length = np.maximum(np.hypot(x, y), 1.0)
    x, y = x / length, y / length
    normal = np.stack([x, y, np.sqrt(np.maximum(1 - x * x - y * y, 0))], axis=-1)
    up = (normal[..., 1:2] + 1) / 2
    diffuse = (1 - up) * np.asarray(look.ground) + up * np.asarray(look.sky)
    gloss = np.zeros_like(x)
    for light in look.lights:
        direction = np.asarray(light.direction) / np.linalg.norm(light.direction)
        cosine = normal @ direction
        # Red light travels furthest under skin: it reaches a little further round the edge of the shadow.
        wrap = np.minimum(light.wrap + np.array([0.12, 0.02, 0.0]), 1.0) if light.wrap > 0 else np.zeros(3)
        lit = np.maximum((cosine[..., None] + wrap) / (1 + wrap), 0)
        diffuse += lit ** (1 + wrap) * np.asarray(light.colour)
        half = direction + np.array([0.0, 0.0, 1.0])
        half /= max(float(np.linalg.norm(half)), 1e-6)
        shine = np.maximum(normal @ half, 0)
        gloss += light.gloss * (0.6 * shine**18 + 0.4 * shine**60)
    return np.concatenate([diffuse, gloss[..., None]], axis=-1).astype(np.float32)


def background(look: Look, height: int, width: int) -> npt.NDArray[np.float32]:
    """Soft gradient in linear light (height, width, 3), a little brighter behind the head."""
    rows = np.linspace(0, 1, height)[:, None, None]
    top, bottom = np.asarray(look.background_top), np.asarray(look.background_bottom)
    blend = rows * rows * (3 - 2 * rows)
    y, x = np.meshgrid(np.linspace(-1, 1, height), np.linspace(-1, 1, width), indexing="ij")
    glow = 1 - 0.05 * np.clip(x * x + y * y, 0, 2)[..., None]
    return to_linear(((1 - blend) * top + blend * bottom) * glow)
