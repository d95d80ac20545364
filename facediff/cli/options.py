"""Options that several commands share: each has one name, one type and one help text, wherever it appears."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from facediff.cli.parsing import Option, changed
from facediff.errors import FaceDiffError
from facediff.utils import ranges
from facediff.utils.files import valid_text
from facediff.utils.hub import check_model_source

if TYPE_CHECKING:
    from facediff.animation import Animation
    from facediff.editing.controls import AnimationControls
    from facediff.export import ExportOptions
    from facediff.pipelines.motion import Source

Output = Annotated[Path, Option(also="-o", metavar="OUT", writes="file")]
OutputFolder = Annotated[Path, Option(also="-o", metavar="OUT", writes="folder")]
Picture = Annotated[Path | None, Option(metavar="PNG", writes="file")]
Checkpoint = Annotated[Path, Option(metavar="C", reads=True)]
Animations = Annotated[list[Path], Option(metavar="ANIMATION", reads=True)]
Corpus = Annotated[str | None, Option(metavar="NAME")]
File = Annotated[Path | None, Option(metavar="FILE", reads=True)]
FileOrList = Annotated[str | None, Option(metavar="FILE", reads=True)]
Folder = Annotated[Path | None, Option(metavar="FOLDER", reads=True)]
Map = Annotated[Path | None, Option(metavar="MAP", reads=True, writes="file")]
Identity = Annotated[str | None, Option(metavar="NAME")]
FrameRate = Annotated[ranges.FrameRate | None, Option(metavar="F")]
Seed = Annotated[ranges.Seed, Option(metavar="N")]
Size = Annotated[ranges.Pixels, Option(metavar="PIXELS")]
View = Literal["front", "three_quarter", "side"]
Workers = Annotated[ranges.Workers | None, Option(metavar="N")]
Scheduler = Annotated[str | None, Option(metavar="WHERE")]


@dataclass(frozen=True)
class SourceOptions:
    """What a bare .npy does not say (an .npz of `facediff animate` says all of it).

    Attributes:
        mesh: neutral face with triangles: .ply, .obj, .glb …
        checkpoint: what is still missing, from a checkpoint
        identity: whose face in the checkpoint; by default the first one trained on
        speech: the recording that the motion belongs to
        frame_rate: frames a second
        unit: unit of length: m, cm, mm, in, or a number of metres
    """

    mesh: File = None
    checkpoint: Annotated[Path | None, Option(metavar="C", reads=True)] = None
    identity: Identity = None
    speech: Annotated[Path | None, Option(metavar="WAV", reads=True)] = None
    frame_rate: FrameRate = None
    unit: Annotated[str | None, Option(metavar="U")] = None

    def check(self, animations: Sequence[Path]) -> None:
        """Refuse, before anything is imported, files that do not exist."""
        for path in animations:
            if not path.is_file():
                raise FaceDiffError(f"{path}: no such file; expected an animation, .npz or .npy")
        if self.checkpoint is not None:
            check_model_source(self.checkpoint, "--checkpoint")
        for option, file in (("--mesh", self.mesh), ("--speech", self.speech)):
            if file is not None and not file.is_file():
                raise FaceDiffError(f"{option} {file}: no such file")
        if self.identity is not None and self.checkpoint is None:
            raise FaceDiffError("--identity: names a face of a checkpoint; give --checkpoint as well")

    def source(self) -> Source:
        """The same for reading."""
        from facediff.pipelines.motion import Source

        return Source(**vars(self))

    def read(self, path: Path) -> Animation:
        """The animation in a file, completed by the options; all of its frames are finite."""
        self.check([path])
        return self.source().read(path)


@dataclass(frozen=True)
class ControlOptions:
    """Animation controls.

    Blinks, gaze, sway and acting are procedural: made by rules, not learnt, and called so in the metadata.

    Attributes:
        expressiveness: scale the motion: 1.2, or by region, upper_face=1.5,lips=0.9,all=1.1 (all: every vertex that no
            other name covers)
        blinks: blinks a minute (17 if no number)
        gaze: eyes that wander by so much at most (4 if no number)
        sway: a head that sways by so much at most (2 if no number)
        eyes: where lids and eyeballs are (.json or .npz, see docs/animation_controls.md); the built-in puppet needs
            none
        controls_seed: seed of blinks, gaze, sway and acting (default: --seed, or 0)
        direction: keys over time of style, expressiveness, brows, head and others (.json, .csv, or an .npz that was
            made with some; see docs/direction.md); for a batch also a folder with a file for each recording
        acting: brows, head and lids that move with the speech: prosody, with options (prosody:strength=0.8,brows=3)
    """

    expressiveness: Annotated[str | None, Option(metavar="FACTORS")] = None
    blinks: Annotated[ranges.BlinkRate | None, Option(metavar="RATE", bare=ranges.USUAL_BLINKS)] = None
    gaze: Annotated[ranges.GazeAngle | None, Option(metavar="DEGREES", bare=ranges.USUAL_GAZE)] = None
    sway: Annotated[ranges.SwayAngle | None, Option(metavar="DEGREES", bare=ranges.USUAL_SWAY)] = None
    eyes: File = None
    controls_seed: Annotated[ranges.Seed | None, Option(metavar="N")] = None
    direction: Annotated[Path | None, Option(metavar="KEYS", reads=True)] = None
    acting: Annotated[str | None, Option(metavar="ACTING")] = None

    def controls(self) -> AnimationControls:
        """The controls that the options ask for."""
        from facediff.editing.controls import AnimationControls

        return AnimationControls(
            self.expressiveness,
            self.blinks,
            self.gaze,
            self.sway,
            self.eyes,
            seed=self.controls_seed,
            direction=self.direction,
            acting=self.acting,
        )


@dataclass(frozen=True)
class OutputOptions:
    """Output.

    Attributes:
        output_unit: unit of length of the file: m, cm, mm, in, or a number of metres (default: the motion's own)
        up: axis that points up in the file (default: y)
        no_speech: omit the sound
        shapes: for .csv and .glb: folder of meshes, .glb with targets, or "puppet" (built in)
        key_tolerance: for weights: leave out keys that a straight line replaces to within so much
        tolerance: for .glb: largest error in mm
        view: for .mp4: camera
        size: for .mp4: height and width in pixels
    """

    output_unit: Annotated[str | None, Option(metavar="U")] = None
    up: Literal["y", "z"] | None = None
    no_speech: bool = False
    shapes: Annotated[Path | None, Option(metavar="SHAPES", reads=True)] = None
    key_tolerance: Annotated[ranges.KeyTolerance, Option(metavar="W")] = 0.0
    tolerance: Annotated[ranges.Millimetres, Option(metavar="MM")] = 0.05
    view: View = "front"
    size: Size = 512

    def check(self, suffix: str) -> None:
        """Refuse options that a format does not use."""
        from facediff.export import check_used

        check_used(suffix, [name for name, is_changed in changed(self).items() if is_changed])

    def export(self, *, footer: str = "", quiet: bool = True) -> ExportOptions:
        """The same for :func:`facediff.export.write_animations`."""
        from facediff.export import ExportOptions

        return ExportOptions(
            unit=self.output_unit,
            up=self.up,
            speech=not self.no_speech,
            view=self.view,
            size=self.size,
            shapes=self.shapes,
            key_tolerance=self.key_tolerance,
            tolerance_mm=self.tolerance,
            footer=footer,
            quiet=quiet,
        )


def with_different_names(animations: Sequence[Animation], paths: Sequence[Path]) -> list[Animation]:
    """The animations under their own names; where those are alike, as of one recording, under their files' names."""
    alike = len({animation.name for animation in animations}) < len(animations)
    return [
        replace(animation, name=valid_text(path.stem if alike else animation.name))
        for animation, path in zip(animations, paths, strict=True)
    ]


LONG, LARGE = 3600.0, 8 * 2**30
"""Seconds and bytes above which a command names its cost and waits for a yes."""


def confirm_cost(yes: bool, lower: str, *, seconds: float = 0.0, size: float = 0.0) -> None:
    """Name what a command is going to take where that is much, and start only if the user agrees.

    Args:
        yes: whether the user has agreed beforehand.
        lower: the options that lower the cost.
        seconds: roughly how long it takes on two processor cores.
        size: bytes that it takes in memory, or on disk until it has ended.

    Raises:
        FaceDiffError: if there is nobody to ask, or the answer is no.
    """
    if yes or (seconds <= LONG and size <= LARGE):
        return
    costs = [f"{seconds / 3600:.3g} hours on two processor cores"] if seconds > LONG else []
    costs += [f"{size / 2**30:.3g} GiB of memory or disk"] if size > LARGE else []
    cost = f"this takes about {' and '.join(costs)}"
    if sys.stdin is not None and sys.stdin.isatty() and sys.stderr.isatty():
        print(f"facediff: {cost}; start? [y/N] ", end="", file=sys.stderr, flush=True)
        if sys.stdin.readline().strip().lower() in ("y", "yes"):
            return
    raise FaceDiffError(f"{cost}; lower {lower}, or add --yes to start all the same")


def check_picture_path(path: Path | None) -> None:
    """Refuse, before any work is done, a picture of another format."""
    if path is not None and path.suffix != ".png":
        raise FaceDiffError(f'--show {path}: unknown suffix "{path.suffix}"; expected a picture .png')


def check_folders(methods: Mapping[str, Path]) -> None:
    """Refuse, before anything is imported, folders of predictions that do not exist."""
    for folder in methods.values():
        if not folder.is_dir():
            raise FaceDiffError(f"{folder}: no such folder; expected the predictions of a method")


def named_folders(
    words: Sequence[str], name_of: Callable[[Path], str] = lambda path: path.resolve().name
) -> dict[str, Path]:
    """Folders by name, from words NAME=FOLDER, or FOLDER, which ``name_of`` names."""
    found: dict[str, Path] = {}
    for word in words:
        name, equals, folder = word.partition("=")
        if not equals or Path(word).exists():
            name, folder = name_of(Path(word)), word
        if not name or not folder:
            raise FaceDiffError(f"{word}: expected NAME=FOLDER")
        if name in found:
            raise FaceDiffError(f'{word}: there is already one called "{name}"; name it with NAME=FOLDER')
        found[name] = Path(folder)
    return found
