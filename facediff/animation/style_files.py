"""The text of ``--style``, and its files: mixtures of names with weights, motions, style vectors.

For models with and without PyTorch alike. Libraries are imported inside the functions, so that splitting alone costs
nothing.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from facediff.errors import OptionError

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from facediff.spaces.files import ParameterClip

FILES = (".npy", ".npz")
"""Suffixes of files that hold a style; anything else is the name of a clip."""
CANCELLED = 1e-3
"""Weights that sum to less than this share of their sizes leave nothing to divide by."""
OTHER_FACE = 0.25
"""How far the stillest vertices may lie from the face, as a share of how far all vertices of a reference do."""
OTHER_ENCODER = 0.1
"""How far two encoders' answers to a still face may lie apart, as a share of their length, to be of one model."""
NUMBER = r"[+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d+)?|[+-]?(?:nan|inf)"


@dataclass(frozen=True)
class Weighted:
    """One style of a mixture.

    Attributes:
        name: a file or the name of a clip.
        weight: None if none was given.
    """

    name: str
    weight: float | None


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
    """A motion or a style vector as read from a file.

    Attributes:
        path: the file.
        array: (T, V, 3) or (T, 3V) absolute vertices, or a style vector.
        template: (V, 3) of an animation, in the motion's unit; None for a bare array.
        frame_rate: likewise.
        unit: likewise.
    """

    path: Path
    array: npt.NDArray[np.generic]
    template: npt.NDArray[np.float32] | None = None
    frame_rate: float | None = None
    unit: str | None = None


def style_given(style: object, *, vertices: bool) -> str | ParameterClip | StyleFile:
    """A style as it was given in Python: the text of ``--style``, motion in parameters, or the content of a file.

    Args:
        style: words; a path; names or paths with their weights; an animation, an array of motion or a vector.
        vertices: whether the model moves vertices, so that an animation's own values are of no use.
    """
    import numpy as np

    from facediff.animation import Animation
    from facediff.spaces.files import ParameterClip

    if isinstance(style, Mapping):
        try:
            return ",".join(f"{name}:{float(weight)!r}" for name, weight in style.items())
        except (TypeError, ValueError) as error:
            raise OptionError.naming(f"{{style}} {style}: expected a number as the weight of each style") from error
    if isinstance(style, str | Path):
        return str(style)
    if isinstance(style, ParameterClip):
        return style
    if isinstance(style, Animation) and style.values is not None and not vertices:
        return ParameterClip(style.name, style.values, style.space, style.frame_rate)
    if isinstance(style, Animation):
        return StyleFile(Path(style.name), style.vertices, style.template, style.frame_rate, style.unit)
    array = np.asarray(style)
    if array.dtype.kind != "f" or array.ndim not in (1, 2, 3):
        raise OptionError.naming(
            f"{{style}}: is {array.dtype} of shape {array.shape}; expected words, a file, an animation, a motion "
            f"(frames, vertices, 3) or a style vector"
        )
    return StyleFile(Path("style"), array)


def open_style(path: Path) -> StyleFile:
    """A style's file, memory-mapped where it is an array."""
    from facediff.animation import read_archive
    from facediff.utils.arrays import open_array

    if not path.is_file():
        raise OptionError.naming(f"{{style}} {path}: no such file")
    if path.suffix == ".npz":
        animation = read_archive(path)
        return StyleFile(path, animation.vertices, animation.template, animation.frame_rate, animation.unit)
    return StyleFile(path, open_array(path, kinds="fiu", name=f"style {path}"))


def marked(vector: npt.NDArray[np.float32], still: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """A style vector (S,) for a file, with its encoder's answer to a still face (S,) behind it.

    Infinity lies between them, so that the whole is no style vector of any other length.
    """
    import numpy as np

    return np.concatenate([vector, [np.float32(np.inf)], still])


def vector_in(
    opened: StyleFile, width: int, still: Callable[[], npt.NDArray[np.float32]] | None
) -> npt.NDArray[np.float32]:
    """The style vector (S,) of a file that holds one, alone or as :func:`marked` with its encoder's answer.

    A vector alone does not tell its model.

    Args:
        opened: the file.
        width: S of the model.
        still: gives the answer of the model's own encoder (S,); None if it has none to ask.
    """
    import numpy as np

    values, middle = np.array(opened.array, np.float32), len(opened.array) // 2
    divided = len(values) % 2 == 1 and bool(np.isinf(values[middle]))
    vector = values[:middle] if divided else values
    name = f"{{style}} {opened.path}"
    remedy = "make one with `facediff style extract` from this model's checkpoint"
    if len(vector) != width or not np.isfinite(vector).all():
        raise OptionError.naming(
            f"{name}: holds {len(vector)} numbers, but this model's style vectors have {width} (no NaN); {remedy}"
        )
    if divided and still is not None:
        answer, model_answer = values[middle + 1 :], still()
        limit = OTHER_ENCODER * max(np.linalg.norm(answer), np.linalg.norm(model_answer))
        if not np.linalg.norm(answer - model_answer) <= limit:
            raise OptionError.naming(
                f"{name}: is of another model: its style encoder gives other numbers for a still face; {remedy}"
            )
    return vector


def frames_of(opened: StyleFile, vertices: int, stride: int) -> npt.NDArray[np.float32]:
    """Absolute vertices (T, V, 3) of every ``stride``-th frame.

    Args:
        opened: the file.
        vertices: V of the model's faces.
        stride: from one frame to the next.
    """
    import numpy as np

    array = opened.array
    if array.ndim not in (2, 3) or not len(array) or array.shape[1:] not in ((vertices, 3), (3 * vertices,)):
        raise OptionError.naming(
            f"{{style}} {opened.path}: has shape {array.shape}; the model's faces have {vertices} vertices, "
            f"so (frames, {vertices}, 3) or (frames, {3 * vertices}) is expected"
        )
    motion = np.array(array[::stride], np.float32).reshape(-1, vertices, 3)
    if not np.isfinite(motion).all():
        raise OptionError.naming(f"{{style}} {opened.path}: holds NaN or infinity")
    return motion


def stride_of(path: Path, stored: float, frame_rate: float) -> int:
    """Every how many-th frame of a file is taken."""
    stride = round(stored / frame_rate)
    if stride < 1 or abs(stride * frame_rate - stored) > 1e-6:
        raise OptionError.naming(
            f"{{style}} {path}: has {stored:g} frames a second, the model {frame_rate:g}; give a motion at that rate"
        )
    return stride


@dataclass(frozen=True)
class Stillness:
    """Where a model's faces keep still when they speak: skull and neck.

    Attributes:
        vertices: the quarter of the vertices that move least in the stored references.
        size: how far vertices move in these references, as a root mean square of offsets from the template.
    """

    vertices: npt.NDArray[np.int64]
    size: float

    def another_face(self, offsets: npt.NDArray[np.float32]) -> bool:
        """Whether offsets (T, V, 3) from a template are of another face than the template's, or the head moves."""
        import numpy as np

        # Where faces keep still, offsets from one's own template are small. Those from another speaker's are not.
        return float(np.sqrt(np.square(offsets[:, self.vertices]).mean())) > OTHER_FACE * self.size


def stillness_of(motions: Sequence[npt.NDArray[np.float32]]) -> Stillness | None:
    """Of reference motions, each (T, V, 3) from its template; None of no motions."""
    import numpy as np

    if not motions:
        return None
    reach = np.max([np.linalg.norm(motion, axis=-1).max(0) for motion in motions], 0)
    still = np.argsort(reach, kind="stable")[: max(1, len(reach) // 4)]
    return Stillness(still, max(float(np.sqrt(np.square(motion).mean())) for motion in motions))
