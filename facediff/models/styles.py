"""Styles as words of the command line: a file, the name of a clip, or a mixture of several."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from facediff.errors import FaceDiffError

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt
    from torch import Tensor

    from facediff.data import Assets, Reference
    from facediff.models import AnimationModel, Style


# Motions that lend their style: whose they are, which template is taken off them, and whether that can be.

STRANGER = 0.25
"""How far the stillest vertices may lie from the face, as a share of how far all vertices of a reference do."""
MEDIAN = "median"
"""Instead of a template's file: the median of the motion's own frames."""


@dataclass
class StyleFile:
    """A motion or a style vector as read from a file, opened once.

    Attributes:
        path: the file.
        array: (T, V, 3) or (T, 3V) absolute vertices, or a style vector.
        template: (V, 3) of a take, in the motion's unit; None where the file does not say.
        frame_rate: likewise.
        unit: likewise.
    """

    path: Path
    array: npt.NDArray[np.generic]
    template: npt.NDArray[np.floating] | None = None
    frame_rate: float | None = None
    unit: str | None = None


def in_corpus(path: Path) -> bool:
    """Whether a motion lies in a corpus folder, or a person's, which has templates of its own."""
    from facediff.data.corpus import MOTION_FOLDERS

    return path.resolve().parent.name in MOTION_FOLDERS


def folder_facts(path: Path, assets: Assets, source: Mapping[str, str]) -> tuple[dict[str, Tensor], float]:
    """Templates that a motion file may belong to, and its motion frames a second."""
    from facediff.data import SpeechMotionDataModule
    from facediff.data.corpus import read_manifest, read_templates
    from facediff.models.checkpoint import find_class
    from facediff.registry import corpus

    templates: dict[str, Tensor] = dict(assets.templates)
    root = path.resolve().parent.parent
    if not in_corpus(path):
        return templates, assets.frame_rate
    if (root / "templates.pkl").is_file():
        templates |= read_templates(root / "templates.pkl", assets.n_vertices)
    module = find_class(corpus, str(source.get("class_path")), SpeechMotionDataModule)
    usual = module.stored_frame_rate if module is not None and str(root) == source.get("root") else None
    return templates, float(read_manifest(root).get("frame_rate") or usual or assets.frame_rate)


def stride_of(path: Path, stored: float, wanted: float) -> int:
    """Every how many-th frame of a file is taken.

    Raises:
        FaceDiffError: if the file's frame rate is no whole multiple of the checkpoint's.
    """
    stride = round(stored / wanted)
    if stride < 1 or abs(stride * wanted - stored) > 1e-6:
        raise FaceDiffError(
            f"--style {path}: has {stored:g} frames a second, the checkpoint {wanted:g}; give a motion at that rate"
        )
    return stride


def corpus_clip(name: str, source: Mapping[str, str]) -> Path:
    """Where a clip of the training corpus lies, if the corpus is on this machine."""
    root = source.get("root")
    path = Path(root) / "vertices_npy" / f"{name}.npy" if root else None
    if path is None or not path.is_file():
        where = f"in the checkpoint nor at {path}" if path else "in the checkpoint, and its corpus is not known"
        raise FaceDiffError(f"--style {name}: no clip of that name {where}; give a .npy file or another clip")
    return path


def open_style(path: Path) -> StyleFile:
    """A style's file, memory-mapped where it is an array."""
    from facediff.utils.arrays import open_array

    if not path.is_file():
        raise FaceDiffError(f"--style {path}: no such file")
    if path.suffix == ".npz":
        from facediff.animation import read_archive

        animation = read_archive(path)
        return StyleFile(path, animation.vertices, animation.template, animation.frame_rate, animation.unit)
    return StyleFile(path, open_array(path, kinds="fiu", name=f"--style {path}"))


def read_reference(
    opened: StyleFile, assets: Assets, whose: str | None, template: Tensor, stride: int = 1
) -> Reference:
    """Offsets from an identity's template (V, 3), from absolute vertices (T, V, 3) or (T, 3V)."""
    import torch

    from facediff.data import Reference

    motion = frames_of(opened, assets, stride)
    offsets = torch.from_numpy(motion) - template
    refuse_unknown(opened.path, offsets, assets, whose)
    return Reference(opened.path.stem, offsets)


def frames_of(opened: StyleFile, assets: Assets, stride: int) -> npt.NDArray[np.float32]:
    """Absolute vertices (T, V, 3) of every ``stride``-th frame.

    Raises:
        FaceDiffError: if the file is of another topology, or not finite.
    """
    import numpy as np

    array, vertices = opened.array, assets.n_vertices
    if array.ndim not in (2, 3) or not len(array) or array.shape[1:] not in ((vertices, 3), (3 * vertices,)):
        raise FaceDiffError(
            f"--style {opened.path}: has shape {array.shape}; the checkpoint's faces have {vertices} vertices, "
            f"so (frames, {vertices}, 3) or (frames, {3 * vertices}) is expected"
        )
    motion = np.array(array[::stride], np.float32).reshape(-1, vertices, 3)
    if not np.isfinite(motion).all():
        raise FaceDiffError(f"--style {opened.path}: holds NaN or infinity")
    return motion


def reference_of_animation(opened: StyleFile, assets: Assets) -> Reference:
    """The offsets of a take from its own template, in the checkpoint's unit."""
    from dataclasses import replace

    import torch

    from facediff.animation import metres_per_unit
    from facediff.data import Reference

    template, unit = opened.template, opened.unit or assets.unit
    if template is None:
        raise FaceDiffError(f"--style {opened.path}: has no template")
    scale = 1.0 if unit == assets.unit else metres_per_unit(unit) / metres_per_unit(assets.unit)
    stride = stride_of(opened.path, opened.frame_rate or assets.frame_rate, assets.frame_rate)
    frames_of(opened, assets, stride)  # refuses another topology before it is compared with the template
    moved = replace(opened, array=opened.array - template[None])  # type: ignore[operator]
    offsets = scale * torch.from_numpy(frames_of(moved, assets, stride))
    refuse_unknown(opened.path, offsets, assets, None)
    return Reference(opened.path.stem, offsets)


def face_of(template: str | Path, opened: StyleFile, assets: Assets) -> Tensor:
    """The template that was given for a motion: a mesh, an array (V, 3), or ``median``.

    Raises:
        FaceDiffError: naming the file, if it is none of these or of another topology.
    """
    import numpy as np
    import torch

    from facediff.mesh import read_mesh

    path = Path(template)
    if str(template) == MEDIAN and not path.is_file():
        median = np.median(frames_of(opened, assets, 1), axis=0)
        print(
            f"note: --style {opened.path}: the median of its {len(opened.array)} frames stands for the neutral face; a "
            f"mouth that is open most of the time then counts as closed"
        )
        return torch.from_numpy(np.asarray(median, np.float32))
    read = open_style(path).array if path.suffix.lower() == ".npy" else read_mesh(path).vertices
    fits = read.size == 3 * assets.n_vertices
    face = np.asarray(read, np.float32).reshape(-1, 3) if fits else np.zeros((0, 3), np.float32)
    if face.shape != (assets.n_vertices, 3) or not np.isfinite(face).all():
        raise FaceDiffError(
            f"--style-template {path}: has shape {read.shape}; expected the neutral face of {assets.n_vertices} finite "
            f"vertices whose motion is in --style, as .obj, .ply or .npy, or the word {MEDIAN}"
        )
    return torch.from_numpy(face)


def refuse_unknown(path: Path, offsets: Tensor, assets: Assets, whose: str | None) -> None:
    """Refuse a motion that is not of the face whose template was taken off it; it would pass for a strange style.

    Told by the quarter of the vertices that move least in the stored references (skull, neck): there the offsets from
    one's own template are small, and those from another's are not, nor those of a head that moves.

    Args:
        path: for the message.
        offsets: (T, V, 3) from the template.
        assets: of the checkpoint.
        whose: who is taken for the motion's person; None where the template came with the motion.
    """
    import torch

    stored = [reference.motion.float() for reference in assets.references.values()]
    if not stored:
        return
    reach = torch.stack([torch.linalg.vector_norm(motion, dim=-1).amax(0) for motion in stored]).amax(0)
    still = reach.argsort()[: max(1, len(reach) // 4)]
    size = float(offsets[:, still].square().mean().sqrt())
    usual = max(float(motion.square().mean().sqrt()) for motion in stored)
    if size <= STRANGER * usual:
        return
    if whose is None:
        raise FaceDiffError(
            f"--style {path}: does not lie on its template: the head moves, or the template is another person's or in "
            f"another unit; give that person's own, and a head that keeps still (`facediff data import-person` does it)"
        )
    raise FaceDiffError(
        f"--style {path}: is not a motion of {whose}'s face, so it must be another person's; give that person's "
        f"neutral face with --style-template, or name the file <identity>_<clip>.npy with an identity that the "
        f"checkpoint knows ({', '.join(sorted(assets.templates))})"
    )


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
    words: str, identity: str, model: AnimationModel, *, template: str | Path | None = None
) -> Reference | Style:
    """The style that the words of ``--style`` ask for.

    Args:
        words: one style as :func:`read_style` takes it, or several with weights, ``a.npy:0.3,b.npy:0.7``; without
            weights all count alike. A mixture is the weighted mean of the model's style vectors. Weights may be
            negative, which leads away from a style; they are divided by their sum.
        identity: whose face is animated.
        model: gives the style vectors.
        template: neutral face of the person whose motion the .npy files hold, or ``median``.

    Raises:
        FaceDiffError: if the model has no styles, a style cannot be read, or the weights make no mean.
    """
    import torch

    from facediff.models import Style

    if not style_width(model):
        raise FaceDiffError(
            f"--style {words}: this checkpoint was trained without a dynamic style, so a style would change nothing; "
            f"leave --style away"
        )
    parts = split_styles(words, [reference.clip for reference in model.assets.references.values()])
    if len(parts) == 1:
        if parts[0].weight not in (None, 1.0):
            raise FaceDiffError(
                f"--style {words}: one style alone cannot be weighted; mix it with another one (A:0.3,B:0.7)"
            )
        return read_style(parts[0].name, identity, model, template=template)
    shares = normalised(words, [part.weight for part in parts])
    styles = [read_style(part.name, identity, model, template=template) for part in parts]
    vector = torch.stack([share * vector_of(s, model) for share, s in zip(shares, styles, strict=True)]).sum(0)
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


def style_width(model: AnimationModel) -> int:
    """How many numbers a style vector of the model has; 0 if it has no dynamic style."""
    import torch

    with torch.inference_mode():
        still = torch.zeros(1, 1, model.n_vertices, 3, device=model.device)
        return int(model.encode_style(still, torch.ones(1, 1, dtype=torch.bool, device=model.device)).shape[1])


def vector_of(style: Reference | Style, model: AnimationModel) -> Tensor:
    """The style vector (style_dim,) of a style, on the CPU."""
    import torch

    from facediff.models import Style

    if isinstance(style, Style):
        return style.vector.float()
    motion = style.motion.float()[None].to(model.device)
    with torch.inference_mode():
        encoded = model.encode_style(motion, torch.ones(motion.shape[:2], dtype=torch.bool, device=model.device))
    # A plain tensor: one made in inference mode could not be used outside of it.
    return encoded[0].cpu().clone()


def extract_style(clips: Sequence[str], identity: str, model: AnimationModel) -> Tensor:
    """The style vector (S,) of clips; their mean if there are several.

    Args:
        clips: motions, as :func:`read_style` takes them.
        identity: whose motion it is, where a file's name does not say it.
        model: gives the style vectors; S is 0 if it was trained without styles.

    Raises:
        FaceDiffError: if a clip cannot be read, or is a style vector already.
    """
    import torch

    from facediff.models import Style

    styles = [read_style(clip, identity, model) for clip in clips]
    for clip, style in zip(clips, styles, strict=True):
        if isinstance(style, Style):
            raise FaceDiffError(f"{clip}: is a style vector already; give a motion (frames, vertices, 3)")
    return torch.stack([vector_of(style, model) for style in styles]).mean(0)


def style_paths(words: str | None) -> list[Path]:
    """The files among the words of ``--style``, by which to tell whether a style has changed."""
    return [Path(part.name) for part in split_styles(words) if Path(part.name).is_file()] if words else []


def read_style(
    style: str, identity: str, model: AnimationModel, *, template: str | Path | None = None
) -> Reference | Style:
    """A style from a file, from the checkpoint, or from the corpus that the checkpoint was trained on.

    A file holds a style vector that ``facediff style extract`` wrote, or a motion in absolute vertices: a take
    (``.npz``), which says its own template, or a bare array (``.npy``). An array's identity follows from its file name
    (``F1_e03.npy``), else it is the identity, unless a template is given. A file in the ``vertices_npy`` of a corpus
    folder comes with that folder's templates and frame rate.
    """
    assets, source = model.assets, model.data_source
    if not style.endswith(MOTIONS):
        for reference in assets.references.values():
            if reference.clip == style:
                return reference
    opened = open_style(Path(style) if style.endswith(MOTIONS) else corpus_clip(style, source))
    path = opened.path
    if opened.array.ndim == 1:
        return read_vector(opened, model)
    if opened.template is not None:
        return reference_of_animation(opened, assets)
    owner = path.stem.split("_condition_")[0].rpartition("_")[0]
    templates, stored = folder_facts(path, assets, source)
    stride = stride_of(path, stored, assets.frame_rate)
    if template is not None and style.endswith(MOTIONS) and not (in_corpus(path) and owner in templates):
        return read_reference(opened, assets, None, face_of(template, opened, assets), stride)
    who = next((name for name in (owner, identity) if name in templates), None)
    face = templates[who] if who is not None else assets.template(identity)
    return read_reference(opened, assets, who or identity, face, stride)


def read_vector(opened: StyleFile, model: AnimationModel) -> Style:
    """A style vector, if it is as long as this model's are."""
    import numpy as np
    import torch

    from facediff.models import Style

    vector, width = np.array(opened.array, np.float32), style_width(model)
    if len(vector) != width or not np.isfinite(vector).all():
        raise FaceDiffError(
            f"--style {opened.path}: holds {len(vector)} numbers, but this checkpoint's style vectors have {width} (no "
            f"NaN); make one with `facediff style extract` from this very checkpoint"
        )
    return Style(opened.path.stem, torch.from_numpy(vector))
