"""An exported model at work: the path from samples to vertices, of files and streams, with NumPy and ONNX Runtime.

What generates the motion of a clip or of a window is in ``sampling.py``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import numpy.typing as npt

from facediff.animation import Animation
from facediff.errors import FaceDiffError, OptionError, choices
from facediff.runtime.folder import Arrays, Description, read_folder
from facediff.runtime.sampling import NAME, RuntimeConditions, WindowSpeech, clip_motion, window_motion
from facediff.runtime.styles import RuntimeStyle, read_style
from facediff.speech.audio import samples_for
from facediff.speech.voice_activity import EnergyGate, Openness, VoiceGate, openness, toward_rest
from facediff.speech.windows import LOW_LATENCY, MotionWindow, SpeechWindows, WindowPlan
from facediff.utils import SAMPLE_RATE
from facediff.utils.ranges import Expressivity, Seed, mismatch
from facediff.version import __version__

if TYPE_CHECKING:
    import onnxruntime  # type: ignore[import-untyped]

Array = npt.NDArray[np.float32]


class RuntimeModel:
    """A model that ``facediff export-model`` wrote.

    Args:
        description: of the folder.
        arrays: likewise.
        load: opens a graph by its name.

    Attributes:
        description: what ``model.json`` says.
        clock: how the model counts its frames.
        windows: how long speech is cut; may be changed at any time.
        loop: each step with its row of the sampler's table.
    """

    def __init__(
        self, description: Description, arrays: Arrays, load: Callable[[str], onnxruntime.InferenceSession]
    ) -> None:
        self.description = description
        self.clock = description.frame_clock
        self.arrays = arrays
        self.windows = description.plan
        self.loop = list(zip(description.steps, description.table, strict=True))
        self._load = load
        # What encodes styles is opened where it is needed: most animations take a style by its name.
        self._sessions = {name: load(name) for name in description.graphs if name != "style"}

    @classmethod
    def open(cls, folder: str | Path, *, threads: int = 0, providers: Sequence[str] | None = None) -> RuntimeModel:
        """Read a folder of ``facediff export-model``.

        Args:
            folder: the folder.
            threads: of the processor; as many as it has cores if 0.
            providers: what computes, by ONNX Runtime's names; the processor if None.

        Raises:
            FaceDiffError: naming the file that is missing or damaged.
        """
        import onnxruntime

        folder = Path(folder)
        description, arrays = read_folder(folder)
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.log_severity_level = 3  # warnings are about optimisations that do not apply
        # Threads that wait by spinning take the processor from whatever else runs: where something does, a frame takes
        # twice as long.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")

        def load(name: str) -> onnxruntime.InferenceSession:
            path = folder / f"{name}.onnx"
            try:
                return onnxruntime.InferenceSession(
                    path, options, providers=list(providers or ["CPUExecutionProvider"])
                )
            except Exception as error:  # ONNX Runtime's own errors share no base class
                raise FaceDiffError(
                    f"{path}: ONNX Runtime cannot read it ({str(error)[:80]}); export the model again"
                ) from error

        return cls(description, arrays, load)

    def choose_low_latency(self) -> None:
        """Answer speech at once from now on: frame by frame, and in few denoising steps where the model samples."""
        self.windows = LOW_LATENCY
        if quick := self.description.quick_steps:
            self.loop = list(zip(quick, self.description.quick_table, strict=True))

    @property
    def frame_rate(self) -> float:
        """Motion frames a second."""
        return self.description.frame_rate

    def animate(
        self,
        audio: Array,
        *,
        identity: str | None = None,
        condition: str | None = None,
        style: str | RuntimeStyle | None = None,
        seed: int = 0,
        expressivity: float = 1.0,
        gate: VoiceGate | None = EnergyGate(),  # noqa: B008 - it cannot be changed
        name: str = NAME,
    ) -> Animation:
        """Animate a face with speech, as ``facediff animate`` does.

        Args:
            audio: speech (S,) at 16 kHz.
            identity: whose face and identity; the first one trained on if None.
            condition: the training identity that the model is conditioned on, where it is not that of the face.
            style: name of a style in the folder, a file or a mixture as ``--style`` takes them, or what
                :meth:`encode_style` gives; that of the face's identity if None.
            seed: seed of the noise; equal seeds give the motion of PyTorch's processor.
            expressivity: from the mean prediction (0) to a sample (1) and beyond (2).
            gate: brings the mouth to rest in pauses; None for no gate.
            name: of the animation.

        Raises:
            FaceDiffError: if a name is unknown, a number is out of range, or the speech is shorter than a frame.
        """
        face, conditions = self._face(identity, condition, style, seed, expressivity)
        audio = np.ascontiguousarray(audio, np.float32)
        if audio.ndim != 1 or not np.isfinite(audio).all():
            raise FaceDiffError(f"audio: is {audio.dtype} {audio.shape}; expected finite samples (S,) at 16 kHz")
        frames = self.clock.frames(len(audio))
        if frames < 1:
            raise FaceDiffError(f"the speech is shorter than one frame ({1 / self.frame_rate:.3f} s); give more of it")
        if self.windows.in_one_pass(frames, self.frame_rate):
            length = samples_for(frames, self.frame_rate) if self.clock.rule == "rounded" else len(audio)
            speech = np.pad(audio[:length], (0, max(0, length - len(audio))))
            # In the precision of the model, which standardises in float32.
            mean = speech.mean(dtype=np.float32)
            deviation = np.sqrt(np.square(speech - mean).mean(dtype=np.float32) + np.float32(self.description.epsilon))
            offsets = clip_motion(self, WindowSpeech(speech, frames, float(mean), float(deviation)), conditions)
        else:
            stream = RuntimeStream(self, face, conditions, self.windows)
            offsets = np.concatenate(list(stream.parts(audio, frames=frames)), 1)
        vertices = offsets[0] + self.arrays["templates"][face]
        if gate is not None:
            opened = openness(audio, len(vertices), self.frame_rate, gate)
            vertices = toward_rest(vertices, opened, self.arrays["templates"][face], self.arrays["rest_weights"][face])
        return self.animation(vertices, face, audio, name, conditions, gate)

    def stream(
        self,
        *,
        identity: str | None = None,
        condition: str | None = None,
        style: str | RuntimeStyle | None = None,
        seed: int = 0,
        expressivity: float = 1.0,
        plan: WindowPlan | None = None,
        gate: VoiceGate | None = EnergyGate(),  # noqa: B008 - it cannot be changed
    ) -> RuntimeStream:
        """Animate speech of any length while it arrives; the arguments are those of :meth:`animate`.

        Args:
            identity: as :meth:`animate` takes it.
            condition: as :meth:`animate` takes it.
            style: as :meth:`animate` takes it.
            seed: as :meth:`animate` takes it.
            expressivity: as :meth:`animate` takes it.
            plan: how speech is cut; shorter windows give frames sooner. :attr:`windows` if None.
            gate: as :meth:`animate` takes it.

        Raises:
            FaceDiffError: as :meth:`animate`.
        """
        face, conditions = self._face(identity, condition, style, seed, expressivity)
        return RuntimeStream(self, face, conditions, plan or self.windows, gate)

    def animation(
        self,
        vertices: Array,
        face: int,
        audio: Array | None,
        name: str,
        conditions: RuntimeConditions,
        gate: VoiceGate | None,
    ) -> Animation:
        """Vertices (T, V, 3) of a face with everything that exporters need."""
        about, arrays = self.description, self.arrays
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
            "identity": about.faces[face],
            **({} if about.style_source == "none" else {"style": conditions.style_name}),
            **({"seed": str(conditions.seed)} if about.generation == "sampled" else {}),
        }
        if about.generation == "sampled":
            metadata["sampler"] = f"{about.sampler}, {len(self.loop)} steps"
        if gate is not None:
            metadata["voice gate"] = "energy" if isinstance(gate, EnergyGate) else type(gate).__name__
        if conditions.expressivity != 1:
            metadata["expressivity"] = f"{conditions.expressivity:g}"
        optional = {key: arrays[key] for key in ("faces", "colours", "inner_lip_pairs") if key in arrays}
        return Animation(
            name=name,
            vertices=np.ascontiguousarray(vertices, np.float32),
            template=arrays["templates"][face],
            frame_rate=about.frame_rate,
            unit=about.unit,
            speech=audio,
            regions=regions,
            metadata=metadata,
            **cast(Any, optional),
        )

    def _face(
        self,
        identity: str | None,
        condition: str | None,
        style: str | RuntimeStyle | None,
        seed: int,
        expressivity: float,
    ) -> tuple[int, RuntimeConditions]:
        """The face's place among the templates, and what motion is conditioned on."""
        about = self.description
        chosen = identity if identity is not None else (about.identities or about.faces)[0]
        if chosen not in about.faces:
            raise FaceDiffError(f'identity: there is no "{chosen}": {choices(chosen, about.faces)}')
        if condition is not None and condition not in about.identities:
            raise FaceDiffError(
                f'condition: the model was not trained on "{condition}": {choices(condition, about.identities)}'
            )
        who = chosen if condition is None else condition
        found = RuntimeStyle(who, np.zeros(0, np.float32))
        if about.style_source == "reference":
            given = chosen if style is None else style
            found = read_style(given, self, chosen) if isinstance(given, str) else given
            if found.vector.shape != self.arrays["styles"].shape[1:]:
                raise FaceDiffError(f"style: {found.name} is of another model; encode it with this one")
        elif style is not None:
            # The model's identities are its styles, if it has any: the one that it is conditioned on is the style.
            if about.style_source == "none":
                raise FaceDiffError(f"style: {about.model} knows no speaking styles; omit the option")
            if style not in about.styles:
                raise FaceDiffError(f'style: there is no "{style}": {choices(str(style), about.styles)}')
            who = str(style)
            found = RuntimeStyle(who, found.vector)
        for option, value, kind in (("seed", seed, Seed), ("expressivity", expressivity, Expressivity)):
            if (expected := mismatch(kind, value)) is not None:
                raise FaceDiffError(f"{option} {value}: out of range; expected {expected}")
        if expressivity != 1 and about.last_step < 0:
            raise FaceDiffError(f"expressivity: {about.model} predicts no mean of its motion; omit the option")
        face = about.faces.index(chosen)
        index = about.identities.index(who) if who in about.identities else -1
        template = self.arrays["templates"][face].astype(np.float32)
        return face, RuntimeConditions(index, found.vector, found.name, template, seed, expressivity)

    def encode_style(self, motion: Array, *, name: str = "reference") -> RuntimeStyle:
        """The style of a reference motion.

        Args:
            motion: offsets (T, V, 3) from the speaker's neutral face, in the model's unit and at its frame rate.
            name: of the style.

        Raises:
            FaceDiffError: if the model takes no styles from motion, or the motion is of another topology.

        Example:
            >>> style = model.encode_style(animation.vertices - animation.template)  # doctest: +SKIP
            >>> model.animate(samples, identity="F1", style=style)  # doctest: +SKIP
        """
        if not self.has("style"):
            raise FaceDiffError(
                f"style: the folder has no style encoder, so {self.description.model} takes styles by name alone; "
                f"choose one of {', '.join(self.description.styles[:5])}, or export the model again"
            )
        motion, vertices = np.ascontiguousarray(motion, np.float32), self.arrays["templates"].shape[1]
        if motion.ndim != 3 or not len(motion) or motion.shape[1:] != (vertices, 3) or not np.isfinite(motion).all():
            raise FaceDiffError(f"style: is {motion.shape}; expected finite offsets (frames, {vertices}, 3)")
        inputs = {"motion": motion[None], "mask": np.ones((1, len(motion)), bool)}
        return RuntimeStyle(name, self.run("style", inputs)[0][0])

    def has(self, graph: str) -> bool:
        """Whether the folder has such a graph."""
        return graph in self.description.graphs

    def run(self, graph: str, inputs: Mapping[str, npt.NDArray[Any]]) -> list[Array]:
        """Results of a graph, which may have no use for some of the inputs."""
        if graph not in self._sessions:
            self._sessions[graph] = self._load(graph)
        session = self._sessions[graph]
        wanted = {each.name for each in session.get_inputs()}
        return cast(list[Array], session.run(None, {name: value for name, value in inputs.items() if name in wanted}))

    def own_frames(self, heard: WindowSpeech) -> int:
        """How many frames the model gives for speech, at least 1; its own number where it counts by itself."""
        frames = heard.frames if self.clock.rule == "rounded" else max(1, self.clock.frames(len(heard.speech)))
        longest = self.description.longest
        if longest and frames > longest:
            raise OptionError.naming(
                f"speech: {frames / self.frame_rate:.1f} s are {frames} frames, and {self.description.model} was made "
                f"for {longest} at most ({longest / self.frame_rate:g} s); animate it in windows ({{window}} 4)"
            )
        return frames

    def features(self, heard: WindowSpeech, frames: int) -> Array:
        """Speech to features (1, frames, …)."""
        return self.run(
            "speech",
            {
                "audio": heard.speech[None],
                "mean": np.array([heard.mean], np.float32),
                "deviation": np.array([heard.deviation], np.float32),
                "samples": np.array([len(heard.speech)], np.int64),
                "mask": np.ones((1, frames), bool),
            },
        )[0]


class RuntimeStream(SpeechWindows[Array]):
    """Animates speech that arrives in pieces; see :class:`~facediff.speech.windows.SpeechWindows`.

    :meth:`feed` and :meth:`finish` give offsets (1, frames, vertices, 3) from the template, before any gate.

    Args:
        model: the model.
        face: place of the face among the templates.
        conditions: what motion is conditioned on.
        plan: the windows.
        gate: kept for who writes the frames; see :meth:`openness`.

    Raises:
        FaceDiffError: if the plan does not fit the frame rate.
    """

    def __init__(
        self,
        model: RuntimeModel,
        face: int,
        conditions: RuntimeConditions,
        plan: WindowPlan,
        gate: VoiceGate | None = None,
    ) -> None:
        super().__init__(plan.in_frames(model.frame_rate), model.frame_rate)
        self.model = model
        self.face = face
        self.conditions = conditions
        self.gate = gate
        self._tail: list[Array] | None = None

    @property
    def heard(self) -> int:
        """Samples so far."""
        return self._heard

    def openness(self) -> Openness | None:
        """The gate's openness of this speech, which has not begun yet; None without a gate."""
        return None if self.gate is None else Openness(self.gate, self.model.frame_rate)

    def generate(self, window: MotionWindow, speech: Array, frames: int, mean: float, deviation: float) -> Array:
        """Motion of a window, which continues the window before it."""
        heard = WindowSpeech(speech, frames, mean, deviation)
        motion, self._tail = window_motion(self.model, heard, window, self.conditions, self._tail)
        return motion

    def joined(self, parts: Sequence[Array]) -> Array:
        """One array."""
        vertices = self.model.arrays["templates"].shape[1]
        return np.concatenate([np.zeros((1, 0, vertices, 3), np.float32), *parts], 1)


def real_time_factor(seconds: float, speech: Array) -> float:
    """Seconds of computing for each second of speech."""
    return seconds / max(len(speech) / SAMPLE_RATE, math.ulp(1.0))
