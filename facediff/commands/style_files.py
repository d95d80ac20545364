"""Styles as words of the command line: a file, the name of a clip, or a mixture of several."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from facediff.errors import FaceDiffError

if TYPE_CHECKING:
    from torch import Tensor

    from facediff.commands.style_motions import StyleFile
    from facediff.data import Reference
    from facediff.systems import SpeechAnimator, Style

MOTIONS = (".npy", ".npz")
CANCELLED = 1e-3
"""Weights whose sum is less than this share of their sizes have nothing left to divide by."""

NUMBER = r"[+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d+)?|[+-]?(?:nan|inf)"


@dataclass(frozen=True)
class Weighted:
    """One word of a mixture.

    Attributes:
        name: a file or the name of a clip.
        weight: None if none was given.
    """

    name: str
    weight: float | None


def read_styles(
    words: str, identity: str, system: SpeechAnimator, *, template: str | Path | None = None
) -> Reference | Style:
    """The style that the words of ``--style`` ask for.

    Args:
        words: one style as :func:`read_style` takes it, or several with weights, ``a.npy:0.3,b.npy:0.7``; without
            weights all count alike. A mixture is the weighted mean of the system's style vectors. Weights may be
            negative, which leads away from a style; they are divided by their sum.
        identity: whose face is animated.
        system: gives the style vectors.
        template: neutral face of the person whose motion the .npy files hold, or ``median``.

    Raises:
        FaceDiffError: if the system has no styles, a style cannot be read, or the weights make no mean.
    """
    import torch

    from facediff.systems import Style

    if not style_width(system):
        raise FaceDiffError(
            f"--style {words}: this checkpoint was trained without a dynamic style, so a style would change nothing; "
            f"leave --style away"
        )
    parts = split_styles(words, [reference.clip for reference in system.assets.references.values()])
    if len(parts) == 1:
        if parts[0].weight not in (None, 1.0):
            raise FaceDiffError(
                f"--style {words}: one style alone cannot be weighted; mix it with another one (A:0.3,B:0.7)"
            )
        return read_style(parts[0].name, identity, system, template=template)
    shares = normalised(words, [part.weight for part in parts])
    styles = [read_style(part.name, identity, system, template=template) for part in parts]
    vector = torch.stack([share * vector_of(s, system) for share, s in zip(shares, styles, strict=True)]).sum(0)
    names = [style.name if isinstance(style, Style) else style.clip for style in styles]
    return Style(" + ".join(f"{share:.3g} {name}" for share, name in zip(shares, names, strict=True)), vector)


def split_styles(words: str, clips: Sequence[str] = ()) -> list[Weighted]:
    r"""The words of a mixture, parted at commas; a weight is what stands behind the last colon, if that is a number.

    Words that are a file, or the name of a clip, as a whole are taken as such: alone, a name may hold commas, or end in
    a colon and a number.

    >>> split_styles(r"C:\ann\x.npy:0.3,F1_e05:-1")
    [Weighted(name='C:\\ann\\x.npy', weight=0.3), Weighted(name='F1_e05', weight=-1.0)]
    """
    if words in clips or Path(words).is_file():
        return [Weighted(words, None)]
    parts = []
    for word in words.split(","):
        found = re.fullmatch(rf"(.*):\s*({NUMBER})\s*", word, re.IGNORECASE)
        name = (found[1] if found else word).strip()
        if not name:
            raise FaceDiffError(f"--style {words}: expected names or files with weights, such as a.npy:0.3,b.npy:0.7")
        parts.append(Weighted(name, float(found[2]) if found else None))
    return parts


def normalised(words: str, weights: Sequence[float | None]) -> list[float]:
    """Weights that sum to 1; a note says so where that changed them.

    Raises:
        FaceDiffError: if only some are given, one is not finite, or their sum is too near to 0.
    """
    given = [weight for weight in weights if weight is not None]
    if not given:
        return [1.0 / len(weights)] * len(weights)
    if len(given) < len(weights):
        raise FaceDiffError(f"--style {words}: give every style a weight (A:0.3,B:0.7), or none of them")
    total = math.fsum(given)
    if not all(map(math.isfinite, given)) or not abs(total) > CANCELLED * math.fsum(map(abs, given)):
        raise FaceDiffError(
            f"--style {words}: expected finite weights whose sum is not 0, since they are divided by it"
        )
    shares = [weight / total for weight in given]
    if abs(total - 1.0) > 1e-6:
        print(f"note: --style: weights are divided by their sum: {', '.join(f'{share:.3g}' for share in shares)}")
    return shares


def style_width(system: SpeechAnimator) -> int:
    """How many numbers a style vector of the system has; 0 if it has no dynamic style."""
    import torch

    with torch.inference_mode():
        still = torch.zeros(1, 1, system.n_vertices, 3, device=system.device)
        return int(system.encode_style(still, torch.ones(1, 1, dtype=torch.bool, device=system.device)).shape[1])


def vector_of(style: Reference | Style, system: SpeechAnimator) -> Tensor:
    """The style vector (style_dim,) of a style, on the CPU."""
    import torch

    from facediff.systems import Style

    if isinstance(style, Style):
        return style.vector.float()
    motion = style.motion.float()[None].to(system.device)
    with torch.inference_mode():
        encoded = system.encode_style(motion, torch.ones(motion.shape[:2], dtype=torch.bool, device=system.device))
    # A plain tensor: one made in inference mode could not be used outside of it.
    return encoded[0].cpu().clone()


def style_paths(words: str | None) -> list[Path]:
    """The files among the words of ``--style``, by which to tell whether a style has changed."""
    return [Path(part.name) for part in split_styles(words) if Path(part.name).is_file()] if words else []


def read_style(
    style: str, identity: str, system: SpeechAnimator, *, template: str | Path | None = None
) -> Reference | Style:
    """A style from a file, from the checkpoint, or from the corpus that the checkpoint was trained on.

    A file holds a style vector that ``facediff style extract`` wrote, or a motion in absolute vertices: a take
    (``.npz``), which says its own template, or a bare array (``.npy``). An array's subject is told by its name
    (``F1_e03.npy``), else it is the identity, unless a template is given. A file in the ``vertices_npy`` of a corpus
    folder comes with that folder's templates and frame rate.
    """
    from facediff.commands.style_motions import (
        corpus_clip,
        face_of,
        folder_facts,
        in_corpus,
        open_style,
        read_reference,
        reference_of_take,
        stride_of,
    )

    assets, source = system.assets, system.data_source
    if not style.endswith(MOTIONS):
        for reference in assets.references.values():
            if reference.clip == style:
                return reference
    opened = open_style(Path(style) if style.endswith(MOTIONS) else corpus_clip(style, source))
    path = opened.path
    if opened.array.ndim == 1:
        return read_vector(opened, system)
    if opened.template is not None:
        return reference_of_take(opened, assets)
    subject = path.stem.split("_condition_")[0].rpartition("_")[0]
    templates, stored = folder_facts(path, assets, source)
    stride = stride_of(path, stored, assets.frame_rate)
    if template is not None and style.endswith(MOTIONS) and not (in_corpus(path) and subject in templates):
        return read_reference(opened, assets, None, face_of(template, opened, assets), stride)
    who = next((name for name in (subject, identity) if name in templates), None)
    face = templates[who] if who is not None else assets.template(identity)
    return read_reference(opened, assets, who or identity, face, stride)


def read_vector(opened: StyleFile, system: SpeechAnimator) -> Style:
    """A style vector, if it is as long as this system's are."""
    import numpy as np
    import torch

    from facediff.systems import Style

    vector, width = np.array(opened.array, np.float32), style_width(system)
    if len(vector) != width or not np.isfinite(vector).all():
        raise FaceDiffError(
            f"--style {opened.path}: holds {len(vector)} numbers, but this checkpoint's style vectors have {width} (no "
            f"NaN); make one with `facediff style extract` from this very checkpoint"
        )
    return Style(opened.path.stem, torch.from_numpy(vector))
