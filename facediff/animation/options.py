"""The options of animating, each declared once: for the command line, Python, streams, and models without PyTorch.

A group of options is a frozen dataclass whose docstring is the help text of ``facediff --help`` and of Python's
``help()``. From top to bottom: the groups; :class:`AnimationOptions`, all groups that decide how speech is animated;
and the same names as keyword arguments for type checkers (:class:`StreamKeywords` and what extends it), which a test
compares with the dataclasses.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import re
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self, TypedDict, TypeVar

from facediff.errors import OptionError, choices
from facediff.utils import ranges
from facediff.utils.option import Option
from facediff.utils.paths import from_home

Scales = str | float | Mapping[str, float]
"""One number, or numbers by name: a mapping, or text as the command line takes it (``lips=0.5,all=1``)."""
FilePath = Path | str
View = Literal["front", "three_quarter", "side"]
Up = Literal["y", "z"]
Tracks = Literal["arkit", "oculus", "vrm"]
Precision = Literal["32", "bf16"]

# In a union, the first type is that of the command line.
if TYPE_CHECKING:
    StyleLike = str | Path | Mapping[str, float] | Any
    DirectionLike = Path | str | Sequence[Mapping[str, Any]] | Mapping[str, Any] | Any
else:
    StyleLike = str | Any
    DirectionLike = Path | Any


def scales_text(scales: Scales) -> str:
    """Numbers by name as the command line takes them.

    Example:
        >>> scales_text({"lips": 0.5, "all": 1}), scales_text(1.2)
        ('lips=0.5,all=1.0', '1.2')
    """
    if isinstance(scales, str):
        return scales
    if isinstance(scales, Mapping):
        return ",".join(f"{name}={scales_text(number)}" for name, number in scales.items())
    # Other texts are refused by the reader of the text, which names it.
    is_number = isinstance(scales, int | float) and not isinstance(scales, bool)
    return repr(float(scales)) if is_number else str(scales)


class CheckedOptions:
    """Base of the groups of options: checks ranges, finds the user's home, and tells which options were changed."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            object.__setattr__(self, name, from_home(value))
        ranges.check_options(self)

    @classmethod
    def defaults(cls) -> dict[str, Any]:
        """The default of every option that has one."""
        return {
            field.name: field.default
            for field in dataclasses.fields(cls)  # type: ignore[arg-type]  # every subclass is a dataclass
            if field.default is not dataclasses.MISSING
        }

    def changed(self) -> dict[str, Any]:
        """The options that differ from their defaults."""
        values = {name: (getattr(self, name), default) for name, default in self.defaults().items()}
        # Arrays compare element by element; whatever has another type than the default was given.
        return {name: v for name, (v, default) in values.items() if type(v) is not type(default) or v != default}

    @classmethod
    def of(cls, *groups: CheckedOptions, **values: Any) -> Self:  # noqa: ANN401 - fields of the class
        """The group whose options come from other groups, then from keywords; others keep their defaults."""
        names = {field.name for field in dataclasses.fields(cls)}  # type: ignore[arg-type]
        merged = {name: value for group in groups for name, value in vars(group).items() if name in names}
        return cls(**{**merged, **values})


@dataclass(frozen=True)
class GenerationOptions(CheckedOptions):
    """Generation (whose face, in which style, how).

    Attributes:
        identity: whose face and identity; by default the first one trained on
        condition: the training identity that the model is conditioned on, where it is not that of the face
        style: the speaking style: a video of a person; a motion (.npy of absolute vertices, .npz animation; of models
            of channels .csv, .json, or clip.npy@flame_artalk with its layout), a vector of `facediff style extract`, a
            clip's name (F1_e03), an identity's (F1), or a mixture of them (a.npy:0.3,b.npy:0.7); by default the one
            that the speech asks for, or else the identity's
        style_template: neutral face (mesh or .npy) of the speaker whose motion the style holds, where the checkpoint
            does not know them
        sampler: sampler by name, with the checkpoint's spacing and last noise where its steps allow them; see `facediff
            components sampler`
        steps: denoising steps of the sampler
        expressivity: 0 for the predicted mean, 1 for a sample, up to 2 for more than that; or by
            region, lips=0.5,upper_face=1.2 (default: the checkpoint's, usually 1)
        guidance: scales of DiffPoseTalk's guidance, audio=1.3,style=2 (default: the checkpoint's)
        seed: seed of the noise; equal seeds give equal motion
        voice_gate: what finds the pauses, in which the mouth comes to rest: energy or silero, with options
            (energy:release=0.3); off for the model's own motion there (default: energy, but off for imported models)
        frame_rate: frames a second of Audio2Face-3D, which has no rate of its own (default: 30)
        mesh: triangles of Audio2Face-3D's face, whose folder has none: a mesh with the same vertices
    """

    identity: Annotated[str | None, Option(metavar="NAME")] = None
    condition: Annotated[str | None, Option(metavar="NAME")] = None
    style: Annotated[StyleLike | None, Option(metavar="STYLE", reads=True)] = None
    style_template: Annotated[str | Path | None, Option(metavar="FACE", reads=True)] = None
    sampler: Annotated[str | None, Option(metavar="NAME")] = None
    steps: Annotated[ranges.Steps | None, Option(metavar="N")] = None
    expressivity: Annotated[Scales | None, Option(metavar="E")] = None
    guidance: Annotated[Scales | None, Option(metavar="SCALES")] = None
    seed: Annotated[ranges.Seed | None, Option(metavar="N")] = 0
    voice_gate: Annotated[str | None, Option(metavar="GATE")] = None
    frame_rate: Annotated[ranges.FrameRate | None, Option(metavar="F")] = None
    mesh: Annotated[FilePath | None, Option(metavar="FILE", reads=True)] = None


@dataclass(frozen=True)
class WindowOptions(CheckedOptions):
    """Windows (of long speech and of streams).

    Attributes:
        window: seconds of a window (default: 4); speech of up to 10 s is animated in one pass
        overlap: seconds that neighbouring windows share (default: 1)
        low_latency: windows of one frame, 0.08 s of look-ahead and two denoising steps, for immediate answers
    """

    window: Annotated[ranges.Window | None, Option(metavar="S")] = None
    overlap: Annotated[ranges.Window | None, Option(metavar="S")] = None
    low_latency: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.low_latency and (self.window is not None or self.overlap is not None):
            raise OptionError("low_latency", "chooses the windows; omit {window} and {overlap}")


@dataclass(frozen=True)
class RecordingOptions(CheckedOptions):
    """Recordings (options that need the whole recording, and are not for streams).

    Attributes:
        samples: how many animations, with seeds one after another
        max_seconds: refuse speech that lasts longer
        denoise: take steady noise out of the recording before the model receives it (the file keeps the recording)
        voice_shift: semitones by which the model receives pitch and formants shifted; -4 closes the lips better at p, b
            and m of some high voices (the file keeps the recording)
        alignment: when which phoneme is spoken, .TextGrid or .csv (start, end, ipa): the lips touch at each p, b and m
        closure_budget: mm that a vertex is moved by at most for that (default: 12)
    """

    samples: Annotated[ranges.Samples, Option(metavar="N")] = 1
    max_seconds: Annotated[ranges.Duration | None, Option(metavar="S")] = None
    denoise: bool = False
    voice_shift: Annotated[ranges.Semitones, Option(metavar="SEMITONES")] = 0.0
    alignment: Annotated[FilePath | None, Option(metavar="FILE", reads=True)] = None
    closure_budget: Annotated[ranges.Millimetres | None, Option(metavar="MM")] = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.closure_budget is not None and self.alignment is None:
            raise OptionError("closure_budget", "has no effect without {alignment}; give it as well")


@dataclass(frozen=True)
class AnimationControls(CheckedOptions):
    """Animation controls.

    Blinks, gaze, sway and acting are procedural: made by rules, not learnt, and called so in the metadata.

    Attributes:
        expressiveness: scale the motion: 1.2, or by region, upper_face=1.5,lips=0.9,all=1.1 (all: every vertex that no
            other name covers)
        blinks: blinks a minute (17 if no number)
        gaze: eyes that wander by so much at most (4 if no number)
        sway: a head that sways by so much at most (2 if no number)
        eyes: where lids and eyeballs are (.json, see docs/animation_controls.md); the built-in puppet needs
            none
        controls_seed: seed of blinks, gaze, sway and acting (default: the seed of the noise, or 0)
        direction: keys over time of style, expressiveness, brows, head and others (.json, .csv, or an .npz that was
            made with some; see docs/animation_controls.md), or a mood: calm, lively, happy, sad, angry,
            surprised; for a batch also a folder with a file for each recording
        acting: brows, head and lids that move with the speech: prosody, with options (prosody:strength=0.8,brows=3)
    """

    expressiveness: Annotated[Scales | None, Option(metavar="FACTORS")] = None
    blinks: Annotated[ranges.BlinkRate | bool | None, Option(metavar="RATE", bare=ranges.USUAL_BLINKS)] = None
    gaze: Annotated[ranges.GazeAngle | bool | None, Option(metavar="DEGREES", bare=ranges.USUAL_GAZE)] = None
    sway: Annotated[ranges.SwayAngle | bool | None, Option(metavar="DEGREES", bare=ranges.USUAL_SWAY)] = None
    eyes: Annotated[FilePath | None, Option(metavar="FILE", reads=True)] = None
    controls_seed: Annotated[ranges.Seed | None, Option(metavar="N")] = None
    direction: Annotated[DirectionLike | None, Option(metavar="KEYS", reads=True)] = None
    acting: Annotated[str | None, Option(metavar="ACTING")] = None

    def __post_init__(self) -> None:
        defaults = {"blinks": ranges.USUAL_BLINKS, "gaze": ranges.USUAL_GAZE, "sway": ranges.USUAL_SWAY}
        for name, number in defaults.items():
            if isinstance(switch := getattr(self, name), bool):
                object.__setattr__(self, name, number if switch else None)
        super().__post_init__()

    @property
    def controls(self) -> AnimationControls:
        """The animation controls alone, where they are a part of more options."""
        return AnimationControls.of(self)

    @property
    def is_off(self) -> bool:
        """Whether nothing is changed."""
        amounts = (self.expressiveness, self.blinks, self.gaze, self.sway, self.direction, self.acting)
        return all(amount is None for amount in amounts)

    @property
    def without_keys(self) -> AnimationControls:
        """The controls without their keys over time."""
        return replace(self.controls, direction=None)


@dataclass(frozen=True)
class TargetOptions(CheckedOptions):
    """Another mesh.

    Attributes:
        target_mesh: transfer the motion to this mesh
        correspondence: .npz of that mesh, to use if it exists, else to write
        carry: move the surface of a target .glb that has shapes of its own (ARKit's, VRM's or Oculus' names), which
            else play the motion by their names, with its bones for head, eyes and jaw
        own_shapes: whether these shapes play it, which depends on the file to write as well
    """

    target_mesh: Annotated[FilePath | None, Option(metavar="FILE", reads=True)] = None
    correspondence: Annotated[FilePath | None, Option(metavar="MAP", reads=True, writes="file")] = None
    carry: bool = False
    own_shapes: Annotated[bool, Option(hidden=True)] = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.correspondence is not None and self.target_mesh is None:
            raise OptionError("correspondence", "belongs to a mesh; give {target_mesh} as well")


@dataclass(frozen=True)
class DeviceOptions(CheckedOptions):
    """Model (where and how it computes).

    Attributes:
        device: cpu, cuda …; auto for CUDA where there is one
        precision: bf16 multiplies in 16 bits, where the processor is faster at it; the motion differs a little
        threads: of the processor, for an exported model (default: its cores)
    """

    device: str = "cpu"
    precision: Precision = "32"
    threads: Annotated[ranges.Threads, Option(metavar="N")] = 0


@dataclass(frozen=True)
class LicenceOptions(CheckedOptions):
    """Licence.

    Attributes:
        commercial_only: refuse a model that is not cleared for commercial use
    """

    commercial_only: bool = False


@dataclass(frozen=True)
class ExportOptions(CheckedOptions):
    """Output.

    Attributes:
        output_unit: unit of length of the file: m, cm, mm, in, or a number of metres (default: the motion's own)
        up: axis that points up in the file (default: y, or z if a target mesh has it up)
        no_speech: omit the sound
        shapes: for .csv and .glb: folder of meshes, .glb with targets, or "puppet" (built in)
        tracks: for .csv: arkit, or oculus (15 visemes) or vrm (vowels and blinks) as a plain table
        key_tolerance: for weights: leave out keys that a straight line replaces to within so much
        tolerance: for .glb: largest error in mm
        surface: for .glb, .usdc and .usda: the .obj or .glb of the animation's mesh, whose texture coordinates are
            written, and to .glb materials and pictures too (default: the target mesh)
        view: for videos: camera
        size: for videos: height and width in pixels; a .gif has a third of it
        video_rate: for videos: pictures a second, with motion interpolated between frames (default: its frame rate)
        footer: text below a video, such as "synthetic corpus"
        quiet: whether progress bars are hidden
        speech_file: name of the .wav file that is written next to the animation; None if there is none. Set by
            :func:`facediff.export.write_animations` for formats that refer to it.
    """

    output_unit: Annotated[str | None, Option(metavar="U")] = None
    up: Up | None = None
    no_speech: bool = False
    shapes: Annotated[FilePath | None, Option(metavar="SHAPES", reads=True)] = None
    tracks: Tracks = "arkit"
    key_tolerance: Annotated[ranges.KeyTolerance, Option(metavar="W")] = 0.0
    tolerance: Annotated[ranges.Millimetres, Option(metavar="MM")] = 0.05
    surface: Annotated[FilePath | None, Option(metavar="MESH", reads=True)] = None
    view: View = "front"
    size: Annotated[ranges.Pixels, Option(metavar="PIXELS")] = 1080
    video_rate: Annotated[ranges.FrameRate | None, Option(metavar="F")] = None
    footer: Annotated[str, Option(hidden=True)] = ""
    quiet: Annotated[bool, Option(hidden=True)] = True
    speech_file: Annotated[str | None, Option(hidden=True)] = None


@dataclass(frozen=True)
class SourceOptions(CheckedOptions):
    """What a bare .npy does not say (an .npz of `facediff animate` says all of it).

    Attributes:
        mesh: neutral face with triangles: .ply, .obj, .glb …
        checkpoint: what is still missing, from a checkpoint
        identity: whose face in the checkpoint; by default the first one trained on
        speech: the recording that the motion belongs to
        frame_rate: frames a second
        unit: unit of length: m, cm, mm, in, or a number of metres
    """

    mesh: Annotated[FilePath | None, Option(metavar="FILE", reads=True)] = None
    checkpoint: Annotated[Path | str | Any | None, Option(metavar="C", reads=True)] = None
    identity: Annotated[str | None, Option(metavar="NAME")] = None
    speech: Annotated[FilePath | None, Option(metavar="WAV", reads=True)] = None
    frame_rate: Annotated[ranges.FrameRate | None, Option(metavar="F")] = None
    unit: Annotated[str | None, Option(metavar="U")] = None


@dataclass(frozen=True, kw_only=True)
class AnimationOptions(
    GenerationOptions, WindowOptions, RecordingOptions, AnimationControls, TargetOptions, DeviceOptions, LicenceOptions
):
    """All options that decide how speech is animated; the groups that it consists of explain them.

    Attributes:
        checkpoint: the trained model
        quiet: whether progress bars are hidden
        alive: whether the built-in face gets a lively style, acting, sway and glances, as far as they were not chosen
    """

    checkpoint: FilePath
    quiet: bool = True
    alive: bool = False

    def words(self) -> list[str]:
        """The options that change a take, as on the command line, but for keys over time and what metadata name.

        Example:
            >>> AnimationOptions(checkpoint="puppet.ckpt", blinks=True, acting="prosody", seed=3).words()
            ['--blinks', '17', '--acting', 'prosody']
        """
        arguments = []
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if field.name in NAMED_ELSEWHERE or value == field.default:
                continue
            if isinstance(value, Mapping):
                value = ",".join(f"{name}={share:.15g}" for name, share in value.items())
            elif isinstance(value, float):
                value = f"{value:.15g}"
            arguments += [f"--{field.name.replace('_', '-')}", *([] if value is True else [str(value)])]
        return arguments


NAMED_ELSEWHERE = (
    *("checkpoint", "identity", "style", "seed", "expressivity", "guidance", "direction"),
    *("samples", "quiet", "device", "commercial_only", "own_shapes", "alive"),
)
"""Options of a take that its metadata name by themselves, that its page asks for, or that change nothing in it."""


def option_texts(options: type) -> dict[str, str]:
    """The help text of every option of a dataclass, from its docstring and those of the groups that it extends."""
    texts: dict[str, str] = {}
    for group in reversed(options.__mro__):
        attributes = (inspect.getdoc(group) or "").partition("Attributes:\n")[2] if group is not object else ""
        for entry in re.split(r"\n(?=    \w)", f"\n{attributes}"):
            name, colon, text = entry.strip().partition(": ")
            if colon and name.isidentifier():
                texts[name] = " ".join(text.split())
    return texts


Function = TypeVar("Function", bound=Callable[..., Any])


def with_options(options: type, keywords: type) -> Callable[[Function], Function]:
    """Decorator of a function with ``**options``, by which ``help()`` and notebooks show every one with its text.

    Args:
        options: the dataclass that declares the options.
        keywords: a TypedDict of those that the function takes.
    """
    fields = {field.name: field for field in dataclasses.fields(options)}
    hints = typing.get_type_hints(keywords)
    names = [name for name in fields if name in hints]

    def decorate(function: Function) -> Function:
        signature = inspect.signature(function)
        plain = [p for p in signature.parameters.values() if p.kind is not p.VAR_KEYWORD]
        parameters = [
            inspect.Parameter(
                name, inspect.Parameter.KEYWORD_ONLY, default=fields[name].default, annotation=hints[name]
            )
            for name in names
        ]
        texts = option_texts(options)
        entries = "".join(f"    {name}: {texts[name]}.\n" for name in names)

        @functools.wraps(function)
        def call(*arguments: Any, **keywords: Any) -> Any:  # noqa: ANN401
            for name in keywords:
                if name not in names and name not in signature.parameters:
                    raise TypeError(f"{function.__name__}() has no option {name!r}: {choices(name, names)}")
            return function(*arguments, **keywords)

        vars(call)["__signature__"] = signature.replace(parameters=[*plain, *parameters])
        call.__doc__ = f"{inspect.cleandoc(function.__doc__ or '')}\n\nOptions:\n{entries}"
        return call  # type: ignore[return-value]

    return decorate


GROUPS = AnimationOptions.__bases__
"""The groups that :class:`AnimationOptions` consists of, in the order of help texts."""


class ActingKeywords(TypedDict, total=False):
    """Keyword arguments of what moves the face while speech arrives."""

    controls_seed: int | None
    direction: DirectionLike | None
    acting: str | None


class ControlKeywords(ActingKeywords, total=False):
    """Keyword arguments of ``Animation.control``."""

    expressiveness: Scales | None
    blinks: float | bool | None
    gaze: float | bool | None
    sway: float | bool | None
    eyes: FilePath | None


class StreamKeywords(ActingKeywords, total=False):
    """Keyword arguments of ``Animator.stream``: the options that need no whole recording."""

    identity: str | None
    condition: str | None
    style: StyleLike | None
    style_template: str | Path | None
    expressiveness: Scales | None
    sampler: str | None
    steps: int | None
    expressivity: Scales | None
    guidance: Scales | None
    seed: int | None
    voice_gate: str | None
    frame_rate: float | None
    mesh: FilePath | None
    window: float | None
    overlap: float | None
    low_latency: bool
    precision: Precision


class RecordingKeywords(StreamKeywords, ControlKeywords, total=False):
    """Keyword arguments of ``Animator.animate`` but for the number of samples, which decides what it returns."""

    max_seconds: float | None
    denoise: bool
    voice_shift: float
    alignment: FilePath | None
    closure_budget: float | None
    target_mesh: FilePath | None
    correspondence: FilePath | None


class AnimateKeywords(RecordingKeywords, total=False):
    """Keyword arguments of ``Animator.animate``."""

    samples: int


class ExportKeywords(TypedDict, total=False):
    """Keyword arguments of ``Animation.save``."""

    output_unit: str | None
    up: Up | None
    no_speech: bool
    shapes: FilePath | None
    tracks: Tracks
    key_tolerance: float
    tolerance: float
    surface: FilePath | None
    view: View
    size: int
    video_rate: float | None
