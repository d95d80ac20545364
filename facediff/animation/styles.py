"""A speaking style as it is given: the text of ``--style``, its files, motion, style vectors, and mixtures of these.

For models with and without PyTorch alike: :class:`StyleReader` asks a model for its names, faces and encoder.
"""

from __future__ import annotations

import math
import re
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np
import numpy.typing as npt

from facediff.animation.animation import Animation, metres_per_unit
from facediff.animation.archives import read_archive
from facediff.errors import OptionError
from facediff.spaces import Space
from facediff.spaces.files import ParameterClip, even, read_parameters
from facediff.spaces.layouts import LAYOUTS, layout
from facediff.spaces.operations import permuted, resampled
from facediff.utils.arrays import open_array, read_arrays

Array = npt.NDArray[np.float32]
S = TypeVar("S")
"""A model's kind of style."""

PARAMETER_FILES = (".csv", ".json", ".npy", ".npz")
"""Suffixes of motion in parameters."""
FILES = (".npy", ".npz")
"""Suffixes of files that hold a style; anything else is the name of a clip."""
CANCELLED = 1e-3
"""Weights that sum to less than this share of their sizes leave nothing to divide by."""
OTHER_FACE = 0.25
"""How far the stillest vertices may lie from the face, as a share of how far all vertices of a reference do."""
LEAST_STILL = 12
"""A tracked face without a skull moves everywhere: there, the limit is three times (a quarter of 12) how far its
stillest vertices move. Clips of one person reach 2.2 times that, the mean face as a template 5.9 times."""
OTHER_ENCODER = 0.1
"""How far two encoders' answers to a still face may lie apart, as a share of their length, to be of one model."""
NUMBER = r"[+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d+)?|[+-]?(?:nan|inf)"


@dataclass(frozen=True)
class Weighted:
    """One style of a mixture."""

    name: str  # a file or the name of a clip
    weight: float | None  # None if none was given


def split_styles(text: str, clips: Sequence[str] = ()) -> list[Weighted]:
    r"""The styles of a mixture, split at commas; a weight follows the last colon, if it is a number.

    Words that are a file, or the name of a clip, as a whole are taken as such: alone, a name may hold commas, or end in
    a colon and a number.

    >>> split_styles(r"C:\ann\x.npy:0.3,F1_e05:-1")
    [Weighted(name='C:\\ann\\x.npy', weight=0.3), Weighted(name='F1_e05', weight=-1.0)]
    """
    # Before anything is split: a file or clip may have commas and colons in its name.
    if text in clips or Path(text).is_file():
        return [Weighted(text, None)]
    parts = []
    for word in text.split(","):
        match = re.fullmatch(rf"(.*):\s*({NUMBER})\s*", word, re.IGNORECASE)
        name = (match[1] if match else word).strip()
        if not name:
            raise OptionError.naming(
                f"{{style}} {text}: expected names or files with weights, such as a.npy:0.3,b.npy:0.7"
            )
        parts.append(Weighted(name, float(match[2]) if match else None))
    return parts


def with_layout(word: str) -> tuple[Path, str | None]:
    """A file of parameters and the layout that is stated for it.

    >>> with_layout("clip.npy@flame_artalk")
    (PosixPath('clip.npy'), 'flame_artalk')
    """
    name, at, layout = word.rpartition("@")
    return (Path(name), layout) if at and name and not Path(word).is_file() else (Path(word), None)


def style_paths(text: str | None) -> list[Path]:
    """The files among the words of ``--style``; if one of them has changed, so has the style."""
    paths = [with_layout(part.name)[0] for part in split_styles(text)] if text else []
    return [path for path in paths if path.is_file()]


def normalised(text: str, weights: Sequence[float | None]) -> list[float]:
    """Weights that sum to 1; a note is printed if that changed them."""
    numbers = [weight for weight in weights if weight is not None]
    if not numbers:
        return [1.0 / len(weights)] * len(weights)
    if len(numbers) < len(weights):
        raise OptionError.naming(f"{{style}} {text}: give every style a weight (A:0.3,B:0.7), or none of them")
    total = math.fsum(numbers)
    # Weights may be negative (to lead away from a style), so their sum may cancel to almost nothing; the mixture, which
    # is divided by it, would be huge.
    if not all(map(math.isfinite, numbers)) or not abs(total) > CANCELLED * math.fsum(map(abs, numbers)):
        raise OptionError.naming(
            f"{{style}} {text}: expected finite weights with a sum other than 0, since they are divided by it"
        )
    shares = [weight / total for weight in numbers]
    if abs(total - 1.0) > 1e-6:
        print(f"note: --style: weights are divided by their sum: {', '.join(f'{share:.3g}' for share in shares)}")
    return shares


@dataclass(frozen=True)
class StyleFile:
    """A motion or a style vector as read from a file."""

    path: Path
    array: npt.NDArray[np.generic]  # (T, V, 3) or (T, 3V) absolute vertices, or a style vector
    template: Array | None = None  # (V, 3) of an animation, in the motion's unit; None for a bare array
    frame_rate: float | None = None
    unit: str | None = None

    def frames(self, vertices: int, stride: int) -> Array:
        """Absolute vertices (T, V, 3) of every ``stride``-th frame, for faces of V vertices."""
        array = self.array
        if array.ndim not in (2, 3) or not len(array) or array.shape[1:] not in ((vertices, 3), (3 * vertices,)):
            raise OptionError.naming(
                f"{{style}} {self.path}: has shape {array.shape}; the model's faces have {vertices} vertices, "
                f"so (frames, {vertices}, 3) or (frames, {3 * vertices}) is expected"
            )
        motion = np.array(array[::stride], np.float32).reshape(-1, vertices, 3)
        if not np.isfinite(motion).all():
            raise OptionError.naming(f"{{style}} {self.path}: holds NaN or infinity")
        return motion


def open_style(path: Path) -> StyleFile:
    """A style's file, memory-mapped where it is an array."""
    if not path.is_file():
        raise OptionError.naming(f"{{style}} {path}: no such file")
    if path.suffix == ".npz":
        animation = read_archive(path)
        return StyleFile(path, animation.vertices, animation.template, animation.frame_rate, animation.unit)
    return StyleFile(path, open_array(path, kinds="fiu", name=f"style {path}"))


def marked(vector: Array, still: Array) -> Array:
    """A style vector (S,) for a file, with its encoder's answer to a still face (S,) behind it.

    Infinity lies between them, so that the whole is no style vector of any other length.
    """
    return np.concatenate([vector, [np.float32(np.inf)], still])


@dataclass(frozen=True)
class Stillness:
    """Where a model's faces keep still when they speak: skull and neck.

    Attributes:
        vertices: the quarter of the vertices that move least in the stored references.
        size: how far vertices move in these references, as a root mean square of offsets from the template; or
            LEAST_STILL times how far those that move least do, if that is more.
    """

    vertices: npt.NDArray[np.int64]
    size: float

    def another_face(self, offsets: Array) -> bool:
        """Whether offsets (T, V, 3) from a template are of another face than the template's, or the head moves."""
        # Where faces keep still, offsets from one's own template are small. Those from another speaker's are not.
        return rms(offsets[:, self.vertices]) > OTHER_FACE * self.size


def stillness_of(motions: Sequence[Array]) -> Stillness | None:
    """Of reference motions, each (T, V, 3) from its template; None of no motions."""
    if not motions:
        return None
    reach = np.max([np.linalg.norm(motion, axis=-1).max(0) for motion in motions], 0)
    still = np.argsort(reach, kind="stable")[: max(1, len(reach) // 4)]
    sizes = [max(rms(motion), LEAST_STILL * rms(motion[:, still])) for motion in motions]
    return Stillness(still, max(sizes))


def rms(values: Array) -> float:
    """Root mean square."""
    return float(np.sqrt(np.square(values).mean()))


def recorded_parameters(source: str, frame_rate: float) -> ParameterClip | None:
    """Motion in parameters of a style: ``clip.json``, or ``clip.npy@flame_artalk`` with its layout.

    None if it is none: a name, a style vector, or an animation of vertices.
    ``frame_rate`` is of an array with a layout without a rate.
    """
    path, stated = with_layout(source)
    if path.suffix not in PARAMETER_FILES or (stated is None and not path.is_file()):
        return None
    if not path.is_file():
        raise OptionError.naming(f"{{style}} {path}: no such file")
    if path.suffix == ".npz" and stated is None and "template" in read_arrays(path, {"template"}):
        animation = read_archive(path)
        if animation.values is None:
            return None
        return ParameterClip(animation.name, animation.values, animation.space, animation.frame_rate)
    if path.suffix == ".npy" and open_style(path).array.ndim == 1:
        return None
    if stated is None and path.suffix in (".npy", ".npz"):
        return read_parameters(path)  # which says what layouts fit
    without_rate = path.suffix == ".npy" and stated in LAYOUTS and LAYOUTS[stated].frame_rate is None
    return read_parameters(path, layout=stated, frame_rate=frame_rate if without_rate else None)


def channels_of(recorded: ParameterClip, space: Space, frame_rate: float) -> Array:
    """Motion in parameters (T, C) in the order of a model's space and at its frame rate.

    What phones do not record, such as a tongue that goes up, is at 0.
    """
    if space.is_vertices:
        raise OptionError.naming(
            f"{{style}} {recorded.name}: is motion in parameters, and this model takes vertices; give such a motion"
        )
    recorded = even(recorded)  # an app drops rows
    values, ordered_space = permuted(recorded.values, recorded.space, space)
    unrecorded = {*space.channels} - {*layout("live_link").channels} if space.kind == "arkit" else set()
    lacking = [
        name for name in ordered_space.absent if name in space.channels and name not in {*space.absent, *unrecorded}
    ]
    if lacking:
        raise OptionError.naming(
            f"{{style}} {recorded.name}: lacks {', '.join(lacking[:4])}{' …' if len(lacking) > 4 else ''}; give a "
            f"motion with the model's channels"
        )
    if abs(recorded.frame_rate - frame_rate) > 1e-6:
        values = resampled(values, space, recorded.frame_rate, frame_rate)
    return values.astype(np.float32)


class StyleReader(ABC, Generic[S]):
    """The styles of one model for one face.

    Args:
        identity: the animated face; also the speaker of a bare array, unless its name says it.
        space: of the model's motion.
        vertices: V of the model's faces.
        frame_rate: frames a second of the model's motion.
        unit: its unit of length.
    """

    advice = "or give an animation (.npz) of a head that keeps still"
    """What helps where a motion does not lie on its template."""

    def __init__(self, identity: str, space: Space, vertices: int, frame_rate: float, unit: str) -> None:
        self.identity, self.space, self.vertices = identity, space, vertices
        self.frame_rate, self.unit = frame_rate, unit

    @abstractmethod
    def names(self) -> Sequence[str]:
        """Names of styles, which may hold commas and colons."""

    @abstractmethod
    def named(self, name: str) -> S | None:
        """The style of a name; None if the model has none of this name."""

    @abstractmethod
    def clip(self, name: str) -> StyleFile:
        """The motion of a clip that is neither a file nor a style of the model; refused if there is none."""

    @abstractmethod
    def face(self, opened: StyleFile) -> tuple[Array, str | None, float]:
        """The neutral face (V, 3) of a bare array, the speaker that it is taken to be, and the array's frame rate."""

    @property
    @abstractmethod
    def width(self) -> int:
        """S: how many numbers a style vector has."""

    @abstractmethod
    def rest(self) -> Array:
        """The channels (C,) of the face at rest."""

    @abstractmethod
    def stillness(self) -> Stillness | None:
        """Where the model's faces keep still; None if it is not known."""

    @abstractmethod
    def still_vector(self) -> Array | None:
        """The style vector (S,) of a face that keeps still; None without a style encoder."""

    @abstractmethod
    def encode(self, name: str, offsets: Array) -> S:
        """The style of reference motion: offsets (T, points, dims) from rest."""

    @abstractmethod
    def of_vector(self, name: str, vector: Array) -> S:
        """A style vector (S,) as a style."""

    @abstractmethod
    def vector(self, style: S) -> tuple[str, Array]:
        """The name of a style, and its style vector (S,)."""

    def style(self, source: object) -> S:
        """The style that was given in Python or in words.

        Args:
            source: the words of ``--style``; a path; names or paths with their weights, ``{"F1": 0.4, "b.npz": 0.6}``;
                a motion as an animation, in parameters, or as an array (T, V, 3) of absolute vertices; a style vector
                (S,).
        """
        if isinstance(source, Mapping):
            try:
                source = ",".join(f"{name}:{float(weight)!r}" for name, weight in source.items())
            except (TypeError, ValueError) as error:
                raise OptionError.naming(
                    f"{{style}} {source}: expected a number as the weight of each style"
                ) from error
        if isinstance(source, str | Path):
            return self.mixture(str(source))
        if isinstance(source, ParameterClip):
            return self.of_parameters(source)
        if isinstance(source, Animation):
            if source.values is not None and not self.space.is_vertices:
                return self.of_parameters(ParameterClip(source.name, source.values, source.space, source.frame_rate))
            path = Path(source.name)
            return self.of_file(StyleFile(path, source.vertices, source.template, source.frame_rate, source.unit))
        array = np.asarray(source)
        if array.dtype.kind != "f" or array.ndim not in (1, 2, 3):
            raise OptionError.naming(
                f"{{style}}: is {array.dtype} of shape {array.shape}; expected words, a file, an animation, a motion "
                f"(frames, vertices, 3) or a style vector"
            )
        return self.of_file(StyleFile(Path("style"), array))

    def mixture(self, text: str) -> S:
        """One style, or the weighted mean of the style vectors of several, ``a.npy:0.3,b.npy:0.7``.

        Without weights all count alike. Weights may be negative, which leads away from a style; they are divided by
        their sum.
        """
        parts = split_styles(text, self.names())
        if len(parts) == 1:
            # A weight of one style would have to mean a distance from some other style, and there is none.
            if parts[0].weight not in (None, 1.0):
                raise OptionError.naming(
                    f"{{style}} {text}: one style alone cannot be weighted; mix it with another one (A:0.3,B:0.7)"
                )
            return self.single(parts[0].name)
        shares = normalised(text, [part.weight for part in parts])
        # Vectors are mixed, not motions: motions averaged frame by frame cancel each other where their timing differs.
        names, vectors = zip(*(self.vector(self.single(part.name)) for part in parts), strict=True)
        vector = np.sum([np.float32(share) * row for share, row in zip(shares, vectors, strict=True)], 0)
        name = " + ".join(f"{share:.3g} {label}" for share, label in zip(shares, names, strict=True))
        return self.of_vector(name, vector.astype(np.float32))

    def single(self, name: str) -> S:
        """A style by its name, from a file, or of a clip."""
        style = self.named(name)
        if style is not None:
            return style
        is_file = name.endswith(FILES)
        recorded = None if self.space.is_vertices and is_file else self.recorded(name)
        if recorded is not None:
            return self.of_parameters(recorded)
        return self.of_file(open_style(Path(name)) if is_file else self.clip(name))

    def recorded(self, name: str) -> ParameterClip | None:
        """Motion in parameters; None if the name is of none."""
        return recorded_parameters(name, self.frame_rate)

    def of_parameters(self, recorded: ParameterClip) -> S:
        """The style of motion in parameters."""
        values = channels_of(recorded, self.space, self.frame_rate)
        return self.encode(recorded.name, (values - self.rest())[..., None])

    def of_file(self, opened: StyleFile) -> S:
        """The style of motion in vertices, or of a style vector."""
        path, scale = opened.path, 1.0
        if opened.array.ndim == 1:
            return self.of_vector(path.stem, self._vector_in(opened))
        if not self.space.is_vertices:
            raise OptionError.naming(
                f"{{style}} {path}: holds vertices, and this model takes channels; give motion in parameters, a style "
                f"of the model by its name, or a style vector of this model"
            )
        if opened.template is None:
            face, whose, rate = self.face(opened)
        else:
            face, whose, rate = opened.template, None, opened.frame_rate or self.frame_rate
            if opened.unit not in (None, self.unit):
                scale = metres_per_unit(str(opened.unit)) / metres_per_unit(self.unit)
        stride = round(rate / self.frame_rate)
        if stride < 1 or abs(stride * self.frame_rate - rate) > 1e-6:
            raise OptionError.naming(
                f"{{style}} {path}: has {rate:g} frames a second, the model {self.frame_rate:g}; give a motion at that "
                f"rate"
            )
        # Networks see offsets from the speaker's own neutral face, at the frame rate and in the unit of their corpus.
        offsets = (scale * (opened.frames(self.vertices, stride) - face)).astype(np.float32)
        stillness = self.stillness()
        if stillness is not None and stillness.another_face(offsets):
            reason = "the head moves, or the template is another person's or in another unit"
            if whose is not None:
                reason = f"it is not {whose}'s; name the file <identity>_<clip>.npy with an identity of the model"
            raise OptionError.naming(f"{{style}} {path}: does not lie on its template: {reason}, {self.advice}")
        return self.encode(path.stem, offsets)

    def _vector_in(self, opened: StyleFile) -> Array:
        """The style vector (S,) of a file that holds one, alone or as :func:`marked` with its encoder's answer."""
        values, middle, still = np.array(opened.array, np.float32), len(opened.array) // 2, self.still_vector()
        divided = len(values) % 2 == 1 and bool(np.isinf(values[middle]))
        vector = values[:middle] if divided else values
        name = f"{{style}} {opened.path}"
        remedy = "make one with `facediff style extract` from this model's checkpoint"
        width = self.width
        if len(vector) != width or not np.isfinite(vector).all():
            raise OptionError.naming(
                f"{name}: holds {len(vector)} numbers, but this model's style vectors have {width} (no NaN); {remedy}"
            )
        if divided and still is not None:
            answer = values[middle + 1 :]
            limit = OTHER_ENCODER * max(np.linalg.norm(answer), np.linalg.norm(still))
            if not np.linalg.norm(answer - still) <= limit:
                raise OptionError.naming(
                    f"{name}: is of another model: its style encoder gives other numbers for a still face; {remedy}"
                )
        return vector
