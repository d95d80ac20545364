"""Motion of an exported model: its graphs, and the sampler's table of coefficients, run with NumPy."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.errors import OptionError
from facediff.runtime.graphs import ExportedGraphs
from facediff.runtime.noise import NormalStream, NumpyWindowNoise, stream_of
from facediff.speech.windows import MotionWindow

Array = npt.NDArray[np.float32]

NAME = "speech"
"""Name of a clip where its noise is drawn, as :meth:`facediff.models.inference.Inference.animate` names it."""

Draw = Callable[[int, int], Array]
"""Unit noise (1, frames, width) for a number of frames and a width."""


@dataclass(frozen=True)
class RuntimeChoices:
    """Who moves and how: the keywords of :meth:`RuntimeModel.animate` and :meth:`RuntimeModel.stream`.

    Attributes:
        identity: face and identity; the first one trained on if None.
        condition: the training identity that the model is conditioned on, if it differs from the face's.
        style: as :func:`~facediff.runtime.styles.style_from` takes it; the face's own if None.
        seed: seed of the noise; equal seeds give the motion of PyTorch's processor.
        expressivity: from the mean prediction (0) to a sample (1) and beyond (2); the folder's if None.
    """

    identity: str | None = None
    condition: str | None = None
    style: Any = None
    seed: int = 0
    expressivity: float | None = None


@dataclass(frozen=True)
class RuntimeConditions:
    """Conditions of the motion other than speech."""

    identity: int
    style: Array
    style_name: str
    template: Array
    choices: RuntimeChoices
    clip: str = NAME  # for which the noise is drawn


@dataclass(frozen=True)
class WindowSpeech:
    """Speech of a clip or a window."""

    samples: Array  # (S,) at 16 kHz
    frames: int
    mean: float  # of all speech so far
    deviation: float


def clip_motion(model: ExportedGraphs, speech: WindowSpeech, conditions: RuntimeConditions) -> Array:
    """Offsets from the template (1, frames, points, dims) of a whole clip."""
    about = model.description
    features = features_of(model, speech, own_frame_count(model, speech))
    if about.generation == "direct":
        motion = model.run("motion", {"features": features, **conditioned(features, conditions)})[0]
    elif about.noise_of == "seed":
        noise = NormalStream(conditions.choices.seed)  # such a model predicts no mean, so there is no other noise
        motion = SamplerRun(model, conditions, None, 0).run(features, noise, noise)
    else:
        name, seed = conditions.clip, conditions.choices.seed
        noises = stream_of(name, seed), stream_of(f"{name}/mean", 0)
        motion = SamplerRun(model, conditions, None, 0).run(features, *noises)
    if motion.shape[1] == speech.frames:
        return motion
    # A model that counts its frames by itself may give fewer than the speech lasts: its last one is held.
    return motion[:, np.minimum(np.arange(speech.frames), motion.shape[1] - 1)]


def window_motion(
    model: ExportedGraphs,
    speech: WindowSpeech,
    window: MotionWindow,
    conditions: RuntimeConditions,
    before: Sequence[Array] | None,
) -> tuple[Array, list[Array]]:
    """Offsets of a window of long speech, which continues another, and the tail that the next one blends with.

    Args:
        model: the model.
        speech: of the window, with some before and after it.
        window: which of its frames are generated.
        conditions: what motion is conditioned on.
        before: the tail of the window before; None for the first.
    """
    if model.description.blending == "motion":
        motion = clip_motion(model, speech, conditions)[:, window.encoded][:, window.fixed : window.frames]
        if before is not None:
            shared = before[0].shape[1]
            blended = before[0] + crossfade(shared, 0)[:, None, None] * (motion[:, :shared] - before[0])
            motion = np.concatenate([blended, motion[:, shared:]], 1)
        return motion, [motion[:, max(0, motion.shape[1] - window.plan.overlap) :]]
    features = np.take(features_of(model, speech, speech.frames), window.encoded, axis=1)
    new, last = slice(window.fixed, window.frames), slice(max(0, window.frames - window.kept), window.frames)
    sampling = SamplerRun(model, conditions, before, window.shared, new)
    noise = NumpyWindowNoise(conditions.clip, window, conditions.choices.seed)
    motion = sampling.run(features, noise, NumpyWindowNoise(f"{conditions.clip}/mean", window, 0))
    return motion, [tail[:, last] for tail in sampling.kept]


def own_frame_count(model: ExportedGraphs, speech: WindowSpeech) -> int:
    """How many frames the model gives for speech, at least 1; its own number where it counts by itself."""
    frames = speech.frames if model.clock.rule == "rounded" else max(1, model.clock.frames(len(speech.samples)))
    longest, rate, name = model.description.longest, model.frame_rate, model.description.model
    if longest and frames > longest:
        raise OptionError.naming(
            f"speech: {frames / rate:.1f} s are {frames} frames, and {name} was made for {longest} at most "
            f"({longest / rate:g} s); animate it in windows ({{window}} 4)"
        )
    return frames


def features_of(model: ExportedGraphs, speech: WindowSpeech, frames: int) -> Array:
    """Speech to features (1, frames, …)."""
    return model.run(
        "speech",
        {
            "audio": speech.samples[None],
            "mean": np.array([speech.mean], np.float32),
            "deviation": np.array([speech.deviation], np.float32),
            "samples": np.array([len(speech.samples)], np.int64),
            "mask": np.ones((1, frames), bool),
        },
    )[0]


def conditioned(features: Array, conditions: RuntimeConditions) -> dict[str, npt.NDArray[Any]]:
    """Inputs shared by all graphs after the first; a graph ignores those it does not declare."""
    return {
        "mask": np.ones((1, features.shape[1]), bool),
        "identity": np.array([conditions.identity], np.int64),
        "style": conditions.style[None],
        "template": conditions.template[None],
    }


def crossfade(shared: int, fixed: int) -> Array:
    """The new window's share in each shared frame: the rule of :func:`facediff.models.inference.crossfaded`."""
    # 0 up to the first frame that may change, smooth at both ends.
    progress = np.maximum(np.arange(shared, dtype=np.float32) - fixed, 0) / np.float32(max(1, shared - fixed))
    return np.asarray(progress * progress * (3 - 2 * progress), np.float32)


class SamplerRun:
    """One run of the sampler, of a clip or of a window that continues another.

    Args:
        model: the model.
        conditions: what motion is conditioned on.
        before: tail of the window before, one array for each evaluation of the network; None for nothing.
        shared: frames that this window shares with it.
        new: the frames that are wanted; those before them are given out already.
    """

    def __init__(
        self,
        model: ExportedGraphs,
        conditions: RuntimeConditions,
        before: Sequence[Array] | None,
        shared: int,
        new: slice = slice(0, None),  # noqa: B008 - it cannot be changed
    ) -> None:
        self.model = model
        self.conditions = conditions
        self.before = before
        self.shared = shared
        self.new = new
        self.kept: list[Array] = []  # the tail for the next window, one array for each evaluation

    def run(self, features: Array, noise: Draw, of_mean: Draw) -> Array:
        """Offsets from the template (1, frames, points, dims), but for those frames that are given out already."""
        about, share = self.model.description, self.conditions.choices.expressivity
        frames, width = features.shape[1], about.drawn or about.state
        mean = None
        if share != 1:
            # As the model's own mean: the prediction at the last step, averaged over a noise and its negative.
            unit = of_mean(frames, width)
            ends = [
                self._decoded(self._evaluate(features, self._start(signed_noise), about.last_step), signed_noise)
                for signed_noise in (unit, -unit)
            ]
            mean = (ends[0] + ends[1]) * np.float32(0.5)
            if share == 0:
                return mean
        unit = noise(frames, width)
        motion = self._decoded(self._loop(features, self._start(unit), noise), unit)
        return motion if mean is None else np.asarray(mean + np.float32(share) * (motion - mean), np.float32)

    def _loop(self, features: Array, noisy: Array, noise: Draw) -> tuple[Array, Array]:
        """The sampler's result, and the tail of the last step."""
        about = self.model.description
        latest: list[Array] = []
        tail, first = noisy, None
        for step, row in self.model.loop:
            of_noisy, *of_latest, of_noise, of_first = [*row, 0.0][:6]
            prediction, tail = self._evaluate(features, noisy, step)
            latest = [prediction, *latest][:3]
            first = prediction if first is None else first
            updated = np.float32(of_noisy) * noisy
            for factor, earlier in [*zip(of_latest, latest, strict=False), (of_first, first)]:
                if factor:
                    updated = updated + np.float32(factor) * earlier
            if of_noise:
                updated = updated + np.float32(of_noise) * self._coloured(noise(features.shape[1], about.state))
            noisy = updated
        return noisy, tail

    def _evaluate(self, features: Array, noisy: Array, step: int) -> tuple[Array, Array]:
        """The network's prediction at a step, blended with the window before's."""
        frames, about = features.shape[1], self.model.description
        before, share = np.zeros((1, frames, about.kept), np.float32), np.ones((1, frames), np.float32)
        if self.before is not None:
            before[:, : self.shared] = self.before[len(self.kept)]
            share[:, : self.shared] = crossfade(self.shared, self.new.start)
        prediction, tail = self.model.run(
            "step",
            {
                "features": features,
                **conditioned(features, self.conditions),
                "state": noisy,
                "step": np.array([step], np.int64),
                "before": before,
                "share": share,
            },
        )
        self.kept.append(tail)
        return prediction, tail

    def _decoded(self, result: tuple[Array, Array], unit: Array) -> Array:
        sample, tail = result
        last = tail if self.model.description.decoded == "kept" else sample
        return self.model.run("motion", {"sample": last[:, self.new], "noise": unit[:, self.new]})[0]

    def _start(self, unit: Array) -> Array:
        """The noisy motion that the loop starts from."""
        if "start" in self.model.description.graphs:
            return self.model.run("start", {"noise": unit})[0]
        return self._coloured(unit)

    def _coloured(self, unit: Array) -> Array:
        root = self.model.arrays.get("noise")
        return unit if root is None else unit @ root
