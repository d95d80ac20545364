"""Drawing meshes without display or GPU, on the software rasteriser of OpenCV 5.

:class:`Renderer` draws a frame; :class:`Camera` and :class:`Look` are its settings; ``_Canvas`` holds the buffers
that OpenCV fills.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError, needs_extra
from facediff.render.meshes import (
    Faces,
    Float64,
    Floats,
    VertexSums,
    check_vertices,
    face_outward,
    hollowness,
    is_open,
    vertex_normals,
)
from facediff.render.occlusion import occlusion
from facediff.render.refinement import Refinement
from facediff.utils.colours import to_linear, to_srgb

Picture = npt.NDArray[np.uint8]
Float32 = npt.NDArray[np.float32]

INSIDE = 0.2  # Share of its light that the back of a face keeps: the inside of a head is dark
HOLLOW_STRENGTH = 0.45  # How strongly hollows of the surface are darkened
DEPTH_STRENGTH = 14.0  # How strongly points that lie behind their surroundings in the picture are darkened
EDGE = 1 / 25  # Longest edge of a lit triangle, as a share of the picture's height
SHORTEST_EDGE = 3.0  # Pixels: shorter edges are never split, since light does not change over so few of them
LOOKED_UP = 1024  # Vertices per row of the lookup of their light
GAMMA_STEPS = 4095  # Steps of the gamma table: fine enough that the darkest step stays below one level of the picture


class Renderer:
    """Draws one topology in one view; keeps its buffers between frames, so use one (a `twin`) per thread.

    Normals are computed again for every frame, ambient occlusion once for the face at rest; the light is looked up per
    vertex of a mesh that is refined until its triangles are small in the picture, interpolated over them per sample of
    the supersampled picture, averaged in linear light and gamma-corrected last. The same input gives the same bytes.

    Args:
        faces: triangles (F, 3) as vertex numbers; either winding.
        template: neutral face (V, 3), y up and z to the viewer, in any unit; the camera is framed on it.
        size: height and width of the picture in pixels, one number for a square.
        view: "front", "three_quarter" or "side"; ignored where a camera is given.
        supersample: samples per pixel and axis; 1 switches anti-aliasing off.
        camera: a camera to use instead, such as one shared by several topologies.
        look: material, lights and background.
        colours: sRGB per vertex (V, 3) for frames without colours of their own, floats from 0 to 1 or uint8; without
            them the look's material.

    Attributes:
        backdrop: the picture (height, width, 3) without the mesh.
    """

    def __init__(
        self,
        faces: npt.ArrayLike,
        *,
        template: npt.ArrayLike,
        size: int | tuple[int, int] = 512,
        view: str = "front",
        supersample: int = 2,
        camera: Camera | None = None,
        look: Look | None = None,
        colours: npt.ArrayLike | None = None,
    ) -> None:
        rest = check_vertices(template, "template")
        self.n_vertices = len(rest)
        self.faces = face_outward(np.asarray(faces, np.int32), rest)
        self.height, self.width = (size, size) if isinstance(size, int) else size
        self.camera = camera or Camera.framing(rest, view=view, aspect=self.width / self.height)
        self.look = look or Look()
        self._colours = None if colours is None else self._linear_colours(colours)
        self._open = is_open(self.faces)
        self._canvas = _Canvas(self.camera, self.height, self.width, supersample)
        self._sums = VertexSums(self.faces, self.n_vertices)
        self._occluded = occlusion(rest, self.faces)
        self._backs = np.ascontiguousarray(self.faces[:, ::-1])
        pixel = self.camera.pixel_size(self.height)
        normals = vertex_normals(rest, self.faces, self._sums)
        longest, shortest = EDGE * self.height * pixel, SHORTEST_EDGE * pixel
        self._refinement = Refinement(self.faces, rest, longest, normals, shortest)
        table = light_table(self.look)
        self._strongest = max(np.float32((table[..., :3].max(axis=2) + table[..., 3]).max()), np.float32(1e-6))
        self._light = table / self._strongest  # the rasteriser interpolates values from 0 to 1
        self._albedo, self._tint = to_linear(self.look.albedo), np.asarray(self.look.hollow, np.float32)
        self._gamma = np.rint(255 * to_srgb(np.linspace(0, 1, GAMMA_STEPS + 1))).astype(np.uint8)
        self._background = background(self.look, self.height, self.width)
        self.backdrop = self._to_bytes(self._background.copy())

    def render(self, vertices: npt.ArrayLike, *, colours: npt.ArrayLike | None = None) -> Picture:
        """Draw one frame.

        Args:
            vertices: absolute positions (V, 3) in the template's unit.
            colours: sRGB per vertex (V, 3), floats from 0 to 1 or uint8; without them the renderer's own.

        Returns:
            The picture (height, width, 3), sRGB.
        """
        points = self.camera.to_camera(check_vertices(vertices, "vertices", self.n_vertices))
        linear = self._colours if colours is None else self._linear_colours(colours)
        picture = self.backdrop.copy()
        window = self._canvas.window(points)
        if window is not None:
            # Colours of a frame stand for numbers (errors), which nothing may darken.
            occluded = self._occluded if colours is None else None
            picture[window.pixels] = self._draw(points, linear, occluded, window)
        return picture

    def twin(self) -> Renderer:
        """This renderer with buffers of its own: both may draw at the same time, each in its thread."""
        renderer = copy.copy(self)
        renderer._canvas = _Canvas(self.camera, self.height, self.width, self._canvas.supersample)
        return renderer

    def _draw(self, points: Float64, colours: Float32 | None, occluded: Float32 | None, window: _Window) -> Picture:
        """The window's pixels: light the vertices, rasterise, darken what lies behind, put over the background."""
        canvas = self._canvas
        canvas.clear(window)
        refined = self._fine_vertices(points, colours, occluded)
        canvas.draw(refined[:, :3], self._lit(refined), self._refinement.faces)
        if self._open:
            # Backs are drawn against the same depth buffer: they show only where one looks inside. It is dark there, so
            # that no facets are seen, and the mesh need not be fine.
            vertices = refined[: self.n_vertices]
            vertices[:, 3:5] *= -1  # the normal of the other side
            vertices[:, 5] *= INSIDE
            canvas.draw(vertices[:, :3], self._lit(vertices), self._backs)
        coverage = canvas.coverage(window)
        picture = window.shrink(canvas.values[window.samples])
        picture *= self._kept_light(coverage, window, tinted=colours is None)
        picture += self._background[window.pixels] * (1 - coverage)[..., None]
        return self._to_bytes(picture)

    def _fine_vertices(self, points: Float64, colours: Float32 | None, occluded: Float32 | None) -> Float32:
        """Of each vertex of the refined mesh: position, normal's x and y, light left in a hollow, own colour if any."""
        normals = vertex_normals(points, self.faces, self._sums)
        shade = np.clip(1 - HOLLOW_STRENGTH * hollowness(points, normals, self._sums), 0, 1)
        if occluded is not None:
            shade *= occluded
        parts: list[Floats] = [points, normals[:, :2], shade[:, None]]
        if colours is not None:
            parts.append(colours)
        return self._refinement.values(np.concatenate(parts, axis=1, dtype=np.float32))

    def _lit(self, vertices: Float32) -> Float32:
        """Light that leaves the vertices of `_fine_vertices` for the viewer, as a share of the strongest: (N, 3)."""
        table, shade, colours = self._light_of(vertices[:, 3:5]), vertices[:, 5:6], vertices[:, 6:]
        tinted = colours.shape[1] == 0
        light = table[:, :3] * (self._albedo if tinted else colours)
        light += table[:, 3:]
        light *= shade * (1 - self._tint) + self._tint if tinted else shade
        return light

    def _light_of(self, normals: Float32) -> Float32:
        """Light by the table, as a share of the strongest, of normals' x and y (N, 2): (N, 4)."""
        cv2, count = opencv(), len(normals)
        # OpenCV looks up pictures, and none that is wider than 32 767 pixels: the vertices go into rows.
        columns = np.zeros((2, -(-count // LOOKED_UP), LOOKED_UP), np.float32)
        np.multiply(normals.T, np.float32((TABLE_SIZE - 1) / 2), out=columns.reshape(2, -1)[:, :count])
        columns += np.float32((TABLE_SIZE - 1) / 2)
        light = cv2.remap(self._light, columns[0], columns[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(light.reshape(-1, 4)[:count], dtype=np.float32)

    def _kept_light(self, coverage: Float32, window: _Window, *, tinted: bool) -> Float32:
        """Factor of the drawn values: the strongest light's strength, less where a pixel lies behind.

        (height, width, 1 or 3)
        """
        # Pixels behind the mean depth of their surroundings (depth-buffer unsharp masking, Luft et al. 2006): this
        # darkens the mouth between the lips. The surface's own hollows are part of the vertices' light.
        cv2, (width, height) = opencv(), window.size
        distances = self._canvas.distances(window, coverage)
        small = (max(width // 4, 1), max(height // 4, 1))
        sums = [cv2.resize(image, small, interpolation=cv2.INTER_AREA) for image in (distances * coverage, coverage)]
        mean, weight = (cv2.GaussianBlur(image, (0, 0), 0.0075 * self.height) for image in sums)
        mean /= np.maximum(weight, np.float32(1e-3))
        distances -= cv2.resize(mean, (width, height), interpolation=cv2.INTER_LINEAR)
        behind = np.maximum(distances, 0, out=distances)
        behind *= coverage
        behind *= np.float32(DEPTH_STRENGTH / self.camera.radius)
        light = (1 / (1 + behind))[..., None]
        return np.asarray((light * (1 - self._tint) + self._tint if tinted else light) * self._strongest, np.float32)

    def _to_bytes(self, picture: Float32) -> Picture:
        """Linear light to sRGB bytes; overwrites its input."""
        np.clip(picture, 0, 1, out=picture)
        picture *= np.float32(GAMMA_STEPS)
        picture += np.float32(0.5)
        return np.take(self._gamma, picture.astype(np.uint16))

    def _linear_colours(self, colours: npt.ArrayLike) -> Float32:
        """Colours per vertex in linear light."""
        array = np.asarray(colours)
        values = check_vertices(array / 255 if array.dtype == np.uint8 else array, "colours", self.n_vertices)
        return to_linear(np.clip(values, 0, 1))


# The camera: a long lens at the distance at which the template fills the picture.

VIEWS: dict[str, float] = {"front": 0.0, "three_quarter": -35.0, "side": -90.0}
"""Degrees by which the head turns about the vertical axis; negative turns the face to the key light on the left."""

MARGIN = 0.1  # Share of the picture's half size that stays free on every side
FIELD_OF_VIEW = math.radians(18.0)  # That of a portrait lens: a wide angle would make the nose look large


@dataclass(frozen=True)
class Camera:
    """A perspective camera that looks at `centre`; make one with `Camera.framing`.

    Attributes:
        centre: the point (x, y, z) in the middle of the picture, in the mesh's unit.
        rotation: rows of the 3 x 3 rotation from the mesh's axes to the camera's (x right, y up, z to the viewer).
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
    ) -> Camera:
        """The camera that shows all of one template, or of several in one unit at equal scale.

        Args:
            templates: (V, 3), or a list of such arrays of any topologies.
            view: a name in `VIEWS`.
            aspect: width / height of the picture.
        """
        if isinstance(templates, np.ndarray) and templates.ndim == 2:
            templates = [templates]
        points = np.concatenate([check_vertices(template, "template") for template in templates])  # type: ignore[union-attr]
        size = float(np.ptp(points, axis=0).max())
        cos, sin = math.cos(math.radians(VIEWS[view])), math.sin(math.radians(VIEWS[view]))
        rotation = np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])
        turned = points @ rotation.T
        middle = (turned.min(axis=0) + turned.max(axis=0)) / 2
        x, y, z = (turned - middle).T
        half = math.tan(FIELD_OF_VIEW / 2) * (1 - MARGIN)
        # A point at depth z in front of the centre is seen within the angle if |x| <= half · aspect · (distance - z).
        distance = float(max(np.max(np.abs(x) / (half * aspect) + z), np.max(np.abs(y) / half + z)))
        return cls(
            centre=tuple((middle @ rotation).tolist()),
            rotation=tuple(tuple(row) for row in rotation.tolist()),
            distance=distance,
            radius=2 * size,
        )

    @property
    def near(self) -> float:
        """Depth in front of which nothing is drawn."""
        return max(self.distance - self.radius, self.distance * 0.02)

    @property
    def far(self) -> float:
        """Depth behind which nothing is drawn."""
        return self.distance + self.radius

    def pixel_size(self, height: int) -> float:
        """Length that a pixel of a picture of this height shows at the centre, in the mesh's unit."""
        return 2 * self.distance * math.tan(FIELD_OF_VIEW / 2) / height

    def to_camera(self, vertices: Floats) -> Float64:
        """Positions (V, 3) in the camera's axes, origin at the camera: visible points have negative z."""
        turned = (vertices - np.asarray(self.centre)) @ np.asarray(self.rotation).T
        turned[:, 2] -= self.distance
        return np.asarray(turned, dtype=np.float64)


def portrait(template: Floats, regions: Mapping[str, npt.ArrayLike]) -> Floats:
    """The vertices (n, 3) that a picture is framed on: without shoulders, where the regions of the face are known.

    The vertices left out lie further below the ``lips`` than nine tenths of the way from there to the ``upper_face``.
    """
    if not {"lips", "upper_face"} <= regions.keys():
        return template
    lips, upper = (float(template[np.asarray(regions[name]), 1].mean()) for name in ("lips", "upper_face"))
    return template[template[:, 1] > lips - 0.9 * (upper - lips)] if upper > lips else template


# The look: material, lights and background.

Colour = tuple[float, float, float]


@dataclass(frozen=True)
class Light:
    """A distant light, fixed to the camera.

    Attributes:
        direction: from the face to the light: x right, y up, z to the viewer; any length.
        colour: linear red, green, blue; 1 lights a white surface fully.
        wrap: 0 for a small lamp, up to 1 for a large soft one that reaches round the edge.
        gloss: strength of its highlight.
    """

    direction: Colour
    colour: Colour
    wrap: float = 0.3
    gloss: float = 0.0


STUDIO = (
    Light((-0.55, 0.60, 0.80), (0.80, 0.76, 0.70), wrap=0.25, gloss=0.16),
    Light((0.85, 0.05, 0.60), (0.14, 0.17, 0.22), wrap=0.5),
    Light((0.75, 0.45, -0.55), (0.50, 0.52, 0.58), wrap=0.0),
)
"""Key light from the upper left, cool fill light from the right, rim light from behind at the right."""

EVEN = (Light((0.0, 0.45, 0.9), (0.85, 0.83, 0.80), wrap=0.3, gloss=0.1),)
"""About the same strength from straight ahead: a symmetric face gives a symmetric picture."""


@dataclass(frozen=True)
class Look:
    """Material, lights and background of a picture; colours are sRGB from 0 to 1 unless a light's.

    Attributes:
        albedo: the surface's own colour where no per-vertex colours are given.
        lights: the lamps in addition to the ambient light.
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


TABLE_SIZE = 256


def light_table(look: Look) -> Float32:
    """Light that leaves a surface, by its normal: (TABLE_SIZE, TABLE_SIZE, 4).

    Row and column are the normal's y and x from -1 to 1 (row 0 is y = -1). Channels 0 to 2 hold the light from a white
    matt surface, channel 3 the highlight, which does not take the surface's colour.
    """
    # All lights are far away and fixed to the camera, so that the colour of a point depends on its normal only. It is
    # computed once for the half sphere that faces the viewer and looked up per sample, which makes shading per pixel
    # affordable without a GPU.
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


def background(look: Look, height: int, width: int) -> Float32:
    """Soft gradient in linear light (height, width, 3), a little brighter behind the head."""
    rows = np.linspace(0, 1, height)[:, None, None]
    top, bottom = np.asarray(look.background_top), np.asarray(look.background_bottom)
    blend = rows * rows * (3 - 2 * rows)
    y, x = np.meshgrid(np.linspace(-1, 1, height), np.linspace(-1, 1, width), indexing="ij")
    glow = 1 - 0.05 * np.clip(x * x + y * y, 0, 2)[..., None]
    return to_linear(((1 - blend) * top + blend * bottom) * glow)


# Buffers, and the calls of OpenCV's software rasteriser that fill them.


def opencv() -> ModuleType:
    """The module cv2; refuses versions older than 5."""
    with needs_extra("cv2", "render", "drawing meshes"):
        import cv2
    if not hasattr(cv2, "triangleRasterize"):
        raise FaceDiffError(
            f"drawing meshes needs OpenCV 5 or later, but {cv2.__version__} is installed: "
            'run  pip install "facediff[render]"'
        )
    return cv2


class _Window(NamedTuple):
    """A rectangle of the picture, as slices of pixels and of samples, and its width and height in pixels."""

    pixels: tuple[slice, slice]
    samples: tuple[slice, slice]
    size: tuple[int, int]

    def shrink(self, samples: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Average the samples of each pixel."""
        cv2 = opencv()
        return np.asarray(cv2.resize(samples, self.size, interpolation=cv2.INTER_AREA))


class _Canvas:
    """A depth buffer and three interpolated values per sample."""

    GRID = 8
    """Windows start and end on multiples of this many pixels: values on a coarser grid inside them would
    otherwise shimmer where a window grows with the motion."""

    def __init__(self, camera: Camera, height: int, width: int, supersample: int) -> None:
        self.camera = camera
        self.height, self.width, self.supersample = height, width, supersample
        self.depth = np.ones((height * supersample, width * supersample), np.float32)
        self.values = np.zeros((*self.depth.shape, 3), np.float32)

    def window(self, points: Float64) -> _Window | None:
        """The part of the picture that can show the points (V, 3, camera axes); None if there is none."""
        ahead = points[points[:, 2] < -self.camera.near]
        if len(ahead) == 0:
            return None
        scale = self.height / 2 / math.tan(FIELD_OF_VIEW / 2) / -ahead[:, 2]
        row, column = self.height / 2 - scale * ahead[:, 1], self.width / 2 + scale * ahead[:, 0]
        limits = []
        for pixel, size in ((row, self.height), (column, self.width)):
            low = max((math.floor(pixel.min()) - 2) // self.GRID * self.GRID, 0)
            high = min(-((-math.ceil(pixel.max()) - 2) // self.GRID) * self.GRID, size)
            if high <= low:
                return None
            limits.append((low, high))
        (top, bottom), (left, right) = limits
        s = self.supersample
        return _Window(
            pixels=(slice(top, bottom), slice(left, right)),
            samples=(slice(top * s, bottom * s), slice(left * s, right * s)),
            size=(right - left, bottom - top),
        )

    def clear(self, window: _Window) -> None:
        """Nothing drawn yet: depth 1, values 0."""
        self.depth[window.samples] = 1
        self.values[window.samples] = 0

    def draw(self, positions: Float32, values: Float32, faces: Faces) -> None:
        """Interpolate values (V, 3) from 0 to 1 over the triangles that face the viewer and are nearest.

        Positions (V, 3) are in camera axes.
        """
        cv2 = opencv()
        settings = cv2.TriangleRasterizeSettings()
        settings.setShadingType(cv2.RASTERIZE_SHADING_SHADED)
        # Depth stays as the rasteriser computes it (0 at the near plane, 1 at the far plane and where nothing is). Its
        # other mode converts to distances and back around every call and loses the second pass: the empty
        # samples come back a rounding error behind the far plane and are never drawn again.
        settings.setGlCompatibleMode(cv2.RASTERIZE_COMPAT_INVDEPTH)
        settings.setCullingMode(cv2.RASTERIZE_CULLING_CW)
        lens = (FIELD_OF_VIEW, self.camera.near, self.camera.far)
        pose = np.eye(4, dtype=np.float32)
        positions, values = np.ascontiguousarray(positions), np.ascontiguousarray(values)
        # The rasteriser does not cut triangles: one that reaches behind the camera would be drawn all over the picture.
        ahead = positions[:, 2] < -self.camera.near
        if not ahead.all():
            faces = np.ascontiguousarray(faces[ahead[faces].all(axis=1)])
            if len(faces) == 0:
                return
        cv2.triangleRasterize(positions, faces, values, self.values, self.depth, pose, *lens, settings)

    def coverage(self, window: _Window) -> Float32:
        """Share of each pixel that the mesh covers."""
        cv2 = opencv()
        covered = window.shrink(cv2.compare(self.depth[window.samples], 1.0, cv2.CMP_LT))
        return np.asarray(covered * np.float32(1 / 255), dtype=np.float32)

    def distances(self, window: _Window, coverage: Float32) -> Float32:
        """Mean distance of each pixel's covered samples from the camera; meaningless where it has none."""
        depth = window.shrink(self.depth[window.samples])
        depth += coverage
        depth -= 1  # what the empty samples added
        depth /= np.maximum(coverage, np.float32(1e-3))
        near_inverse, far_inverse = 1 / self.camera.near, 1 / self.camera.far
        return np.asarray(
            1 / (np.float32(near_inverse) + depth * np.float32(far_inverse - near_inverse)), dtype=np.float32
        )
