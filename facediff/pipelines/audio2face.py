"""A folder of Audio2Face-3D as a pipeline: vertices, weights of face and tongue, and how jaw and eyes turn."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import numpy.typing as npt

from facediff.animation.options import AnimationOptions
from facediff.editing.regularised_weights import Regularisation, RegularisedSolver, pairs_of
from facediff.errors import FaceDiffError, OptionError, refuse_idle
from facediff.pipelines.animate import AnimationPipeline
from facediff.pipelines.exported import FIXED
from facediff.pipelines.stages import Stage, Take
from facediff.runtime.audio2face import LICENCE, Array, Audio2Face, FaceAnimator
from facediff.spaces import Rotation, Space
from facediff.spaces.arkit import ARKIT
from facediff.spaces.operations import with_apples_mouth
from facediff.spaces.rotations import convert
from facediff.speech.voice_activity import OFF
from facediff.speech.windows import WindowPlan
from facediff.utils import SAMPLE_RATE
from facediff.utils.hints import Range
from facediff.utils.licences import Licence, licence_metadata, require_cleared

if TYPE_CHECKING:
    from facediff.animation import Animation

FRAME_RATE = 30.0
"""Frames a second by default; any rate will do."""

UNIT = "cm"

Part = Literal["skin", "tongue"]


def solve_weights(model: Audio2Face, part: Part, vertices: Array) -> Array:
    """NVIDIA's weights (T, K) of the folder's blendshapes, in the order of ``model.folder.poses[part].names``."""
    poses = model.folder.poses.get(part)
    if poses is None:
        raise FaceDiffError(f"{model.folder.network.parent}: has no blendshapes of the {part}; get the whole folder")
    settings = poses.settings
    strengths = (settings.l1, settings.l2, settings.temporal, settings.symmetry, settings.template_size)
    solver = RegularisedSolver(
        poses.neutral,
        poses.deltas,
        mask=poses.mask,
        regularisation=Regularisation(*strengths),
        active=settings.active,
        symmetric=pairs_of(settings.symmetric),
        cancel=pairs_of(settings.cancel),
        multipliers=settings.multipliers,
        offsets=settings.offsets,
    )
    return solver.solve(np.asarray(vertices).reshape(len(vertices), -1, 3)).astype(np.float32)


class Audio2FacePipeline(AnimationPipeline):
    """Animates recordings with a folder of Audio2Face-3D."""

    def __init__(self, options: AnimationOptions, *, model: Audio2Face | None = None) -> None:
        refuse_fixed(options)
        frame_rate = options.frame_rate or FRAME_RATE
        self.model = Audio2Face.open(options.checkpoint, threads=options.threads) if model is None else model
        folder = self.model.folder
        self.actor = folder.facts.actor or "actor"
        self.corpus = f"Audio2Face-3D's {self.actor}"
        if options.commercial_only:
            require_cleared(options.checkpoint, licences_of(self.model))
        refuse_idle(
            f"the folder has one face, {self.actor}",
            identity=options.identity not in (None, self.actor),
            condition=options.condition not in (None, self.actor),
        )
        self.emotion = {} if options.style is None else emotions_of(options.style)
        self.model.emotion(self.emotion)  # refuses unknown emotions
        self._animated: list[dict[str, Array]] = []
        template = folder.arrays["skin"]
        super().__init__(
            options,
            face={
                "template": template,
                "faces": None if options.mesh is None else triangles_of(Path(options.mesh), len(template)),
                "frame_rate": float(frame_rate),
                "unit": UNIT,
                "regions": {"mask": folder.poses["skin"].mask} if "skin" in folder.poses else {},
            },
            windows=WindowPlan(),
            model="Audio2Face-3D",
            samples=False,
            usual_gate=OFF,
            rest_weights=lambda: FaceAnimator(folder, frame_rate).lower[:, 0].astype(np.float32),
        )
        self.channels = SolveChannels(self.with_channels) if self.has_weights else None

    @property
    def stream_timing(self) -> tuple[float, float]:
        """Seconds of a window after the moment of its frame, and of a frame: each has a window of its own."""
        facts = self.model.folder.facts
        return (facts.buffer - facts.before) / SAMPLE_RATE, 1 / self.frame_rate

    @property
    def has_weights(self) -> bool:
        """Whether the folder has blendshapes under ARKit's names."""
        poses = self.model.folder.poses
        return "skin" in poses and {*poses["skin"].names} <= {*ARKIT}

    def frames_of(self, samples: int) -> int:
        """How many frames there are for so many samples of speech."""
        return self.model.frames(samples, self.frame_rate)

    def generate(self, speech: Array, seeds: Sequence[int]) -> tuple[int, Iterator[Sequence[Array]]]:
        """Frames, and absolute vertices of the skin, a second after the other."""
        total = self.frames_of(len(speech))
        return total, self._seconds(speech, total)

    def _seconds(self, speech: Array, total: int) -> Iterator[Sequence[Array]]:
        animator, facts = FaceAnimator(self.model.folder, self.frame_rate), self.model.folder.facts
        part = max(1, round(self.frame_rate))
        self._animated = []
        for start in self.track(range(0, total, part), "seconds"):
            count = min(part, total - start)
            first = max(0, self.model.moment(start, self.frame_rate) - facts.before)
            last = self.model.moment(start + count, self.frame_rate) + facts.buffer
            result = self.model.infer(
                speech[first:last], self.frame_rate, self.emotion, start=start, frames=count, origin=first
            )
            animated = animator.animate(result)
            yield [animated.pop("skin_vertices")]
            self._animated.append(animated)

    def generator(self, seed: int) -> Audio2FaceStream:
        """The model at the beginning of a stream."""
        return Audio2FaceStream(self.model, self.frame_rate, self.emotion)

    def with_channels(self, animation: Animation) -> Animation:
        """With the weights of the face and the tongue, and how jaw and eyes turn."""
        animated = {name: np.concatenate([part[name] for part in self._animated]) for name in self._animated[0]}
        poses = self.model.folder.poses
        skin = solve_weights(self.model, "skin", animation.vertices)
        columns = {"skin": with_apples_mouth(skin, poses["skin"].names)}
        if "tongue" in poses:
            columns["tongue"] = solve_weights(self.model, "tongue", animated["tongue_vertices"])
        turned = convert(animated["jaw_transform"][:, :3, :2].swapaxes(1, 2).reshape(-1, 6), "six_d", "axis_angle")
        eyes = np.deg2rad(animated["eyes_rotation"])
        still = np.zeros((len(eyes), 1))
        moved = [turned, animated["jaw_transform"][:, :3, 3], eyes[:, [1, 0]], still, eyes[:, [3, 2]], still]
        values = np.concatenate([*columns.values(), *moved], axis=1)
        return animation.made_of(self.space(), np.ascontiguousarray(values, np.float32))

    def space(self) -> Space:
        """The channels: the folder's shapes, then the jaw's turn and shift and the eyes' turns, in radians and cm."""
        poses = self.model.folder.poses
        skin = poses["skin"].names
        tongue = (
            [f"tongue_{name}" if name in skin else name for name in poses["tongue"].names] if "tongue" in poses else []
        )
        jaw = [f"jaw_{axis}" for axis in "xyz"] + [f"jaw_shift_{axis}" for axis in "xyz"]
        eyes = [f"{side}_eye_{angle}" for side in ("right", "left") for angle in ("yaw", "pitch", "roll")]
        first = len(skin) + len(tongue)
        return Space(
            "arkit",
            (*skin, *tongue, *jaw, *eyes),
            version="arkit",
            rig=f"Audio2Face-3D {self.actor}",
            rotations=(
                Rotation("jaw", first, "axis_angle"),
                Rotation("right_eye", first + 6, "euler"),
                Rotation("left_eye", first + 9, "euler"),
            ),
        )

    def metadata(self, seed: int) -> dict[str, str]:
        """What an animation says of the model and its choices."""
        facts = self.model.folder.facts
        emotions = ",".join(f"{name}:{strength:g}" for name, strength in self.emotion.items())
        return {
            "model": f"Audio2Face-3D v2.3, {facts.actor}",
            **licence_metadata(licences_of(self.model)),
            "identity": self.actor,
            "style": emotions or "the usual emotion",
        }


class SolveChannels(Stage):
    """Channels of the vertices that were generated; :class:`~facediff.pipelines.stages.Direct` may change these."""

    def __init__(self, solve: Callable[[Animation], Animation]) -> None:
        self.solve = solve

    def whole(self, take: Take) -> None:
        """Solve for all frames at once."""
        for sample in take.samples:
            sample.settle(self.solve(sample.animation()))


class Audio2FaceStream:
    """Animates speech that arrives in pieces: a frame is certain once its window has been heard."""

    def __init__(self, model: Audio2Face, frame_rate: float, emotion: dict[str, float]) -> None:
        self.model, self.frame_rate, self.emotion = model, frame_rate, emotion
        self.frames = 0
        self._animator = FaceAnimator(model.folder, frame_rate)
        self._speech = np.zeros(0, np.float32)
        self._dropped = 0  # samples before these, which no window will hear again

    def feed(self, samples: Array) -> Array:
        """The frames (m, V, 3) that more speech (n,) at 16 kHz makes certain."""
        self._speech = np.concatenate([self._speech, np.asarray(samples, np.float32)])
        facts = self.model.folder.facts
        sample_count = self._dropped + len(self._speech)
        return self._next(self.model.frames(max(0, sample_count - (facts.buffer - facts.before) + 1), self.frame_rate))

    def finish(self) -> Array:
        """The frames (m, V, 3) that are left."""
        return self._next(self.model.frames(self._dropped + len(self._speech), self.frame_rate))

    def _next(self, total: int) -> Array:
        """Frames up to this one; then what no later window hears is forgotten."""
        count, facts = max(0, total - self.frames), self.model.folder.facts
        if not count:
            return np.zeros((0, facts.skin_vertices, 3), np.float32)
        result = self.model.infer(
            self._speech, self.frame_rate, self.emotion, start=self.frames, frames=count, origin=self._dropped
        )
        self.frames += count
        drop = max(0, self.model.moment(self.frames, self.frame_rate) - facts.before - self._dropped)
        self._speech, self._dropped = self._speech[drop:], self._dropped + min(drop, len(self._speech))
        return self._animator.animate(result)["skin_vertices"]


def refuse_fixed(options: AnimationOptions) -> None:
    """Refuse options that such a model does not have."""
    changed = [
        item[0] for item in options.changed().items() if item not in (("device", "auto"), ("low_latency", False))
    ]
    names = (*FIXED, "expressivity", "window", "overlap", "low_latency")
    reason = "has no meaning for Audio2Face-3D, whose frames have a window each"
    refuse_idle(reason, **{name: name in changed for name in names})


def triangles_of(path: Path, vertices: int) -> npt.NDArray[np.int32]:
    """The triangles of a mesh that must have so many vertices, in the folder's order."""
    from facediff.mesh import read_mesh

    mesh = read_mesh(path)
    if len(mesh.vertices) != vertices:
        raise OptionError(
            "mesh",
            f"has {len(mesh.vertices)} vertices and the folder's face {vertices}; expected the mesh that belongs to it",
            path,
        )
    return np.asarray(mesh.faces, np.int32)


def licences_of(model: Audio2Face) -> tuple[Licence, ...]:
    """The licence of the weights, for the actor of the folder."""
    return (replace(LICENCE, of=f"weights of Audio2Face-3D {model.folder.facts.actor}".strip()),)


def emotions_of(style: object) -> dict[str, float]:
    """Strengths by name.

    Example:
        >>> emotions_of("joy:0.7,pain:0.2"), emotions_of("anger"), emotions_of({"fear": 0.5})
        ({'joy': 0.7, 'pain': 0.2}, {'anger': 1.0}, {'fear': 0.5})
    """
    strengths: dict[str, float] = {}
    parts = [f"{name}:{weight}" for name, weight in style.items()] if isinstance(style, dict) else str(style).split(",")
    for part in parts:
        name, colon, number = part.partition(":")
        strengths[name.strip()] = Range(-10, 10).read(f"{{style}}: {name}", number.strip()) if colon else 1.0
    return strengths
