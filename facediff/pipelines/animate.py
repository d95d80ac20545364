"""One recording of speech, or several, animated with one model, one face and one style."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facediff.animation.options import AnimationOptions, DirectionLike, ExportOptions, Scales, scales_text
from facediff.editing.controls import check_controls, is_procedural, keys_file, keys_of
from facediff.errors import FaceDiffError, OptionError
from facediff.utils import ranges
from facediff.utils.files import scratch_folder, valid_text
from facediff.utils.hub import model_name
from facediff.utils.licences import licence_metadata
from facediff.utils.progress import track

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    import numpy as np
    import numpy.typing as npt

    from facediff.animation import Animation
    from facediff.data import Assets, Reference
    from facediff.editing.acting import Acting, Performer
    from facediff.editing.controlled import ControlledFace
    from facediff.editing.correspondence import Correspondence
    from facediff.editing.direction import Direction
    from facediff.models import AnimationModel, Style
    from facediff.pipelines.directing import DirectedStream
    from facediff.pipelines.rest import MouthAtRest
    from facediff.speech.phonemes import TimedPhoneme
    from facediff.speech.voice_activity import VoiceGate

MIN_SECONDS = 0.2
STEP_SECONDS = 0.01  # What a denoising step of a second of speech takes on two cores (tools/benchmarks/RESULTS.md)
PIXEL_SECONDS = 4e-8  # What drawing and encoding a pixel of a video takes


def check_options(options: AnimationOptions) -> None:
    """Refuse options that contradict each other and files that are not there, before a model is loaded.

    Raises:
        FaceDiffError: naming the option.
    """
    expressivity_of(options)
    read_scales(options.guidance)
    gate_of(options)
    check_controls(options)
    if options.acting is not None:
        from facediff.editing.acting import read_acting

        read_acting(options.acting)
    if (keys := keys_of(options.direction)) is not None:
        for name in ("style", "condition", "expressivity", "guidance"):
            if getattr(options, name) is not None:
                keys.refuse_both(name)
    if options.style_template is not None and options.style is None:
        raise OptionError("style_template", "belongs to a motion; give {style} as well")
    if options.target_mesh is not None and not Path(options.target_mesh).is_file():
        raise OptionError("target_mesh", "no such file", options.target_mesh)


def expressivity_of(options: AnimationOptions) -> dict[str, float]:
    """Expressivity by region; ``all`` stands for every vertex that no other name covers. Empty for the model's own."""
    if options.expressivity is None:
        return {}
    from facediff.editing.expressiveness import read_factors

    return read_factors(options.expressivity, "expressivity", ranges.EXPRESSIVITY.most)


def gate_text(options: AnimationOptions) -> str:
    """The voice gate's name with its options."""
    from facediff.speech.voice_activity import QUICK_GATE, USUAL_GATE

    # The usual gate looks further ahead than windows of low latency do.
    return QUICK_GATE if options.low_latency and options.voice_gate == USUAL_GATE else options.voice_gate


def gate_of(options: AnimationOptions) -> VoiceGate | None:
    """What finds the pauses in which the mouth comes to rest; None if nothing does."""
    from facediff.speech.voice_activity import read_gate

    return read_gate(gate_text(options))


class AnimationPipeline:
    """Animates recordings with one model, one face and one style.

    Args:
        options: the choices. A seed that decides nothing is refused.
        model: a model that is loaded already, on its device; it keeps what the options choose. None to load the
            checkpoint.

    Raises:
        FaceDiffError: if the checkpoint, the style or another option cannot be used.

    Example::

        pipeline = AnimationPipeline(AnimationOptions(checkpoint="demo/puppet.ckpt", identity="F1"))
        pipeline.write(read_recording(Path("speech.wav")), "speech", Path("speech.mp4"), seed=0)
    """

    def __init__(self, options: AnimationOptions, *, model: AnimationModel | None = None) -> None:
        from facediff.models import load_model
        from facediff.models.styles import style_from

        self.options = options
        if model is None:
            model = load_model(
                Path(options.checkpoint), usable_device(options.device), commercial_only=options.commercial_only
            )
        self.model = model
        if options.samples > 1 and not self.model.samples:
            raise OptionError("samples", f"{self._one_animation}; omit the option", options.samples)
        if (
            options.seed
            and not self.model.samples
            and (options.controls_seed is not None or not is_procedural(options))
        ):
            raise OptionError("seed", f"{self._one_animation}; omit the option", options.seed)
        if options.low_latency:
            self.model.choose_low_latency()
        if options.sampler is not None or options.steps is not None:
            self.model.choose_sampler(options.sampler, options.steps)
        if options.guidance is not None:
            self.model.choose_guidance(read_scales(options.guidance))
        self.model.windows = self.model.windows.chosen(options.window, options.overlap)
        self.model.windows.in_frames(self.model.frame_rate)
        self.identity = options.identity or self.model.identities[0]
        self.model.check_condition(options.condition)
        facts = facts_of(self.model.assets, self.identity)
        name = f"the checkpoint's corpus {self.model.assets.corpus}"
        if options.expressivity is not None:
            self._choose_expressivity(facts["template"], facts["regions"], name)
        gate = gate_of(options)
        self.rest: MouthAtRest | None = None
        if gate is not None:
            from facediff.pipelines.rest import MouthAtRest

            self.rest = MouthAtRest(gate, facts["template"], facts["regions"], self.model.frame_rate)
        self._correspondence: Correspondence | None = None
        self._phonemes: list[TimedPhoneme] | None = None  # of the recording, once they are known
        self.style: Reference | Style | None = None
        if options.style is not None and not (isinstance(options.style, str) and not options.style):
            self.style = style_from(options.style, self.identity, self.model, template=options.style_template)
        self.acting: Acting | None = None
        if options.acting is not None:
            from facediff.editing.acting import read_acting

            self.acting = read_acting(options.acting)
        self.direct(keys_of(options.direction, self.model.frame_rate))

    @property
    def _one_animation(self) -> str:
        return f"{type(self.model).__name__} makes one animation, whatever the seed"

    def direct(self, direction: Direction | None) -> None:
        """Follow other keys over time from now on.

        Raises:
            FaceDiffError: naming the channel that the model or its face cannot follow.
        """
        from facediff.pipelines.directing import plan_runs

        options = self.options
        if direction is not None and self.style is not None:
            direction.refuse_both("style")
        self.direction = direction
        self.runs = plan_runs(
            direction, self.model, self.identity, self.style, options.condition, options.style_template
        )
        finished = None if direction is None else direction.without_model_channels()
        self.face: ControlledFace | None = None
        if finished is not None or not options.without_keys.is_off:
            from facediff.editing.controlled import ControlledFace

            facts = facts_of(self.model.assets, self.identity)
            name = f"the checkpoint's corpus {self.model.assets.corpus}"
            self.face = ControlledFace(
                options.controls, finished, facts["template"], facts["faces"], facts["regions"], facts["unit"], name
            )

    def stream(self, seeds: Sequence[int]) -> DirectedStream:
        """What animates speech of any length while it arrives, a sample for each seed."""
        from facediff.pipelines.directing import DirectedStream

        return DirectedStream(self.model, self.runs, identity=self.identity, seeds=seeds)

    def _choose_expressivity(
        self, template: npt.NDArray[np.floating], regions: Mapping[str, npt.NDArray[np.integer]], name: str
    ) -> None:
        """Take over the expressivity of a face (V, 3) with regions, which errors call ``name``."""
        from facediff.editing.expressiveness import ALL, region_factors

        factors = expressivity_of(self.options)
        if not self.model.samples and {*factors.values()} != {1.0}:
            raise OptionError(
                "expressivity",
                f"{type(self.model).__name__} makes one animation and no samples around a mean; omit the option",
                self.options.expressivity,
            )
        if {*factors} == {ALL}:
            self.model.choose_expressivity(factors[ALL])
            return
        import torch

        # A region's number fades into the rest as those of expressiveness do, so that no edge is visible.
        of_vertices = region_factors(template, regions, factors, name)
        self.model.choose_expressivity(torch.from_numpy(of_vertices).float())

    def cost(self, speech: npt.NDArray[np.float32], output: Path, size: int) -> tuple[float, float]:
        """Roughly the seconds on two processor cores, and the bytes, that :meth:`write` takes for some speech (S,)."""
        from facediff.speech.audio import SAMPLE_RATE

        count, heard = self.options.samples, len(speech) / SAMPLE_RATE
        frames = count * heard * self.model.frame_rate
        steps = getattr(getattr(self.model, "sampler", None), "steps", 1)
        seconds = STEP_SECONDS * steps * count * heard * len(self.runs)
        if output.suffix == ".mp4":
            seconds += PIXEL_SECONDS * frames * size**2
        return seconds, 12 * frames * len(self.model.assets.template(self.identity))

    def write(
        self, speech: npt.NDArray[np.float32], name: str, output: Path, export: ExportOptions, *, seed: int
    ) -> tuple[list[Path], Animation]:
        """Animate speech and write the animations.

        Args:
            speech: (S,) at 16 kHz.
            name: the animations' name.
            output: the file; its suffix names the format.
            export: how it is written.
            seed: seed of the first sample.

        Returns:
            the files, and the first animation.

        Raises:
            FaceDiffError: if a file cannot be written.
        """
        from facediff.export import write_animations

        with self.samples(speech, name, output, seed=seed) as samples:
            finished = [self.finished(animation, seed + i) for i, animation in enumerate(samples)]
            return write_animations(output, finished, export), finished[0]

    @contextmanager
    def samples(
        self, speech: npt.NDArray[np.float32], name: str, output: Path | None, *, seed: int
    ) -> Iterator[list[Animation]]:
        """Samples of some speech as they come from the model; long ones are on disk as long as the context lasts.

        The arguments are those of :meth:`write`; the folder of ``output`` must have room for long samples, which are
        kept in memory if it is None.
        """
        seeds, name = [seed + i for i in range(self.options.samples)], valid_text(name)
        heard = speech
        if self.options.denoise:
            from facediff.speech.denoising import denoised

            heard = denoised(speech)
        # Counted in whole frames, as the model counts them: otherwise speech of just about the limit would be animated
        # by windows here and in one pass there.
        short = self.model.windows.in_one_pass(self.model.frames_of(len(heard)), self.model.frame_rate)
        spool: AbstractContextManager[Path | None] = (
            nullcontext() if short or output is None else scratch_folder(output)
        )
        with spool as folder:
            with self.precision():
                if folder is None:
                    motions, style = self._in_one_pass(heard, seeds, "sampling" if short else "seconds of speech")
                    opened = self.openness(heard, len(motions[0]))
                    motions = [self.at_rest(motion, opened) for motion in motions]
                else:
                    motions, style = self._by_windows(heard, seeds, folder)
            yield [
                self._animation(motion, speech, name if len(seeds) == 1 else f"{name}, sample {i + 1}", each, style)
                for i, (motion, each) in enumerate(zip(motions, seeds, strict=True))
            ]

    def finished(self, animation: Animation, seed: int) -> Animation:
        """A sample after everything that the options ask for after inference."""
        animation = self.closed(animation)
        if self.face is not None:
            animation = self.face.apply(animation, seed=seed, acted=self._acted(animation, seed))
        if self.options.target_mesh is None:
            return animation
        target = Path(self.options.target_mesh)
        correspondence = None if self.options.correspondence is None else Path(self.options.correspondence)
        from facediff.editing.fit_check import check_fit, refuse_poor
        from facediff.editing.retargeting import carry, retarget
        from facediff.mesh import read_mesh

        if self._correspondence is not None:
            return carry(animation, self._correspondence, read_mesh(target))
        # All samples have one face, so that one correspondence serves all.
        known = correspondence is not None and correspondence.exists()
        made, self._correspondence = retarget(
            animation,
            target,
            correspondence,
            judge=None if known else lambda made, found: refuse_poor(target, check_fit(animation, made, found)),
        )
        return made

    @property
    def look_ahead(self) -> float:
        """Seconds of speech, at most, that must be heard after an instant before its frame of a stream is certain."""
        return max(
            self.model.windows.look_ahead,
            0.0 if self.acting is None else self.acting.look_ahead,
            0.0 if self.rest is None else self.rest.openness().look_ahead,
        )

    def performer(self, seed: int) -> Performer | None:
        """What acts to speech while it arrives; None without acting."""
        if self.acting is None:
            return None
        return self.acting.performer(self.model.frame_rate, self._acting_seed(seed))

    def _acting_seed(self, seed: int) -> int:
        return seed if self.options.controls_seed is None else self.options.controls_seed

    def animation_of(self, vertices: npt.NDArray[np.float32]) -> Animation:
        """Frames (m, V, 3) of the animated face, with nothing else that is known of them."""
        from facediff.animation import Animation

        return Animation(name="stream", vertices=vertices, **facts_of(self.model.assets, self.identity))

    def _acted(self, animation: Animation, seed: int) -> npt.NDArray[np.float64] | None:
        """What acting does in each frame of a sample; None without it."""
        if self.acting is None:
            return None
        from facediff.editing.acting import act

        return act(self.acting, animation, self._acting_seed(seed))

    def closed(self, animation: Animation) -> Animation:
        """A sample whose lips touch where its phonemes say so, if their times are given."""
        alignment, transcript, speech = self.options.alignment, self.options.transcript, animation.speech
        from facediff.editing.closures import BUDGET, close_lips
        from facediff.speech.phonemes import closed_times, read_alignment

        if self._phonemes is None:
            if alignment is not None:
                self._phonemes = read_alignment(Path(alignment))
            elif transcript is not None and speech is not None:
                from facediff.editing.transcripts import align_transcript

                self._phonemes = align_transcript(transcript, speech)
            else:
                return animation
        budget = self.options.closure_budget
        return close_lips(animation, closed_times(self._phonemes), BUDGET if budget is None else budget)

    def precision(self) -> AbstractContextManager[object]:
        """Within it the network multiplies in the precision asked for; noise and vertices stay as they are."""
        import torch

        return torch.autocast(self.model.device.type, torch.bfloat16, enabled=self.options.precision == "bf16")

    def openness(self, speech: npt.NDArray[np.float32], frames: int) -> npt.NDArray[np.float32] | None:
        """How far the mouth may be open in each frame (frames,) of some speech (S,); None without a gate."""
        if self.rest is None:
            return None
        from facediff.speech.voice_activity import openness

        return openness(speech, frames, self.model.frame_rate, self.rest.gate)

    def at_rest(
        self, vertices: npt.NDArray[np.float32], openness: npt.NDArray[np.float32] | None
    ) -> npt.NDArray[np.float32]:
        """Vertices (T, V, 3) with the mouth as far at rest as the openness (T,) of their frames says."""
        return vertices if self.rest is None or openness is None else self.rest.apply(vertices, openness)

    def _in_one_pass(
        self, speech: npt.NDArray[np.float32], seeds: Sequence[int], description: str
    ) -> tuple[list[npt.NDArray[np.float32]], str]:
        """Vertices (T, V, 3) of the samples, in memory, and the style's name."""
        import torch

        from facediff.pipelines.directing import blend

        audio, motions = torch.from_numpy(speech).to(self.model.device), []
        styles: dict[str, None] = {}
        for run in self.runs:
            with self.model.choosing(run.choices):
                made = self.model.animate_samples(
                    audio,
                    identity=self.identity,
                    condition=run.condition,
                    style=run.style,
                    seeds=seeds,
                    progress=None if self.options.quiet else partial(track, description=description),
                )
            motions.append(torch.stack([sample.vertices for sample in made]))
            styles[made[0].reference_name] = None
        return [*blend(motions, self.runs, self.model.frame_rate).numpy()], ", ".join(styles)

    def _by_windows(
        self, speech: npt.NDArray[np.float32], seeds: Sequence[int], folder: Path
    ) -> tuple[list[npt.NDArray[np.float32]], str]:
        """Memory maps (T, V, 3) of the samples, whose windows go to disk as they are made, and the style's name."""
        from facediff.animation.files import MotionWriter
        from facediff.utils.arrays import open_array

        stream = self.stream(seeds)
        progress = None if self.options.quiet else partial(track, description="seconds of speech")
        template = self.model.assets.template(self.identity)
        writers = [MotionWriter(folder / f"{seed}.npy", tuple(template.shape)) for seed in seeds]
        opened, done = self.openness(speech, self.model.frames_of(len(speech))), 0
        for part in stream.parts(speech, progress=progress):
            now = None if opened is None else opened[done : done + part.shape[1]]
            done += part.shape[1]
            for writer, motion in zip(writers, part, strict=True):
                writer.write(self.at_rest(motion.numpy(), now))
        for writer in writers:
            writer.close()
        return [open_array(writer.path) for writer in writers], ", ".join(stream.style_names)

    def _animation(
        self, motion: npt.NDArray[np.float32], speech: npt.NDArray[np.float32], name: str, seed: int, style: str
    ) -> Animation:
        from facediff.animation import Animation
        from facediff.version import __version__

        assets, sampler = self.model.assets, getattr(self.model, "sampler", None)
        trained_on = assets.identity_index(self.identity) >= 0
        metadata = {
            "generator": f"facediff {__version__}",
            "model": type(self.model).__name__,
            "checkpoint": valid_text(model_name(self.options.checkpoint)),
            "corpus": f"{assets.corpus} (synthetic)" if assets.synthetic else assets.corpus,
            **licence_metadata(self.model.licences),
            "identity": self.identity if trained_on else f"{self.identity} (not trained on)",
            "style": style,
            "seed": str(seed),
            "precision": "bfloat16 and float32" if self.options.precision == "bf16" else "float32",
        }
        if self.options.condition is not None:
            metadata["condition"] = self.options.condition
        if sampler is not None:
            metadata["sampler"] = f"{type(sampler).__name__}, {sampler.steps} steps"
        if self.rest is not None:
            metadata["voice gate"] = gate_text(self.options)
        if self.options.denoise:
            metadata["denoised"] = "yes"
        if self.direction is not None:
            metadata["direction"] = self.direction.text()
        for option in ("expressivity", "guidance"):
            if (chosen := getattr(self.options, option)) is not None:
                metadata[option] = scales_text(chosen)
        facts = facts_of(assets, self.identity)
        return Animation(name=name, vertices=motion, speech=speech, metadata=metadata, **facts)


def read_scales(guidance: Scales | None) -> dict[str, float]:
    """Scales of guidance by condition; empty for None.

    Raises:
        FaceDiffError: if the text holds none, a condition comes twice, or a scale is out of range.

    Example:
        >>> read_scales("style=1.5,speech=1.2")
        {'style': 1.5, 'speech': 1.2}
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
                "expected each condition once with its scale, such as style=1.5,speech=1.2",
                ranges.shown(text),
            )
        scales[name.strip()] = ranges.GUIDANCE_SCALE.read(f"--guidance {name.strip()}", number.strip())
    return scales


def direction_for(direction: DirectionLike, recording: Path, *, streamed: bool = False) -> DirectionLike:
    """The keys over time of one recording, where a folder has a file for each.

    Raises:
        FaceDiffError: if the folder has none for this recording.
    """
    folder = keys_file(direction)
    if folder is None or not folder.is_dir():
        return direction
    from facediff.editing.direction import direction_file

    file = None if streamed else direction_file(folder, recording)
    if file is None:
        raise OptionError(
            "direction", f"has no {recording.stem}.json or {recording.stem}.csv; give the file's name", folder
        )
    return file


def read_recording(path: Path, max_seconds: float | None = None) -> npt.NDArray[np.float32]:
    """Speech (S,) at 16 kHz.

    Args:
        path: wav, flac, ogg, mp3 or a video.
        max_seconds: longest speech allowed.

    Raises:
        FaceDiffError: if the file cannot be read, or lasts too short or too long.
    """
    from facediff.speech.audio import read_speech

    speech = read_speech(path, max_seconds=max_seconds)
    check_speech(speech, str(path))
    return speech


def check_speech(speech: npt.NDArray[np.float32], name: str) -> None:
    """Refuse speech (S,) at 16 kHz that animates nothing; silence animates a face at rest.

    Raises:
        FaceDiffError: naming ``name``, if it lasts too short.
    """
    from facediff.speech.audio import SAMPLE_RATE

    seconds = len(speech) / SAMPLE_RATE
    if seconds < MIN_SECONDS:
        raise FaceDiffError(f"{name}: lasts {seconds:.2f} s; expected speech of at least {MIN_SECONDS} s")


def facts_of(assets: Assets, identity: str | None = None) -> dict[str, Any]:
    """A checkpoint's assets as :class:`facediff.animation.Animation` takes them.

    The neutral face is that of ``identity``, the first one trained on if None.
    """
    import numpy as np

    def array(value: object, kind: type) -> object:
        return None if value is None else np.asarray(value, kind)

    return {
        "template": array(assets.template(identity or assets.identities[0]), np.float32),
        "faces": array(assets.faces, np.int32),
        "frame_rate": assets.frame_rate,
        "unit": assets.unit,
        "colours": array(assets.colours, np.uint8),
        "regions": {name: np.asarray(indices, np.int64) for name, indices in assets.regions.items()},
        "inner_lip_pairs": array(assets.inner_lip_pairs, np.int64),
    }


def on_processor(device: str) -> bool:
    """Whether a device is the processor, of which every process has a share."""
    import torch

    return device == "cpu" or (device == "auto" and not torch.cuda.is_available())


def usable_device(name: str) -> str:
    """The device's name; ``auto`` is a CUDA device where there is one, and the processor elsewhere."""
    import torch

    if name == "auto":
        name = "cpu" if on_processor(name) else "cuda"
    try:
        # Memory is allocated and read back, which devices that exist in name only cannot do (meta).
        float(torch.ones(1, device=torch.device(name)).sum())
    except Exception as error:  # each backend raises its own, down to NotImplementedError and ImportError
        reason = next(iter(str(error).splitlines()), "")[:200]
        raise OptionError("device", f"not usable on this machine ({reason}); try {{device}} cpu", name) from error
    return name
