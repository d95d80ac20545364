"""The parts of a model as computation graphs that run without PyTorch, for the ONNX format.

Every exported model has a graph ``speech``, which encodes speech, and a graph ``motion``, which gives vertices. A model
that generates all frames in one pass (``direct``) has nothing else. One that samples has ``step`` between them, which
predicts clean motion from noisy motion once; the loop over the steps is a table of numbers (:func:`update_table`),
since every linear sampler is one. The loop is left out of the graphs on purpose: recording ten steps one after the
other takes ten times as long, and the file would hold the network ten times. Constants go along as plain
numbers.

Here is what all models share; each method has its own graphs next to its network.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Generic, Literal, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from facediff.data import Batch
from facediff.errors import FaceDiffError
from facediff.models.audio_encoders import Lengths, Waves
from facediff.models.checkpoint_content import CheckpointContent
from facediff.models.layers import of_frames
from facediff.models.samplers import Sampler
from facediff.registry import name_of
from facediff.speech.windows import FrameClock

Axes = dict[int, str]
"""Which axes of an input have any length: ``batch``, ``samples``, ``frames``."""

BATCH: Axes = {0: "batch"}
FRAMES: Axes = {0: "batch", 1: "frames"}

StyleSource = Literal["reference", "identity", "none"]
"""Kind of style: a vector of a reference motion, a training identity, or nothing that the model knows."""

Blending = Literal["steps", "motion"]
"""Where overlapping windows of long speech are blended: in every denoising step, or in the motion."""

NoiseOf = Literal["clip", "seed"]
"""What noise depends on: the clip's name and the seed, or the seed alone."""


@dataclass(frozen=True)
class Graph:
    """One part of a model, ready to be exported.

    Attributes:
        name: of its file.
        module: computes it.
        inputs: example values by name, in the order of the module's arguments.
        axes: of each input, which axes may be of any length.
        outputs: names of the results.
    """

    name: str
    module: nn.Module
    inputs: dict[str, Tensor]
    axes: dict[str, Axes]
    outputs: tuple[str, ...]


@dataclass(frozen=True)
class SamplingLoop:
    """The loop over the graph ``step``.

    Attributes:
        state: numbers in a frame of noisy motion.
        drawn: numbers in a frame of the unit noise that the loop starts from.
        kept: numbers in a frame of the graph's second result.
        sampler: its name.
        steps: the diffusion steps that are visited.
        table: for each of them, the numbers of :func:`update_table`.
        last_step: the step at which only the mean is left; −1 where the model predicts none.
        decoded: input of the last graph: the ``sample``, or the ``kept`` numbers of the last step.
        noise: what unit noise is multiplied by before use, (state, state); None for nothing.
        noise_of: what noise depends on.
        quick_steps: the steps that are visited at low latency; see
            :meth:`~facediff.models.inference.Inference.choose_low_latency`.
        quick_table: for each of them, as in ``table``.
    """

    state: int
    drawn: int
    kept: int
    sampler: str
    steps: list[int]
    table: list[list[float]]
    last_step: int
    decoded: Literal["sample", "kept"]
    noise: Float[Tensor, "state state"] | None
    noise_of: NoiseOf
    quick_steps: list[int] = field(default_factory=list)
    quick_table: list[list[float]] = field(default_factory=list)


NO_LOOP = SamplingLoop(0, 0, 0, "", [], [], -1, "sample", None, "clip")
"""The loop of a model that has none."""


@dataclass(frozen=True)
class Graphs:
    """A whole model as graphs and numbers.

    Attributes:
        parts: the graphs.
        equal_lengths: whether all clips of a batch must be of one length, since a part of the model knows no padding;
            reference motions of a batch always must.
        blending: how windows of long speech are joined.
        clock: how the model counts its frames.
        style: kind of style.
        epsilon: added to the variance of speech before it is standardised.
        longest: frames at most in one pass; 0 for any number.
        sampling: of a model that samples.
    """

    parts: list[Graph]
    equal_lengths: bool
    blending: Blending
    clock: FrameClock
    style: StyleSource
    epsilon: float = 1e-7
    longest: int = 0
    sampling: SamplingLoop | None = None


def update_table(sampler: Sampler) -> list[list[float]]:
    """The updates of a linear sampler as numbers.

    For each step: the factors of the noisy motion, of the latest prediction and the two before it, and of new noise,
    which is 0 where none is drawn. A last row may have one number more, the factor of the first prediction.

    Example:
        >>> from facediff.models.samplers import DdimSampler, NoiseProcess
        >>> update_table(DdimSampler(process=NoiseProcess(), steps=4))[-1]
        [0.0, 1.0, 0.0, 0.0, 0.0]
    """
    name = name_of(type(sampler))
    if not sampler.linear:
        raise FaceDiffError(
            f"sampler: {name} is no fixed linear combination; choose ddim, ddpm or dpm_solver, or set linear = True "
            "in its class if it is one"
        )
    zero, one = torch.zeros((), dtype=torch.float64), torch.ones((), dtype=torch.float64)
    table = []
    for i in range(sampler.steps):
        count = min(i + 1, sampler.memory)
        row = []
        # A linear function is determined by its values at the unit vectors.
        for column in range(5):
            noisy, *predictions = (one if column == unit else zero for unit in range(4))
            random_part = one if column == 4 else zero
            latest = predictions[:count][::-1]
            row.append(float(sampler.update(i, noisy, latest, lambda like, random_part=random_part: random_part)))  # type: ignore[misc]
        table.append(row)
    if sampler.spread != 1 and sampler.steps > 1:
        table[0][0] *= sampler.spread
        table[-1] = [sampler.spread * factor for factor in table[-1]] + [0.0]
        # The first prediction is among the latest three of two or three steps.
        table[-1][sampler.steps if sampler.steps <= 3 else 5] += 1 - sampler.spread
        table[-1] = table[-1][: 5 if sampler.steps <= 3 else 6]
    return table


@dataclass(frozen=True)
class Speech:
    """The speech of a batch.

    Attributes:
        audio: at 16 kHz, padded.
        audio_lengths: valid samples of each clip.
        cached_features: of the encoder's frozen part; a graph has none.
    """

    audio: Waves
    audio_lengths: Lengths
    cached_features: None = None


SpeechInput = Batch | Speech
"""Where speech is found."""

SpeechEncoding = Callable[[Speech, Int[Tensor, " batch"], int], Tensor]
"""Features of speech for a number of frames of each clip, and the largest of these numbers."""


ModelType = TypeVar("ModelType")


class ModelPart(nn.Module, Generic[ModelType]):
    """A part of a model as a module by itself, to become a graph."""

    def __init__(self, model: ModelType) -> None:
        super().__init__()
        self.model = model


class SpeechGraph(ModelPart[CheckpointContent]):
    """Speech to one feature per frame of motion."""

    def __init__(self, model: CheckpointContent, encode: SpeechEncoding, steps_of: Callable[[int], int]) -> None:
        super().__init__(model)
        self.encode = encode
        self.steps_of = steps_of

    def forward(
        self,
        audio: Float[Tensor, "batch samples"],
        mean: Float[Tensor, " batch"],
        deviation: Float[Tensor, " batch"],
        samples: Int[Tensor, " batch"],
        mask: Bool[Tensor, "batch frames"],
    ) -> Float[Tensor, "batch frames *width"]:
        """Encode.

        Args:
            audio: at 16 kHz, padded.
            mean: of each clip, by which it is standardised.
            deviation: of each clip, by which it is divided.
            samples: valid ones of each clip.
            mask: True on each clip's frames of motion.
        """
        level = self.model.speech_encoder.at_level(mean[:, None], deviation[:, None])
        with level, of_frames(self.steps_of(mask.shape[1])):
            return self.encode(Speech(audio, samples), mask.sum(1), mask.shape[1])


def speech_graph(
    model: CheckpointContent, encode: SpeechEncoding, steps_of: Callable[[int], int] = lambda frames: frames
) -> Graph:
    """The graph of the audio encoder; see :class:`SpeechGraph` for the arguments."""
    batch, samples = 2, 32_000
    frames = model.clock.frames(samples)
    return Graph(
        "speech",
        SpeechGraph(model, encode, steps_of),
        {
            "audio": torch.randn(batch, samples, generator=torch.Generator().manual_seed(0)),
            "mean": torch.zeros(batch),
            "deviation": torch.ones(batch),
            "samples": torch.full((batch,), samples),
            "mask": torch.ones(batch, frames, dtype=torch.bool),
        },
        {
            "audio": {0: "batch", 1: "samples"},
            **dict.fromkeys(("mean", "deviation", "samples"), BATCH),
            "mask": FRAMES,
        },
        ("features",),
    )


class StyleGraph(ModelPart[CheckpointContent]):
    """Reference motion to a style vector."""

    def forward(
        self, motion: Float[Tensor, "batch frames points dims"], mask: Bool[Tensor, "batch frames"]
    ) -> Float[Tensor, "batch style_dim"]:
        """Encode offsets from the template."""
        with of_frames(mask.shape[1]):
            return self.model.encode_style(motion, mask)


def style_graphs(model: CheckpointContent, width: int) -> list[Graph]:
    """The graph that takes a style from motion, if styles have any width."""
    batch, frames = 2, 50
    motion = torch.randn(batch, frames, model.n_vertices, model.dims, generator=torch.Generator().manual_seed(0))
    inputs = {"motion": motion, "mask": torch.ones(batch, frames, dtype=torch.bool)}
    graph = Graph("style", StyleGraph(model), inputs, dict.fromkeys(inputs, FRAMES), ("style",))
    return [graph] if width else []


def results_of(graph: Graph) -> Any:  # noqa: ANN401 - a tensor, or a tuple of them
    """A graph's results for its example values; values that follow from weights alone become constants of it."""
    with torch.no_grad():
        return graph.module.eval()(*graph.inputs.values())
