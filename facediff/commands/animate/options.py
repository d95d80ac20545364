"""The options of ``facediff animate``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from facediff.commands.directing_options import add_directing_options
from facediff.errors import FaceDiffError

if TYPE_CHECKING:
    from facediff.export import ExportOptions

SEEDS = 2**62
VIEWS = ("front", "three_quarter", "side")
EPILOG = """examples:
  facediff animate speech.wav --checkpoint demo/puppet.ckpt -o speech.mp4
  facediff animate speech.wav --checkpoint demo/puppet.ckpt --takes 3 --blinks -o speech.html
  facediff animate recordings/ --checkpoint demo/puppet.ckpt --suffix .glb -o animations/
  arecord -f S16_LE -r 16000 -t raw | facediff animate - --stream --checkpoint demo/puppet.ckpt -o live.npy"""


def parser() -> argparse.ArgumentParser:
    """Options of the command."""
    made = argparse.ArgumentParser(
        "facediff animate",
        description="Animate a face with a recording of speech, with many, or with speech as it comes.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    made.add_argument(
        "speech",
        nargs="+",
        type=Path,
        help="recording: wav, flac, ogg or mp3, any sample rate, mono or stereo; several, or a folder of them, for a "
        "batch; - with --stream",
    )
    made.add_argument("--checkpoint", type=Path, required=True, metavar="C", help="trained system (.ckpt)")
    made.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="OUT",
        help="file whose suffix names the format: .mp4 .html .glb .usdc .obj .ply .pc2 .mdd .csv .npz .npy (see "
        "`facediff export --help`); a folder for a batch",
    )
    made.add_argument("--identity", metavar="NAME", help="whose face and identity; the first one trained on if absent")
    made.add_argument(
        "--style",
        metavar="STYLE",
        help="who lends the style: a motion (.npy of absolute vertices, .npz take), a vector of `facediff style "
        "extract`, a clip's name (F1_e03), or a mixture of them (a.npy:0.3,b.npy:0.7); the identity's stored reference "
        "if absent",
    )
    made.add_argument(
        "--style-template",
        metavar="FACE",
        help="neutral face (mesh or .npy) of the person whose motion --style holds, where the checkpoint does not know "
        "them; or the word median",
    )
    made.add_argument("--takes", type=int, default=1, metavar="N", help="so many takes, with seeds one after another")
    made.add_argument("--sampler", metavar="NAME", help="sampler by name; see `facediff components sampler`")
    made.add_argument("--steps", type=int, help="denoising steps of the sampler")
    made.add_argument("--seed", type=int, default=0, help="seed of the noise (default: 0)")
    made.add_argument("--device", default="cpu", help="cpu (default), cuda …")
    made.add_argument(
        "--precision",
        default="32",
        choices=["32", "bf16"],
        help="bf16 multiplies in 16 bits, where the processor is quicker at it; the motion differs a little",
    )
    made.add_argument("--quiet", action="store_true", help="no progress bars")
    add_output_options(made)
    add_window_options(made)
    add_batch_options(made)
    add_directing_options(made)
    return made


def add_output_options(made: argparse.ArgumentParser) -> None:
    """What concerns the files that are written."""
    group = made.add_argument_group("output")
    group.add_argument("--target-mesh", type=Path, metavar="MESH", help="carry the motion to this mesh")
    group.add_argument(
        "--correspondence",
        type=Path,
        metavar="MAP",
        help="with --target-mesh: .npz to use if it is there, else to write",
    )
    group.add_argument("--shapes", type=Path, metavar="SHAPES", help="for .csv: folder of meshes, or .glb with targets")
    group.add_argument(
        "--output-unit", metavar="U", help="unit of length of the file: m, cm, mm, in, or metres as a number"
    )
    group.add_argument("--up", choices=["y", "z"], help="axis that points up in the file (default: y)")
    group.add_argument("--no-speech", action="store_true", help="leave the sound away")
    group.add_argument("--view", default="front", choices=VIEWS, help="camera of the video")
    group.add_argument("--size", type=int, default=512, help="height and width of the video in pixels (default: 512)")


def add_window_options(made: argparse.ArgumentParser) -> None:
    """What concerns long speech."""
    group = made.add_argument_group("long speech (made by windows that overlap)")
    group.add_argument("--window", type=float, metavar="S", help="seconds of a window (default: 4)")
    group.add_argument("--overlap", type=float, metavar="S", help="seconds that neighbours share (default: 1)")
    group.add_argument("--max-seconds", type=float, metavar="S", help="refuse speech that lasts longer")
    group.add_argument(
        "--stream", action="store_true", help="read PCM (16 bit, mono, little endian) from standard input as it comes"
    )
    group.add_argument("--rate", type=int, default=16_000, help="sample rate of that PCM (default: 16000)")


def add_batch_options(made: argparse.ArgumentParser) -> None:
    """What concerns several recordings."""
    group = made.add_argument_group("batch (several recordings or a folder; resumable)")
    group.add_argument("--suffix", default=".mp4", help="format of the batch's outputs (default: .mp4)")
    group.add_argument("--workers", type=int, metavar="N", help="processes (default: one for each processor)")
    group.add_argument("--retry-failed", action="store_true", help="try recordings again that failed before")


def export_options(args: argparse.Namespace) -> ExportOptions:
    """How the takes are written."""
    from facediff.export import ExportOptions

    return ExportOptions(
        unit=args.output_unit,
        up=args.up,
        speech=not args.no_speech,
        view=args.view,
        size=args.size,
        shapes=args.shapes,
        quiet=args.quiet,
    )


def check_seed(seed: int) -> None:
    """Refuse what the generators of random numbers do not take, clips' and takes' own numbers added.

    Raises:
        FaceDiffError: if it is too small or too large.
    """
    if not 0 <= seed < SEEDS:
        raise FaceDiffError(f"--seed {seed}: expected 0 or more, and less than {SEEDS}")


def check(args: argparse.Namespace, output: Path) -> None:
    """Refuse what can be refused before a model is loaded.

    Raises:
        FaceDiffError: naming the option.
    """
    from facediff.commands.directing_options import check_directing
    from facediff.export import check_export

    if args.takes < 1:
        raise FaceDiffError(f"--takes {args.takes}: expected 1 or more")
    check_seed(args.seed)
    if args.size < 16:
        raise FaceDiffError(f"--size {args.size}: expected at least 16 pixels")
    if args.correspondence is not None and args.target_mesh is None:
        raise FaceDiffError("--correspondence: belongs to a mesh; give --target-mesh as well")
    if args.style_template is not None and args.style is None:
        raise FaceDiffError("--style-template: belongs to a motion; give --style as well")
    if args.target_mesh is not None and not args.target_mesh.is_file():
        raise FaceDiffError(f"--target-mesh {args.target_mesh}: no such file")
    check_directing(args)
    check_export(output, export_options(args), args.takes)
