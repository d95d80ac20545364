"""Styles as words of the command line: a file, or the name of a clip."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from facediff.errors import FaceDiffError

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt
    from torch import Tensor

    from facediff.data import Assets, Reference
    from facediff.systems import SpeechAnimator, Style

STRANGER = 0.25
"""How far the stillest vertices may lie from the face, as a share of how far all vertices of a reference do."""


def read_style(style: str, identity: str, system: SpeechAnimator) -> Reference | Style:
    """A style from a file, from the checkpoint, or from the corpus that the checkpoint was trained on.

    A file holds a style vector that ``facediff style extract`` wrote, or a motion in absolute vertices. A motion's
    subject is told by its name (``F1_e03.npy``), else it is the identity. A file in the ``vertices_npy`` of a corpus
    folder comes with that folder's templates and frame rate.
    """
    assets, source = system.assets, system.data_source
    if not style.endswith(".npy"):
        for reference in assets.references.values():
            if reference.clip == style:
                return reference
    path = Path(style) if style.endswith(".npy") else corpus_clip(style, source)
    if open_array(path).ndim == 1:
        return read_vector(path, system)
    subject = path.stem.split("_condition_")[0].rpartition("_")[0]
    templates, stored = folder_facts(path, assets, source)
    who = next((name for name in (subject, identity) if name in templates), None)
    template = templates[who] if who is not None else assets.template(identity)
    return read_reference(path, assets, who or identity, template, stride_of(path, stored, assets.frame_rate))


def folder_facts(path: Path, assets: Assets, source: Mapping[str, str]) -> tuple[dict[str, Tensor], float]:
    """Templates that a motion file may belong to, and its motion frames a second."""
    from facediff.data import SpeechMotionDataModule
    from facediff.data.corpus import MOTION_FOLDERS, read_manifest, read_templates
    from facediff.systems.checkpoint import imported

    templates: dict[str, Tensor] = dict(assets.templates)
    root = path.resolve().parent.parent
    if path.resolve().parent.name not in MOTION_FOLDERS:
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


def open_array(path: Path) -> npt.NDArray[np.generic]:
    """A NumPy file, memory-mapped."""
    import numpy as np

    if not path.is_file():
        raise FaceDiffError(f"--style {path}: no such file")
    try:
        array: npt.NDArray[np.generic] = np.load(path, mmap_mode="r", allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:
        raise FaceDiffError(f"--style {path}: not a readable NumPy array ({error})") from error
    return array


def read_vector(path: Path, system: SpeechAnimator) -> Style:
    """A style vector, if it is as long as this system's are."""
    import numpy as np
    import torch

    from facediff.systems import Style

    vector = np.array(open_array(path), np.float32)
    width = system.encode_style(torch.zeros(1, 1, system.n_vertices, 3), torch.ones(1, 1, dtype=torch.bool)).shape[1]
    if len(vector) != width or not np.isfinite(vector).all():
        raise FaceDiffError(
            f"--style {path}: holds {len(vector)} numbers, but this checkpoint's style vectors have {width} (no NaN); "
            f"make one with `facediff style extract` from this very checkpoint"
        )
    return Style(path.stem, torch.from_numpy(vector))


def read_reference(path: Path, assets: Assets, subject: str, template: Tensor, stride: int = 1) -> Reference:
    """Offsets from a subject's template (V, 3), from a file of absolute vertices (T, V, 3) or (T, 3V)."""
    import numpy as np
    import torch

    from facediff.data import Reference

    array = open_array(path)
    vertices = assets.n_vertices
    if array.ndim not in (2, 3) or not len(array) or array.shape[1:] not in ((vertices, 3), (3 * vertices,)):
        raise FaceDiffError(
            f"--style {path}: has shape {array.shape}; the checkpoint's faces have {vertices} vertices, "
            f"so (frames, {vertices}, 3) or (frames, {3 * vertices}) is expected"
        )
    motion = np.array(array[::stride], np.float32).reshape(-1, vertices, 3)
    if not np.isfinite(motion).all():
        raise FaceDiffError(f"--style {path}: holds NaN or infinity")
    offsets = torch.from_numpy(motion) - template
    refuse_stranger(path, offsets, assets, subject)
    return Reference(path.stem, offsets)


def refuse_stranger(path: Path, offsets: Tensor, assets: Assets, subject: str) -> None:
    """Refuse a motion of another person's face, which would pass for a strange style.

    Told by the quarter of the vertices that move least in the stored references (skull, neck): there the offsets from
    one's own template are small, and those from another's are not.
    """
    import torch

    stored = [reference.motion.float() for reference in assets.references.values()]
    if not stored:
        return
    reach = torch.stack([torch.linalg.vector_norm(motion, dim=-1).amax(0) for motion in stored]).amax(0)
    still = reach.argsort()[: max(1, len(reach) // 4)]
    size = float(offsets[:, still].square().mean().sqrt())
    usual = max(float(motion.square().mean().sqrt()) for motion in stored)
    if size > STRANGER * usual:
        raise FaceDiffError(
            f"--style {path}: is not a motion of {subject}'s face, so it must be another person's; name the file "
            f"<subject>_<clip>.npy, with a subject that the checkpoint knows ({', '.join(sorted(assets.templates))})"
        )
