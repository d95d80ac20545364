"""An exported model at work: the path from samples to motion, of files and streams, with NumPy and ONNX Runtime.

The motion of a clip or of a window is generated in ``sampling.py``; pauses, controls and files are handled for every
model by :mod:`facediff.pipelines`, so that most programs want :func:`facediff.load` instead.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import numpy.typing as npt

from facediff.animation import Animation
from facediff.animation.animation import WITHOUT_FACE
from facediff.errors import FaceDiffError, OptionError, check_known, refuse_idle
from facediff.runtime.folder import Arrays, Description, decoder_of
from facediff.runtime.graphs import ExportedGraphs
from facediff.runtime.sampling import NAME, RuntimeChoices, RuntimeConditions, WindowSpeech, clip_motion, window_motion
from facediff.runtime.styles import RuntimeStyle, encode_style, style_from
from facediff.speech.audio import samples_for
from facediff.speech.windows import LOW_LATENCY, LOW_LATENCY_AHEAD, MotionWindow, SpeechWindows, WindowPlan
from facediff.utils.hints import mismatch
from facediff.utils.ranges import Expressivity, Seed
from facediff.version import __version__

if TYPE_CHECKING:
    import onnxruntime  # type: ignore[import-untyped]

    from facediff.spaces.decoding import ChannelDecoder

Array = npt.NDArray[np.float32]


class RuntimeModel(ExportedGraphs):
    """A model that ``facediff export-model`` wrote; :meth:`open` reads its folder.

    Attributes:
        windows: how long speech is cut; may be changed at any time.
    """

    def __init__(
        self, description: Description, arrays: Arrays, load: Callable[[str], onnxruntime.InferenceSession]
    ) -> None:
        super().__init__(description, arrays, load)
        self.windows = description.plan

    def choose_low_latency(self) -> None:
        """Animate frame by frame from now on, and in few denoising steps where the model samples."""
        self.windows = LOW_LATENCY_AHEAD if self.description.blending == "steps" else LOW_LATENCY
        if quick := self.description.quick_steps:
            self.loop = list(zip(quick, self.description.quick_table, strict=True))

    def animate(self, audio: Array, *, name: str = NAME, **choices: Any) -> Animation:  # noqa: ANN401
        """Animate a face with speech, as the model moves it: also in pauses.

        Of a model of channels the vertices are decoded by the folder's rig, and the head as a whole stays where it is.

        Args:
            audio: speech (S,) at 16 kHz.
            name: of the animation.
            choices: fields of :class:`~facediff.runtime.sampling.RuntimeChoices`: who moves, in which style.
        """
        stream = self.stream(**choices)
        return self.animation(self.motion(audio, stream), stream, audio, name)

    def motion(self, audio: Array, stream: RuntimeStream) -> Array:
        """Absolute points (T, points, dims) of a recording (S,): vertices, or the channels of the model's space.

        Args:
            audio: speech at 16 kHz.
            stream: at its beginning; it says who moves, and how.
        """
        return np.concatenate(list(self.parts(audio, stream)))

    def parts(
        self,
        audio: Array,
        stream: RuntimeStream,
        progress: Callable[[Iterable[int]], Iterable[int]] | None = None,
        frames: int | None = None,
    ) -> Iterator[Array]:
        """The same part by part: all of a short recording at once, a long one by windows.

        Args:
            audio: speech at 16 kHz.
            stream: at its beginning; it says who moves, and how.
            progress: wraps the iteration over the seconds of a long recording.
            frames: of the motion, where they are known.
        """
        audio = np.ascontiguousarray(audio, np.float32)
        frames = self.clock.frames(len(audio)) if frames is None else frames
        if frames < 1:
            raise FaceDiffError(f"the speech is shorter than one frame ({1 / self.frame_rate:.3f} s); give more of it")
        if not self.windows.in_one_pass(frames, self.frame_rate):
            yield from stream.parts(audio, frames=frames, progress=progress)
            return
        length = samples_for(frames, self.frame_rate) if self.clock.rule == "rounded" else len(audio)
        samples = np.pad(audio[:length], (0, max(0, length - len(audio))))
        # In the precision of the model, which standardises in float32.
        mean = samples.mean(dtype=np.float32)
        deviation = np.sqrt(np.square(samples - mean).mean(dtype=np.float32) + np.float32(self.description.epsilon))
        speech = WindowSpeech(samples, frames, float(mean), float(deviation))
        yield stream.joined([clip_motion(self, speech, stream.conditions)])

    def stream(self, *, plan: WindowPlan | None = None, **choices: Any) -> RuntimeStream:  # noqa: ANN401
        """Animate speech of any length while it arrives.

        Args:
            plan: how speech is cut; shorter windows give frames sooner. :attr:`windows` if None.
            choices: as :meth:`animate` takes them.
        """
        face, conditions = self._face(RuntimeChoices(**choices))
        return RuntimeStream(self, face, conditions, plan or self.windows)

    def decoder(self, face: int) -> ChannelDecoder | None:
        """What turns channels into the vertices of a face, by its place; None for a model of vertices."""
        return decoder_of(self.description, self.arrays, face)

    def still(self, stream: RuntimeStream) -> Animation:
        """A stream's face at rest, one frame, with everything that animations of it have in common."""
        return self.animation(stream.conditions.template[None], stream, None, "face")

    def animation(self, points: Array, stream: RuntimeStream, audio: Array | None, name: str) -> Animation:
        """Points (T, points, dims) of a stream's face with everything that exporters need."""
        about, arrays, conditions = self.description, self.arrays, stream.conditions
        face = about.faces[stream.face]
        regions = {
            key.removeprefix("region_"): value.astype(np.int64)
            for key, value in arrays.items()
            if key.startswith("region_")
        }
        metadata = {
            "generator": f"facediff {__version__}",
            "model": f"{about.model}, exported in {about.precision}",
            "corpus": f"{about.corpus} (synthetic)" if about.synthetic else about.corpus,
            **about.licences,
            "identity": face if face in about.known else f"{face} (not trained on)",
            **({} if (condition := conditions.choices.condition) is None else {"condition": condition}),
            **({} if about.style_source == "none" else {"style": conditions.style_name}),
        }
        if about.generation == "sampled":
            metadata |= {"seed": str(conditions.choices.seed), "sampler": f"{about.sampler}, {len(self.loop)} steps"}
        if conditions.choices.expressivity != 1:
            metadata["expressivity"] = f"{conditions.choices.expressivity:g}"
        decoder = self.decoder(stream.face)
        # Without a rig, a folder has a point for each channel, and no triangles.
        if decoder is not None and decoder.space.kind != "arkit" and "faces" not in arrays:
            metadata["face"] = WITHOUT_FACE
        optional = {key: arrays[key] for key in ("faces", "colours", "inner_lip_pairs") if key in arrays}
        if "colours" in optional and optional["colours"].ndim == 3:
            optional["colours"] = optional["colours"][stream.face]
        animation = Animation(
            name=name,
            vertices=np.ascontiguousarray(points if decoder is None else decoder.vertices(points), np.float32),
            template=arrays["templates"][stream.face],
            frame_rate=about.frame_rate,
            unit=about.unit,
            speech=audio,
            regions=regions,
            metadata=metadata,
            **cast(Any, optional),
        )
        if decoder is None:
            return animation
        return animation.made_of(decoder.space, decoder.values(points), decoder.deltas)

    def _face(self, choice: RuntimeChoices) -> tuple[int, RuntimeConditions]:
        """The face's place among the templates, and the conditions of its motion."""
        about, style = self.description, choice.style
        choice = replace(choice, expressivity=about.usual_expressivity) if choice.expressivity is None else choice
        identity = about.known[0] if choice.identity is None else choice.identity
        check_known("{identity}", "identity", [identity], about.faces)
        if choice.condition is not None:
            check_known("{condition}", "trained identity", [choice.condition], about.identities)
        conditioned_on = identity if choice.condition is None else choice.condition
        vector = RuntimeStyle(conditioned_on, np.zeros(0, np.float32))
        if about.style_source == "reference":
            vector = style_from(identity if style is None else style, self, identity)
            if vector.vector.shape != self.arrays["styles"].shape[1:]:
                raise OptionError("style", f"{vector.name} is of another model; encode it with this one")
        elif style is not None:
            # The model's identities are its styles, if it has any: the one that it is conditioned on is the style.
            refuse_idle(f"{about.model} knows no speaking styles", style=about.style_source == "none")
            check_known("{style}", "style", [str(style)], about.styles)
            conditioned_on = str(style)
            vector = RuntimeStyle(conditioned_on, vector.vector)
        for option, value, kind in (("seed", choice.seed, Seed), ("expressivity", choice.expressivity, Expressivity)):
            if (expected := mismatch(kind, value)) is not None:
                raise OptionError(option, f"out of range; expected {expected}", value)
        if about.last_step < 0:
            refuse_idle(f"{about.model} predicts no mean of its motion", expressivity=choice.expressivity != 1)
        face = about.faces.index(identity)
        index = about.identities.index(conditioned_on) if conditioned_on in about.identities else -1
        vertices = about.motion_space.is_vertices
        resting = self.arrays["templates"][face] if vertices else self.arrays["resting"][face][:, None]
        return face, RuntimeConditions(index, vector.vector, vector.name, resting.astype(np.float32), choice)

    def encode_style(self, motion: Array, *, name: str = "reference") -> RuntimeStyle:
        """The style of a reference motion.

        Args:
            motion: offsets (T, V, 3) from the speaker's neutral face, in the model's unit and at its frame rate; of a
                model of channels, (T, C, 1) from their values at rest.
            name: of the style.

        Example:
            >>> style = model.encode_style(animation.vertices - animation.template)  # doctest: +SKIP
            >>> model.animate(samples, identity="F1", style=style)  # doctest: +SKIP
        """
        return encode_style(self, motion, name)


class RuntimeStream(SpeechWindows[Array]):
    """Animates speech that arrives in pieces; see :class:`~facediff.speech.windows.SpeechWindows`.

    :meth:`feed` and :meth:`finish` give absolute points (frames, points, dims), as the model moves them: vertices, or
    the channels of its space.
    """

    def __init__(self, model: RuntimeModel, face: int, conditions: RuntimeConditions, plan: WindowPlan) -> None:
        super().__init__(plan.in_frames(model.frame_rate), model.frame_rate)
        self.model = model
        self.face = face
        self.conditions = conditions
        self._tail: list[Array] | None = None

    def generate(self, window: MotionWindow, speech: Array, frames: int, mean: float, deviation: float) -> Array:
        """Offsets (1, frames, points, dims) of a window, which continues the window before it."""
        window_speech = WindowSpeech(speech, frames, mean, deviation)
        motion, self._tail = window_motion(self.model, window_speech, window, self.conditions, self._tail)
        return motion

    def joined(self, parts: Sequence[Array]) -> Array:
        """Offsets (1, frames, points, dims) of consecutive frames as absolute points (frames, points, dims)."""
        template = self.conditions.template
        offsets = np.concatenate([np.zeros((1, 0, *template.shape), np.float32), *parts], 1)
        return np.asarray(offsets[0] + template, np.float32)
