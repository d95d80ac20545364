"""Audio2Face-3D v2.3 (NVIDIA, 2025) without PyTorch: windows of speech to coefficients, and coefficients to a face.

The network sees half a second around each frame's moment, so that any frame rate may be asked for and frames do not
depend on one another; the stages after the network smooth them. docs/methods.md tells NVIDIA's method from additions.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError, check_known
from facediff.runtime.audio2face_folder import REMEDY, SAMPLE_RATE, Audio2FaceFolder, read_audio2face
from facediff.runtime.graphs import open_session, run_session
from facediff.utils.hints import check_number
from facediff.utils.licences import Licence
from facediff.utils.limits import FRAME_RATES, quoted

if TYPE_CHECKING:
    import onnxruntime  # type: ignore[import-untyped]

Array = npt.NDArray[np.float32]
Array64 = npt.NDArray[np.float64]

LICENCE = Licence(
    "weights",
    "NVIDIA Open Model License",
    "allowed",
    "huggingface.co/nvidia/Audio2Face-3D-v2.3-Mark",
)
"""The released models' licence; the data of the actor Claire are for evaluation only, which its owner says apart."""

SACCADE_RATE = 30
"""Rows a second of the stored saccades."""

AT_ONCE = 32
"""Windows that the network is given together where it takes several."""


class Audio2Face:
    """A model folder with its network, ready to run.

    Example:
        >>> model = Audio2Face.open("Audio2Face-3D-v2.3-Mark")  # doctest: +SKIP
        >>> result = model.infer(speech, 30, {"joy": 0.7})  # doctest: +SKIP
        >>> FaceAnimator(model.folder, 30).animate(result)["skin_vertices"].shape  # doctest: +SKIP
        (69, 61520, 3)
    """

    def __init__(self, folder: Audio2FaceFolder, session: onnxruntime.InferenceSession) -> None:
        self.folder, self._session = folder, session
        facts = folder.facts
        expected = {"input": facts.buffer, "emotion": facts.implicit + len(facts.emotions)}
        ends = {node.name: node.shape for node in session.get_inputs()}
        results = [node.name for node in session.get_outputs()]
        fits = ends.keys() == expected.keys() and "result" in results
        # A length that is open has a name in place of a number.
        if not fits or any(
            len(shape) != 3
            or any(isinstance(n, int) and n != size for n, size in zip(shape[1:], (1, expected[name]), strict=True))
            for name, shape in ends.items()
        ):
            raise FaceDiffError(
                f"{folder.network}: takes {quoted(ends)} and gives {quoted(results)}; expected input (B, 1, "
                f"{expected['input']}) and emotion (B, 1, {expected['emotion']}), and result; {REMEDY}"
            )
        self._batch = 1 if isinstance(ends["input"][0], int) else AT_ONCE
        self._result = results.index("result")

    @classmethod
    def open(cls, folder: str | Path, *, threads: int = 0) -> Audio2Face:
        """Read a folder as NVIDIA distributes it; ``threads`` of 0 are as many as the processor has cores."""
        content = read_audio2face(Path(folder))
        return cls(content, open_session(content.network, threads=threads))

    @staticmethod
    def frames(samples: int, frame_rate: float) -> int:
        """Frames with moments in so many samples: frame k is at k/frame_rate seconds."""
        return math.ceil(samples / step(frame_rate))

    @staticmethod
    def moment(frame: int, frame_rate: float) -> int:
        """The sample that a frame's window is about, rounded down; exact, so that no frame rate drifts."""
        return math.floor(frame * step(frame_rate))

    def emotion(self, strengths: Mapping[str, float] | None = None) -> Array:
        """The network's emotion (I + E,): the implicit one of the settings, then the explicit one.

        Args:
            strengths: of explicit emotions by name; of all others the model's usual ones.
        """
        names = self.folder.facts.emotions
        explicit = np.array(self.folder.facts.default_emotion, np.float32)
        check_known("emotion", "emotion", strengths or (), names)
        for name, strength in (strengths or {}).items():
            explicit[names.index(name)] = check_number("emotion", name, strength, -10, 10)
        return np.concatenate([self.folder.implicit, explicit])

    def infer(
        self,
        audio: Array,
        frame_rate: float,
        emotion: Mapping[str, float] | None = None,
        *,
        start: int = 0,
        frames: int | None = None,
        origin: int = 0,
    ) -> Array:
        """Results of the network for each frame.

        Args:
            audio: speech (S,) at 16 kHz, full scale 1, not normalised.
            frame_rate: frames a second.
            emotion: strengths by name.
            start: the first frame.
            frames: how many; all with moments in the speech if None.
            origin: the sample of the recording that ``audio`` begins with, where it is the rest of a longer one.

        Returns:
            (T, n): coefficients of skin and tongue, offsets of the jaw's points, angles of the eyes.
        """
        facts = self.folder.facts
        count = self.frames(len(audio), frame_rate) - start if frames is None else frames
        emotions = self.emotion(emotion)
        moments = [self.moment(start + frame, frame_rate) - origin for frame in range(count)]
        after = max(0, max(moments, default=0) + facts.buffer - facts.before - len(audio))
        padded = np.pad(audio.astype(np.float32), (facts.before, after))
        padded *= np.float32(self.folder.settings.input_strength)
        results = np.empty((count, facts.size), np.float32)
        for first in range(0, count, self._batch):
            rows = slice(first, min(first + self._batch, count))
            windows = np.stack([padded[at : at + facts.buffer] for at in moments[rows]])[:, None]
            inputs = {"input": windows, "emotion": np.tile(emotions, (len(windows), 1, 1))}
            result = run_session(self._session, inputs, str(self.folder.network))[self._result]
            if result.size != len(windows) * facts.size or result.dtype != np.float32 or not np.isfinite(result).all():
                raise FaceDiffError(
                    f"{self.folder.network}: gives {result.dtype} {result.shape}; expected {facts.size} finite numbers "
                    f"for each window, as network_info.json says; {REMEDY}"
                )
            results[rows] = result.reshape(len(windows), facts.size)
        return results


class FaceAnimator:
    """Makes a face of the network's results, frame after frame; it remembers the state of the smoothing.

    Attributes:
        lower: (V, 1) how far each vertex belongs to the lower face.
    """

    def __init__(self, folder: Audio2FaceFolder, frame_rate: float) -> None:
        self.folder, self.frame_rate = folder, float(frame_rate)
        arrays, settings = folder.arrays, folder.settings
        height = arrays["skin"][:, 1].astype(np.float64)
        share = (height - height.min()) / np.ptp(height)
        distance = (settings.face_mask_level - share) / settings.face_mask_softness
        with np.errstate(over="ignore"):  # far below the border, exp overflows to infinity, which gives the right 0
            self.lower = (1 / (1 + np.exp(-distance)))[:, None]
        self._parts = (
            (self.lower * settings.lower_face_strength, self._share(settings.lower_face_smoothing)),
            ((1 - self.lower) * settings.upper_face_strength, self._share(settings.upper_face_smoothing)),
        )
        lids, lips = np.float64(-settings.eyelid_open_offset), np.float64(settings.lip_open_offset)
        self._offset = arrays["eye_close"] * lids + arrays["lip_open"] * lips
        self._filters: list[list[Array64]] = []
        self._frame = 0

    def _share(self, smoothing: float) -> float:
        """The part of a difference that a filter takes over in a frame: half of it in ``smoothing`` seconds."""
        return 1 - 0.5 ** (1 / self.frame_rate / smoothing) if smoothing > 0 else 1.0

    def animate(self, result: Array) -> dict[str, Array]:
        """The next frames, of results (T, n) of the network.

        Returns:
            ``skin_vertices`` (T, V, 3), ``tongue_vertices`` (T, U, 3), ``jaw_transform`` (T, 4, 4) for column vectors,
            and ``eyes_rotation`` (T, 4): the angles x and y of the right eye, then of the left one.
        """
        facts, count = self.folder.facts, len(result)
        skin, tongue, jaw, eyes = np.split(result, np.cumsum([facts.skin, facts.tongue, facts.jaw]), axis=1)
        vertices = np.empty((count, facts.skin_vertices, 3), np.float32)
        for frame, coefficients in enumerate(skin):
            vertices[frame] = self._skin(coefficients)
        animated = {
            "skin_vertices": vertices,
            "tongue_vertices": self._tongue(tongue),
            "jaw_transform": np.array([self._jaw(row.reshape(-1, 3)) for row in jaw], np.float32).reshape(count, 4, 4),
            "eyes_rotation": self._eyes(eyes),
        }
        self._frame += count
        return animated

    def _skin(self, coefficients: Array) -> Array64:
        arrays = self.folder.arrays
        # The shapes are displacements; the mean that they were taken about is the face at rest, which is added last.
        delta = np.tensordot(coefficients, arrays["skin_shapes"], 1)
        pose = self.folder.settings.skin_strength * delta.astype(np.float64) + self._offset
        if not self._filters:
            self._filters = [[pose.copy(), pose.copy()] for _ in self._parts]
        total = arrays["skin"].astype(np.float64)
        for (mask, share), filters in zip(self._parts, self._filters, strict=True):
            followed = pose
            for state in filters:
                state += (followed - state) * share
                followed = state
            total += mask * followed
        return total

    def _tongue(self, coefficients: Array) -> Array:
        arrays, settings = self.folder.arrays, self.folder.settings
        delta = np.tensordot(coefficients.astype(np.float64), arrays["tongue_shapes"], 1)
        offset = np.array([0, settings.tongue_height_offset, settings.tongue_depth_offset])
        return np.asarray(arrays["tongue"] + delta * settings.tongue_strength + offset, np.float32)

    def _jaw(self, offsets: Array) -> Array:
        settings, rest = self.folder.settings, self.folder.arrays["jaw"].astype(np.float64)
        shift = np.array([0, settings.lower_teeth_height_offset, settings.lower_teeth_depth_offset])
        return rigid_transform(rest, rest + offsets * settings.lower_teeth_strength + shift).astype(np.float32)

    def _eyes(self, angles: Array) -> Array:
        settings, saccades = vars(self.folder.settings), self.folder.arrays["saccades"]
        # In exact arithmetic: NVIDIA adds up a clock in single precision, which at 25 frames a second is late by a row
        # wherever a moment of the saccades meets a frame.
        clock = step(self.frame_rate) * SACCADE_RATE / SAMPLE_RATE
        seed = Fraction(settings["eye_saccade_seed"])
        rows = [
            math.floor(seed + frame * clock) % len(saccades) for frame in range(self._frame, self._frame + len(angles))
        ]
        saccade_angles = np.tile(saccades[rows], (1, 2)) * np.float64(settings["saccade_strength"])
        offsets = np.array([settings[f"{side}_eye_rot_{axis}_offset"] for side in ("right", "left") for axis in "xy"])
        moved = settings["eyeballs_strength"] * angles.astype(np.float64)
        return np.asarray(offsets + moved + saccade_angles, np.float32)


def rigid_transform(rest: Array64, moved: Array64) -> Array64:
    """The 4 × 4 matrix of the rotation and shift that bring points (P, 3) nearest to others, in column vectors.

    Kabsch, "A solution for the best rotation to relate two sets of vectors", 1976.

    Example:
        >>> points = np.random.default_rng(0).normal(size=(5, 3))
        >>> bool(np.allclose(rigid_transform(points, points + [0, 1, 0])[:3, 3], [0, 1, 0]))
        True
    """
    start, end = rest.mean(0), moved.mean(0)
    left, _, right = np.linalg.svd((rest - start).T @ (moved - end))
    # A mirrored fit may be the nearest, but a jaw is not mirrored: the weakest axis is turned round then.
    mirrored = np.linalg.det(right.T @ left.T)
    rotation = right.T @ np.diag([1, 1, mirrored]) @ left.T
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = rotation, end - rotation @ start
    return transform


def step(frame_rate: float) -> Fraction:
    """Samples from one frame to the next, exactly; 30000/1001 frames a second are known as such.

    >>> step(30), step(30000 / 1001) == Fraction(16_000 * 1001, 30_000)
    (Fraction(1600, 3), True)
    """
    check_number("frame_rate", "the frame rate", frame_rate, *FRAME_RATES)
    return SAMPLE_RATE / Fraction(frame_rate).limit_denominator(1001)
