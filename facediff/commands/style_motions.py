"""Motions that lend their style: whose they are, which template is taken off them, and whether that can be."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from facediff.errors import FaceDiffError

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt
    from torch import Tensor

    from facediff.data import Assets, Reference

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
    from facediff.systems.checkpoint import imported

    templates: dict[str, Tensor] = dict(assets.templates)
    root = path.resolve().parent.parent
    if not in_corpus(path):
        return templates, assets.frame_rate
    if (root / "templates.pkl").is_file():
        templates |= read_templates(root / "templates.pkl", assets.n_vertices)
    module = imported(str(source.get("class_path")), SpeechMotionDataModule)  # type: ignore[type-abstract]
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
    import numpy as np

    if not path.is_file():
        raise FaceDiffError(f"--style {path}: no such file")
    if path.suffix == ".npz":
        from facediff.takes import read_archive

        take = read_archive(path)
        return StyleFile(path, take.vertices, take.template, take.frame_rate, take.unit)
    try:
        array: npt.NDArray[np.generic] = np.load(path, mmap_mode="r", allow_pickle=False)
    except (ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
        raise FaceDiffError(f"--style {path}: not a readable NumPy array ({error})") from error
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
        raise FaceDiffError(f"--style {path}: holds no array of numbers; expected a motion or a style vector")
    return StyleFile(path, array)


def read_reference(
    opened: StyleFile, assets: Assets, whose: str | None, template: Tensor, stride: int = 1
) -> Reference:
    """Offsets from a subject's template (V, 3), from absolute vertices (T, V, 3) or (T, 3V)."""
    import torch

    from facediff.data import Reference

    motion = frames_of(opened, assets, stride)
    offsets = torch.from_numpy(motion) - template
    refuse_stranger(opened.path, offsets, assets, whose)
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


def reference_of_take(opened: StyleFile, assets: Assets) -> Reference:
    """The offsets of a take from its own template, in the checkpoint's unit."""
    from dataclasses import replace

    import torch

    from facediff.data import Reference
    from facediff.takes import metres_per_unit

    template, unit = opened.template, opened.unit or assets.unit
    if template is None:
        raise FaceDiffError(f"--style {opened.path}: has no template")
    scale = 1.0 if unit == assets.unit else metres_per_unit(unit) / metres_per_unit(assets.unit)
    stride = stride_of(opened.path, opened.frame_rate or assets.frame_rate, assets.frame_rate)
    frames_of(opened, assets, stride)  # refuses another topology before it is compared with the template
    moved = replace(opened, array=opened.array - template[None])  # type: ignore[operator]
    offsets = scale * torch.from_numpy(frames_of(moved, assets, stride))
    refuse_stranger(opened.path, offsets, assets, None)
    return Reference(opened.path.stem, offsets)


def face_of(template: str | Path, opened: StyleFile, assets: Assets) -> Tensor:
    """The template that was given for a motion: a mesh, an array (V, 3), or ``median``.

    Raises:
        FaceDiffError: naming the file, if it is none of these or of another topology.
    """
    import numpy as np
    import torch

    from facediff.topology import read_mesh

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


def refuse_stranger(path: Path, offsets: Tensor, assets: Assets, whose: str | None) -> None:
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
        f"neutral face with --style-template, or name the file <subject>_<clip>.npy with a subject that the checkpoint "
        f"knows ({', '.join(sorted(assets.templates))})"
    )
