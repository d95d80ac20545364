"""Scores of rendered frames by networks that users bring, such as lip-sync and lip-reading models, as graphs of ONNX.

facediff ships no weights. A render metric is a class that states size and part of its pictures and scores a clip with
its speech; it is registered with ``@facediff.registry.render_metric.register("name")``, and chosen by
``facediff evaluate --render name:option=value``. Files are read as those of exported models are: what a graph may cost
is checked before it is opened, and no code of a file is run.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Literal, cast

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError, located
from facediff.registry import render_metric
from facediff.render.rasteriser import Camera, Renderer, portrait
from facediff.runtime.graphs import open_session, run_session
from facediff.speech.audio import SAMPLE_RATE
from facediff.speech.cepstra import mel_filters

if TYPE_CHECKING:
    import onnxruntime  # type: ignore[import-untyped]

Frames = npt.NDArray[np.uint8]
Speech = npt.NDArray[np.float32]
Array = npt.NDArray[np.floating]


class RenderMetric(ABC):
    """Base of scores of rendered frames; a subclass defines :meth:`score`.

    Attributes:
        part: in the pictures: the ``face``, or the ``mouth`` and as much around it.
        size: height and width of the pictures.
    """

    part: Literal["face", "mouth"] = "face"
    size: tuple[int, int] = (224, 224)

    @abstractmethod
    def score(self, frames: Frames, speech: Speech, frame_rate: float) -> Mapping[str, float]:
        """Scores of one clip by name.

        Args:
            frames: pictures (T, H, W, 3), sRGB.
            speech: samples (S,) at 16 kHz, beginning with the first frame; empty if there is none.
            frame_rate: frames a second.
        """


@dataclass(frozen=True)
class RenderGraph:
    """A graph of ONNX, opened once it has been read."""

    path: Path

    @cached_property
    def session(self) -> onnxruntime.InferenceSession:
        """The graph, ready to run."""
        return open_session(self.path)

    @property
    def inputs(self) -> dict[str, list[int | str | None]]:
        """Shapes of the inputs by name."""
        return {end.name: list(end.shape) for end in self.session.get_inputs()}

    def run(self, inputs: Mapping[str, Array]) -> dict[str, Array]:
        """The outputs by name, finite, of inputs by name."""
        numbers = {name: np.ascontiguousarray(value, np.float32) for name, value in inputs.items()}
        results = run_session(self.session, numbers, str(self.path))
        outputs = dict(zip((end.name for end in self.session.get_outputs()), results, strict=True))
        for name, value in outputs.items():
            if value.dtype.kind != "f" or not value.size or not np.isfinite(value).all():
                raise FaceDiffError(
                    f"{self.path}: gives {value.dtype} {value.shape} as {name}; expected finite numbers"
                )
        return outputs


@render_metric.register("onnx")
class OnnxScores(RenderMetric):
    """Scores by an ONNX graph: the mean of each output is a score of the output's name.

    Its input ``frames`` is (1, T, H, W, 3) with colours from 0 to 1, H and W fixed; an input ``speech``, if it has one,
    is (1, S) at 16 kHz. Lip-reading scores and perceptual ones such as PLRS can be exported in this form.

    Args:
        graph: the file.
        part: ``face`` or ``mouth``.
    """

    def __init__(self, *, graph: str = "", part: Literal["face", "mouth"] = "face") -> None:
        self.graph = RenderGraph(Path(graph))
        self.part = part
        shape = self.graph.inputs.get("frames", [])
        if len(shape) != 5 or shape[4] != 3 or not self.graph.inputs.keys() <= {"frames", "speech"}:
            raise FaceDiffError(
                f"{graph}: has the inputs {self.graph.inputs}; expected frames (1, T, H, W, 3), and speech (1, S) if "
                f"it hears"
            )
        self.size = _size(graph, shape[2:4])

    def score(self, frames: Frames, speech: Speech, frame_rate: float) -> Mapping[str, float]:
        """The mean of each output."""
        inputs: dict[str, Array] = {"frames": frames[None] / np.float32(255)}
        if "speech" in self.graph.inputs:
            inputs["speech"] = speech_for(self.graph, speech)[None]
        outputs = self.graph.run(inputs)
        return {name: float(value.mean()) for name, value in outputs.items()}


@render_metric.register("sync")
class SyncScores(RenderMetric):
    """LSE-D and LSE-C: are mouth and sound in step by two encoders, as SyncNet's are?

    Each moment of the motion, 25 a second, gives a window of five mouth pictures (0.2 s, which it begins), and of the
    sound a mel spectrogram of the same 0.2 s. With d(o), the mean over moments of the Euclidean distance between the
    video's embedding and that of the sound o frames later, for o from −15 to 15: LSE-D is the least d, LSE-C the median
    of d less the least (Chung and Zisserman 2016; names of Prajwal et al. 2020), and ``offset`` where it lies. Windows
    without a partner are left out.

    ``video`` takes (N, 15, H, W), five pictures of three colours after one another, or (N, 3, 5, H, W), from 0 to 1;
    ``audio`` takes (N, 1, 80, 16): log mel of windows of 800 samples every 200, pre-emphasis 0.97, 55 to 7600 Hz on the
    Slaney scale, in decibels less 20, from −100 to 0 mapped to −4 to 4, which is Wav2Lip's. Scores of different
    encoders, and of renders and camera pictures, cannot be compared.

    Args:
        video: the graph of the video's encoder.
        audio: the graph of the sound's.
        order: of colours, ``bgr`` as OpenCV reads them, or ``rgb``.
        reach: largest offset, in frames.
    """

    part = "mouth"

    def __init__(
        self, *, video: str = "", audio: str = "", order: Literal["bgr", "rgb"] = "bgr", reach: int = 15
    ) -> None:
        self.video, self.audio = RenderGraph(Path(video)), RenderGraph(Path(audio))
        self.order, self.reach = order, reach
        ends = [list(graph.inputs.items()) for graph in (self.video, self.audio)]
        shapes = [end[0][1] if len(end) == 1 else [] for end in ends]
        self.flat = len(shapes[0]) == 4
        if shapes[0][1:-2] not in ([15], [3, 5]) or shapes[1][1:] != [1, 80, 16]:
            raise FaceDiffError(
                f"{video} and {audio}: have the inputs {shapes[0]} and {shapes[1]}; expected (N, 15, H, W) or "
                f"(N, 3, 5, H, W), and (N, 1, 80, 16)"
            )
        self.names = [end[0][0] for end in ends]
        self.size = _size(video, shapes[0][-2:])

    def score(self, frames: Frames, speech: Speech, frame_rate: float) -> Mapping[str, float]:
        """Both scores and the offset, of one clip."""
        speech_for(self.video, speech)
        indices = np.rint(np.arange(int(len(frames) / frame_rate * 25 + 1e-6)) * frame_rate / 25).astype(int)
        pictures = frames[indices.clip(0, len(frames) - 1)][..., :: -1 if self.order == "bgr" else 1]
        count = min(len(pictures) - 4, (len(speech) - SAMPLE_RATE // 5) // (SAMPLE_RATE // 25) + 1)
        if count < 2 * self.reach:
            raise FaceDiffError(f"a clip of {len(frames)} frames is too short for offsets of {self.reach} frames")
        windows = np.stack([pictures[start : start + 5] for start in range(count)]) / np.float32(255)
        # (N, 5, H, W, 3): colours within pictures, or pictures within colours.
        video = windows.transpose(0, 1, 4, 2, 3) if self.flat else windows.transpose(0, 4, 1, 2, 3)
        video = video.reshape(count, 15, *self.size) if self.flat else video
        mel = mel_spectrogram(speech)
        starts = [min(round(3.2 * start), mel.shape[1] - 16) for start in range(count)]
        sounds = np.stack([mel[None, :, start : start + 16] for start in starts])
        moving, sounding = self._embeddings(self.video, 0, video), self._embeddings(self.audio, 1, sounds)
        offsets = range(-self.reach, self.reach + 1)
        distances = []
        for offset in offsets:
            first, last = max(0, -offset), min(count, count - offset)
            gaps = moving[first:last] - sounding[first + offset : last + offset]
            distances.append(float(np.linalg.norm(gaps, axis=1).mean()))
        least = int(np.argmin(distances))
        return {
            "lse_d": distances[least],
            "lse_c": float(np.median(distances)) - distances[least],
            "offset": float(offsets[least]),
        }

    def _embeddings(self, graph: RenderGraph, which: int, windows: Array) -> Array:
        """Embeddings (N, D), a few windows at a time, or as many as the graph takes."""
        batch = graph.inputs[self.names[which]][0]
        step, count = batch if isinstance(batch, int) else 32, len(windows)
        if isinstance(batch, int):  # it takes neither more nor fewer: copies of the last window fill its last batch up
            windows = windows[np.minimum(np.arange(-(-count // step) * step), count - 1)]
        parts = [
            next(iter(graph.run({self.names[which]: windows[start : start + step]}).values()))
            for start in range(0, len(windows), step)
        ]
        return np.concatenate([part.reshape(len(part), -1) for part in parts])[:count].astype(np.float64)


def speech_for(graph: RenderGraph, speech: Speech) -> Speech:
    """The speech of a clip, which a graph needs."""
    if not len(speech):
        raise FaceDiffError(f"{graph.path}: reads speech, and the truth has no wav/ next to it")
    return speech


def mel_spectrogram(speech: Speech) -> Array:
    """Log mel (80, frames) of speech (S,) at 16 kHz, 80 frames a second, as :class:`SyncScores` says."""
    emphasised = np.append(speech[:1], speech[1:] - 0.97 * speech[:-1]).astype(np.float64)
    padded = np.pad(emphasised, 400, mode="reflect") if len(speech) > 400 else np.pad(emphasised, 400)
    count = max(16, len(speech) // 200 + 1)
    padded = np.pad(padded, (0, max(0, 200 * (count - 1) + 800 - len(padded))))
    windows = np.lib.stride_tricks.sliding_window_view(padded, 800)[::200][:count]
    hann = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(800) / 800)
    mel = mel_filters(80, 800, 55.0, 7600.0, scale="slaney").astype(np.float64) @ np.abs(np.fft.rfft(windows * hann)).T
    decibels = 20 * np.log10(np.maximum(mel, 1e-5)) - 20
    return np.asarray(np.clip(8 * (decibels + 100) / 100 - 4, -4, 4), np.float32)


def _size(path: str, dims: Sequence[int | str | None]) -> tuple[int, int]:
    if not all(isinstance(size, int) and size > 0 for size in dims):
        raise FaceDiffError(f"{path}: takes pictures of {dims[0]} × {dims[1]}; export it with a fixed height and width")
    height, width = cast(tuple[int, int], tuple(dims))
    return height, width


# Rendering and scoring clips.


def read_render_metrics(texts: Sequence[str]) -> dict[str, RenderMetric]:
    """Render metrics by ``NAME:option=value,…``, under these texts."""
    metrics: dict[str, RenderMetric] = {}
    for text in texts:
        name, options = render_metric.read(text)
        metrics[name if name not in metrics else text] = render_metric.get(name)(**options)
    return metrics


def framing(metric: RenderMetric, template: Array, regions: Mapping[str, Sequence[int]]) -> Camera:
    """The camera of a metric's pictures of a face (V, 3).

    The face is without shoulders, where its ``upper_face`` is known next to its ``lips``; the mouth is a region twice
    as wide as the lips, around their middle.
    """
    height, width = metric.size
    if metric.part == "face":
        return Camera.framing(portrait(template, dict(regions)), aspect=width / height)
    mouth = template[list(regions["lips"])]
    middle, half = (mouth.max(0) + mouth.min(0)) / 2, np.ptp(mouth, axis=0)
    half[1] = half[0] * height / width
    camera = Camera.framing(np.stack([middle - half, middle + half]), aspect=width / height, margin=0.0)
    # The camera draws within a radius: the head's, not the mouth's.
    return replace(camera, radius=Camera.framing(template).radius)


@dataclass(frozen=True, kw_only=True)
class RenderScorer:
    """Renders clips and scores them.

    Attributes:
        metrics: by name.
        faces: (F, 3) triangles.
        regions: vertices of the ``lips`` and, if known, of the ``upper_face``.
        frame_rate: frames a second.
        speech: gives the samples of a clip by its name; empty where there is none.
    """

    metrics: Mapping[str, RenderMetric]
    faces: npt.NDArray[np.integer]
    regions: Mapping[str, Sequence[int]]
    frame_rate: float
    speech: Callable[[str], Speech]

    def score(self, clip: str, vertices: Array, template: Array) -> dict[str, float]:
        """All scores of a clip, ``<metric>/<score>``.

        Args:
            clip: the truth's name, by which its speech is found.
            vertices: (T, V, 3) absolute.
            template: (V, 3) the face at rest, for the camera.
        """
        scores: dict[str, float] = {}
        pictures: dict[tuple[str, tuple[int, int]], Frames] = {}
        for name, metric in self.metrics.items():
            key = (metric.part, metric.size)
            if key not in pictures:
                camera = framing(metric, template, self.regions)
                renderer = Renderer(self.faces, template=template, size=metric.size, camera=camera)
                pictures[key] = np.stack([renderer.render(frame) for frame in vertices])
            speech = self.speech(clip)
            speech = speech[: int(len(vertices) / self.frame_rate * SAMPLE_RATE + 1e-6)]
            with located(f"--render {name}: {clip}"):
                values = metric.score(pictures[key], speech, self.frame_rate)
            scores |= {f"{name}/{score}": value for score, value in values.items()}
        return scores


def means(rows: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """The mean of each score over clips."""
    names = dict.fromkeys(name for row in rows for name in row)
    return {name: float(np.mean([row[name] for row in rows if name in row])) for name in names}
