"""Recordings of speech animated with one model, one face and one style: all that is not the model's own.

From top to bottom: the checks before a model is loaded (:func:`check_options`); and :class:`AnimationPipeline`,
which takes speech from samples to finished animations and files. Subclasses generate the motion: with PyTorch
(:mod:`facediff.pipelines.trained`) or without (:mod:`facediff.pipelines.exported`).
"""

from __future__ import annotations

import json
import secrets
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from facediff.animation import Animation
from facediff.animation.options import AnimationOptions, ExportOptions, Scales, scales_text
from facediff.editing.controls import check_controls, is_procedural, keys_file, keys_of
from facediff.errors import OptionError, refuse_idle
from facediff.pipelines.stages import (
    Act,
    AnimationStream,
    Array,
    CloseLips,
    Decode,
    Denoise,
    Direct,
    Generate,
    Rest,
    Retarget,
    SampleMotion,
    Stage,
    Take,
    VertexGenerator,
)
from facediff.speech.voice_activity import OFF, QUICK_GATE, USUAL_GATE, MouthAtRest, read_gate
from facediff.utils import SAMPLE_RATE, hints, ranges
from facediff.utils.files import scratch_folder, valid_text
from facediff.utils.hub import is_audio2face
from facediff.utils.progress import track
from facediff.utils.ranges import USUAL_GAZE, USUAL_SWAY
from facediff.version import __version__

if TYPE_CHECKING:
    from facediff.editing.controls.direction import Direction
    from facediff.spaces.decoding import ChannelDecoder
    from facediff.speech.audio import SpeechRecording
    from facediff.speech.windows import WindowPlan

PIXEL_SECONDS = 4e-8  # What drawing and encoding a pixel of a video takes

Progress = Callable[[int, int], object]
"""Called with the progress and the total, in denoising steps or seconds of speech."""


def check_options(options: AnimationOptions) -> None:
    """Refuse options that contradict each other and files that are not there, before a model is loaded."""
    expressivity_of(options)
    read_scales(options.guidance)
    read_gate(options.voice_gate or OFF)
    check_controls(options)
    if options.style is not None and (keys := keys_of(options.direction)) is not None:
        keys.refuse_both("style")
    if options.acting is not None:
        from facediff.editing.acting import read_acting

        read_acting(options.acting)
    if not is_audio2face(options.checkpoint):
        refuse_idle(
            "is for a folder of Audio2Face-3D, other models have their own",
            frame_rate=options.frame_rate is not None,
            mesh=options.mesh is not None,
        )
    for name in ("mesh", "target_mesh"):
        if (file := getattr(options, name)) is not None and not Path(file).is_file():
            raise OptionError(name, "no such file", file)
    if options.style is None:
        refuse_idle("has no effect without {style}", style_template=options.style_template is not None)


def enlivened(options: AnimationOptions) -> AnimationOptions:
    """The options with acting, sway and glances where the user chose none, by an option or by keys over time."""
    if keys_file(options.direction) is not None:
        return options
    keys = keys_of(options.direction)
    usual: dict[str, Any] = {"acting": "prosody", "sway": USUAL_SWAY, "gaze": USUAL_GAZE}
    free = [name for name in usual if getattr(options, name) is None and (keys is None or not keys.under(name))]
    return replace(options, **{name: usual[name] for name in free})


def expressivity_of(options: AnimationOptions) -> dict[str, float]:
    """Expressivity by region; ``all`` stands for every vertex that no other name covers. Empty for the model's own."""
    if options.expressivity is None:
        return {}
    from facediff.editing.controls.expressiveness import read_factors

    return read_factors(options.expressivity, "expressivity", ranges.EXPRESSIVITY.most)


class AnimationPipeline(ABC):
    """Animates recordings with one model, one face and one style.

    A subclass opens its model, and then calls this constructor.

    Attributes:
        seed: of the first sample.
        gate: the voice gate's name with its options.
        progress: called while motion is generated; None for a bar on the terminal, if the options ask for one.
        channels: the stage that finds channels of finished vertices, of a model that has such.
        corpus: name of the model's faces in errors; set before this constructor is called.
    """

    corpus: str
    style_name = ""
    """Name of the style of the latest motion."""
    channels: Stage | None = None
    takes_style_keys = False
    step_seconds = 0.01
    """What generating a second of speech takes on two processor cores."""

    def __init__(
        self,
        options: AnimationOptions,
        *,
        face: dict[str, Any],  # fields of an Animation: template, regions, frame_rate …
        windows: WindowPlan,
        model: str,  # its name, for errors
        samples: bool,  # whether the motion depends on a seed
        usual_gate: str,
        rest_weights: Callable[[], Array],  # how far each vertex (V,) goes to rest in pauses
        decoder: ChannelDecoder | None = None,  # of motion that is channels
    ) -> None:
        self.options, self.facts, self.windows = options, face, windows
        if options.alive and decoder is None and self.is_built_in:
            self.options = options = enlivened(options)
        self.frame_rate: float = face["frame_rate"]
        self.windows.in_frames(self.frame_rate)
        draws_controls = is_procedural(options) and options.controls_seed is None
        if not samples:
            refuse_idle(
                f"{model} makes one animation for all seeds",
                samples=options.samples > 1,
                seed=bool(options.seed) and not draws_controls,
            )
        self.seed = (
            options.seed if options.seed is not None else secrets.randbelow(2**31) if samples or draws_controls else 0
        )
        self.progress: Progress | None = None
        self.decoder = decoder
        self.gate = options.voice_gate or usual_gate
        if options.low_latency and self.gate == USUAL_GATE:
            self.gate = QUICK_GATE  # The usual gate looks further ahead than windows of low latency do.
        self.rest: Rest | None = None
        if (gate := read_gate(self.gate)) is not None:
            resting = face["template"] if decoder is None else decoder.resting[:, None].astype(np.float32)
            weights = rest_weights() if decoder is None else decoder.rest_weights
            self.rest = Rest(MouthAtRest(gate, resting, weights, self.frame_rate))
        self.act: Act | None = None
        if options.acting is not None:
            from facediff.editing.acting import read_acting

            self.act = Act(read_acting(options.acting), self.frame_rate, options.controls_seed)
        self.lips: CloseLips | None = None
        if options.alignment is not None:
            self.lips = CloseLips(options.alignment, options.closure_budget)
        self.retarget: Retarget | None = None
        if options.target_mesh is not None:
            file = None if options.correspondence is None else Path(options.correspondence)
            self.retarget = Retarget(Path(options.target_mesh), file, own_shapes=options.own_shapes)
        self.direct(keys_of(options.direction))

    @property
    def stages(self) -> list[Stage]:
        """The stages of a recording, in their order."""
        options = self.options
        stages: list[Stage | None] = [
            Denoise(noise=options.denoise, semitones=options.voice_shift),
            Generate(self),
            self.rest,
            self.act,
            Decode(self.still, self.decoder),
            self.channels,
            self.lips,
            None if self.face is None and self.decoder is None else Direct(self.face, self.frame_rate),
            self.retarget,
        ]
        return [stage for stage in stages if stage is not None]

    @abstractmethod
    def generate(self, speech: Array, seeds: Sequence[int]) -> tuple[int, Iterator[Sequence[Array]]]:
        """Frames for some speech (S,), and their absolute points part by part, for each sample (T, V, dims)."""

    @abstractmethod
    def generator(self, seed: int) -> VertexGenerator:
        """The model at the beginning of a stream."""

    @abstractmethod
    def frames_of(self, samples: int) -> int:
        """How many frames the model gives for so many samples of speech."""

    @abstractmethod
    def metadata(self, seed: int) -> dict[str, str]:
        """What an animation says of the model and its choices."""

    @property
    def stream_timing(self) -> tuple[float, float]:
        """Seconds of speech that a frame of a stream waits for the model, at most, and from one window to the next."""
        plan = self.windows.in_frames(self.frame_rate)  # a frame may be longer than planned
        return max(self.windows.look_ahead, plan.look_ahead / self.frame_rate), plan.hop / self.frame_rate

    @property
    def has_weights(self) -> bool:
        """Whether animations have weights of ARKit's shapes, or are of the built-in face, which has such shapes."""
        if self.decoder is not None and self.decoder.space.kind == "arkit":
            return True
        return self.options.target_mesh is None and self.is_built_in

    @property
    def is_built_in(self) -> bool:
        """Whether the model's face is the built-in one."""
        from facediff.editing.blendshapes import is_built_in_face

        return is_built_in_face(len(self.facts["template"]), self.facts.get("faces"))

    def direct(self, direction: Direction | None) -> None:
        """Follow other keys over time from now on."""
        if direction is not None and not self.takes_style_keys:
            direction.refuse_model_channels(exported=True)
        self.direction = direction
        self.face = None
        face_direction = None if direction is None else direction.without_model_channels()
        if face_direction is not None or not self.options.without_keys.is_off:
            from facediff.editing.controls.controlled_face import ControlledFace

            face = self.facts
            self.face = ControlledFace(
                self.options.controls,
                face_direction,
                face["template"],
                face["faces"],
                face["regions"],
                face["unit"],
                self.corpus,
            )

    def cost(self, seconds_of_speech: float, output: Path, size: int) -> tuple[float, float]:
        """Roughly the seconds on two processor cores, and the bytes, that :meth:`write` takes for some speech."""
        from facediff.export import is_film

        duration = self.options.samples * seconds_of_speech
        frames = duration * self.frame_rate
        seconds = self.step_seconds * duration
        if is_film(output.suffix):
            seconds += PIXEL_SECONDS * frames * size**2
        return seconds, 12 * frames * len(self.facts["template"])

    def write(
        self, recording: SpeechRecording, output: Path, export: ExportOptions, *, seed: int | None = None
    ) -> tuple[list[Path], Animation]:
        """Animate a recording and write the animations; the files, and the first animation."""
        from facediff.export import write_animations
        from facediff.mesh.textures import hands_on_textures

        # A surface alone would lose materials, skins and targets of a .glb, coordinates and pictures.
        target = Path(self.options.target_mesh or "")
        is_dressed = output.suffix.lower() == ".glb" and export.output_unit is None and self._target_has_materials
        own_shapes = self.options.own_shapes
        into = target if own_shapes or is_dressed or hands_on_textures(target, output) else None
        with self.animations(recording, output, seed=seed) as animations:
            z_up = self.retarget is not None and self.retarget.z_up
            if output.suffix == ".html" and recording.path:  # the page tells how the take is made again
                animations = [
                    replace(one, metadata={**one.metadata, "recording": valid_text(recording.path)})
                    for one in animations
                ]
            written = write_animations(output, animations, export, into=into, own_shapes=own_shapes, z_up=z_up)
            return written, animations[0]

    @cached_property
    def _target_has_materials(self) -> bool:
        """Whether the target mesh is a .glb that wears more than its surface."""
        from facediff.mesh.glb import has_materials_or_targets

        return self.options.target_mesh is not None and has_materials_or_targets(Path(self.options.target_mesh))

    @contextmanager
    def animations(
        self, recording: SpeechRecording, output: Path | None = None, *, seed: int | None = None
    ) -> Iterator[list[Animation]]:
        """Finished samples of a recording; long ones are on disk as long as the context lasts.

        The arguments are as in :meth:`write`; the folder of ``output`` must have room for long samples, which are
        kept in memory if it is None.
        """
        first = self.seed if seed is None else seed
        count, name = self.options.samples, valid_text(recording.name)
        # Counted in whole frames, as the model counts them: otherwise speech of just about the limit would be animated
        # by windows here and in one pass there.
        fits_memory = self.windows.in_one_pass(self.frames_of(len(recording.speech)), self.frame_rate)
        spool: AbstractContextManager[Path | None] = (
            nullcontext() if fits_memory or output is None else scratch_folder(output)
        )
        with spool as folder:
            samples = [
                SampleMotion(first + i, name if count == 1 else f"{name}, sample {i + 1}", folder) for i in range(count)
            ]
            take = Take(recording, recording.speech, samples)
            for stage in self.stages:
                stage.whole(take)
            yield [
                replace(sample.animation(), speech=recording.sound, sample_rate=recording.rate) for sample in samples
            ]

    def stream(self, rate: int = SAMPLE_RATE, *, channels: bool = False) -> AnimationStream:
        """Animates speech of any length while it arrives; gives vertices, or the motion's ``channels`` (m, C, 1)."""
        plain = channels or (self.face is None and self.decoder is None)
        stages = [stage for stage in self.stages if not (plain and isinstance(stage, Decode | Direct))]
        steps = [stage.stream(self.seed) for stage in stages]
        return AnimationStream(self.generator(self.seed), [step for step in steps if step is not None], rate)

    @property
    def look_ahead(self) -> float:
        """Seconds of speech, at most, that must arrive after an instant before its frame of a stream is certain."""
        return max(self.stream_timing[0], *(stage.look_ahead for stage in self.stages))

    def track(self, items: Iterable[int], description: str) -> Iterable[int]:
        """Items one by one, with their progress shown or reported."""
        report = self.progress
        if report is None:
            yield from items if self.options.quiet else track(items, description)
            return
        total = len(items) if isinstance(items, Sequence) else 0
        for count, item in enumerate(items, start=1):
            yield item
            report(count, max(count, total))

    def still(self, sample: SampleMotion | None) -> Animation:
        """The face at rest, one frame: of a sample, with everything that its animation says; or of a stream."""
        template = self.facts["template"]
        if sample is None:
            return Animation(name="stream", vertices=template[None], **self.facts)
        options = self.options
        metadata = {"generator": f"facediff {__version__}", **self.metadata(sample.seed)}
        if self.rest is not None:
            metadata["voice gate"] = self.gate
        if options.denoise:
            metadata["denoised"] = "yes"
        if options.voice_shift:
            metadata["voice shift"] = f"{options.voice_shift:+g} semitones"
        if self.direction is not None:
            metadata["direction"] = self.direction.text()
        if words := options.words():
            metadata["options"] = json.dumps(words, ensure_ascii=False, allow_nan=False)
        for option in ("expressivity", "guidance"):
            if (scales := getattr(options, option)) is not None:
                metadata[option] = scales_text(scales)
        return Animation(sample.name, template[None], metadata=metadata, **self.facts)


def read_scales(guidance: Scales | None) -> dict[str, float]:
    """Scales of guidance by condition; empty for None.

    Example:
        >>> read_scales("style=1.5,audio=1.2")
        {'style': 1.5, 'audio': 1.2}
    """
    scales: dict[str, float] = {}
    if guidance is None:
        return scales
    text = scales_text(guidance)
    for word in text.split(","):
        name, equals, number = word.partition("=")
        if not equals or not name.strip() or name.strip() in scales:
            raise OptionError(
                "guidance",
                "expected each condition once with its scale, such as style=1.5,audio=1.2",
                hints.shown(text),
            )
        scales[name.strip()] = ranges.GUIDANCE_SCALE.read(f"{{guidance}}: {name.strip()}", number.strip())
    return scales
