"""The data of figures: the clips of truth and methods and their mesh; and the painter of that mesh."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from torch import Tensor

from facediff.data.check.findings import few
from facediff.data.corpus import ALL
from facediff.errors import FaceDiffError, check_known
from facediff.evaluation.file_pairs import (
    DEFAULT_PATTERNS,
    OWN,
    TRUTH_PATTERN,
    NamePattern,
    Truth,
    index_truths,
    list_names,
    pair_up,
)
from facediff.evaluation.scoring import read_vertices
from facediff.render import EVEN, Camera, Light, Look, Renderer
from facediff.render.rasteriser import FIELD_OF_VIEW

TRUTH = "truth"  # Name of the truth in a figure
CHUNK = 2**20  # Coordinates that are converted to float64 together: 8 MB, however long a clip is
WHITE = (1.0, 1.0, 1.0)

SHADED = Look(lights=EVEN, background_top=WHITE, background_bottom=WHITE)
"""For faces: light from straight ahead, the same on both halves."""

FLAT = Look(
    lights=(Light((0.0, 0.25, 0.97), (0.45, 0.45, 0.45), wrap=1.0),),
    sky=(0.55, 0.55, 0.55),
    ground=(0.55, 0.55, 0.55),
    background_top=WHITE,
    background_bottom=WHITE,
)
"""For colours that stand for numbers: surfaces towards the viewer have exactly their colour, without highlights."""

HALF = math.tan(FIELD_OF_VIEW / 2)

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class FigureData:
    """The files of truth and methods, with their mesh, templates and frame rate."""

    truths: dict[str, Truth]  # truths by clip, ``<subject>_<sentence>``
    # Each method's predictions by clip; methods in the order in which they are drawn.
    methods: dict[str, dict[str, Path]]
    n_vertices: int
    # Frames a second of the predictions, and of the truth after ``truth_stride``; None if not known.
    frame_rate: float | None = None
    truth_stride: int = 1  # every n-th frame of a truth is used
    unit: str = ""  # of length of the vertices
    templates: Mapping[str, Tensor] = field(default_factory=dict)  # neutral face (V, 3) by identity
    faces: npt.NDArray[np.int32] | None = None  # triangles (F, 3); None if no mesh is known
    rest: Array | None = None  # positions (V, 3) of the mesh file; None if no mesh is known
    colours: npt.NDArray[np.uint8] | None = None  # sRGB (V, 3) of the mesh file; None if it has none
    corpus: Path | None = None  # the corpus folder that the truth belongs to, if it does
    remark: str = ""  # below every figure, such as that the corpus is synthetic

    @property
    def names(self) -> list[str]:
        """The truth's name and the methods'."""
        return [TRUTH, *self.methods]

    @property
    def scale(self) -> tuple[float, str]:
        """The factor by which lengths are multiplied for a figure, and the resulting unit."""
        return (1000.0, "mm") if self.unit == "m" else (1.0, self.unit.partition(" (")[0] or "unit of the vertices")

    @property
    def rate(self) -> float:
        """Frames a second."""
        if self.frame_rate is None:
            raise FaceDiffError("the frame rate of the predictions is not known; give --frame-rate")
        return self.frame_rate

    def choose(self, clips: Sequence[str] | None = None) -> list[str]:
        """Clips to draw: the given ones, else all that the truth and every method have."""
        sets: dict[str, Mapping[str, object]] = {TRUTH: self.truths, **self.methods}
        if clips is None:
            clips = [clip for clip in self.truths if all(clip in files for files in sets.values())]
        if not clips:
            raise FaceDiffError(
                f"{' and '.join(self.names)} have no clip in common; the truth has {few(self.truths)}; "
                f"give --pattern and --truth-pattern, which say how files are named"
            )
        for name, files in sets.items():
            check_known(name, "clip", clips, files)
        return list(dict.fromkeys(clips))

    def open(self, clip: str) -> dict[str, Tensor]:
        """Absolute vertices (T, V, 3) of the truth and of each method, memory-mapped, each in its own length."""
        opened = {TRUTH: read_vertices(self.truths[clip].path, self.n_vertices, self.truth_stride)}
        for method, files in self.methods.items():
            opened[method] = read_vertices(files[clip], self.n_vertices)
        return opened

    def path(self, clip: str, name: str) -> Path:
        """The file of a clip's vertices, of the truth or of a method."""
        return self.truths[clip].path if name == TRUTH else self.methods[name][clip]

    def template(self, clip: str) -> Array:
        """Neutral face (V, 3) of a clip's speaker."""
        subject = self.truths[clip].name.subject
        if subject not in self.templates:
            speakers = f" with {subject}, not only {', '.join(self.templates)}" if self.templates else ""
            raise FaceDiffError(f"no template of {subject}, needed by clip {clip}; give --templates FILE{speakers}")
        return np.asarray(self.templates[subject], np.float64)

    def mesh(self, clips: Sequence[str]) -> tuple[npt.NDArray[np.int32], Array]:
        """Triangles (F, 3), and a face at rest (V, 3): the mean of the clips' templates, else the mesh file's own."""
        if self.faces is None or self.rest is None:
            raise FaceDiffError(
                "the triangles of the mesh are not known; give --mesh FILE, a .ply or .obj of this topology"
            )
        subjects = dict.fromkeys(self.truths[clip].name.subject for clip in clips)
        templates = [np.asarray(self.templates[name], np.float64) for name in subjects if name in self.templates]
        return self.faces, np.mean(templates, axis=0) if templates else self.rest


def find_clips(
    methods: Mapping[str, Path],
    truth: Path,
    *,
    subjects: Sequence[str] = (),
    patterns: Sequence[str] = DEFAULT_PATTERNS,
    truth_pattern: str = TRUTH_PATTERN,
    identity: str = OWN,
) -> tuple[dict[str, Truth], dict[str, dict[str, Path]]]:
    """Truths by clip and each method's predictions by clip, matched by their names as ``facediff evaluate`` does.

    ``subjects`` are the known speakers; ``identity`` is ``own``, or a condition of the predictions.
    """
    problem = f'a method cannot be called "{TRUTH}"; name it with NAME=FOLDER' if TRUTH in methods else ""
    if identity == ALL:
        problem = "--identity all: a figure shows one condition; expected own or an identity's name"
    if problem:
        raise FaceDiffError(problem)
    names, _ = list_names(truth, [NamePattern(truth_pattern, subjects)])
    truths = dict(sorted(index_truths(names).items()))
    readers = [NamePattern(pattern, subjects) for pattern in patterns]
    predictions: dict[str, dict[str, Path]] = {}
    for method, folder in methods.items():
        files, _ = list_names(folder, readers)
        pairs, _ = pair_up(files, truths, identity)
        if not pairs:
            raise FaceDiffError(
                f"{folder}: no file is a prediction of a truth's clip under the condition {identity}; the truth has "
                f"{few(truths) or f'no file like {truth_pattern}.npy'}; give --pattern, --truth-pattern or --identity"
            )
        predictions[method] = {pair.clip: next(iter(pair.predictions.values())) for pair in pairs}
    return truths, predictions


def shortest(motions: Mapping[str, Tensor]) -> tuple[int, str | None]:
    """The frames common to all motions, and a note on cut frames; None if all have one length."""
    lengths = {name: len(motion) for name, motion in motions.items()}
    frames = min(lengths.values())
    if len(set(lengths.values())) == 1:
        return frames, None
    sizes = ", ".join(f"{name} {length}" for name, length in lengths.items())
    return frames, f"lengths differ ({sizes} frames): cut to the first {frames}"


def chunks(motion: Tensor, path: Path, frames: int) -> Iterator[Array]:
    """The first ``frames`` frames of a motion (T, V, 3) in float64, a few at a time; refuses NaN and infinity."""
    step = max(1, CHUNK // max(1, motion[0].numel()))
    for first in range(0, frames, step):
        part = np.asarray(motion[first : min(first + step, frames)], np.float64)
        if not np.isfinite(part).all():
            raise FaceDiffError(f"{path}: holds NaN or infinity; repair or omit the file")
        yield part


class Painter:
    """Draws triangles (F, 3) on white, with a camera framed once on the face at rest, ``shape`` (V, 3).

    Colours are sRGB (V, 3) of the surface, else the look's material shows; a region is shown in a close-up.
    """

    def __init__(
        self,
        faces: npt.NDArray[np.int32],
        shape: Array,
        *,
        view: str = "front",
        look: Look = SHADED,
        colours: npt.NDArray[np.uint8] | None = None,
        region: Sequence[int] | None = None,
    ) -> None:
        self.faces, self.shape, self.look, self.colours = faces, shape, look, colours
        framed = shape
        if region is not None:
            # Points (N, 3) of the region, and the corners of a box wider by 0.45 of their width on every side.
            points = shape[list(region)]
            more = 0.45 * np.ptp(points[:, 0])
            limits = zip(points.min(0) - (more, more, 0), points.max(0) + (more, more, 0), strict=True)
            corners = np.stack(np.meshgrid(*limits), -1).reshape(-1, 3)
            framed = np.concatenate([points, corners])
        face, camera = Camera.framing(shape, view=view), Camera.framing(framed, view=view)
        # A close-up must not cut off the ears, which are behind the framed region.
        self._camera = replace(camera, radius=max(camera.radius, face.radius))
        points = self._camera.to_camera(framed)
        projected = points[:, :2] / -points[:, 2:]
        margin = 0.015 * np.ptp(projected, axis=0).max()  # for motion that leaves the template
        # The camera's picture is wider than the face, since perspective makes far parts small: it is cut to the face.
        # HALF is half the extent of the camera's picture at distance 1.
        low, high = projected.min(0) - margin, projected.max(0) + margin
        self._extent = np.clip(low, -HALF, HALF), np.clip(high, -HALF, HALF)

    @property
    def aspect(self) -> float:
        """Width of a picture by its height."""
        low, high = self._extent
        return float((high[0] - low[0]) / (high[1] - low[1]))

    def set_size(self, width: int, height: int) -> None:
        """Choose how many pixels a picture has."""
        low, high = self._extent
        scale = height / (high[1] - low[1])
        size = math.ceil(2 * HALF * scale)
        left, top = round((HALF + low[0]) * scale), round((HALF - high[1]) * scale)
        left, top = min(max(left, 0), max(size - width, 0)), min(max(top, 0), max(size - height, 0))
        self._cut = slice(top, top + height), slice(left, left + width)
        self._renderer = Renderer(
            self.faces,
            template=self.shape,
            size=(max(size, height), max(size, width)),
            camera=self._camera,
            look=self.look,
            colours=self.colours,
        )

    def paint(self, vertices: Array, colours: npt.NDArray[np.uint8] | None = None) -> npt.NDArray[np.uint8]:
        """A picture (height, width, 3), of the size that was set, of a face (V, 3) on pure white."""
        picture = self._renderer.render(vertices, colours=colours)[self._cut]
        picture[(picture == self._renderer.backdrop[self._cut]).all(-1)] = 255  # the backdrop darkens in its corners
        return picture
