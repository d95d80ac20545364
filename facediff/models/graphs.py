"""The parts of a model as computation graphs that run without PyTorch, for the ONNX format.

A model is exported in three graphs, and what is constant goes along as plain numbers. ``speech`` is its audio encoder.
``step`` predicts clean motion from noisy motion once; the loop over the steps is a table of numbers
(:func:`update_table`), since every linear sampler is one. ``motion`` turns the result into vertices. The loop is left
out of the graphs on purpose: recording ten steps one after the other takes ten times as long, and the file would hold
the network ten times.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from facediff.errors import FaceDiffError
from facediff.models.dual_path.network import Conditions
from facediff.models.folding import unchanged
from facediff.models.layers import of_frames

if TYPE_CHECKING:
    from facediff.models.audio_encoders import AudioEncoder
    from facediff.models.dual_path.model import DualPathDiffusion
    from facediff.models.samplers import Sampler

Axes = dict[int, str]
"""Which axes of an input have any length: ``batch``, ``samples``, ``frames``."""


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
class Graphs:
    """A whole model as graphs and numbers.

    Attributes:
        parts: the graphs.
        epsilon: added to the variance of speech before it is standardised.
        equal_lengths: whether all clips of a batch must be of one length, since the audio encoder or the decoder knows
            no padding.
        state: numbers in a frame of noisy motion.
        kept: numbers in a frame of what windows of long speech are blended by.
        sampler: its name.
        steps: the diffusion steps that are visited.
        table: for each of them, the numbers of :func:`update_table`.
        last_step: the step at which only the mean is left.
        decoded: what the last graph decodes: the ``sample``, or the ``kept`` numbers of the last step.
        noise: what unit noise is multiplied by before use, (state, state); None for nothing.
    """

    parts: list[Graph]
    epsilon: float
    equal_lengths: bool
    state: int
    kept: int
    sampler: str
    steps: list[int]
    table: list[list[float]]
    last_step: int
    decoded: Literal["sample", "kept"]
    noise: Float[Tensor, "state state"] | None


def update_table(sampler: Sampler) -> list[list[float]]:
    """The updates of a linear sampler as numbers.

    For each step: the factors of the noisy motion, of the latest prediction and the two before it, and of new noise.
    The last one is 0 where no noise is drawn.

    Raises:
        FaceDiffError: if the sampler is not linear.

    Example:
        >>> from facediff.models.samplers import DdimSampler, NoiseProcess
        >>> update_table(DdimSampler(process=NoiseProcess(), steps=4))[-1]
        [0.0, 1.0, 0.0, 0.0, 0.0]
    """
    name = type(sampler).__name__
    if not sampler.linear:
        raise FaceDiffError(f"sampler: {name} is no fixed linear combination; choose ddim, ddpm or dpm_solver")
    zero, one = torch.zeros((), dtype=torch.float64), torch.ones((), dtype=torch.float64)
    table = []
    for i in range(sampler.steps):
        count = min(i + 1, sampler.memory)
        row = []
        # A linear function is known by what it makes of each unit vector.
        for place in range(5):
            noisy, *predictions = (one if place == unit else zero for unit in range(4))
            drawn = one if place == 4 else zero
            latest = predictions[:count][::-1]
            row.append(float(sampler.update(i, noisy, latest, lambda like, drawn=drawn: drawn)))  # type: ignore[misc]
        table.append(row)
    return table


class SpeechGraph(nn.Module):
    """Speech to one feature per frame of motion."""

    def __init__(self, encoder: AudioEncoder) -> None:
        super().__init__()
        self.encoder = encoder

    def forward(
        self,
        audio: Float[Tensor, "batch samples"],
        mean: Float[Tensor, " batch"],
        deviation: Float[Tensor, " batch"],
        samples: Int[Tensor, " batch"],
        mask: Bool[Tensor, "batch frames"],
    ) -> Float[Tensor, "batch frames dim"]:
        """Encode.

        Args:
            audio: at 16 kHz, padded.
            mean: of each clip, by which it is standardised.
            deviation: likewise.
            samples: valid ones of each clip.
            mask: True on each clip's frames of motion.
        """
        with self.encoder.at_level(mean[:, None], deviation[:, None]), of_frames(mask.shape[1]):
            features: Tensor = self.encoder(audio, samples, mask.sum(1))
        return features


class StepGraph(nn.Module):
    """Noisy motion to clean motion at one step, under speech, identity and style."""

    def __init__(self, model: DualPathDiffusion) -> None:
        super().__init__()
        self.model = model

    def forward(
        self,
        features: Float[Tensor, "batch frames dim"],
        mask: Bool[Tensor, "batch frames"],
        identity: Int[Tensor, " batch"],
        style: Float[Tensor, "batch style_dim"],
        state: Float[Tensor, "batch frames state"],
        step: Int[Tensor, " batch"],
        before: Float[Tensor, "batch frames kept"],
        share: Float[Tensor, "batch frames"],
    ) -> tuple[Tensor, Tensor]:
        """The prediction, and what the next window of long speech takes as ``before``.

        Args:
            features: of the speech.
            mask: True on valid frames.
            identity: indices, −1 for unknown.
            style: F_dyn.
            state: the noisy motion.
            step: counted from 0.
            before: what the window before kept, in the frames that this one shares with it.
            share: of this window in each frame, 1 where nothing is shared.
        """
        network, kept = self.model.network, list[Tensor]()
        tokens = network.style_tokens(torch.cat([network.identity_encoder(identity), style], dim=-1))

        def blend(now: Tensor) -> Tensor:
            kept.append(torch.lerp(before, now, share[..., None]))
            return kept[0]

        space = self.model._space(Conditions(features, tokens, mask), blend)  # noqa: SLF001 - a part of the model
        return space.denoise(state, step), kept[0]


class MotionGraph(nn.Module):
    """The end of sampling to offsets from the template."""

    def __init__(self, model: DualPathDiffusion, decoded: Literal["sample", "kept"]) -> None:
        super().__init__()
        self.model = model
        self.decoded = decoded

    def forward(self, sample: Float[Tensor, "batch frames width"]) -> Float[Tensor, "batch frames vertices 3"]:
        """In the unit of the corpus."""
        model = self.model
        scaled = model.network.clean_motion(sample) if self.decoded == "kept" else sample
        return model.motion_space.decode(scaled) / model.scale


BATCH: Axes = {0: "batch"}
FRAMES: Axes = {0: "batch", 1: "frames"}


def graphs_of(model: DualPathDiffusion) -> Graphs:
    """A dual-path model with its present sampler as graphs and numbers.

    Raises:
        FaceDiffError: if its sampler is not linear, or conditions are guided.
    """
    if [*model.views()] != [()]:
        raise FaceDiffError("guidance: a guided model cannot be exported; set all scales to 1")
    network, sampler = model.network, model.sampler
    table = update_table(sampler)
    preconditioned = model.motion_space.preconditioning is not None
    folded = model.sampling_space == "folded" and not preconditioned
    batch, frames, width = 2, 50, network.embed.in_features
    dim = network.embed.out_features
    state = dim if folded else width
    kept = width if preconditioned else dim
    speech = speech_graph(network.audio_encoder, model.frame_rate)
    style = sum(network.style_encoder.token_dims)
    mask = torch.ones(batch, frames, dtype=torch.bool)
    step = Graph(
        "step",
        StepGraph(model),
        {
            "features": torch.zeros(batch, frames, dim),
            "mask": mask,
            "identity": torch.zeros(batch, dtype=torch.long),
            "style": torch.zeros(batch, style),
            "state": torch.zeros(batch, frames, state),
            "step": torch.zeros(batch, dtype=torch.long),
            "before": torch.zeros(batch, frames, kept),
            "share": torch.ones(batch, frames),
        },
        {
            **dict.fromkeys(("features", "mask", "state", "before", "share"), FRAMES),
            **dict.fromkeys(("identity", "style", "step"), BATCH),
        },
        ("prediction", "kept"),
    )
    with torch.no_grad():
        step.module(*step.inputs.values())  # what follows from the weights alone is computed here, not in the graph
        root = None
        if folded:  # else noise is used as it is, and the unit matrix of all coordinates would take gigabytes
            space = model._space(_nothing(step.inputs), unchanged)  # noqa: SLF001 - a part of the model
            root = space.noise(torch.eye(state)[None])[0]
    decoded: Literal["sample", "kept"] = "kept" if folded else "sample"
    last = Graph(
        "motion",
        MotionGraph(model, decoded),
        {"sample": torch.zeros(batch, frames, kept if folded else state)},
        {"sample": FRAMES},
        ("offsets",),
    )
    return Graphs(
        parts=[speech, step, last],
        epsilon=1e-7,
        equal_lengths=not (network.audio_encoder.takes_padding and network.decoder.graph_takes_padding),
        state=state,
        kept=kept,
        sampler=type(sampler).__name__,
        steps=list(sampler.timesteps),
        table=table,
        last_step=model.process.steps - 1,
        decoded=decoded,
        noise=root,
    )


def speech_graph(encoder: AudioEncoder, frame_rate: float) -> Graph:
    """The graph of an audio encoder.

    Args:
        encoder: any.
        frame_rate: of the motion; example values only.
    """
    batch, seconds = 2, 2
    samples, frames = 16_000 * seconds, round(frame_rate * seconds)
    return Graph(
        "speech",
        SpeechGraph(encoder),
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


def _nothing(inputs: dict[str, Tensor]) -> Conditions:
    """Conditions of example values."""
    return Conditions(inputs["features"], inputs["features"][:, :1], inputs["mask"])
