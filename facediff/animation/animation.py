"""The class :class:`Animation`, and units of length."""

from __future__ import annotations

import mmap
import secrets
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Self, Unpack

import numpy as np
import numpy.typing as npt

from facediff.animation.options import (
    AnimationControls,
    ControlKeywords,
    ExportKeywords,
    ExportOptions,
    with_options,
)
from facediff.errors import FaceDiffError, OptionError
from facediff.mesh.flame import rotations
from facediff.spaces import VERTICES, Space
from facediff.spaces.space import metres_per_unit as metres_per_unit
from facediff.utils import SAMPLE_RATE
from facediff.utils.files import reserve_room
from facediff.utils.hints import check_number
from facediff.utils.lazy import late
from facediff.utils.limits import COORDINATE, FRAME_RATES, SAMPLE_RATES, in_range

MAPPED_BYTES = 1 << 23  # How much of a memory map is read before its pages are released
OUT_OF_RANGE = f"NaN, infinity or a coordinate beyond {COORDINATE:g}"


WITHOUT_FACE = "none, a point stands for each channel"
"""Metadata ``face`` of motion in parameters that no face is known for."""

PHONEMES = "phonemes"
"""Metadata key: the phonemes of the speech as JSON, where they were given."""
MOTION = "facediff.pipelines.motion"  # What shows, changes and writes animations


@dataclass(frozen=True, eq=False)
class Channels:
    """Channels of a parametric space that an animation's vertices were made of."""

    space: Space
    values: npt.NDArray[np.float32]  # (T, C)
    # The animation's array: a change of the vertices makes another one, which the channels do not belong to.
    vertices: npt.NDArray[np.float32]
    # (K, V, 3): by what each channel of Space.face moves the vertices at 1; None if they are no weighted sum
    deltas: npt.NDArray[np.float32] | None = None


@dataclass(frozen=True, eq=False, repr=False)
class Animation:
    """Finished motion of one face: to look at, to compare, to change and to write.

    It has everything that players, exporters and retargeting need. In a notebook it plays, with its speech.

    Attributes:
        name: its name in messages and in files.
        vertices: (T, V, 3) absolute positions; float32, finite, possibly a memory map that is read frame by frame.
            y points up and z towards the viewer.
        template: (V, 3) the neutral face.
        frame_rate: frames a second; frame t is shown from t / frame_rate on.
        faces: (F, 3) triangles; None if they are not known, so that the face cannot be drawn.
        unit: unit of length, as :func:`facediff.animation.metres_per_unit` takes it.
        speech: (S,) mono, full scale 1, starting with the first frame; None for a silent animation.
        sample_rate: of the speech, in Hz.
        colours: (V, 3) vertex colours (sRGB, 0 to 255); None if there are none.
        regions: vertex indices by region name (``lips``, ``upper_face``).
        inner_lip_pairs: (P, 2) upper and lower vertices of the inner lips, for the mouth's opening; None if unknown.
        head: (T, 6) how the head moves as a whole, if it does: a rotation about the origin, axis-angle in radians, and
            then a shift; the vertices have been moved by it, see :meth:`still`.
        channels: of a parametric space that the vertices were made of, if any; see :attr:`values`.
        metadata: text about how it was made: identity, style, what in it is procedural …

    Example:
        >>> template = np.zeros((4, 3), np.float32)
        >>> animation = Animation("hello", np.stack([template] * 50), template, frame_rate=25)
        >>> animation
        Animation("hello": 50 frames, 2.00 s at 25 a second, 4 vertices in m, silent)
    """

    name: str
    vertices: npt.NDArray[np.float32]
    template: npt.NDArray[np.float32]
    frame_rate: float
    faces: npt.NDArray[np.int32] | None = None
    unit: str = "m"
    speech: npt.NDArray[np.float32] | None = None
    sample_rate: int = SAMPLE_RATE
    colours: npt.NDArray[np.uint8] | None = None
    regions: Mapping[str, npt.NDArray[np.int64]] = field(default_factory=dict)
    inner_lip_pairs: npt.NDArray[np.int64] | None = None
    head: npt.NDArray[np.float64] | None = None
    channels: Channels | None = None
    metadata: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        shape = self.vertices.shape
        if len(shape) != 3 or shape[2] != 3 or not shape[0]:
            raise FaceDiffError(f"{self.name}: has shape {shape}; expected (frames, vertices, 3), one frame at least")
        frames, count = shape[:2]
        width = 0 if self.channels is None else len(self.channels.space.channels)
        for name, array, expected in (
            ("template", self.template, (count, 3)),
            ("colours", self.colours, (count, 3)),
            ("head", self.head, (frames, 6)),
            ("values", self.values, (frames, width)),
            ("deltas", self.deltas, (len(self.space.face), count, 3)),
        ):
            if array is not None and (array.shape != expected or not in_range(array)):
                raise FaceDiffError(
                    f"{self.name}: its {name} of shape {array.shape} should have {expected}, or holds "
                    f"{OUT_OF_RANGE}; give the mesh that the motion was made for"
                )
        for name, rows in (("triangles", self.faces), ("pairs of inner lips", self.inner_lip_pairs)):
            if rows is not None and len(rows) and not 0 <= rows.min() <= rows.max() < count:
                raise FaceDiffError(
                    f"{self.name}: its {name} refer to vertex {int(rows.max())} of {count}; give the mesh that the "
                    f"motion was made for"
                )
        if self.speech is not None and not np.isfinite(self.speech).all():
            raise FaceDiffError(f"{self.name}: its speech holds NaN or infinity; give another recording")
        check_number(self.name, "frame rate", self.frame_rate, *FRAME_RATES)
        check_number(self.name, "sample rate", self.sample_rate, *SAMPLE_RATES, whole=True)
        metres_per_unit(self.unit)

    @property
    def values(self) -> npt.NDArray[np.float32] | None:
        """The channels (T, C) that the vertices were made of; None if there are none, or the vertices were changed."""
        unchanged_vertices = self.channels is not None and self.channels.vertices is self.vertices
        return self.channels.values if unchanged_vertices and self.channels is not None else None

    @property
    def space(self) -> Space:
        """Meaning of :attr:`values`; vertices where there are none."""
        return VERTICES if self.values is None or self.channels is None else self.channels.space

    @property
    def deltas(self) -> npt.NDArray[np.float32] | None:
        """What each channel of the face (K, V, 3) moves the vertices by; None without :attr:`values`, or if unknown."""
        return None if self.values is None or self.channels is None else self.channels.deltas

    @property
    def without_face(self) -> bool:
        """Whether it is channels alone: each of its points then stands for one of them."""
        return self.metadata.get("face") == WITHOUT_FACE and self.values is not None

    def made_of(
        self, space: Space, values: npt.NDArray[np.float32], deltas: npt.NDArray[np.floating] | None = None
    ) -> Self:
        """The same with the channels that its vertices were made of; with the arguments of :class:`Channels`."""
        shapes = None if deltas is None else np.asarray(deltas, np.float32)
        return replace(self, channels=Channels(space, values, self.vertices, shapes))

    @property
    def seconds(self) -> float:
        """How long it lasts."""
        return len(self.vertices) / self.frame_rate

    @cached_property
    def triangles(self) -> npt.NDArray[np.int32]:
        """The triangles (F, 3)."""
        if self.without_face:
            raise FaceDiffError(
                f"{self.name}: its motion is {len(self.space.channels)} channels ({self.space.kind}), which no rig "
                f"turns into vertices; import the model with --mesh, or write the channels to .npz or .npy"
            )
        if self.faces is None or not len(self.faces):
            raise OptionError.naming(
                f"{self.name}: comes without a mesh (triangles); give one with {{mesh}}, or write .npy, .npz, .pc2 or "
                f".mdd, which need none"
            )
        return self.faces

    def part(self, frames: slice | list[int]) -> Self:
        """The same with some of the frames only; the speech begins with the first of a slice, and else stays whole."""
        first = frames.indices(len(self.vertices))[0] if isinstance(frames, slice) else 0
        speech = None if self.speech is None else self.speech[round(first * self.sample_rate / self.frame_rate) :]
        head = None if self.head is None else self.head[frames]
        part = replace(self, vertices=self.vertices[frames], head=head, speech=speech)
        return part if self.values is None else part.made_of(self.space, self.values[frames], self.deltas)

    def still(self) -> Self:
        """The same with a head that does not move as a whole; itself if it does not.

        Example:
            >>> face = np.eye(3, dtype=np.float32)
            >>> turned = Animation("nod", face[None] + 1, face, 25, head=np.array([[0, 0, 0, 1.0, 1, 1]]))
            >>> bool((turned.still().vertices == face).all())
            True
        """
        if self.head is None:
            return self
        still = replace(self, vertices=without_head(self.vertices, self.head), head=None)
        return still if self.values is None else still.made_of(self.space, self.values, self.deltas)

    def frames(self) -> Iterator[npt.NDArray[np.float32]]:
        """Frame after frame (V, 3)."""
        for _, vertices in stretches_of(self.vertices):
            yield from vertices

    def refuse_not_finite(self) -> None:
        """Check every frame."""
        for index, frame in enumerate(self.frames()):
            if not in_range(frame):
                raise FaceDiffError(f"{self.name}: frame {index} holds {OUT_OF_RANGE}; generate the motion again")

    def sound(self) -> npt.NDArray[np.float32] | None:
        """The speech (S,) as long as the motion: cut, or padded with silence; None for a silent animation."""
        if self.speech is None:
            return None
        samples = round(self.seconds * self.sample_rate)
        speech = self.speech[:samples].astype(np.float32, copy=False)
        return speech if len(speech) == samples else np.pad(speech, (0, samples - len(speech)))

    @with_options(ExportOptions, ExportKeywords)
    def save(self, path: str | Path, **options: Unpack[ExportKeywords]) -> list[Path]:
        """Write a file of any export format; all of it, or nothing.

        Args:
            path: the file; its suffix chooses the format: .npz keeps everything, .glb, .usdc, .mp4, .html …
            options: listed below; those that the format does not use are refused.

        Returns:
            the file, and those that were written next to it.
        """
        files: list[Path] = late(f"{MOTION}:save")([self], path, options)
        return files

    def compare(
        self, truth: Animation, output: str | Path | None = None, *, labels: Sequence[str] | None = None
    ) -> Any:  # noqa: ANN401 - facediff.pipelines.motion.Page
        """The animation next to the truth, with a heat map of each vertex's distance from it.

        The longer one is cut to the shorter.

        Args:
            truth: a motion of the same face at the same frame rate, such as :func:`facediff.read` gives.
            output: an .html file to write as well.
            labels: names to show, the truth's first.

        Returns:
            the page, which plays in a notebook and can be written with its ``save``.
        """
        return late(f"{MOTION}:compare")([self], truth, output, labels)

    @with_options(AnimationControls, ControlKeywords)
    def control(self, **options: Unpack[ControlKeywords]) -> Animation:
        """The animation with animation controls applied: ``anim.control(expressiveness=1.2, blinks=True)``.

        Args:
            options: listed below.
        """
        animation: Animation = late(f"{MOTION}:control")(self, AnimationControls(**options))
        return animation

    def retarget(
        self,
        target_mesh: str | Path,
        *,
        correspondence: str | Path | None = None,
        landmarks: str | Path | None = None,
        accept_poor: bool = False,
    ) -> Animation:
        """The same motion on another mesh; a result with lips that stick or skin that tears is refused.

        Args:
            target_mesh: the other face at rest: .obj, .ply, .glb …
            correspondence: .npz to use if it exists, else to write for other animations.
            landmarks: .csv of pairs of vertices that are one place, or the .json of `facediff retarget --pick`.
            accept_poor: give the result of a new correspondence as it is.
        """
        animation: Animation = late(f"{MOTION}:retarget")(self, target_mesh, correspondence, landmarks, accept_poor)
        return animation

    def drive(self, avatar: str | Path, path: str | Path) -> list[Path]:
        """Write a copy of an avatar that plays the motion by its own shapes and bones.

        Args:
            avatar: a .glb with shapes under names of ARKit, Oculus or VRM. Weights go by name where the motion has
                ARKit's or is of the built-in face; :meth:`retarget` other motion to the avatar first.
            path: the .glb to write.
        """
        written: list[Path] = late(f"{MOTION}:drive")(self, avatar, path)
        return written

    def blendshapes(self, shapes: str | Path, *, carry: bool = False, only_arkit: bool = False, **options: Any) -> Any:  # noqa: ANN401 - facediff.editing.blendshapes.Weights
        """Weights of blendshapes that come nearest to the motion; their ``save`` writes a table.

        Args:
            shapes: folder of .obj or .ply files named jawOpen, mouthFunnel …, a .glb with named targets, or ``puppet``
                for the built-in face's.
            carry: the shapes are of another topology: transfer them to this mesh.
            only_arkit: leave out shapes without ARKit's names.
            options: fields of :class:`facediff.editing.blendshapes.SolveOptions`: ``smoothness``, ``region`` …
        """
        return late(f"{MOTION}:blendshapes")(self, shapes, carry=carry, only_arkit=only_arkit, **options)

    def _repr_html_(self) -> str | None:
        """The face, playing in a notebook; None without a mesh, for the text alone."""
        text: str | None = late(f"{MOTION}:Page")([self])._repr_html_()
        return text

    def __repr__(self) -> str:
        metadata = self.metadata
        facts = [f"{len(self.vertices)} frames", f"{self.seconds:.2f} s at {self.frame_rate:g} a second"]
        facts += [f"{len(self.template)} vertices in {self.unit}"]
        facts += [f"identity {metadata['identity']}"] if "identity" in metadata else []
        facts += [f"style of {metadata['style']}"] if "style" in metadata else []
        facts += ["with speech" if self.speech is not None else "silent"]
        return f'Animation("{self.name}": {", ".join(facts)})'


class MotionMap(np.memmap):
    """Motion in a file that takes little memory, however long it is: pages that were read or written are given back.

    Its items are plain views of the file.
    """

    _touched = 0
    _mmap: mmap.mmap | None  # NumPy's; the only way to give pages back

    def __getitem__(self, index: Any) -> Any:  # noqa: ANN401 - as of an array
        item = super().__getitem__(index)
        self._release(getattr(item, "nbytes", 0))
        return np.asarray(item) if isinstance(item, np.ndarray) else item

    def __setitem__(self, index: Any, value: Any) -> None:  # noqa: ANN401 - as of an array
        super().__setitem__(index, value)
        self._release(getattr(value, "nbytes", 0))

    def _release(self, count: int) -> None:
        self._touched += count
        if self._touched > MAPPED_BYTES and self._mmap is not None and hasattr(mmap, "MADV_DONTNEED"):
            self._touched = 0
            self._mmap.madvise(mmap.MADV_DONTNEED)


def stretches_of(motion: npt.NDArray[np.float32]) -> Iterator[tuple[slice, npt.NDArray[np.float32]]]:
    """Stretches of a motion (T, points, dims), and which frames they are; all of it at once where it is in memory."""
    step = len(motion)
    if isinstance(motion, np.memmap):
        # Whole stretches of 32 frames, as pages pack them.
        step = max(1, MAPPED_BYTES // (32 * max(1, motion[0].nbytes))) * 32
    for start in range(0, len(motion), step):
        frames = slice(start, min(start + step, len(motion)))
        yield frames, motion[frames]


def measured(
    motion: npt.NDArray[np.float32], measure: Callable[[npt.NDArray[np.float32]], npt.NDArray[np.floating]]
) -> npt.NDArray[np.floating]:
    """Numbers (T, …) of all frames of a motion, from a function of some of them (n, points, dims)."""
    return np.concatenate([measure(vertices) for _, vertices in stretches_of(motion)])


def without_head(vertices: npt.NDArray[np.float32], head: npt.NDArray[np.float64]) -> npt.NDArray[np.float32]:
    """Vertices (T, V, 3), moved by ``head`` (T, 6) as :attr:`Animation.head` has it, as they were before."""
    still = allocate_like(vertices)
    turns = rotations(head[:, :3])
    for index, frame in enumerate(vertices):
        still[index] = (frame - head[index, 3:]) @ turns[index] if head[index].any() else frame
    return still


def allocate_like(vertices: npt.NDArray[np.float32], shape: tuple[int, ...] | None = None) -> npt.NDArray[np.float32]:
    """An array to write to, of the same shape or another: in memory, or on disk where the vertices are a memory map.

    A file on disk lies next to the map's, or where temporary files go if that folder cannot be written, and vanishes
    with the array.
    """
    shape = shape or vertices.shape
    if not isinstance(vertices, np.memmap):
        return np.empty(shape, np.float32)
    temporary = Path(tempfile.gettempdir())
    folder = temporary if vertices.filename is None else Path(vertices.filename).parent
    name = f".facediff-{secrets.token_hex(8)}.partial"
    try:
        path = folder / name
        room = _mapped(path, shape)
    except OSError:
        path = temporary / name
        room = _mapped(path, shape)
    with suppress(OSError):  # Windows keeps a file that is in use
        path.unlink()
    return room


def _mapped(path: Path, shape: tuple[int, ...]) -> npt.NDArray[np.float32]:
    array = MotionMap(path, np.float32, "w+", shape=shape)
    try:
        reserve_room(path)
    except OSError:
        path.unlink()
        raise
    return array
