"""A loaded system with a command's options: recordings in, finished takes out."""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from facediff.commands.animate.options import export_options
from facediff.commands.directing_options import check_directing, directed
from facediff.errors import FaceDiffError

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    import numpy as np
    import numpy.typing as npt

    from facediff.data import Reference
    from facediff.retarget import Correspondence
    from facediff.systems import Style
    from facediff.systems.windows import WindowPlan
    from facediff.takes import Take

T = TypeVar("T")


class Performer:
    """Animates recordings with one system, one face and one style.

    Args:
        args: the options of ``facediff animate``.

    Raises:
        FaceDiffError: if the checkpoint, the style or another option is no good.
    """

    def __init__(self, args: argparse.Namespace) -> None:
        from facediff.commands.style_files import read_styles
        from facediff.systems import load_system

        self.args = args
        self.system = load_system(args.checkpoint, device=device(args.device))
        if args.sampler is not None or args.steps is not None:
            self.system.choose_sampler(args.sampler, args.steps)
        self.system.windows = window_plan(args, self.system.windows)
        self.system.windows.in_frames(self.system.frame_rate)
        self.identity = args.identity or self.system.identities[0]
        self.system.assets.template(self.identity)
        check_directing(args, self.system.assets)
        self._correspondence: Correspondence | None = None
        self.style: Reference | Style | None = None
        if args.style:
            self.style = read_styles(args.style, self.identity, self.system, template=args.style_template)

    def write(self, speech: npt.NDArray[np.float32], name: str, output: Path, *, seed: int) -> tuple[list[Path], Take]:
        """Animate speech (S,) at 16 kHz and write it under a name; the files, and the first take.

        Raises:
            FaceDiffError: if a file cannot be written.
        """
        from facediff.export import write_takes

        with self.takes(speech, name, seed, output) as takes:
            finished = [self.finished(take, seed + i) for i, take in enumerate(takes)]
            return write_takes(output, finished, export_options(self.args)), finished[0]

    @contextmanager
    def takes(self, speech: npt.NDArray[np.float32], name: str, seed: int, output: Path) -> Iterator[list[Take]]:
        """Takes of some speech, as they come from the system; long ones lie on disk as long as the context lasts."""
        from facediff.data.audio import SAMPLE_RATE

        seeds = [seed + i for i in range(self.args.takes)]
        # In whole frames, as the system counts: else speech of just about the limit would be made in another way here.
        rate = self.system.frame_rate
        short = self.system.windows.at_once(round(len(speech) * rate / SAMPLE_RATE), rate)
        # On the disk that the result goes to, which is the one that has room for it.
        spool: AbstractContextManager[str | None] = nullcontext() if short else self._folder(output)
        with spool as folder:
            with self.precision():
                if folder is None:
                    motions, style = self._at_once(speech, seeds)
                else:
                    motions, style = self._by_windows(speech, seeds, Path(folder))
            yield [
                self._take(motion, speech, name if len(seeds) == 1 else f"{name}, take {i + 1}", take_seed, style)
                for i, (motion, take_seed) in enumerate(zip(motions, seeds, strict=True))
            ]

    def finished(self, take: Take, seed: int) -> Take:
        """A take with everything done to it that the options ask for after the system."""
        take = directed(take, self.args, seed=None if self.args.directing_seed is not None else seed)
        if self.args.target_mesh is not None:
            take = self._carried(take)
        return take

    def _carried(self, take: Take) -> Take:
        """The take on the other mesh; the correspondence is found once for all takes, since all have one face."""
        from facediff.commands.target_mesh import carried_with
        from facediff.retarget import carry
        from facediff.topology import read_mesh

        if self._correspondence is None:
            made, self._correspondence = carried_with(take, self.args.target_mesh, self.args.correspondence)
            return made
        return carry(take, self._correspondence, read_mesh(self.args.target_mesh))

    def precision(self) -> AbstractContextManager[object]:
        """Within it the network multiplies in the precision asked for; noise and vertices stay as they are."""
        import torch

        return torch.autocast(self.system.device.type, torch.bfloat16, enabled=self.args.precision == "bf16")

    def _at_once(
        self, speech: npt.NDArray[np.float32], seeds: Sequence[int]
    ) -> tuple[list[npt.NDArray[np.float32]], str]:
        import torch

        progress = None if self.args.quiet else partial(bar, description="sampling")
        made = self.system.animate_takes(
            torch.from_numpy(speech).to(self.system.device),
            subject=self.identity,
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

        from facediff.takes.motion_files import MotionWriter

        stream = self.system.stream(subject=self.identity, style=self.style, seeds=seeds)
        progress = None if self.args.quiet else partial(bar, description="seconds of speech")
        template = self.system.assets.template(self.identity)
        writers = [MotionWriter(folder / f"{seed}.npy", tuple(template.shape)) for seed in seeds]
        for part in stream.over(torch.from_numpy(speech).to(self.system.device), progress=progress):
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
    ) -> Take:
        from facediff.commands.take_options import facts_of
        from facediff.takes import Take

        facts = facts_of(self.system.assets, self.identity)
        return Take(name=name, vertices=motion, speech=speech, metadata=self._metadata(seed, style), **facts)

    def _metadata(self, seed: int, style: str) -> dict[str, str]:
        from facediff import __version__

        assets = self.system.assets
        sampler = getattr(self.system, "sampler", None)
        told = {
            "generator": f"facediff {__version__}",
            "system": type(self.system).__name__,
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


def bar(items: Iterable[T], *, description: str) -> Iterable[T]:
    """The items, with a progress bar."""
    from tqdm import tqdm

    return tqdm(items, desc=description, leave=False)
