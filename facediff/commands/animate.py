"""``facediff animate``: speech in, animation out."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from facediff.errors import FaceDiffError

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt
    from torch import Tensor

    from facediff.data import Assets, Reference
    from facediff.systems import SpeechAnimator, Style

T = TypeVar("T")

MIN_SECONDS = 0.2
SILENCE = 1e-4
STRANGER = 0.25
"""How far the stillest vertices may lie from the face, as a share of how far all vertices of a reference do."""
SUFFIXES = (".mp4", ".npy")


def parser() -> argparse.ArgumentParser:
    """Options of the command."""
    made = argparse.ArgumentParser("facediff animate", description="Animate a face with a recording of speech.")
    made.add_argument("speech", type=Path, help="recording: wav, flac, ogg or mp3, any sample rate, mono or stereo")
    made.add_argument("--checkpoint", type=Path, required=True, metavar="C", help="trained system (.ckpt)")
    made.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="OUT",
        help=".mp4 (video with the speech) or .npy (frames, vertices, 3; absolute vertices)",
    )
    made.add_argument("--identity", metavar="NAME", help="whose face and identity; the first one trained on if absent")
    made.add_argument(
        "--style",
        metavar="REFERENCE",
        help="who lends the style: a .npy file of absolute vertices, a .npy file that `facediff style extract` wrote, "
        "or a clip's name (F1_e03); "
        "the identity's stored reference if absent",
    )
    made.add_argument("--sampler", metavar="NAME", help="sampler by name; see `facediff components sampler`")
    made.add_argument("--steps", type=int, help="denoising steps of the sampler")
    made.add_argument("--seed", type=int, default=0, help="seed of the noise (default: 0)")
    made.add_argument("--device", default="cpu", help="cpu (default), cuda …")
    made.add_argument("--max-seconds", type=float, default=60.0, help="longest speech accepted (default: 60)")
    made.add_argument("--view", default="front", choices=["front", "three_quarter", "side"], help="camera of the video")
    made.add_argument("--size", type=int, default=512, help="height and width of the video in pixels (default: 512)")
    made.add_argument("--quiet", action="store_true", help="no progress bars")
    return made


def run(name: str, arguments: Sequence[str]) -> int:
    """Animate; every input is checked before the model is loaded, and the output appears whole or not at all."""
    args = parser().parse_args(list(arguments))
    check_output(args.output)
    speech = read_checked(args.speech, args.max_seconds)

    from facediff.systems import load_system

    system = load_system(args.checkpoint, device=device(args.device))
    if args.sampler is not None or args.steps is not None:
        system.choose_sampler(args.sampler, args.steps)
    identity = args.identity or system.identities[0]
    style = read_style(args.style, identity, system) if args.style else None

    import torch

    progress = None if args.quiet else partial(bar, description="sampling")
    made = system.animate(
        torch.from_numpy(speech).to(system.device), subject=identity, style=style, seed=args.seed, progress=progress
    )
    write(args.output, made.vertices.numpy(), speech, system.assets, args)
    print(f"{args.output}: {len(made.vertices)} frames, identity {made.identity}, style of {made.reference_name}")
    return 0


def check_output(path: Path) -> None:
    """Refuse an unknown suffix or a place that cannot be written, before any work is done."""
    from facediff.files import check_writable

    if path.suffix not in SUFFIXES:
        raise FaceDiffError(f'--output {path}: unknown suffix "{path.suffix}"; expected one of {", ".join(SUFFIXES)}')
    check_writable(path)


def read_checked(path: Path, max_seconds: float) -> npt.NDArray[np.float32]:
    """Speech (S,) at 16 kHz that is neither too short, too long nor silent."""
    import numpy as np

    from facediff.data.audio import SAMPLE_RATE, read_speech

    speech = read_speech(path)
    seconds = len(speech) / SAMPLE_RATE
    if seconds < MIN_SECONDS:
        raise FaceDiffError(f"{path}: lasts {seconds:.2f} s; expected speech of at least {MIN_SECONDS} s")
    if seconds > max_seconds:
        raise FaceDiffError(
            f"{path}: lasts {seconds:.0f} s, more than --max-seconds {max_seconds:g}; cut it into pieces, or raise the "
            f"limit (memory grows with the square of the length)"
        )
    if float(np.abs(speech).max()) < SILENCE:
        raise FaceDiffError(f"{path}: holds only silence; expected a recording of speech")
    return speech


def device(name: str) -> str:
    """The device, if this machine has it."""
    import torch

    try:
        torch.empty(0, device=name)
    except (RuntimeError, AssertionError) as error:
        reason = next(iter(str(error).splitlines()), "")
        raise FaceDiffError(f"--device {name}: not usable on this machine ({reason}); try --device cpu") from error
    return name


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


def bar(items: Iterable[T], *, description: str, total: int | None = None) -> Iterable[T]:
    """The items, with a progress bar."""
    from tqdm import tqdm

    return tqdm(items, desc=description, total=total, leave=False)


def write(
    path: Path,
    vertices: npt.NDArray[np.float32],
    speech: npt.NDArray[np.float32],
    assets: Assets,
    args: argparse.Namespace,
) -> None:
    """Write absolute vertices (T, V, 3) in the format that the suffix names."""
    if path.suffix == ".npy":
        import numpy as np

        from facediff.files import atomic

        with atomic(path) as temporary:
            np.save(temporary, vertices)
        return
    write_animation(path, [vertices], ["facediff"], speech, assets, view=args.view, size=args.size, quiet=args.quiet)


def write_animation(
    path: Path,
    motions: Sequence[npt.NDArray[np.float32]],
    labels: Sequence[str],
    speech: npt.NDArray[np.float32],
    assets: Assets,
    *,
    view: str = "front",
    size: int = 512,
    quiet: bool = False,
) -> None:
    """Write motions (T, V, 3) side by side as a video with sound."""
    from facediff.data.audio import SAMPLE_RATE, fit_length, samples_for
    from facediff.render import write_video

    frames = drawn_frames(path, motions, labels, assets, view=view, size=size)
    shown = frames if quiet else bar(frames, description=f"drawing {path.name}", total=len(motions[0]))
    sound = fit_length(speech, samples_for(len(motions[0]), assets.frame_rate))
    write_video(path, shown, assets.frame_rate, sound, SAMPLE_RATE)


def drawn_frames(
    path: Path,
    motions: Sequence[npt.NDArray[np.float32]],
    labels: Sequence[str],
    assets: Assets,
    *,
    view: str = "front",
    size: int = 512,
) -> Iterator[npt.NDArray[np.uint8]]:
    """Pictures of motions (T, V, 3) side by side, one a frame.

    Raises:
        FaceDiffError: naming ``path``, if the corpus had no mesh to draw.
    """
    from facediff.render import Renderer, side_by_side

    if assets.faces is None:
        raise FaceDiffError(f"{path}: the checkpoint holds no faces to draw, since its corpus has no mesh; write .npy")
    colours = None if assets.colours is None else assets.colours.numpy()
    template = next(iter(assets.templates.values())).numpy()
    renderer = Renderer(assets.faces.numpy(), template=template, view=view, size=size, colours=colours)
    footer = f"{assets.corpus}: synthetic corpus" if assets.synthetic else assets.corpus
    return side_by_side(renderer, motions, labels, footer=footer)
