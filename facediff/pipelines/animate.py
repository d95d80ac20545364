"""A loaded model with a command's options: recordings in, finished takes out."""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from facediff.cli.options import add_directing_options, check_directing, directed
from facediff.errors import FaceDiffError
from facediff.utils.progress import track

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    import numpy as np
    import numpy.typing as npt

    from facediff.animation import Animation
    from facediff.data import Reference
    from facediff.editing.correspondence import Correspondence
    from facediff.export import ExportOptions
    from facediff.models import Style
    from facediff.models.inference import WindowPlan


# Recordings of speech as a command takes them: neither too short nor silent.

MIN_SECONDS = 0.2
SILENCE = 1e-4


def refuse_replacing(recordings: Sequence[Path], outputs: Sequence[Path]) -> None:
    """Refuse to write an animation over a recording: a video whose speech is taken may have the animation's suffix.

    Raises:
        FaceDiffError: naming the output.
    """
    heard = {recording.resolve() for recording in recordings}
    for output in outputs:
        if output.resolve() in heard:
            raise FaceDiffError(f"--output: {output} is itself a recording and would be replaced; choose another place")


def read_checked(path: Path, max_seconds: float | None = None) -> npt.NDArray[np.float32]:
    """Speech (S,) at 16 kHz.

    Raises:
        FaceDiffError: if the file cannot be read, holds only silence, or lasts too short or too long.
    """
    import numpy as np

    from facediff.data.audio import SAMPLE_RATE, read_speech

    speech = read_speech(path)
    seconds = len(speech) / SAMPLE_RATE
    if seconds < MIN_SECONDS:
        raise FaceDiffError(f"{path}: lasts {seconds:.2f} s; expected speech of at least {MIN_SECONDS} s")
    if max_seconds is not None and seconds > max_seconds:
        raise FaceDiffError(
            f"{path}: lasts {seconds:.0f} s, more than --max-seconds {max_seconds:g}; cut it or raise the limit"
        )
    if float(np.abs(speech).max()) < SILENCE:
        raise FaceDiffError(f"{path}: holds only silence; expected a recording of speech")
    return speech


# The options of ``facediff animate``.

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
    made.add_argument("--checkpoint", type=Path, required=True, metavar="C", help="trained model (.ckpt)")
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
    from facediff.cli.options import check_directing
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


T = TypeVar("T")


class AnimationPipeline:
    """Animates recordings with one model, one face and one style.

    Args:
        args: the options of ``facediff animate``.

    Raises:
        FaceDiffError: if the checkpoint, the style or another option is no good.
    """

    def __init__(self, args: argparse.Namespace) -> None:
        from facediff.models import load_model
        from facediff.models.styles import read_styles

        self.args = args
        self.model = load_model(args.checkpoint, device=device(args.device))
        if args.sampler is not None or args.steps is not None:
            self.model.choose_sampler(args.sampler, args.steps)
        self.model.windows = window_plan(args, self.model.windows)
        self.model.windows.in_frames(self.model.frame_rate)
        self.identity = args.identity or self.model.identities[0]
        self.model.assets.template(self.identity)
        check_directing(args, self.model.assets)
        self._correspondence: Correspondence | None = None
        self.style: Reference | Style | None = None
        if args.style:
            self.style = read_styles(args.style, self.identity, self.model, template=args.style_template)

    def write(
        self, speech: npt.NDArray[np.float32], name: str, output: Path, *, seed: int
    ) -> tuple[list[Path], Animation]:
        """Animate speech (S,) at 16 kHz and write it under a name; the files, and the first take.

        Raises:
            FaceDiffError: if a file cannot be written.
        """
        from facediff.export import write_animations

        with self.takes(speech, name, seed, output) as takes:
            finished = [self.finished(animation, seed + i) for i, animation in enumerate(takes)]
            return write_animations(output, finished, export_options(self.args)), finished[0]

    @contextmanager
    def takes(self, speech: npt.NDArray[np.float32], name: str, seed: int, output: Path) -> Iterator[list[Animation]]:
        """Takes of some speech, as they come from the model; long ones lie on disk as long as the context lasts."""
        from facediff.data.audio import SAMPLE_RATE

        seeds = [seed + i for i in range(self.args.takes)]
        # In whole frames, as the model counts: else speech of just about the limit would be made in another way here.
        rate = self.model.frame_rate
        short = self.model.windows.in_one_pass(round(len(speech) * rate / SAMPLE_RATE), rate)
        # On the disk that the result goes to, which is the one that has room for it.
        spool: AbstractContextManager[str | None] = nullcontext() if short else self._folder(output)
        with spool as folder:
            with self.precision():
                if folder is None:
                    motions, style = self._at_once(speech, seeds)
                else:
                    motions, style = self._by_windows(speech, seeds, Path(folder))
            yield [
                self._take(motion, speech, name if len(seeds) == 1 else f"{name}, take {i + 1}", sample_seed, style)
                for i, (motion, sample_seed) in enumerate(zip(motions, seeds, strict=True))
            ]

    def finished(self, animation: Animation, seed: int) -> Animation:
        """A take with everything done to it that the options ask for after the model."""
        animation = directed(animation, self.args, seed=None if self.args.directing_seed is not None else seed)
        if self.args.target_mesh is not None:
            animation = self._carried(animation)
        return animation

    def _carried(self, animation: Animation) -> Animation:
        """The take on the other mesh; the correspondence is found once for all takes, since all have one face."""
        from facediff.cli.options import carried_with
        from facediff.editing.retargeting import carry
        from facediff.mesh import read_mesh

        if self._correspondence is None:
            made, self._correspondence = carried_with(animation, self.args.target_mesh, self.args.correspondence)
            return made
        return carry(animation, self._correspondence, read_mesh(self.args.target_mesh))

    def precision(self) -> AbstractContextManager[object]:
        """Within it the network multiplies in the precision asked for; noise and vertices stay as they are."""
        import torch

        return torch.autocast(self.model.device.type, torch.bfloat16, enabled=self.args.precision == "bf16")

    def _at_once(
        self, speech: npt.NDArray[np.float32], seeds: Sequence[int]
    ) -> tuple[list[npt.NDArray[np.float32]], str]:
        import torch

        progress = None if self.args.quiet else partial(track, description="sampling")
        made = self.model.animate_samples(
            torch.from_numpy(speech).to(self.model.device),
            identity=self.identity,
            style=self.style,
            seeds=seeds,
            progress=progress,
        )
        return [prediction.vertices.numpy() for prediction in made], made[0].reference_name

    def _by_windows(
        self, speech: npt.NDArray[np.float32], seeds: Sequence[int], folder: Path
    ) -> tuple[list[npt.NDArray[np.float32]], str]:
        """Each window goes to disk as it is made; what comes back are memory maps."""
        import numpy as np
        import torch

        from facediff.animation.files import MotionWriter

        stream = self.model.stream(identity=self.identity, style=self.style, seeds=seeds)
        progress = None if self.args.quiet else partial(track, description="seconds of speech")
        template = self.model.assets.template(self.identity)
        writers = [MotionWriter(folder / f"{seed}.npy", tuple(template.shape)) for seed in seeds]
        for part in stream.parts(torch.from_numpy(speech).to(self.model.device), progress=progress):
            for writer, motion in zip(writers, part, strict=True):
                writer.write((motion.cpu() + template).numpy())
        for writer in writers:
            writer.close()
        return [np.load(writer.path, mmap_mode="r") for writer in writers], stream.clip.reference_names[0]

    @staticmethod
    @contextmanager
    def _folder(output: Path) -> Iterator[str]:
        made = [folder for folder in (output.parent, *output.parent.parents) if not folder.exists()]
        try:
            output.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(prefix=f".{output.stem}.partial-", dir=output.parent) as folder:
                yield folder
        except OSError as error:
            raise FaceDiffError(
                f"{output}: cannot be written ({error.strerror or error}); make room, or choose another folder"
            ) from error
        finally:
            for parent in made:
                if parent.is_dir() and not any(parent.iterdir()):
                    parent.rmdir()

    def _take(
        self, motion: npt.NDArray[np.float32], speech: npt.NDArray[np.float32], name: str, seed: int, style: str
    ) -> Animation:
        from facediff.animation import Animation
        from facediff.cli.options import facts_of

        facts = facts_of(self.model.assets, self.identity)
        return Animation(name=name, vertices=motion, speech=speech, metadata=self._metadata(seed, style), **facts)

    def _metadata(self, seed: int, style: str) -> dict[str, str]:
        from facediff import __version__

        assets = self.model.assets
        sampler = getattr(self.model, "sampler", None)
        told = {
            "generator": f"facediff {__version__}",
            "model": type(self.model).__name__,
            "checkpoint": self.args.checkpoint.name,
            "corpus": f"{assets.corpus} (synthetic)" if assets.synthetic else assets.corpus,
            "identity": self.identity
            if assets.identity_index(self.identity) >= 0
            else f"{self.identity} (not trained on)",
            "style": style,
            "seed": str(seed),
            "precision": "bfloat16 and float32" if self.args.precision == "bf16" else "float32",
        }
        return told if sampler is None else {**told, "sampler": f"{type(sampler).__name__}, {sampler.steps} steps"}


def window_plan(args: argparse.Namespace, usual: WindowPlan) -> WindowPlan:
    """How long speech is cut.

    Raises:
        FaceDiffError: if a length is impossible.
    """
    seconds = usual.seconds if args.window is None else args.window
    overlap = min(usual.overlap, seconds / 2) if args.overlap is None else args.overlap
    return replace(usual, seconds=seconds, overlap=overlap)


def device(name: str) -> str:
    """The device, if this machine has it."""
    import torch

    try:
        torch.empty(0, device=name)
    except (RuntimeError, AssertionError) as error:
        reason = next(iter(str(error).splitlines()), "")
        raise FaceDiffError(f"--device {name}: not usable on this machine ({reason}); try --device cpu") from error
    return name
