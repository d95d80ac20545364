"""``facediff animate``: speech in, animation out."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from facediff.errors import FaceDiffError

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from facediff.data import Assets

T = TypeVar("T")

MIN_SECONDS = 0.2
SILENCE = 1e-4
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

    from facediff.commands.style_files import read_style
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
